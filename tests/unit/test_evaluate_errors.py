"""Evaluation: statistics of known errors, truths from several places, and the bound by hand."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from rfpose.dsp import TonePhases
from rfpose.errors import InvalidInputError, RecordingError
from rfpose.multilat import PoseStatus, joint_covariance, mirror_normal
from rfpose.pipeline.choice import choose
from rfpose.pipeline.evaluate import Statistics, evaluate, ratio_of, read_truth
from rfpose.pipeline.formats.result import Result
from rfpose.pipeline.formats.result_file import write_result
from rfpose.pipeline.formats.truth_rows import align_truth, truth_rows
from rfpose.pipeline.simulate import simulate
from rfpose.pipeline.solve import solve
from rfpose.scenario import load_scenario
from rfpose.truth import Truth

SHIPPED = Path(__file__).resolve().parents[2] / "data" / "table2_100m.toml"
N_FRAME = 3
SNR = 1e4


def _exact_result() -> Result:
    """Return a result without noise: two heliostats that look up, three frames, truth with it."""
    shipped = load_scenario(SHIPPED)
    scenario = shipped.changed(heliostat=shipped.heliostat[:2])
    mirror = np.array(scenario.heliostat[0].receiver_mirror_m)
    place = np.concatenate([*(mirror + pivot for pivot in scenario.pivot_enu_m), scenario.calibration_enu_m])
    distance = np.linalg.norm(place[:, None] - scenario.transmitter_enu_m, axis=-1)
    tones = TonePhases.empty(
        receiver_ids=scenario.receiver_ids,
        transmitter_ids=scenario.transmitter_ids,
        tone_hz=scenario.tone_hz,
        frame_start_index=10**16 + 10**8 * np.arange(N_FRAME),
    )
    tones.phase_rad[..., 0] = -2.0 * np.pi * distance / scenario.wavelength_m[0]
    tones.sigma_rad[...] = 1e-5
    tones.status[...] = 0
    truth = Truth(
        heliostat_ids=scenario.heliostat_ids,
        receiver_ids=scenario.receiver_ids,
        transmitter_ids=scenario.transmitter_ids,
        normal_enu=np.broadcast_to([0.0, 0.0, 1.0], (N_FRAME, 2, 3)),
        receiver_enu_m=np.broadcast_to(place, (N_FRAME, *place.shape)),
        frame_start_index=tones.frame_start_index,
        tone_snr=np.full((N_FRAME, 7, 10, 1), SNR),
    )
    choice, settings = choose(scenario, pose="independent"), {"estimator": "hilbert"}
    return solve(tones, scenario, choice, sample_rate=Fraction(40_000_000), settings=settings, truth=truth)


@pytest.fixture(scope="module")
def result() -> Result:
    return _exact_result()


def _truth(result: Result) -> Truth:
    assert result.truth is not None
    return result.truth


def test_statistics_of_known_values() -> None:
    found = Statistics.of(np.array([[3.0, np.nan], [4.0, 0.0]]))
    assert found.rms == pytest.approx(math.sqrt(25.0 / 3.0))
    assert (found.median, found.max) == (3.0, 4.0)
    assert found.p95 == pytest.approx(3.9)
    assert math.isnan(Statistics.of([np.nan]).rms)


def test_exact_phases_have_no_error(result: Result) -> None:
    found = evaluate(result)
    assert found.normal_error_mrad.max < 1e-6
    assert found.position_error_m.max < 1e-8
    assert (found.solved, found.failed) == (2 * N_FRAME, 0)


def test_tilted_truth_is_an_error_of_that_angle(result: Result) -> None:
    tilted = np.array(_truth(result).normal_enu)
    tilted[:, 1] = [math.sin(2e-3), 0.0, math.cos(2e-3)]
    found = evaluate(result, replace(_truth(result), normal_enu=tilted))
    assert found.normal_error_mrad.rms == pytest.approx(2.0 / math.sqrt(2.0))
    assert found.normal_error_mrad.max == pytest.approx(2.0)
    assert [row.normal_error_mrad.rms for row in found.heliostats] == pytest.approx([0.0, 2.0], abs=1e-6)


def test_shifted_truth_is_a_position_error(result: Result) -> None:
    shifted = _truth(result).receiver_enu_m + np.array([0.0, 0.3, 0.4])
    found = evaluate(result, replace(_truth(result), receiver_enu_m=shifted))
    assert found.position_error_m.rms == pytest.approx(0.5)
    assert found.position_error_m.median == pytest.approx(0.5)


def test_bound_from_true_snr_by_hand(result: Result) -> None:
    found = evaluate(result)
    assert found.bound_source == "truth"
    # 1/(n·snr) for each tone phase, one calibration receiver of the same noise
    sigma_m = result.scenario.wavelength_m[0] / (2.0 * np.pi) / math.sqrt(400_000 * SNR)
    place = _truth(result).receiver_enu_m[0, :3]
    cov = joint_covariance(result.scenario.transmitter_enu_m, place, sigma_m, sigma_m)
    assert found.bound_rad[0, 0] == pytest.approx(float(mirror_normal(place, cov).sigma_rad))
    assert found.bound_mrad == pytest.approx(1e3 * np.sqrt(np.mean(found.bound_rad**2)))


def test_bound_without_snr_is_what_the_result_says(result: Result) -> None:
    found = evaluate(result, replace(_truth(result), tone_snr=None))
    assert found.bound_source == "result"
    assert found.bound_mrad == pytest.approx(found.sigma_mrad)


def test_transmitter_without_signal_does_not_enter_the_bound(result: Result) -> None:
    snr = np.array(_truth(result).tone_snr)
    bounds = []
    for silent in (1e-15, 0.0, np.nan):
        snr[:, :, 0] = silent
        bounds.append(evaluate(result, replace(_truth(result), tone_snr=snr)).bound_mrad)
    assert 1.0 < bounds[0] / evaluate(result).bound_mrad < 3.0
    assert bounds == pytest.approx([bounds[0]] * 3)


def test_failed_poses_are_counted_and_left_out(result: Result) -> None:
    status = np.array(result.poses.status)
    status[0, 0], status[1, 0] = PoseStatus.TOO_FEW, PoseStatus.RESIDUAL
    normal = np.array(result.poses.normal_enu)
    normal[0, 0], normal[1, 0] = np.nan, [1.0, 0.0, 0.0]
    found = evaluate(replace(result, poses=replace(result.poses, status=status, normal_enu=normal)))
    assert (found.solved, found.failed) == (4, 2)
    assert found.failure_reasons == {PoseStatus.TOO_FEW.reason: 1, PoseStatus.RESIDUAL.reason: 1}
    assert found.normal_error_mrad.max < 1e-6
    assert (found.heliostats[0].solved, found.heliostats[0].failed) == (1, 2)


def test_keys_are_the_contract(result: Result) -> None:
    found = evaluate(result).as_dict()
    assert {"normal_error_mrad", "position_error_m", "bound_mrad", "ratio_to_bound", "solved", "failed"} <= set(found)
    for name in ("normal_error_mrad", "position_error_m"):
        assert list(found[name]) == ["rms", "median", "p95", "max"]
    assert list(found["bound_mrad"]) == ["rms"]


# -- which truth ---------------------------------------------------------------------------------------------


def test_no_truth_is_refused(result: Result) -> None:
    with pytest.raises(InvalidInputError, match="`truth=FILE`"):
        evaluate(replace(result, truth=None))


def test_truth_of_a_later_day_is_refused(result: Result) -> None:
    later = replace(_truth(result), frame_start_index=result.frame_start_index + 10**12)
    with pytest.raises(InvalidInputError, match="another time"):
        evaluate(result, later)


def test_truth_rows_hold_until_the_next(result: Result) -> None:
    truth = _truth(result)
    start = np.array(truth.frame_start_index)
    assert truth_rows(truth, start).tolist() == [0, 1, 2]
    assert truth_rows(truth, start[[0, 2]] + 5).tolist() == [0, 2]
    assert truth_rows(truth, start[:1] - 1).tolist() == [-1]
    assert truth_rows(replace(truth, frame_start_index=None), start).tolist() == [0, 0, 0]


def test_truth_of_a_recording_or_result_that_is_open(result: Result) -> None:
    wanted = evaluate(result).as_dict()
    bare = replace(result, truth=None)
    recording = simulate(result.scenario)
    recording.truth = result.truth
    assert evaluate(bare, result).as_dict() == wanted
    assert evaluate(bare, recording).as_dict() == wanted
    with pytest.raises(InvalidInputError, match=r"<Result .* carries no truth"):
        evaluate(bare, bare)


def test_truth_in_another_order_is_put_right(result: Result) -> None:
    truth = _truth(result)
    turned = Truth(
        heliostat_ids=truth.heliostat_ids[::-1],
        receiver_ids=truth.receiver_ids[::-1],
        transmitter_ids=truth.transmitter_ids[::-1],
        normal_enu=truth.normal_enu[:, ::-1],
        receiver_enu_m=truth.receiver_enu_m[:, ::-1],
        frame_start_index=truth.frame_start_index,
        tone_snr=np.arange(N_FRAME * 70.0).reshape(N_FRAME, 7, 10, 1)[:, ::-1, ::-1],
    )
    found = align_truth(turned, result.scenario)
    np.testing.assert_array_equal(found.receiver_enu_m, truth.receiver_enu_m)
    np.testing.assert_array_equal(found.tone_snr, np.arange(N_FRAME * 70.0).reshape(N_FRAME, 7, 10, 1))
    assert found.receiver_ids == truth.receiver_ids


def test_truth_from_a_result_file(result: Result, tmp_path: Path) -> None:
    write_result(result, tmp_path / "r.h5")
    assert evaluate(result, read_truth(tmp_path / "r.h5", result.scenario)).as_dict() == evaluate(result).as_dict()
    write_result(replace(result, truth=None), tmp_path / "bare.h5")
    with pytest.raises(RecordingError, match=r"bare\.h5: holds no truth"):
        read_truth(tmp_path / "bare.h5", result.scenario)


def test_truth_from_json(result: Result, tmp_path: Path) -> None:
    place = _truth(result).receiver_enu_m[0]
    entries = [
        {"id": "H02", "normal_enu": [0.0, 0.0, 2.0], "receivers_enu_m": place[3:6].tolist()},
        {"id": "elsewhere", "normal_enu": [1.0, 0.0, 0.0]},
    ]
    (tmp_path / "truth.json").write_text(json.dumps({"heliostats": entries}))
    truth = read_truth(tmp_path / "truth.json", result.scenario)
    np.testing.assert_array_equal(truth.normal_enu[0, 1], [0.0, 0.0, 1.0])
    found = evaluate(result, truth)
    assert found.normal_error_mrad.max < 1e-6
    assert math.isnan(found.heliostats[0].normal_error_mrad.rms)
    assert found.bound_source == "result"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "not valid JSON.*it must hold `heliostats`"),
        ("[]", "not a truth file"),
        ("{}", "`heliostats` is missing"),
        ('{"heliostats": [{"id": "H01"}]}', r"`heliostats\[0\]\.normal_enu` is missing"),
        ('{"heliostats": [{"id": "H01", "normal_enu": [0, 1]}]}', r"normal_enu` must have shape \(3\), got \(2,\)"),
        ('{"heliostats": [{"id": "H01", "normal_enu": [0, 0, 1], "receivers_enu_m": [[1, 2, 3]]}]}', "receivers_enu_m"),
    ],
)
def test_bad_json_is_named(result: Result, tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "truth.json").write_text(text)
    with pytest.raises(RecordingError, match=r"truth\.json: " + ".*" + message):
        read_truth(tmp_path / "truth.json", result.scenario)


@pytest.mark.parametrize("common", ["nothing", "a mirror's errors", "a frame's errors"])
def test_ratio_scatters_as_its_sigma_says(common: str) -> None:
    """Over many fields: errors of two axes, alone or with a part that all of a mirror's (a frame's) share."""
    rng = np.random.default_rng(17)
    n_frame, n_mirror, n_field = 12, 20, 800
    bound = np.repeat(rng.uniform(0.5, 2.0, n_mirror)[None], n_frame, axis=0)
    found = []
    for _ in range(n_field):
        noise = rng.normal(size=(n_frame, n_mirror, 2))
        if common != "nothing":
            shape = (1, n_mirror, 2) if common.startswith("a mirror") else (n_frame, 1, 2)
            noise = np.sqrt(0.5) * (noise + rng.normal(size=shape))
        found.append(ratio_of(1.3 * bound * np.linalg.norm(noise, axis=-1) / np.sqrt(2.0), bound))
    ratio, sigma = np.array(found).T
    assert np.mean(ratio) == pytest.approx(1.3, rel=0.02)
    # 800 fields tell a scatter to 2.5 %; few frames (12) tell their own only roughly, and somewhat low
    assert np.sqrt(np.mean(sigma**2)) == pytest.approx(np.std(ratio), rel=0.15)


def test_ratio_of_one_pose_has_no_scatter_to_judge_by() -> None:
    ratio, sigma = ratio_of(np.array([[2e-3, np.nan]]), np.array([[1e-3, 1e-3]]))
    assert ratio == pytest.approx(2.0)
    assert math.isnan(sigma)
    assert all(math.isnan(value) for value in ratio_of(np.full((2, 2), np.nan), np.full((2, 2), np.nan)))
