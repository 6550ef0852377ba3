"""IQ file to normal: errors sit at the bound, and what the result reports is what it scatters.

Frames are independent (noise, and calibration noise); a mirror's receivers and the mirrors of one frame share the
calibration noise. Tolerances are four standard deviations of the statistic, counted with that in mind.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rfpose.pipeline.evaluate import Evaluation, evaluate, read_truth
from rfpose.pipeline.formats.result import Result
from rfpose.pipeline.process import process
from rfpose.pipeline.simulate import simulate
from rfpose.scenario import load_scenario

SHIPPED = Path(__file__).resolve().parents[2] / "data" / "table2_100m.toml"
N_FRAME = 120
N_HELIOSTAT = 3


def _site(path: Path) -> Path:
    shipped = load_scenario(SHIPPED)
    shipped.changed(
        heliostat=shipped.heliostat[::4],
        radio={"frame_samples": 4000, "clock_search_ppm": 5.0},
        simulation={"frame_count": N_FRAME, "frame_interval_s": 0.5, "tone_snr_db": 55.0, "sun_azimuth_deg": 170.0},
    ).save(path)
    return path


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("consistency")
    simulate(_site(directory / "site.toml"), seed=11).save(directory / "rec.h5")
    return directory / "rec.h5"


@pytest.fixture(scope="module", params=["hilbert", "correlator"])
def found(request: pytest.FixtureRequest, recording: Path) -> tuple[str, Result, Evaluation]:
    result = process(recording, recording.with_name(f"{request.param}.h5"), estimator=request.param)
    return request.param, result, evaluate(result)


def test_normal_errors_are_at_the_bound(found: tuple[str, Result, Evaluation]) -> None:
    estimator, _, evaluation = found
    assert evaluation.bound_source == "truth"
    assert (evaluation.solved, evaluation.failed) == (N_FRAME * N_HELIOSTAT, 0)
    # RMS of 360 angles of two nearly equal components: relative deviation 1/(2√360) = 2.6 %
    tolerance = 4.0 * 0.5 / np.sqrt(N_FRAME * N_HELIOSTAT)
    loss = 1.08 if estimator == "hilbert" else 1.03
    assert 1.0 - tolerance < evaluation.ratio_to_bound < loss * (1.0 + tolerance)


def test_reported_normal_covariance_is_the_scatter(found: tuple[str, Result, Evaluation]) -> None:
    _, result, _ = found
    assert result.truth is not None
    error = result.poses.normal_enu - result.truth.normal_enu
    inverse = np.linalg.pinv(result.poses.cov_enu, rcond=1e-6, hermitian=True)
    squared = np.einsum("fhi,fhij,fhj->fh", error, inverse, error)
    # mean of 360 χ² of two degrees of freedom, each of variance 4
    assert squared.mean() == pytest.approx(2.0, abs=4.0 * 2.0 / np.sqrt(squared.size))


def test_reported_position_covariance_is_the_scatter(found: tuple[str, Result, Evaluation]) -> None:
    _, result, _ = found
    assert result.truth is not None
    rows = slice(0, 3 * N_HELIOSTAT)
    error = result.fixes.position_enu_m[:, rows] - result.truth.receiver_enu_m[:, rows]
    squared = np.einsum("fri,frij,frj->fr", error, np.linalg.inv(result.fixes.cov_enu_m2[:, rows]), error)
    # χ² of three degrees of freedom, variance 6; the receivers of a frame share half their noise, so only the
    # frames count as independent
    assert squared.mean() == pytest.approx(3.0, abs=4.0 * np.sqrt(6.0 / N_FRAME))


def test_residuals_have_the_degrees_of_freedom_left(found: tuple[str, Result, Evaluation]) -> None:
    _, result, _ = found
    chi2 = result.fixes.chi2[:, : 3 * N_HELIOSTAT]
    # ten transmitters less three coordinates and a clock: 6, variance 12
    assert chi2.mean() == pytest.approx(6.0, abs=4.0 * np.sqrt(12.0 / N_FRAME))


def test_truth_can_come_from_the_recording(found: tuple[str, Result, Evaluation], recording: Path) -> None:
    _, result, evaluation = found
    again = evaluate(result, read_truth(recording, result.scenario))
    assert again.as_dict() == evaluation.as_dict()
