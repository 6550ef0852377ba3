"""Rays foreseen against path tables of a ray tracer and responses by moments that this project did not make."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

from rfpose.propagation import Foresight, RayKind, foresee

ROOT = Path(__file__).resolve().parents[2]
TRACED = ROOT.parent / "shared" / "data" / "traced"

pytestmark = pytest.mark.skipif(not TRACED.is_dir(), reason=f"no traced paths in shared data ({TRACED.name} is absent)")


@pytest.fixture(scope="module")
def compared():
    """The benchmark that reads the tables and matches rays."""
    path = ROOT / "benchmarks" / "foreseen_rays.py"
    spec = importlib.util.spec_from_file_location("foreseen_rays", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules["foreseen_rays"] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules["foreseen_rays"]


def foreseen(compared, traced, **options):
    carrier = np.full(len(traced.transmitter_enu_m), traced.carrier_hz)
    wanted = Foresight(reach_m=1e3, faint=0.0, **options)
    return foresee(traced.transmitter_enu_m, carrier, traced.mirrors, traced.surroundings, wanted)


@pytest.mark.parametrize("place", ["front", "beside", "cal"])
@pytest.mark.parametrize(
    ("variant", "mhz", "sun"), [("ground", 433, 0), ("field", 100, 1), ("plates", 433, 0), ("plates", 433, 1)]
)
def test_reflected_and_hidden_rays_are_the_tracers(compared, variant, mhz, sun, place):
    traced = compared.read(TRACED, variant, mhz, sun, place)
    rays = foreseen(compared, traced, diffracted="none")
    partner, way = compared.matched(traced, rays)
    assert (partner >= 0).all()
    for kind in (RayKind.DIRECT, RayKind.GROUND, RayKind.SPECULAR):
        assert np.sum(rays.kind == kind) == np.sum(traced.kind == kind)
    # its rays are launched at random and miss some of a plate as small as the mirror's own: 16 of 191 at most here
    extra = np.sum(rays.kind == RayKind.OWN_PLATE) - np.sum(traced.kind == RayKind.OWN_PLATE)
    assert 0 <= extra <= 16
    np.testing.assert_allclose(way[partner], traced.length_m, atol=1e-9)
    size = np.linalg.norm(traced.field_enu, axis=1, keepdims=True)
    apart = np.linalg.norm(rays.field_enu[partner] - traced.field_enu, axis=1, keepdims=True) / size
    assert np.quantile(apart, 0.9) < 2e-3  # its directions are in single precision
    _, median = compared.phases_apart(traced, rays, partner)
    assert median < 1e-4


def test_diffracted_rays_have_the_tracers_places_and_with_its_coefficients_its_fields(compared):
    traced = compared.read(TRACED, "edges", 433, 1, "beside")
    rays = foreseen(compared, traced, wedge="sionna")
    partner, way = compared.matched(traced, rays)
    once = np.array([code.count("+") - code.count("ground") < 1 for code in traced.code])
    bent = np.array(["D:" in code for code in traced.code]) & once
    assert bent.sum() > 1500
    assert np.mean(partner[bent] >= 0) > 0.97  # the rest at the tower's foot
    both = np.flatnonzero(bent & (partner >= 0))
    np.testing.assert_allclose(way[partner[both]], traced.length_m[both], atol=2e-5)  # vertices in single precision
    apart = np.linalg.norm(rays.field_enu[partner[both]] - traced.field_enu[both], axis=1)
    relative = apart / np.linalg.norm(traced.field_enu[both], axis=1)
    assert np.median(relative) < 1e-4
    assert np.quantile(relative, 0.9) < 2e-3
    rms, _ = compared.phases_apart(traced, rays, partner[partner >= 0])
    assert rms < 0.02


@pytest.mark.parametrize("sun", [0, 1])
def test_rays_of_the_own_plate_explain_what_moments_have_for_it(compared, sun):
    left = {name: share for name, (share, _) in compared.own_plate_by_moments(TRACED, sun).items()}
    assert left["direct"] > 0.35
    assert left["and its reflection"] < 0.32
    # receivers a seventh of a wavelength before a plate of three: rays need not do better
    assert left["and its edges"] < 0.17
