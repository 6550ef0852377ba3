"""Scenario files: what they mean, and what is refused with which words."""

from pathlib import Path

import numpy as np
import pytest

from rfpose.errors import ScenarioError
from rfpose.scenario import load_scenario, parse_scenario

DATA = Path(__file__).resolve().parents[2] / "data"
TABLE2 = (DATA / "table2_100m.toml").read_text()


@pytest.mark.parametrize("path", sorted(DATA.glob("*.toml")), ids=lambda p: p.stem)
def test_shipped_scenarios_load_and_survive_a_round_trip(path):
    scenario = load_scenario(path)
    assert parse_scenario(scenario.to_toml()) == scenario


def test_axes_follow_the_file():
    s = parse_scenario(TABLE2)
    assert s.transmitter_ids[:2] == ("T1", "T2")
    assert s.receiver_ids[:4] == ("H01_r0", "H01_r1", "H01_r2", "H02_r0")
    assert s.receiver_ids[-1] == "cal0"
    assert s.receiver_rows(1) == slice(3, 6)
    assert s.receivers[3].heliostat == 1
    assert s.receivers[3].oscillator == s.receivers[5].oscillator == "H02"
    assert s.receivers[-1].calibration == 0
    np.testing.assert_allclose(s.line_hz[0], [-18e6, -17.25e6, -18.75e6])
    np.testing.assert_allclose(s.wavelength_m, 299792458 / 750e3)


def test_separate_oscillators_have_their_own_names():
    s = parse_scenario(TABLE2.replace('oscillator = "shared"', 'oscillator = "separate"'))
    assert len({r.oscillator for r in s.receivers}) == len(s.receivers)


def test_arrays_cannot_be_written():
    s = parse_scenario(TABLE2)
    with pytest.raises(ValueError, match="read-only"):
        s.transmitter_enu_m[0, 0] = 1.0


def test_scale_stretches_lengths_and_wavelengths_only():
    unit, scaled = load_scenario(DATA / "table2.toml"), load_scenario(DATA / "table2.toml", scale=100.0)
    np.testing.assert_allclose(scaled.transmitter_enu_m, 100 * unit.transmitter_enu_m)
    np.testing.assert_allclose(scaled.wavelength_m, 400.0)
    np.testing.assert_allclose(scaled.pivot_enu_m, 100 * unit.pivot_enu_m)
    np.testing.assert_allclose(
        scaled.heliostat[0].receiver_mirror_m, 100 * np.array(unit.heliostat[0].receiver_mirror_m)
    )
    assert scaled.radio == unit.radio
    by_frequency = parse_scenario(TABLE2).scaled(2.0)
    np.testing.assert_allclose(by_frequency.tone_hz, 375e3)


def test_unit_table_is_the_papers():
    s = load_scenario(DATA / "table2.toml")  # verification R1, R4
    assert s.transmitter_enu_m.shape == (10, 3)
    np.testing.assert_allclose(s.transmitter_enu_m[[0, 6, 9]], [[1, 0, 0.2], [0.433, 0.25, 0.4], [0, 0, 0.5]])
    side = np.linalg.norm(np.subtract(*s.heliostat[0].receiver_mirror_m[:2]))
    assert side == pytest.approx(0.0173, rel=1e-3)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("carrier_hz = -14e6", "carrierhz = -14e6", r"unknown key `transmitter\[1\].carrierhz`"),
        ("carrier_hz = -14e6", "", r"`transmitter\[1\].carrier_hz` is missing"),
        ("carrier_hz = -14e6", 'carrier_hz = "high"', r"transmitter\[1\].carrier_hz.*high"),
        ("carrier_hz = -14e6", "carrier_hz = nan", r"transmitter\[1\].carrier_hz.*finite"),
        ("carrier_hz = -14e6", "carrier_hz = -17.25e6", "collide"),
        ("carrier_hz = -14e6", "carrier_hz = -18e6", "collide"),
        ("carrier_hz = -18e6", "carrier_hz = -19.9e6", "outside the recorded band"),
        ("[50.0, 86.6, 30.0]", "[100.0, 0.0, 20.0]", "`T1` and `T2` stand at the same place"),
        ('id = "T2"', 'id = "T2"\nmast = "T1"', "`T2` is one more carrier of `T1`.*same"),
        ('id = "T2"', 'id = "T2"\nmast = "T99"', "`T2` is one more carrier of `T99`"),
        ('id = "T2"', 'id = "T1"', "transmitter `T1` appears twice"),
        ('id = "H02"', 'id = "H01"', "`H01` appears twice"),
        ("[-0.4994, 0.865, 0.0]", "[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]", ""),
        (
            "receiver_mirror_m = [[0.9988, 0.0, 0.0], [-0.4994, 0.865, 0.0], [-0.4994, -0.865, 0.0]]",
            "receiver_mirror_m = [[0, 0, 0], [1, 0, 0], [2, 0, 0]]",
            "must not lie on a line",
        ),
        (
            "receiver_mirror_m = [[0.9988, 0.0, 0.0], [-0.4994, 0.865, 0.0], [-0.4994, -0.865, 0.0]]",
            "receiver_mirror_m = [[0, 0, 0], [1, 0, 0]]",
            "three or more receivers",
        ),
        ("frame_samples = 400_000", "frame_samples = 0", "radio.frame_samples"),
        ("frame_samples = 400_000", "frame_samples = 1_000_000_000", "radio.frame_samples"),
        ("modulation_index = 0.8", "modulation_index = 1.2", "modulation"),
        ("frequency_hz = 750e3", "frequency_hz = 750e3\nwavelength_m = 400.0", "exactly one"),
        ("sample_rate_hz = 40e6", "sample_rate_hz = -40e6", "radio.sample_rate_hz"),
        ("[simulation]", '[[simulation.blocked]]\ntransmitter = "T99"\n[simulation]', "T99"),
        ("clock_offset_ppm = 2.0", "clock_offset_ppm = 70.0", "clock_search_ppm"),
        ("name =", "name", "not valid TOML"),
        ('oscillator = "shared"', 'oscillator = "none"', "oscillator"),
        ('name = "Table 2', 'scale = "big"\nname = "Table 2', "scale"),
        ('name = "Table 2', 'scale = -1.0\nname = "Table 2', "scale"),
    ],
)
def test_contradictions_are_named(old, new, words):
    assert old in TABLE2
    if not words:  # four receivers are welcome
        assert len(parse_scenario(TABLE2.replace(old, new)).heliostat[0].receiver_ids) == 4
        return
    with pytest.raises(ScenarioError, match=words) as caught:
        parse_scenario(TABLE2.replace(old, new), source="site.toml")
    assert str(caught.value).startswith("site.toml: ")
    assert "\n" not in str(caught.value)


def test_field_control_and_events_survive_a_round_trip():
    text = (DATA / "tracking_100m.toml").read_text()
    table = (
        '\n[[tracking.event]]\nhour = 9.5\nwhat = "calibrate"\nheliostats = ["H01", "H03"]\n'
        '[[tracking.event]]\nhour = 12\nwhat = "cluster-fails"\ncluster = 0\nday = 1\n'
        "[tracking.structure]\nnatural_hz = 3.3\ndamping = 0.05\n[tracking.aperture]\nimage_ratio = 1.2\n"
    )
    s = parse_scenario(text + table)
    assert [event.what for event in s.tracking.event] == ["calibrate", "cluster-fails"]
    assert s.tracking.event[0].heliostats == ("H01", "H03")
    again = parse_scenario(s.to_toml())
    assert again == s
    assert again.tracking.structure.natural_hz == 3.3
    with pytest.raises(ScenarioError, match=r"^site\.toml: .*unknown key.*field_control.*watchdog_s") as caught:
        parse_scenario(text.replace("[tracking.field_control.bus]", "watchdog_s = 3\n[tracking.field_control.bus]"),
                       source="site.toml")  # fmt: skip
    assert "\n" not in str(caught.value)


def test_missing_and_binary_files(tmp_path):
    with pytest.raises(ScenarioError, match=r"nowhere\.toml"):
        load_scenario(tmp_path / "nowhere.toml")
    (tmp_path / "binary.toml").write_bytes(b"\x89HDF\r\n\xff\xfe")
    with pytest.raises(ScenarioError, match=r"binary\.toml: is not text in UTF-8 .*check that it is the right file"):
        load_scenario(tmp_path / "binary.toml")


STRUCTURES = """
[site.structures]
width_m = 2.0
height_m = 1.5
[[site.structures.box]]
id = "tower"
base_enu_m = [0.0, 0.0, 0.0]
size_m = [6.0, 4.0, 46.0]
azimuth_deg = 90.0
[[site.structures.plate]]
id = "N1"
pivot_enu_m = [24.0, 3.0, 2.0]
[[site.structures.plate]]
id = "N2"
pivot_enu_m = [20.0, 8.0, 2.0]
height_m = 3.0
arm_m = 0.2
"""
BARE = TABLE2.replace("[radio]", STRUCTURES + "[radio]", 1)


def test_structures_stand_where_they_are_said_to_and_scale_with_the_site():
    s = parse_scenario(BARE)
    plates = s.site.structures.plate
    assert [(p.width_m, p.height_m, p.arm_m) for p in plates] == [(2.0, 1.5, 0.0), (2.0, 3.0, 0.2)]
    assert parse_scenario(s.to_toml()) == s
    assert [m.id for m in s.mirrors[-2:]] == ["N1", "N2"]
    np.testing.assert_allclose(s.mirror_pivot_enu_m[-1], [20.0, 8.0, 2.0])
    large = s.scaled(2.0).site.structures
    assert large.box[0].size_m == (12.0, 8.0, 92.0)
    assert (large.plate[1].width_m, large.plate[1].arm_m) == (4.0, 0.4)
    assert large.plate[1].pivot_enu_m == (40.0, 16.0, 4.0)


def test_a_box_holds_what_lies_in_it_as_it_is_turned():
    box = parse_scenario(BARE).site.structures.box[0]  # its y side, 4 m, looks east
    assert box.holds((1.9, 2.9, 45.9))
    assert not box.holds((2.1, 0.0, 10.0))
    assert not box.holds((0.0, 0.0, 46.1))
    assert not box.holds((0.0, 0.0, -0.1))


def test_plates_come_from_a_plan_that_also_has_the_mirrors_with_receivers(tmp_path):
    plan = tmp_path / "field.csv"
    plan.write_text("id,east_m,north_m,up_m\nH01,20.0,0.1,2.0\nN1,24,3,2\nP7,70,10,2\n")
    text = BARE.replace("[site.structures]\n", f'[site.structures]\ncsv = "{plan}"\n', 1)
    plates = parse_scenario(text).site.structures.plate
    assert [p.id for p in plates] == ["N1", "N2", "P7"]
    assert plates[2].pivot_enu_m == (70.0, 10.0, 2.0)
    assert plates[2].height_m == 1.5
    plan.write_text("id,east_m,north_m,up_m\nH01,60.0,0.1,2.0\n")
    with pytest.raises(ScenarioError, match="`H01` names a heliostat and a plate"):
        parse_scenario(text)
    plan.write_text("id,east_m,north_m\nP1,left,0.1\n")
    with pytest.raises(ScenarioError, match=r"field\.csv: line 2, `east_m`"):
        parse_scenario(text)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("height_m = 1.5\n", "", "plate `N1` has no `height_m`; give it there, or in .site.structures."),
        ('id = "N2"', 'id = "N1"', "`N1` names two of kind plate"),
        ('id = "N2"', 'id = "tower"', "`tower` names a box and a plate"),
        ('id = "N2"', 'id = "H02"', "`H02` names a heliostat and a plate"),
        ("[6.0, 4.0, 46.0]", "[6.0, 4.0, 50.0]", "box `tower` of .site.structures. covers transmitter `T10`"),
        ("[6.0, 4.0, 46.0]", "[6.0, 46.0, 46.0]", "box `tower` of .site.structures. covers pivot of heliostat `H01`"),
        ("[6.0, 4.0, 46.0]", "[6.0, 0.0, 46.0]", r"site\.structures\.box\[0\]\.size_m"),
        ("[site.structures]\n", "[site.structures]\ncsv = 3\n", "path of a file"),
        ("arm_m = 0.2", "arm_m = 0.2\nnormal_enu = [0, 0, 0]", "must not be zero"),
        ("[mirror]\n", "[mirror]\nwidth_m = 2.0\n", "give both or neither"),
        ("[radio]\n", "[posture]\nsigma_rad = 0.0\n[radio]\n", "posture.sigma_rad"),
    ],
)
def test_structures_that_cannot_be_are_named(old, new, words):
    assert old in BARE
    with pytest.raises(ScenarioError, match=words) as caught:
        parse_scenario(BARE.replace(old, new, 1), source="site.toml")
    assert str(caught.value).startswith("site.toml: ")
    assert "\n" not in str(caught.value)


def test_a_structure_on_a_calibration_receiver_is_refused():
    s = parse_scenario(TABLE2)
    place = s.calibration_enu_m[0]
    box = {"id": "hut", "base_enu_m": tuple(place - [0.0, 0.0, 1.0]), "size_m": (2.0, 2.0, 3.0)}
    with pytest.raises(ScenarioError, match=r"box `hut` .* covers calibration receiver `cal0`"):
        s.changed(site={"structures": {"box": (box,)}})


def test_outlines_of_mirrors_are_optional_and_their_own():
    s = parse_scenario(TABLE2.replace("[mirror]\n", "[mirror]\nwidth_m = 2.0\nheight_m = 1.5\n"))
    assert {(h.width_m, h.height_m) for h in s.heliostat} == {(2.0, 1.5)}
    assert parse_scenario(TABLE2).heliostat[0].width_m is None
