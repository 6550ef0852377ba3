"""IQ to normal without calibration receivers: differences between the receivers of a mirror with a surveyed pivot."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rfpose.dsp import CalibrationStatus
from rfpose.errors import GeometryError, ScenarioError
from rfpose.multilat import FixStatus, RangeStatus
from rfpose.multilat.rigid import MirrorKnowledge, MirrorProblem
from rfpose.multilat.rigid.start import rotations_from_differences
from rfpose.pipeline.choice import choose
from rfpose.pipeline.evaluate import Evaluation, evaluate
from rfpose.pipeline.formats.result import Result
from rfpose.pipeline.process import process
from rfpose.pipeline.simulate import simulate
from rfpose.pipeline.solvable import check_solvable
from rfpose.scenario import Scenario, load_scenario

SHIPPED = Path(__file__).resolve().parents[2] / "data" / "table2_100m.toml"
N_FRAME = 25
DRIFT_RAD = 0.1
"""In the hour that the frames are spread over."""


def site(mirror: dict[str, Any], *, drift_rad: float = DRIFT_RAD, calibration: bool = True) -> Scenario:
    shipped = load_scenario(SHIPPED)
    return shipped.changed(
        heliostat=[h.changed(**{"pivot_sigma_m": 0.005, **mirror}) for h in shipped.heliostat[:4]],
        radio={"frame_samples": 4000, "clock_search_ppm": 2.0},
        calibration_receiver=shipped.calibration_receiver if calibration else [],
        simulation={
            "frame_count": N_FRAME,
            "frame_interval_s": 3600.0 / N_FRAME,
            "tone_snr_db": 60.0,
            "sun_azimuth_deg": 170.0,
            "transmitter_phase_drift_rad_per_sqrt_h": drift_rad,
        },
    )


def solved(directory: Path, mirror: dict[str, Any], *, drift_rad: float) -> Result:
    (directory / "site.toml").write_text(site(mirror, drift_rad=drift_rad, calibration=False).to_toml())
    simulate(directory / "site.toml", seed=5).save(directory / "rec.h5", force=True)
    return process(directory / "rec.h5", directory / "r.h5", estimator="correlator", force=True)


CLOCKS = {"one clock": {"receiver_delay_sigma_s": 0.0}, "three clocks": {"carrier_phase": False}}


@pytest.fixture(scope="module", params=CLOCKS)
def found(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Result, Evaluation]:
    result = solved(tmp_path_factory.mktemp("bare"), CLOCKS[request.param], drift_rad=10.0)
    return result, evaluate(result)


def test_normals_are_at_the_bound_whatever_the_transmitters_do(found: tuple[Result, Evaluation]) -> None:
    _, evaluation = found
    assert evaluation.failed == 0
    # the rms of that many pairs of angles is known to 1/√(4 n)
    spread = 4.0 / np.sqrt(4.0 * 4 * N_FRAME)
    assert abs(evaluation.ratio_to_bound - 1.0) < spread
    assert evaluation.sigma_mrad == pytest.approx(evaluation.bound_mrad, rel=0.05)


def test_what_is_not_known_says_so(found: tuple[Result, Evaluation]) -> None:
    result, evaluation = found
    assert np.all(result.fixes.status == FixStatus.UNCALIBRATED)
    assert np.all(result.ranges.status == RangeStatus.UNCALIBRATED)
    assert np.all(result.calibration.status == CalibrationStatus.MISSING)
    assert np.isnan(evaluation.position_error_m.rms)
    # a mirror is where its pivot was surveyed
    pivot = result.scenario.pivot_enu_m
    assert np.abs(result.poses.centre_enu_m - pivot).max() < 0.5


def test_calibration_receivers_of_a_recording_can_be_left_alone(tmp_path: Path) -> None:
    mirror = CLOCKS["one clock"]
    (tmp_path / "site.toml").write_text(site(mirror).to_toml())
    (tmp_path / "bare.toml").write_text(site(mirror, calibration=False).to_toml())
    simulate(tmp_path / "site.toml", seed=5).save(tmp_path / "rec.h5")
    both = [
        evaluate(process(tmp_path / "rec.h5", tmp_path / f"{name}.h5", estimator="correlator", scenario=path))
        for name, path in (("with", None), ("without", tmp_path / "bare.toml"))
    ]
    assert [e.failed for e in both] == [0, 0]
    assert both[1].normal_error_mrad.rms == pytest.approx(both[0].normal_error_mrad.rms, rel=0.02)


def test_an_old_calibration_does_no_harm(tmp_path: Path) -> None:
    whole = site(CLOCKS["one clock"])
    dropped = [
        {"receiver": c.id, "frame": f, "first_sample": 0, "sample_count": 4000}
        for c in whole.calibration_receiver
        for f in range(3, N_FRAME)
    ]
    whole.changed(simulation={"dropped": dropped}).save(tmp_path / "site.toml")
    simulate(tmp_path / "site.toml", seed=5).save(tmp_path / "rec.h5")
    rigid = evaluate(process(tmp_path / "rec.h5", tmp_path / "r.h5", estimator="correlator"))
    fits = evaluate(process(tmp_path / "rec.h5", tmp_path / "i.h5", estimator="correlator", pose="independent"))
    assert rigid.failed == 0
    assert abs(rigid.ratio_to_bound - 1.0) < 4.0 / np.sqrt(4.0 * 4 * N_FRAME)
    # three fits take the drift for geometry
    assert fits.normal_error_mrad.rms > 1000.0 * rigid.normal_error_mrad.rms


def _as_it_is(plain: Scenario) -> Scenario:
    return plain


def _not_surveyed(plain: Scenario) -> Scenario:
    one, other, *more = plain.heliostat
    return plain.changed(heliostat=[one, other.changed(pivot_sigma_m=None), *more])


def _reflecting(plain: Scenario) -> Scenario:
    return plain.changed(reflection={"model": "estimate"})


def _short_tone(plain: Scenario) -> Scenario:
    return plain.changed(tone={"frequency_hz": 60e6}, radio={"sample_rate_hz": 400e6})


@pytest.mark.parametrize(
    ("pose", "change", "error", "message"),
    [
        ("independent", _as_it_is, ScenarioError, "no calibration receiver, and pose `independent`.*pivot_sigma_m"),
        ("rigid", _not_surveyed, ScenarioError, "no calibration receiver.*`H02`.*not surveyed.*pivot_sigma_m"),
        ("rigid", _reflecting, ScenarioError, "no calibration receiver, and reflections.*leave reflections out"),
        ("rigid", _short_tone, GeometryError, "ambiguous.*quarter.*add a tone"),
    ],
)
def test_what_cannot_do_without_calibration_is_refused(
    pose: str, change: Any, error: type[Exception], message: str
) -> None:
    scenario = change(site({}, calibration=False))
    with pytest.raises(error, match=message):
        check_solvable(scenario, pose=pose, choice=choose(scenario, pose=pose))


@pytest.mark.parametrize("clock_sigma_m", [0.0, np.inf])
def test_the_start_finds_any_orientation(clock_sigma_m: float) -> None:
    rng = np.random.default_rng(4)
    n = 200
    transmitter = load_scenario(SHIPPED).transmitter_enu_m
    places = np.array([[1.0, 0.0, 0.3], [-0.5, 0.9, 0.3], [-0.5, -0.9, 0.3]])
    turn = np.linalg.qr(rng.normal(size=(n, 3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))[:, None, None]
    pivot = np.column_stack([rng.uniform(-60, 60, (n, 2)), rng.uniform(2, 4, n)])
    receiver = pivot[:, None] + np.einsum("mab,rb->mra", turn, places)
    z = np.linalg.norm(receiver[:, :, None] - transmitter, axis=-1) + 1e3 * rng.normal(size=(n, 1, len(transmitter)))
    if clock_sigma_m > 0.0:
        z += 100.0 * rng.normal(size=(n, 3, 1))
    z[:, 1, 2] = np.nan
    problem = MirrorProblem.of(
        transmitter,
        places,
        z[:, None],
        sigma_m=1e-3,
        transmitter_sigma_m=np.inf,
        clock_class=[0],
        start_pivot_enu_m=pivot,
        start_rot_enu_from_mirror=np.nan,
        knowledge=MirrorKnowledge(clock_sigma_m=clock_sigma_m),
    )
    found = rotations_from_differences(problem)
    angle = np.arccos(np.clip((np.einsum("mab,mab->m", found, turn) - 1.0) / 2.0, -1.0, 1.0))
    # parallax is left out: a start, good to a few degrees
    assert np.median(angle) < 0.1
    assert np.mean(angle < 0.5) > 0.97
