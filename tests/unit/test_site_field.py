"""What a mirror's antennas would receive: where rays arrive from, and how voltages change as the mirror turns."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rfpose as rf
from rfpose import geometry
from rfpose.multilat.site import Common
from rfpose.pipeline.mirrors import mirror_groups
from rfpose.pipeline.site import SiteField, antenna_of
from rfpose.propagation import RayKind

COMMON = Common(floor=0.05, tail=3.0, factor_scale=np.ones(len(RayKind)), soil_change=0j, soil_sigma=(0.3, 0.1))
PATTERN = rf.shipped_scenario("table2_100m.toml").parent / "antenna_front_433MHz.h5"
FRONT = ((0.9988, 0.0, 0.1), (-0.4994, 0.865, 0.1), (-0.4994, -0.865, 0.1))


@pytest.fixture(scope="module")
def site():
    told = rf.load_scenario(rf.shipped_scenario("table2_100m.toml"))
    mirror = {"receiver_mirror_m": FRONT, "width_m": 2.0, "height_m": 2.0, "pivot_sigma_m": 0.005}
    return told.changed(
        heliostat=told.heliostat[:2],
        radio={"centre_frequency_hz": 433e6},
        reflection={"model": "fresnel", "permittivity": 12.0, "conductivity_s_per_m": 0.01},
    ).changed(heliostat=mirror)


def field_of(site, **antenna):
    told = site.changed(antenna=antenna) if antenna else site
    (group,) = mirror_groups(told)
    rot = geometry.rot_enu_from_mirror(geometry.unit([[0.2, 0.5, 1.0], [-0.4, 0.3, 1.0]]))
    return SiteField(told, group, rot[None], antenna_of(told)), group.pivot_enu_m, rot


def total(voltages, pivot, rot, wavenumber, n_receiver):
    """(mirror, receiver, transmitter) what arrives, by the formula of `Rays`."""
    rays = voltages.rays
    link = np.repeat(np.arange(len(rays.first) - 1), np.diff(rays.first))
    mirror, transmitter = link // (n_receiver * len(wavenumber)), link % len(wavenumber)
    at = pivot[mirror] + np.einsum("kab,kb->ka", rot[mirror], rays.place_mirror_m)
    path = np.linalg.norm(rays.source_enu_m - at, axis=1) + rays.extra_m
    out = np.zeros(len(rays.first) - 1, complex)
    np.add.at(out, link, voltages.voltage * np.exp(-1j * wavenumber[transmitter] * path))
    return out.reshape(len(pivot), n_receiver, -1)


def test_the_field_before_a_metal_plate_is_that_of_images(site):
    """Tangential field vanishes on metal: a dipole along the plate and its image cancel as it comes close."""
    near = site.changed(
        heliostat={"receiver_mirror_m": tuple((x, y, 1e-3) for x, y in ((0.5, 0.0), (-0.3, 0.4), (-0.3, -0.4)))},
        reflection={"model": "none", "permittivity": None, "conductivity_s_per_m": None},
        multipath={"foresee": ["own_plate"], "visibility": True},
        antenna={"receiver": "dipole", "axis_mirror": (0.0, 1.0, 0.0)},
    )
    field, pivot, rot = field_of(near)
    found = field(pivot, rot, COMMON)
    wavenumber = 2.0 * np.pi * near.carrier_rf_hz / near.radio.propagation_speed_mps
    h = total(found, pivot, rot, wavenumber, 3)
    direct = np.linalg.norm(near.transmitter_enu_m - pivot[:, None], axis=-1)
    before = np.einsum("mtx,mx->mt", near.transmitter_enu_m - pivot[:, None], rot[:, :, 2]) > 5.0
    both = np.bincount(np.repeat(np.arange(60), np.diff(found.rays.first)), minlength=60).reshape(2, 3, 10) >= 2
    lit = both & before[:, None]
    assert lit.sum() > 10
    # 2 k z cos(incidence) of the free field is left, and edges: a short way from cancelling
    assert np.median((np.abs(h) * direct[:, None])[lit]) < 0.1


@pytest.mark.parametrize("antenna", [{"receiver": "dipole"}, {"pattern": str(PATTERN)}], ids=["dipole", "pattern"])
def test_voltages_change_with_posture_as_their_slope_says(site, antenna):
    # a pattern holds two per cent beside its frequency: the carriers in the middle of the band
    near = sorted(site.transmitter, key=lambda t: abs(t.carrier_hz))[:4]
    told = site.with_transmitters(near).changed(multipath={"foresee": ["ground"]})
    field, pivot, rot = field_of(told, **antenna)
    here = field(pivot, rot, COMMON)
    step = 1e-4 * np.array([0.3, -0.7, 0.5])
    turned = Rotation.from_rotvec(step).as_matrix() @ rot
    there = field(pivot, turned, COMMON)
    assert there.rays.n_ray == here.rays.n_ray
    change = there.voltage - here.voltage
    expected = here.slope @ step
    scale = np.abs(here.voltage).max()
    # directions to the sources change, too, since receivers move; that is four orders smaller
    assert np.abs(change - expected).max() < 0.05 * np.abs(expected).max()
    assert np.abs(expected).max() > 1e-6 * scale


def test_the_grounds_slope_is_the_change_by_its_permittivity(site):
    field, pivot, rot = field_of(site)
    here = field(pivot, rot, COMMON)
    other = Common(
        floor=0.05, tail=3.0, factor_scale=np.ones(len(RayKind)), soil_change=0.01 + 0j, soil_sigma=(0.3, 0.1)
    )
    there = field(pivot, rot, other)
    assert there.rays.n_ray == here.rays.n_ray
    ground = (here.rays.kind == RayKind.GROUND) & (np.abs(here.voltage) > 1e-6)
    relative = there.voltage[ground] / here.voltage[ground] - 1.0
    np.testing.assert_allclose(relative, 0.01 * here.soil_slope[ground], rtol=0.01)
    assert np.abs(relative).max() > 1e-4
    assert np.abs(here.soil_slope[here.rays.kind == RayKind.DIRECT]).max() < 1e-9


def test_mirrors_of_which_nothing_is_wanted_get_no_rays(site):
    field, pivot, rot = field_of(site)
    unwanted = rot.copy()
    unwanted[0] = np.nan
    found = field(pivot, unwanted, COMMON)
    count = np.diff(found.rays.first).reshape(2, -1).sum(axis=1)
    assert count[0] == 0
    assert count[1] > 0
