"""The simulator's truth, and what it refuses."""

import numpy as np
import pytest

from rfpose import geometry
from rfpose.errors import InvalidInputError, ScenarioError
from rfpose.scenario import parse_scenario
from rfpose.simulator import Simulator

SITE = """
name = "small"
{top}
[radio]
sample_rate_hz = 1e6
centre_frequency_hz = 100e6
frame_samples = 1000
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
{body}
[mirror]
receiver_mirror_m = [[1.0, 0.0, 0.0], [-0.5, 0.866, 0.0], [-0.5, -0.866, 0.1]]
arm_m = 0.3
[simulation]
{simulation}
"""
HELIOSTATS = """
[[calibration_receiver]]
id = "cal"
position_enu_m = [15.0, -20.0, 2.5]
[[heliostat]]
id = "H1"
pivot_enu_m = [20.0, 5.0, 3.0]
[[heliostat]]
id = "H2"
pivot_enu_m = [-20.0, 35.0, 3.0]
"""
AIM = "[site]\naim_enu_m = [0.0, 0.0, 50.0]"
SUN = "sun_azimuth_deg = [170.0, 190.0]\nsun_elevation_deg = 55.0\n"


def make(*, top=AIM, body=HELIOSTATS, simulation=SUN, seed=1):
    return Simulator(parse_scenario(SITE.format(top=top, body=body, simulation=simulation)), seed=seed)


def test_mirrors_send_the_sun_to_the_aim_point():
    truth = make(simulation=SUN + "frame_count = 3").truth
    assert truth.heliostat_ids == ("H1", "H2")
    assert truth.receiver_ids == ("H1_r0", "H1_r1", "H1_r2", "H2_r0", "H2_r1", "H2_r2", "cal")
    assert truth.transmitter_ids == ("A", "B")
    sun = geometry.enu_from_azimuth_elevation(np.radians([170.0, 180.0, 190.0]), np.radians(55.0))
    for i, pivot in enumerate([[20.0, 5.0, 3.0], [-20.0, 35.0, 3.0]]):
        normal = truth.normal_enu[:, i]
        np.testing.assert_allclose(np.linalg.norm(normal, axis=-1), 1.0, rtol=1e-14)
        reflected = 2 * np.sum(normal * sun, axis=-1, keepdims=True) * normal - sun
        to_aim = np.array([0.0, 0.0, 50.0]) - pivot
        assert np.max(geometry.angle_between_rad(reflected, np.broadcast_to(to_aim, (3, 3)))) < 1e-12


def test_receivers_are_fixed_to_the_mirror():
    truth = make().truth
    assert truth.receiver_enu_m.shape == (4, 7, 3)
    for i, pivot in enumerate([[20.0, 5.0, 3.0], [-20.0, 35.0, 3.0]]):
        own = truth.receiver_enu_m[:, 3 * i : 3 * i + 3]
        height = np.einsum("frk,fk->fr", own - pivot, truth.normal_enu[:, i])
        np.testing.assert_allclose(height, np.tile([0.3, 0.3, 0.4], (4, 1)), atol=1e-12)
        np.testing.assert_allclose(np.linalg.norm(own[:, 0] - own[:, 1], axis=-1), np.hypot(1.5, 0.866), rtol=1e-12)
        normal = np.cross(own[:, 1] - own[:, 0], own[:, 2] - own[:, 0])  # counter-clockwise seen from the front
        assert np.all(np.sum(normal * truth.normal_enu[:, i], axis=-1) > 0)
        assert np.max(np.abs(own[:, 0, 2] - (np.array(pivot)[2] + 0.3 * truth.normal_enu[:, i, 2]))) < 1e-12  # x level
    np.testing.assert_array_equal(truth.receiver_enu_m[:, 6], np.tile([15.0, -20.0, 2.5], (4, 1)))


def test_a_given_normal_wins_and_needs_no_sun():
    body = HELIOSTATS.replace("pivot_enu_m", "normal_enu = [0.0, -3.0, 4.0]\npivot_enu_m")
    truth = make(top="", body=body, simulation="").truth
    np.testing.assert_allclose(truth.normal_enu, np.tile([0.0, -0.6, 0.8], (4, 2, 1)), atol=1e-15)
    both = make(body=body).truth
    np.testing.assert_array_equal(both.normal_enu, truth.normal_enu)


def test_truth_is_complete_and_cannot_be_written():
    truth = make().truth
    shapes = {
        "normal_enu": (4, 2, 3),
        "receiver_enu_m": (4, 7, 3),
        "frame_start_index": (4,),
        "transmitter_phase_rad": (4, 2, 1),
        "clock_ppm": (7,),
        "receiver_delay_s": (4, 7),
        "tone_snr": (4, 7, 2, 1),
    }
    for name, shape in shapes.items():
        array = getattr(truth, name)
        assert array.shape == shape
        assert not array.flags.writeable
    np.testing.assert_array_equal(truth.frame_start_index, 1_782_043_200_000_000 + 1000 * np.arange(4))


def test_calibration_receivers_alone_can_be_simulated():
    body = HELIOSTATS[: HELIOSTATS.index("[[heliostat]]")]
    sim = make(top="", body=body, simulation="")
    assert [c.receiver_id for c in sim] == ["cal"] * 4


REFUSED = {
    "no posture": ({"simulation": ""}, r"heliostat `H1` has no posture.*`normal_enu`.*sun_azimuth_deg.*sun_elevation"),
    "no aim": ({"top": ""}, r"heliostat `H1` has no posture.*`site.aim_enu_m`$"),
    "no elevation": ({"simulation": "sun_azimuth_deg = 1.0"}, r"`H1`.*give `simulation.sun_elevation_deg`$"),
    "at aim": ({"top": "[site]\naim_enu_m = [-20.0, 35.0, 3.0]"}, r"heliostat `H2` stands at `site.aim_enu_m`"),
    "opposite": (
        {
            "top": "[site]\naim_enu_m = [20.0, 5.0, 3.5]",
            "simulation": "sun_azimuth_deg = 0.0\nsun_elevation_deg = -90.0",
        },
        r"heliostat `H1`: sun and aim point are opposite",
    ),
    "no receiver": ({"body": ""}, r"no receivers to simulate"),
    "overlap": ({"simulation": SUN + "frame_interval_s = 5e-4"}, r"frame_interval_s.*overlap"),
    "far future": ({"simulation": SUN + "start_unix_s = 9_300_000_000_000"}, r"start_unix_s.*less than or equal to"),
    "absurd snr": ({"simulation": SUN + "tone_snr_db = 1e6"}, r"tone_snr_db.*within ±1000 dB"),
    "absurd headroom": ({"simulation": SUN + "headroom_db = -1e6"}, r"headroom_db.*within ±1000 dB"),
    "absurd clock": ({"simulation": SUN + "clock_offset_ppm = 1e6"}, r"clock_offset_ppm.*clock_search_ppm"),
    "receiver at transmitter": (
        {"body": HELIOSTATS.replace("[15.0, -20.0, 2.5]", "[100.0, 0.0, 20.0]")},
        r"receiver `cal` stands where transmitter `A` stands",
    ),
    "receiver underground": (
        {"simulation": SUN + "ground = {coefficient = [-0.3, 0.0], height_m = 2.6}"},
        r"receiver `cal` at height 2.5 m lies below the ground at 2.6 m",
    ),
    "transmitter underground": (
        {"simulation": SUN + "ground = {coefficient = [-0.3, 0.0], height_m = 25.0}"},
        r"transmitter `A` at height 20 m lies below the ground at 25 m",
    ),
    "drop beyond the frames": (
        {"simulation": SUN + "dropped = [{receiver = 'cal', frame = 4, first_sample = 0, sample_count = 1}]"},
        r"dropped\[0\].*frame 4, but there are 4 frames",
    ),
    "drop beyond the frame": (
        {"simulation": SUN + "dropped = [{receiver = 'cal', frame = 0, first_sample = 999, sample_count = 2}]"},
        r"dropped\[0\].*ends at sample 1001.*1000 samples",
    ),
    "blocked after the end": (
        {"simulation": SUN + "blocked = [{transmitter = 'A', first_frame = 4}]"},
        r"blocked\[0\].*holds for no frame",
    ),
    "blocked backwards": (
        {"simulation": SUN + "blocked = [{transmitter = 'A', first_frame = 2, last_frame = 1}]"},
        r"blocked\[0\].*holds for no frame",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused_with_place_and_remedy(case):
    change, message = REFUSED[case]
    with pytest.raises(ScenarioError, match=message) as caught:
        make(**change)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("seed", [-1, 1.5, "1", True, None])
def test_seed_must_be_a_non_negative_integer(seed):
    with pytest.raises(InvalidInputError, match="`seed` must be a non-negative integer"):
        make(seed=seed)
