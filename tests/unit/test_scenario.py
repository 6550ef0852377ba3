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
