"""`scripts/trace_sionna.py`: what it has standing where, exact lengths, and its rays where Sionna RT is installed."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

from raytables import image_table
from rfpose.geometry import rot_enu_from_mirror
from rfpose.scenario import parse_scenario

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "trace_sionna.py"
SITE = """
name = "small"
[site]
aim_enu_m = [0.0, 0.0, 50.0]
[[site.structures.box]]
id = "hut"
base_enu_m = [10.0, 20.0, 0.0]
size_m = [4.0, 2.0, 3.0]
azimuth_deg = 30.0
[[site.structures.plate]]
id = "N"
pivot_enu_m = [-30.0, 10.0, 2.0]
width_m = 3.0
height_m = 1.0
arm_m = 0.5
[radio]
sample_rate_hz = 1e6
centre_frequency_hz = 433e6
frame_samples = 256
[[tone]]
frequency_hz = 20e3
[[transmitter]]
id = "A"
position_enu_m = [100.0, 0.0, 20.0]
carrier_hz = -300e3
[[transmitter]]
id = "B"
position_enu_m = [-50.0, 86.6, 30.0]
carrier_hz = 50e3
[[heliostat]]
id = "H"
pivot_enu_m = [20.0, 5.0, 3.0]
receiver_mirror_m = [[1.0, 0.0, 0.1], [-0.5, 0.866, 0.1], [-0.5, -0.866, 0.1]]
width_m = 2.0
height_m = 2.0
[reflection]
model = "fresnel"
permittivity = 15.0
[simulation]
frame_count = 2
sun_azimuth_deg = [120.0, 200.0]
sun_elevation_deg = 40.0
"""


@pytest.fixture(scope="module")
def script():
    spec = importlib.util.spec_from_file_location("trace_sionna", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    sys.modules["trace_sionna"] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules["trace_sionna"]


@pytest.fixture
def site():
    return parse_scenario(SITE)


def test_things_stand_where_the_scenario_has_them(script, site):
    normals = np.array([[0.1, -0.2, 0.9], [-0.3, 0.2, 0.8]])
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    named = {what: [t.name for t in script.things_of(site, normals, what)] for what in script.WHAT}
    assert named == {
        "direct": [],
        "ground": ["ground"],
        "field": ["ground", "hut", "N"],
        "plates": ["ground", "hut", "H", "N"],
        "edges": ["ground", "hut", "H", "N"],
        "open": ["ground", "hut", "N"],
    }
    things = {thing.name: thing for thing in script.things_of(site, normals, "edges")}
    for name, pivot, normal, width, height, arm in (
        ("H", [20.0, 5.0, 3.0], normals[0], 2.0, 2.0, 0.0),
        ("N", [-30.0, 10.0, 2.0], normals[1], 3.0, 1.0, 0.5),
    ):
        flat = (things[name].vertices - pivot - arm * normal) @ rot_enu_from_mirror(normal)
        assert sorted(map(tuple, np.round(flat, 9) + 0.0)) == sorted(
            (a * width / 2, b * height / 2, 0.0) for a in (-1, 1) for b in (-1, 1)
        )
    hut = things["hut"]
    # its y side looks 30 degrees east of north
    x, y = np.array([np.cos(np.pi / 6), -0.5, 0.0]), np.array([0.5, np.cos(np.pi / 6), 0.0])
    off = hut.vertices - [10.0, 20.0, 0.0]
    assert {tuple(np.round([abs(v @ x), abs(v @ y)], 9)) for v in off} == {(2.0, 1.0)}
    assert sorted({round(float(v[2]), 9) for v in off}) == [script.BASE_M, 3.0]
    for point, normal in hut.faces:  # each of its five faces holds four of its corners
        assert np.sum(np.abs((hut.vertices - point) @ normal) < 1e-9) == 4


def test_lengths_of_reflected_rays_are_exact(script, site):
    """By images, though the points where they are reflected have single precision; a diffracted ray's is along them."""
    transmitter, receiver = np.array([100.0, 0.0, 20.0]), np.array([20.0, 5.0, 3.0])
    exact = float(np.linalg.norm(transmitter * [1, 1, -1] - receiver))
    share = transmitter[2] / (transmitter[2] + receiver[2])
    point = transmitter + share * (receiver * [1, 1, -1] - transmitter)
    ground = script.things_of(site, np.eye(3)[[2, 2]], "ground")[0].faces
    rough = (point + np.array([2e-3, -1e-3, 3e-6]))[None]
    assert script._length([1], [ground], rough, transmitter, receiver) == pytest.approx(exact, abs=1e-12)
    along = np.linalg.norm(rough[0] - transmitter) + np.linalg.norm(receiver - rough[0])
    assert script._length([8], [ground], rough, transmitter, receiver) == pytest.approx(along, abs=1e-12)


def test_traced_ground_is_that_of_images(script, site):
    pytest.importorskip("sionna", reason="Sionna RT is not installed")
    table = script.trace(site, 1, "ground")
    expected = image_table(list(site.receiver_ids), table["rx_enu_m"], table["tx_enu_m"], 433e6)
    order = np.lexsort((table["length_m"], table["tx"], table["rx"]))
    np.testing.assert_array_equal(table["code"][order], expected["code"])
    np.testing.assert_allclose(table["length_m"][order], expected["length_m"], atol=1e-9)
    direct = expected["code"] == ""
    got, wanted = table["a_theta"][order], expected["a_theta"]
    np.testing.assert_allclose(got[direct], wanted[direct], rtol=1e-5)
    # Fresnel's, of vertical polarisation; a lossless ground gets the least loss that makes the slab a half-space
    soil = 15.0 - 1j * script.LEAST_LOSS_S_PER_M * np.sqrt(15.0) / (2.0 * np.pi * 433e6 * 8.8541878e-12)
    sine = np.abs(np.cos(table["theta_r"][order][~direct]))
    root = np.sqrt(soil - 1.0 + sine**2)
    factor = (soil * sine - root) / (soil * sine + root)
    ratio = got[~direct] / wanted[~direct] * (-0.3 + 0.1j)
    np.testing.assert_allclose(ratio, factor, atol=2e-4)
