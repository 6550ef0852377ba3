"""What rays off neighbours, tower and the mirror's own plate do to ranges that are taken for straight ones."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rfpose import geometry
from rfpose.checks import FloatArray
from rfpose.multilat.site import Common
from rfpose.pipeline.mirrors import MirrorGroup, mirror_groups
from rfpose.pipeline.site.field import ReceivingAntenna, SiteField, VerticalAntenna, antenna_of, foresight_of
from rfpose.pipeline.site.poses import wavenumbers_of
from rfpose.propagation import RayKind, Rays, bystanders, foresee
from rfpose.propagation.site import place_things
from rfpose.scenario import Scenario

__all__ = ["stray_ranges"]

ComplexArray = npt.NDArray[np.complex128]

_NOTHING_FOUND = Common(
    floor=0.0, tail=np.inf, factor_scale=np.ones(len(RayKind)), soil_change=0j, soil_sigma=(0.0, 0.0)
)


def stray_ranges(
    scenario: Scenario, rot_enu_from_mirror: FloatArray, tone_hz: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return by how much ranges are too long that were measured among reflections.

    Rays are those that pose ``site`` foresees, but for the ground's. A link whose straight ray is hidden is not
    measured rightly at all, and counts as without error here.

    Parameters
    ----------
    scenario
        With carriers above zero.
    rot_enu_from_mirror : (mirror, 3, 3)
        Of `Scenario.mirrors`, heliostats and plates.
    tone_hz : (group,)
        Tones; 0: the carrier [Hz].

    Returns
    -------
    (heliostat, group, receiver, transmitter), (calibration receiver, group, transmitter)
        [m].

    Raises
    ------
    ScenarioError, RecordingError
        A pattern of other receivers, missing or damaged.
    """
    dry = scenario.changed(multipath={"foresee": tuple(k for k in scenario.multipath.foresee if k != "ground")})
    antenna = antenna_of(dry)
    n_receiver = max(len(h.receiver_mirror_m) for h in dry.heliostat)
    mirrors = np.zeros((len(dry.heliostat), len(tone_hz), n_receiver, len(dry.transmitter)))
    for group in mirror_groups(dry):
        shift = _of_mirrors(dry, group, rot_enu_from_mirror, tone_hz, antenna)
        mirrors[group.column, :, : shift.shape[2]] = shift
    return mirrors, _of_calibration(dry, rot_enu_from_mirror, tone_hz)


def _of_mirrors(
    scenario: Scenario, group: MirrorGroup, rot: FloatArray, tone_hz: FloatArray, antenna: ReceivingAntenna
) -> FloatArray:
    """(heliostat, group, receiver, transmitter) [m]."""
    mine = rot[group.column]
    heard = SiteField(scenario, group, rot[None], antenna)(group.pivot_enu_m, mine, _NOTHING_FOUND)
    receiver = group.pivot_enu_m[:, None] + np.einsum("mab,mrb->mra", mine, group.places_m)
    shift = _shift_m(scenario, heard.rays, heard.voltage, receiver, mine, group.pivot_enu_m, tone_hz)
    return np.moveaxis(shift, 0, 1)


def _of_calibration(scenario: Scenario, rot: FloatArray, tone_hz: FloatArray) -> FloatArray:
    """(calibration receiver, group, transmitter) [m]."""
    place = scenario.calibration_enu_m
    if not len(place):
        return np.zeros((0, len(tone_hz), len(scenario.transmitter)))
    stand = bystanders(place)
    things = place_things(scenario, rot).surroundings
    rays = foresee(
        scenario.transmitter_enu_m, scenario.carrier_rf_hz, stand, things, foresight_of(scenario, own_plate=False)
    )
    upright = np.broadcast_to(np.eye(3), (len(place), 3, 3))
    towards = geometry.unit(rays.source_enu_m - place[_owner(rays, len(scenario.transmitter))])
    none = np.zeros(rays.n_ray, np.int64)
    voltage, _, _ = VerticalAntenna().receive(rays.field_enu, towards, np.eye(3), none, none)
    return np.moveaxis(_shift_m(scenario, rays, voltage, place[:, None], upright, place, tone_hz)[:, :, 0], 0, 1)


def _owner(rays: Rays, n_link: int) -> npt.NDArray[np.int64]:
    """(ray,) which mirror or bystander receives it."""
    return np.repeat(np.arange(len(rays.first) - 1) // n_link, np.diff(rays.first))


def _shift_m(
    scenario: Scenario,
    rays: Rays,
    voltage: ComplexArray,
    receiver_enu_m: FloatArray,
    rot: FloatArray,
    pivot_enu_m: FloatArray,
    tone_hz: FloatArray,
) -> FloatArray:
    """(group, mirror, receiver, transmitter) what the sum of rays adds to the straight one [m]."""
    n_mirror, n_receiver = receiver_enu_m.shape[:2]
    straight_m = np.linalg.norm(scenario.transmitter_enu_m - receiver_enu_m[:, :, None], axis=-1)
    n_transmitter = straight_m.shape[2]
    link = np.repeat(np.arange(straight_m.size), np.diff(rays.first))
    mirror = link // (n_receiver * n_transmitter)
    at = pivot_enu_m[mirror] + np.einsum("kab,kb->ka", rot[mirror], rays.place_mirror_m)
    detour_m = np.linalg.norm(rays.source_enu_m - at, axis=1) + rays.extra_m - straight_m.ravel()[link]
    k = wavenumbers_of(scenario)
    seen = np.zeros(straight_m.size, np.bool_)
    seen[link[rays.kind == RayKind.DIRECT]] = True

    def line(hz: float) -> ComplexArray:
        """Sum of the rays, the straight one's phase taken off."""
        kappa = 2.0 * np.pi * hz / scenario.radio.propagation_speed_mps
        out = np.zeros(straight_m.size, np.complex128)
        np.add.at(out, link, voltage * np.exp(-1j * (k[link % n_transmitter] + kappa) * detour_m))
        return out.reshape(n_mirror, n_receiver, n_transmitter)

    carrier, shifts = line(0.0), []
    direct = np.zeros(straight_m.size, np.complex128)
    np.add.at(direct, link, np.where(rays.kind == RayKind.DIRECT, voltage, 0.0))
    for hz in tone_hz:
        if hz == 0.0:
            shifts.append(-np.angle(carrier * direct.reshape(carrier.shape).conj()) / k)
            continue
        kappa = 2.0 * np.pi * hz / scenario.radio.propagation_speed_mps
        shifts.append(-np.angle(line(hz) * carrier.conj() + line(-hz).conj() * carrier) / kappa)
    return np.where(seen.reshape(carrier.shape), np.array(shifts), 0.0)
