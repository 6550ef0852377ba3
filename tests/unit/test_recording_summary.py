"""Does `describe` find what is wrong, and only that?"""

import json
import re
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from rfpose.cli._app import app
from rfpose.errors import ScenarioError
from rfpose.recording import RecordingWriter, check_against, describe, open_recording
from rfpose.scenario import load_scenario

SCENARIO = load_scenario(Path(__file__).resolve().parents[2] / "data" / "table2_100m.toml")
N = 400_000


def noise(n, sigma=3000.0, seed=0):
    return np.random.default_rng(seed).normal(scale=sigma, size=(n, 2)).round().astype(np.int16)


def record(path, samples, **changes):
    """Make a recording of all the scenario's receivers; ``samples`` goes to the first, quiet noise to the rest."""
    settings = {
        "scenario": SCENARIO,
        "receiver_ids": SCENARIO.receiver_ids,
        "sample_rate": Fraction(40_000_000),
        "centre_frequency_hz": 100e6,
        "sample_format": "int16",
        "full_scale": 32767,
        "provenance": {},
    } | changes
    quiet = noise(N // 20).astype(samples.dtype)
    with RecordingWriter(path, **settings) as writer:
        for k, receiver_id in enumerate(settings["receiver_ids"]):
            writer.write(receiver_id, 10**9, samples if k == 0 else quiet)
    with open_recording(path) as recording:
        summary = describe(recording)
    json.dumps(summary, allow_nan=False)
    return summary


def test_sound_recording(tmp_path):
    summary = record(tmp_path / "r.h5", noise(N))
    assert summary["problems"] == []
    assert summary["sound"] is True
    assert summary["frames"] == 1
    assert summary["stretches"] == 1
    assert summary["span_s"] == summary["recorded_s"] == 0.01
    assert summary["start_unix_s"] == 25.0
    entry = summary["receivers"]["H01_r0"]
    # 8e5 values: the rms of normal noise scatters by 1/sqrt(2·8e5) = 0.08 %; five sigma
    assert entry["rms"] == pytest.approx(3000.0, rel=0.004)
    assert entry["rms_dbfs"] == pytest.approx(20 * np.log10(3000 / 32767), abs=0.04)


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda x: x * 0, "H01_r0: all samples looked at are zero"),
        (lambda x: np.clip(x.astype(np.int32) * 20, -32767, 32767).astype(np.int16), "values looked at are clipped"),
        (lambda x: np.concatenate([x[:-7], np.full((7, 2), -32768, np.int16)]), "7 of 400000 samples .* fill value"),
        (lambda x: x[:1000], None),
    ],
)
def test_spoilt_samples(tmp_path, spoil, words):
    summary = record(tmp_path / "r.h5", spoil(noise(N)))
    if words is None:  # short receivers only: no stretch holds a frame
        assert summary["problems"] == ["no stretch is as long as a frame of 400000 samples"]
    else:
        assert summary["sound"] is False
        assert any(re.search(words, problem) for problem in summary["problems"])


def test_non_finite_floats(tmp_path):
    x = noise(N).astype(np.float32)
    x[5, 0], x[6, 1], x[8] = np.nan, np.inf, np.nan
    summary = record(tmp_path / "r.h5", x, sample_format="complex64")
    assert summary["problems"] == [
        "H01_r0: 1 of 400000 samples looked at hold the fill value: lost samples",
        "H01_r0: 2 of 800000 values looked at are NaN or Inf",
    ]


def test_only_a_bounded_part_is_looked_at_yet_all_over(tmp_path):
    x = noise(3_000_000)
    x[-1000:] = -32768
    summary = record(tmp_path / "r.h5", x, receiver_ids=["H01_r0"])
    entry = summary["receivers"]["H01_r0"]
    assert entry["samples"] == 3_000_000
    assert entry["looked_at"] == 2**20
    assert entry["fill_samples"] == 1000


def test_pieces_run_across_gaps(tmp_path):
    x, path = noise(2_000_000), tmp_path / "r.h5"
    with RecordingWriter(
        path, scenario=None, receiver_ids=["a"], sample_rate=Fraction(10**6), centre_frequency_hz=None,
        sample_format="int16", full_scale=32767, provenance={},
    ) as writer:  # fmt: skip
        for k in range(200):  # blocks of 10 000, shorter than a piece
            writer.write("a", k * 20_000, x[k * 10_000 : (k + 1) * 10_000])
    with open_recording(path) as recording:
        summary = describe(recording)
    assert summary["sound"] is True
    assert summary["receivers"]["a"]["blocks"] == 200
    assert summary["receivers"]["a"]["lost_samples"] == 199 * 10_000
    assert summary["stretches"] == 200
    assert summary["recorded_s"] == 2.0
    assert summary["span_s"] == pytest.approx(3.99)


def bursts(path, starts_by_receiver, count, *, jump=10**6, n_burst=4):
    """Write bursts every ``jump`` samples; a receiver's start of None in a burst is one that it missed."""
    with RecordingWriter(
        path, scenario=None, receiver_ids=list(starts_by_receiver), sample_rate=Fraction(10**6),
        centre_frequency_hz=None, sample_format="int16", full_scale=32767, provenance={},
    ) as writer:  # fmt: skip
        for name, starts in starts_by_receiver.items():
            for k in range(n_burst):
                if starts[k] is not None:
                    writer.write(name, 10**15 + k * jump + starts[k], noise(count))
    with open_recording(path) as recording:
        return describe(recording)


def test_pauses_that_all_receivers_make_are_no_losses(tmp_path):
    summary = bursts(tmp_path / "r.h5", {"a": [0, 0, 0, 0], "b": [0, 3, 1, 6], "c": [0, 0, None, 0]}, 1000)
    assert {name: entry["lost_samples"] for name, entry in summary["receivers"].items()} == {"a": 0, "b": 0, "c": 1001}
    assert summary["problems"] == []
    assert summary["stretches"] == 4


def test_a_gap_while_others_record_is_a_loss(tmp_path):
    summary = bursts(tmp_path / "r.h5", {"a": [0, 0, 0, 0], "b": [0, 20, 20, 20]}, 1000, jump=1000)
    assert summary["receivers"]["b"]["lost_samples"] == 20
    assert summary["receivers"]["a"]["lost_samples"] == 0


def test_dates_stand_beside_the_index(tmp_path):
    summary = bursts(tmp_path / "r.h5", {"a": [0, 0, 0, 0]}, 1000)
    assert summary["start_index"] == 10**15
    assert summary["start_utc"] == "2001-09-09T01:46:40.000000000Z"
    assert summary["end_utc"] == "2001-09-09T01:46:43.001000000Z"


def test_receivers_so_far_apart_that_they_share_no_frame_are_told(tmp_path):
    radio = SCENARIO.radio.model_copy(update={"frame_samples": 1000})
    with RecordingWriter(
        tmp_path / "r.h5", scenario=SCENARIO.model_copy(update={"radio": radio}), receiver_ids=SCENARIO.receiver_ids,
        sample_rate=Fraction(40_000_000), centre_frequency_hz=1e8, sample_format="int16", full_scale=32767,
        provenance={},
    ) as writer:  # fmt: skip
        for k, name in enumerate(SCENARIO.receiver_ids):
            writer.write(name, 10**15 + (600 if k < 2 else 0), noise(1000))
    with open_recording(tmp_path / "r.h5") as recording:
        summary = describe(recording)
    (problem,) = summary["problems"]
    assert problem.startswith(
        "2 receivers (`H01_r0`, `H01_r1`): recorded 1 frames of 1000 samples, but lies so far beside"
    )
    assert [entry["frames"] for entry in summary["receivers"].values()] == [0, 0] + [1] * (
        len(SCENARIO.receiver_ids) - 2
    )


def test_info_sums_up_receivers_that_are_alike(tmp_path):
    bursts(tmp_path / "r.h5", {"a": [0, 0, 0, 0], "b": [0, 0, 0, 0], "c": [0, 0, None, 0]}, 1000)
    shown = CliRunner().invoke(app, ["info", str(tmp_path / "r.h5")])
    rows = [line for line in shown.output.splitlines() if "samples" in line and "blocks" in line]
    assert [row.split(":")[0].strip() for row in rows] == ["a … b (2 alike)", "c"]
    assert "receivers: 3" in shown.output


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"sample_rate": Fraction(20_000_000)}, r"20000000 samples/s.*`radio.sample_rate_hz` = 40000000"),
        ({"centre_frequency_hz": 101e6}, r"tuned to 101000000 Hz.*`radio.centre_frequency_hz` = 100000000"),
        ({"receiver_ids": ["x0", "x1"]}, r"holds receivers `x0`, `x1`, but the scenario names `H01_r0`"),
    ],
)
def test_recording_and_scenario_disagree(tmp_path, changes, words):
    summary = record(tmp_path / "r.h5", noise(N), **changes)
    assert summary["sound"] is False
    with open_recording(tmp_path / "r.h5") as recording, pytest.raises(ScenarioError, match=words):
        check_against(recording, SCENARIO)


def test_scenario_agrees_even_when_some_receivers_are_missing(tmp_path):
    summary = record(tmp_path / "r.h5", noise(N), receiver_ids=SCENARIO.receiver_ids[:5], centre_frequency_hz=None)
    assert summary["problems"][0].startswith("32 receivers of the scenario are not in the recording: `H02_r2`")
    with open_recording(tmp_path / "r.h5") as recording:
        check_against(recording, SCENARIO)


def test_rate_that_is_no_decimal_number_agrees(tmp_path):
    radio = SCENARIO.radio.model_copy(update={"sample_rate_hz": 1e8 / 3})
    scenario = SCENARIO.model_copy(update={"radio": radio})
    record(tmp_path / "r.h5", noise(N), sample_rate=Fraction(10**8, 3))
    with open_recording(tmp_path / "r.h5") as recording:
        check_against(recording, scenario)


def test_empty_recording(tmp_path):
    with RecordingWriter(
        tmp_path / "r.h5", scenario=SCENARIO, receiver_ids=SCENARIO.receiver_ids, sample_rate=Fraction(40_000_000),
        centre_frequency_hz=1e8, sample_format="int16", full_scale=32767, provenance={},
    ):  # fmt: skip
        pass
    with open_recording(tmp_path / "r.h5") as recording:
        summary = describe(recording)
    assert "no samples were recorded" in summary["problems"]
    assert summary["frames"] == 0
