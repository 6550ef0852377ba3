"""What is bad in a recording becomes NaN with a reason; all else comes out as if nothing were wrong."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rfpose.dsp import CalibrationStatus, LineStatus
from rfpose.errors import GeometryError, InvalidInputError, RecordingError, ScenarioError
from rfpose.multilat import FixStatus, PoseStatus
from rfpose.pipeline.formats.result import Result
from rfpose.pipeline.formats.result_summary import summarise
from rfpose.pipeline.process import process
from rfpose.recording import RecordingWriter
from rfpose.scenario import Scenario, load_scenario
from rfpose.simulator import Chunk, Simulator

SHIPPED = Path(__file__).resolve().parents[2] / "data" / "table2_100m.toml"
N_SAMPLE = 8000


def _scenario(mirrors: tuple[int, ...] = (0, 1), **simulation: object) -> Scenario:
    site = load_scenario(SHIPPED)
    return site.changed(
        heliostat=[site.heliostat[k] for k in mirrors],
        radio={"frame_samples": N_SAMPLE},
        simulation={"frame_count": 3, "frame_interval_s": 1.0, "sun_azimuth_deg": 170.0, **simulation},
    )


def _record(
    path: Path,
    scenario: Scenario,
    spoil: Callable[[Chunk], None] = lambda _chunk: None,
    late: Callable[[str], int] = lambda _receiver_id: 0,
) -> Path:
    """Write a simulated recording whose samples ``spoil`` may change, each receiver ``late`` samples too late."""
    simulator = Simulator(scenario, seed=3)
    writer = RecordingWriter(
        path,
        scenario=scenario,
        receiver_ids=simulator.receiver_ids,
        sample_rate=scenario.radio.sample_rate,
        centre_frequency_hz=scenario.radio.centre_frequency_hz,
        sample_format=simulator.sample_format,
        full_scale=simulator.full_scale,
        provenance={},
    )
    with writer:
        for chunk in simulator:
            spoil(chunk)
            writer.write(chunk.receiver_id, chunk.start_index + late(chunk.receiver_id), chunk.samples)
        writer.write_truth(simulator.truth)
    return path


def _spoil(receiver_id: str, frame: int, how: Callable[[np.ndarray], None]) -> Callable[[Chunk], None]:
    start = _scenario().simulation.start_unix_s * 40_000_000 + frame * 40_000_000

    def spoil(chunk: Chunk) -> None:
        if chunk.receiver_id == receiver_id and chunk.start_index == start:
            how(chunk.samples)

    return spoil


@pytest.fixture(scope="module")
def clean(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Result]:
    directory = tmp_path_factory.mktemp("clean")
    results = {}
    for sample_format in ("int16", "complex64"):
        recording = _record(directory / f"{sample_format}.h5", _scenario(sample_format=sample_format))
        results[sample_format] = process(recording, directory / f"{sample_format}_result.h5")
    return results


def _to(value: float, count: int = N_SAMPLE) -> Callable[[np.ndarray], None]:
    def change(samples: np.ndarray) -> None:
        samples[:count] = value

    return change


@pytest.mark.parametrize(
    ("sample_format", "how", "status"),
    [
        ("complex64", _to(np.nan, 1), LineStatus.NOT_FINITE),
        ("complex64", _to(np.inf, 1), LineStatus.NOT_FINITE),
        ("int16", _to(0), LineStatus.NO_SIGNAL),
        ("int16", _to(0, 2000), LineStatus.MISSING_SAMPLES),
        ("int16", _to(-32768, 2000), LineStatus.MISSING_SAMPLES),
        ("int16", _to(32767, 2000), LineStatus.CLIPPED),
    ],
)
def test_bad_samples_cost_one_mirror_frame(
    tmp_path: Path, clean: dict[str, Result], sample_format: str, how: Callable[[np.ndarray], None], status: LineStatus
) -> None:
    scenario = _scenario(sample_format=sample_format)
    recording = _record(tmp_path / "rec.h5", scenario, _spoil("H01_r1", 1, how))
    result = process(recording, tmp_path / "result.h5")
    assert np.all(result.tones.status[1, 1] == status)
    assert np.isnan(result.fixes.position_enu_m[1, 1]).all()
    assert result.fixes.status[1, 1] == FixStatus.NOT_FINITE
    assert np.isnan(result.poses.normal_enu[1, 0]).all()
    assert result.poses.status[1, 0] == PoseStatus.TOO_FEW
    summary = summarise(result)
    assert summary["poses"] == {"solved": 5, "failed": 1, "reasons": {PoseStatus.TOO_FEW.reason: 1}}
    assert summary["tones"]["reasons"] == {status.reason: 10}
    # frames before, and the other mirror in all frames, are untouched; later ones start from a re-acquired clock
    good, expected = result.poses.normal_enu, clean[sample_format].poses.normal_enu
    np.testing.assert_array_equal(good[:, 1], expected[:, 1])
    np.testing.assert_array_equal(good[0], expected[0])
    np.testing.assert_allclose(good[2, 0], expected[2, 0], atol=1e-6)


def test_gap_costs_one_mirror_frame(tmp_path: Path, clean: dict[str, Result]) -> None:
    gap = {"receiver": "H02_r0", "frame": 2, "first_sample": 100, "sample_count": 50}
    result = process(_record(tmp_path / "rec.h5", _scenario(dropped=[gap])), tmp_path / "result.h5")
    assert np.all(result.tones.status[2, 3] == LineStatus.GAP)
    assert result.poses.status.tolist() == [[0, 0], [0, 0], [0, PoseStatus.TOO_FEW]]
    solved = result.poses.status == PoseStatus.OK
    np.testing.assert_array_equal(result.poses.normal_enu[solved], clean["int16"].poses.normal_enu[solved])


def test_bursts_that_start_some_samples_apart_are_measured_each_in_its_own_frame(
    tmp_path: Path, clean: dict[str, Result]
) -> None:
    """A trigger reaches the receivers at different samples; a burst is one frame long, so no frame fits in all."""
    names = _scenario().receiver_ids
    late = dict(zip(names, np.random.default_rng(8).integers(0, 50, len(names)).tolist(), strict=True))
    result = process(_record(tmp_path / "rec.h5", _scenario(), late=lambda name: late[name]), tmp_path / "result.h5")
    np.testing.assert_array_equal(result.tones.phase_rad, clean["int16"].tones.phase_rad)
    np.testing.assert_array_equal(result.poses.normal_enu, clean["int16"].poses.normal_enu)
    assert summarise(result)["poses"]["solved"] == 6


def test_too_few_transmitters_cost_the_mirror_that_does_not_see_them(tmp_path: Path) -> None:
    blocked = [{"transmitter": f"T{i}", "receivers": ["H02"]} for i in range(1, 7)]
    result = process(_record(tmp_path / "rec.h5", _scenario(blocked=blocked)), tmp_path / "result.h5")
    assert np.all(result.tones.status[:, 3:6, :6] == LineStatus.ABSENT)
    assert np.all(result.fixes.status[:, 3:6] == FixStatus.TOO_FEW)
    assert np.all(result.poses.status[:, 1] == PoseStatus.TOO_FEW)
    assert np.all(result.poses.status[:, 0] == PoseStatus.OK)


def test_a_transmitter_that_is_off_is_left_out(tmp_path: Path) -> None:
    result = process(_record(tmp_path / "rec.h5", _scenario(blocked=[{"transmitter": "T4"}])), tmp_path / "result.h5")
    assert np.all(result.calibration.status[:, 3] == CalibrationStatus.MISSING)
    assert np.all(result.poses.status == PoseStatus.OK)
    assert np.all(result.fixes.n_transmitter[:, :6] == 9)


def test_calibration_receiver_that_is_dead_costs_everything_but_the_tones(tmp_path: Path) -> None:
    def spoil(chunk: Chunk) -> None:
        if chunk.receiver_id == "cal0":
            chunk.samples[:] = 0

    result = process(_record(tmp_path / "rec.h5", _scenario(), spoil), tmp_path / "result.h5")
    assert np.all(result.calibration.status == CalibrationStatus.MISSING)
    assert np.all(result.tones.status[:, :6] == LineStatus.OK)
    assert np.all(result.poses.status == PoseStatus.TOO_FEW)


def test_receiver_that_is_not_in_the_recording(
    tmp_path: Path, clean: dict[str, Result], caplog: pytest.LogCaptureFixture
) -> None:
    site = tmp_path / "site.toml"
    _scenario((0, 1, 4)).save(site)
    recording = _record(tmp_path / "rec.h5", _scenario())
    with caplog.at_level(logging.WARNING):
        result = process(recording, tmp_path / "result.h5", scenario=site)
    assert "differs from the given one" in caplog.text
    assert "lacks receivers H05_r0, H05_r1, H05_r2" in caplog.text
    assert np.all(result.tones.status[:, 6:9] == LineStatus.NOT_RECORDED)
    assert np.all(result.poses.status[:, 2] == PoseStatus.TOO_FEW)
    np.testing.assert_array_equal(result.poses.normal_enu[:, :2], clean["int16"].poses.normal_enu)
    assert result.truth is not None
    assert np.isnan(result.truth.normal_enu[:, 2]).all()


# -- what is refused -----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return _record(tmp_path_factory.mktemp("recording") / "rec.h5", _scenario(frame_count=1))


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"calibration_receiver": ()}, ScenarioError, "no calibration receiver.*calibration_receiver"),
        ({"heliostat": ()}, ScenarioError, "no heliostat"),
        ({"transmitter": load_scenario(SHIPPED).transmitter[:4]}, GeometryError, "5 or more transmitters"),
        ({"tone": {"frequency_hz": 1.5e6}}, GeometryError, "ambiguous.*add a tone"),
        ({"radio": {"sample_rate_hz": 41e6}}, ScenarioError, "41000000"),
        ({"radio": {"frame_samples": N_SAMPLE + 1}}, RecordingError, "no stretch as long as a frame of 8001"),
    ],
)
def test_hopeless_sites_are_refused_before_any_work(
    tmp_path: Path, recording: Path, change: dict[str, Any], error: type[Exception], message: str
) -> None:
    site = tmp_path / "site.toml"
    _scenario().changed(**change).save(site)
    with pytest.raises(error, match=message):
        process(recording, tmp_path / "result.h5", scenario=site)
    assert [path.name for path in tmp_path.iterdir()] == ["site.toml"]


@pytest.mark.parametrize("setting", ["estimator", "pose"])
def test_unknown_settings_are_refused(tmp_path: Path, recording: Path, setting: str) -> None:
    with pytest.raises(InvalidInputError, match=f"`{setting}` must be one of .*got 'guess'"):
        process(recording, tmp_path / "result.h5", **{setting: "guess"})
    assert not list(tmp_path.iterdir())
