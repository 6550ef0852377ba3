"""IQ to normal with reflections, bad transmitters and drifting delays: what the estimators mend, and what they say."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from rfpose.errors import GeometryError, InvalidInputError
from rfpose.multilat import PoseStatus
from rfpose.multilat.integrity import IntegrityStatus, TransmitterStatus
from rfpose.pipeline.bound import normal_bound_rad
from rfpose.pipeline.choice import PoseChoice, choose
from rfpose.pipeline.evaluate import evaluate
from rfpose.pipeline.formats.result import Result
from rfpose.pipeline.formats.result_file import open_result, write_result
from rfpose.pipeline.formats.result_summary import summarise
from rfpose.pipeline.noise import phase_noise
from rfpose.pipeline.process import process
from rfpose.pipeline.simulate import simulate
from rfpose.pipeline.solvable import check_solvable
from rfpose.pipeline.solve import solve
from rfpose.scenario import Scenario, load_scenario

SHIPPED = Path(__file__).resolve().parents[2] / "data" / "table2_100m.toml"
COEFFICIENT = (-0.3, 0.1)
N_FRAME = 12
N_POSE = 4 * N_FRAME


def site(
    mirror: dict[str, Any], simulation: dict[str, Any], *, tone_hz: tuple[float, ...] = (0.75e6, 7.5e6)
) -> Scenario:
    """Four heliostats of the shipped field, carriers far enough apart for 7.5 MHz tones."""
    shipped = load_scenario(SHIPPED)
    return shipped.changed(
        heliostat=[h.changed(**mirror) for h in shipped.heliostat[:4]],
        radio={"sample_rate_hz": 64e6, "frame_samples": 4000, "clock_search_ppm": 2.0},
        tone=[{"frequency_hz": f, "modulation_index": 0.8 / len(tone_hz)} for f in tone_hz],
        transmitter=[t.changed(carrier_hz=-16.2e6 + 3.6e6 * i) for i, t in enumerate(shipped.transmitter)],
        simulation={
            "frame_count": N_FRAME,
            "frame_interval_s": 1.0,
            "tone_snr_db": 60.0,
            "sun_azimuth_deg": 170.0,
            "path_loss": "free_space",
            **simulation,
        },
    )


def recorded(scenario: Scenario, directory: Path, name: str) -> Path:
    (directory / f"{name}.toml").write_text(scenario.to_toml())
    simulate(directory / f"{name}.toml", seed=3).save(directory / f"{name}.h5")
    return directory / f"{name}.h5"


# -- reflections ---------------------------------------------------------------------------------------------

KNOWN = {"pivot_sigma_m": 0.005, "receiver_delay_sigma_s": 0.0}


@pytest.fixture(scope="module")
def two_ray(tmp_path_factory: pytest.TempPathFactory) -> Path:
    ground = {"ground": {"coefficient": COEFFICIENT}}
    return recorded(site(KNOWN, ground), tmp_path_factory.mktemp("two_ray"), "two")


@pytest.fixture(scope="module")
def free_rms(tmp_path_factory: pytest.TempPathFactory) -> float:
    path = recorded(site(KNOWN, {}), tmp_path_factory.mktemp("free"), "free")
    found = evaluate(process(path, path.with_name("r.h5"), estimator="correlator"))
    assert found.failed == 0
    return found.normal_error_mrad.rms


@pytest.fixture(scope="module")
def estimated(two_ray: Path) -> Result:
    return process(two_ray, two_ray.with_name("estimated.h5"), estimator="correlator", reflection="estimate")


def test_an_estimated_reflection_costs_no_accuracy(estimated: Result, free_rms: float) -> None:
    found = evaluate(estimated)
    assert found.failed == 0
    assert found.normal_error_mrad.rms <= 1.3 * free_rms
    # the rms of that many pairs of angles is known to 1/√(4 n)
    assert found.ratio_to_bound < 1.0 + 4.0 / np.sqrt(4.0 * N_POSE)
    assert found.protection is not None
    assert (found.protection.exceeded, found.protection.covered) == (0, N_POSE)


def test_the_coefficient_and_its_sigma_are_in_the_result(estimated: Result, two_ray: Path) -> None:
    table = estimated.reflection
    assert table is not None
    error = table.coefficient[..., 0] - complex(*COEFFICIENT)
    assert np.all(np.abs(error.real) < 5.0 * table.coefficient_sigma[..., 0, 0])
    assert np.all(np.abs(error.imag) < 5.0 * table.coefficient_sigma[..., 0, 1])
    assert table.coefficient_sigma.max() < 1e-3
    assert np.all(table.probability_direct < 1e-3)
    again = open_result(two_ray.with_name("estimated.h5"))
    assert again.settings["reflection"] == "estimate"
    summary = summarise(again)["reflection"]
    assert (summary["needed"], summary["coefficients"]["ground"]["status"]) == (N_POSE, "estimated")


def test_an_ignored_reflection_is_never_silent(two_ray: Path) -> None:
    result = process(two_ray, two_ray.with_name("ignored.h5"), estimator="correlator", reflection="ignore")
    assert result.truth is not None
    error = np.linalg.norm(result.poses.normal_enu - result.truth.normal_enu, axis=-1)
    assert np.all(error > 1e-3)
    assert np.all(result.poses.status == PoseStatus.UNEXPLAINED)
    assert result.integrity is not None
    assert np.all(np.isinf(result.integrity.protection_level_rad))
    assert summarise(result)["integrity"]["excluded"] == {}


def test_a_given_coefficient_is_used_as_given(two_ray: Path, tmp_path: Path, free_rms: float) -> None:
    path = tmp_path / "known.toml"
    site(KNOWN, {}).changed(reflection={"model": "known", "coefficient": COEFFICIENT}).save(path)
    result = process(two_ray, tmp_path / "r.h5", scenario=path, estimator="correlator")
    assert evaluate(result).normal_error_mrad.rms <= 1.3 * free_rms
    assert result.reflection is not None
    assert np.all(result.reflection.coefficient_sigma == 0.0)


@pytest.fixture(scope="module")
def far_apart(tmp_path_factory: pytest.TempPathFactory) -> Result:
    """Three calibration receivers with reflections of their own, in three frames."""
    one = site(KNOWN, {"ground": {"coefficient": COEFFICIENT}, "frame_count": 3})
    places = ([15.0, -20.0, 2.5], [-45.0, 35.0, 8.0], [35.0, 60.0, 8.0])
    like = one.calibration_receiver[0]
    three = [like.changed(id=f"C{k}", position_enu_m=place) for k, place in enumerate(places)]
    path = recorded(one.changed(calibration_receiver=three), tmp_path_factory.mktemp("far"), "far")
    return process(path, path.with_name("r.h5"), estimator="correlator", reflection="estimate")


@pytest.mark.parametrize("model", ["estimate", "known"])
@pytest.mark.parametrize("lost", ["nothing", "phases"])
def test_calibration_receivers_each_have_a_reflection_of_their_own(far_apart: Result, model: str, lost: str) -> None:
    scenario, tones = far_apart.scenario, far_apart.tones
    if model == "known":
        scenario = scenario.changed(reflection={"model": "known", "coefficient": COEFFICIENT})
    if lost == "phases":
        # a frame whose average is of two, a transmitter seen by one, and one that another frame must stand in for
        phase = np.array(tones.phase_rad)
        phase[0, -1], phase[1, -2:, 3], phase[2, -3:, 5] = np.nan, np.nan, np.nan
        tones = replace(tones, phase_rad=phase)
    choice = replace(far_apart.choice, reflection=model)
    result = solve(
        tones,
        scenario,
        choice,
        sample_rate=far_apart.sample_rate,
        settings=far_apart.settings,
        truth=far_apart.truth,
    )
    found = evaluate(result)
    assert found.failed == 0
    # two angles a pose, twelve poses: 4.5 sigma
    assert found.ratio_to_bound < 1.0 + 4.5 / np.sqrt(4.0 * 12)
    assert found.sigma_mrad == pytest.approx(found.bound_mrad, rel=0.1)


# -- what cannot be known ------------------------------------------------------------------------------------


def _as_measured(scenario: Scenario, directory: Path, name: str) -> Result:
    path = recorded(scenario, directory, name)
    return process(path, path.with_name(f"{name}_r.h5"), estimator="correlator")


def _among(thickness_m: float, pivot_height_m: float) -> Scenario:
    """Mirrors between transmitters about 2 m high."""
    plain = site({"receiver_delay_sigma_s": 0.0}, {"frame_count": 3})
    place, pivot = plain.transmitter_enu_m.copy(), plain.pivot_enu_m.copy()
    place[:, 2] = 2.0 + thickness_m * np.random.default_rng(5).uniform(-0.5, 0.5, len(place))
    pivot[:, 2] = 2.0 + (-1.0) ** np.arange(len(pivot)) * pivot_height_m
    heliostat = [h.changed(pivot_enu_m=p) for h, p in zip(plain.heliostat, pivot, strict=True)]
    return plain.with_transmitters(place).changed(heliostat=heliostat)


def test_mirrors_among_level_transmitters_have_an_image_and_say_so(tmp_path: Path) -> None:
    result = _as_measured(_among(0.0, 2.5), tmp_path, "level")
    assert np.all(result.poses.status == PoseStatus.AMBIGUOUS)
    assert np.all(np.isfinite(result.poses.normal_enu))
    found = evaluate(result)
    assert (found.solved, found.failed) == (0, 12)


def test_mirrors_among_nearly_level_transmitters_are_solved_from_both_sides(tmp_path: Path) -> None:
    result = _as_measured(_among(0.5, 2.5), tmp_path, "nearly")
    found = evaluate(result)
    assert found.solved == 12
    assert found.ratio_to_bound < 1.0 + 4.5 / np.sqrt(4.0 * 12)


@pytest.mark.parametrize("pose", ["rigid", "independent"])
def test_a_pose_that_tells_nothing_is_not_solved(tmp_path: Path, pose: str) -> None:
    scenario = site({}, {"frame_count": 3, "tone_snr_db": 0.0}, tone_hz=(0.75e6,))
    path = recorded(scenario, tmp_path, "weak")
    result = process(path, tmp_path / "r.h5", estimator="correlator", pose=pose)
    found = evaluate(result)
    assert np.all(result.poses.sigma_rad[result.poses.status == PoseStatus.OK] <= 0.1)
    assert found.solved == 0
    assert np.any(result.poses.status == PoseStatus.UNCERTAIN)
    assert any("0.1 rad" in reason for reason in found.failure_reasons)


# -- bad transmitters ----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def clean(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recorded(site(KNOWN, {}), tmp_path_factory.mktemp("clean"), "clean")


def _interfered(clean: Path, path: Path, receivers: list[str], *, i_transmitter: int, relative: float) -> Path:
    """Put a sine half a resolution beside a sideband of one transmitter into some receivers."""
    path.write_bytes(clean.read_bytes())
    scenario = load_scenario(clean.with_suffix(".toml"))
    offset = scenario.carrier_hz[i_transmitter] + scenario.tone_hz[1] + 0.4 * 64e6 / 4000
    with h5py.File(path, "r+") as file:
        for receiver in receivers:
            dataset = file[f"receivers/{receiver}/iq"]
            iq = dataset[()]
            wave = relative * np.abs(iq["r"]).max() * np.exp(2j * np.pi * offset / 64e6 * np.arange(len(iq)))
            iq["r"] += np.rint(wave.real).astype("i2")
            iq["i"] += np.rint(wave.imag).astype("i2")
            dataset[...] = iq
    return path


def test_interference_is_left_out_with_its_reason(clean: Path, tmp_path: Path) -> None:
    mirror = ["H02_r0", "H02_r1", "H02_r2"]
    path = _interfered(clean, tmp_path / "jammed.h5", mirror, i_transmitter=3, relative=0.02)
    result = process(path, tmp_path / "r.h5", estimator="correlator")
    table = result.integrity
    assert table is not None
    # a sine pulls the phase by more or less, as the two happen to meet: what it spoils is left out
    left_out = table.transmitter_status > TransmitterStatus.NOT_RECEIVED
    assert left_out[:, 1, 3].sum() > N_FRAME / 2
    left_out[:, 1, 3] = False
    assert not left_out.any()
    assert np.all(table.status[:, [0, 2, 3]] == IntegrityStatus.OK)
    assert list(summarise(result)["integrity"]["excluded"]) == ["T4"]
    assert list(summarise(result)["integrity"]["excluded"]["T4"]) == [TransmitterStatus.INTERFERENCE.reason]
    found = evaluate(result)
    assert found.failed == 0
    # the sine is noise to the mirror's other transmitters too, which their sigma says
    assert np.all(found.normal_error_rad < 4.5 * result.poses.sigma_rad)
    assert found.protection is not None
    assert found.protection.exceeded == 0
    off = process(path, tmp_path / "off.h5", estimator="correlator", integrity=False)
    assert off.integrity is None
    assert off.settings["integrity"] == "off"


def test_a_transmitter_elsewhere_than_surveyed_is_left_out(clean: Path, tmp_path: Path) -> None:
    told = load_scenario(clean.with_suffix(".toml"))
    place = told.transmitter_enu_m.copy()
    place[6, 0] += 0.5
    told.with_transmitters(place).save(tmp_path / "moved.toml")
    result = process(clean, tmp_path / "r.h5", scenario=tmp_path / "moved.toml", estimator="correlator")
    excluded = summarise(result)["integrity"]["excluded"]
    assert list(excluded) == ["T7"]
    assert sum(excluded["T7"].values()) == N_POSE
    assert evaluate(result).normal_error_mrad.max < 0.01


def test_a_pivot_that_contradicts_the_data_is_flagged_not_averaged(clean: Path, tmp_path: Path) -> None:
    told = load_scenario(clean.with_suffix(".toml"))
    heliostat = list(told.heliostat)
    heliostat[2] = heliostat[2].changed(pivot_enu_m=np.add(heliostat[2].pivot_enu_m, (0.3, 0.0, 0.0)))
    told.changed(heliostat=heliostat).save(tmp_path / "off.toml")
    result = process(clean, tmp_path / "r.h5", scenario=tmp_path / "off.toml", estimator="correlator")
    table = result.integrity
    assert table is not None
    assert np.all(table.prior_rejected[:, 2, 0])
    assert not table.prior_rejected[:, [0, 1, 3]].any()
    assert np.all(table.status[:, 2] == IntegrityStatus.PRIOR_REJECTED)
    assert summarise(result)["integrity"]["priors_rejected"] == {"pivot": N_FRAME}
    assert evaluate(result).normal_error_mrad.max < 0.01


# -- drifting delays -----------------------------------------------------------------------------------------


OUTER = ((70.0, 0.0), (-10.0, -80.0), (-60.0, 45.0), (45.0, 65.0))
"""Where one clock is worth most."""


@pytest.fixture(scope="module")
def learned(tmp_path_factory: pytest.TempPathFactory) -> Result:
    mirror = {"receiver_delay_drift_s_per_sqrt_min": 1e-12, "carrier_phase": False}
    simulation = {
        "frame_count": 60,
        "frame_interval_s": 10.0,
        "receiver_delay_s": 1e-9,
        "receiver_delay_drift_s_per_sqrt_min": 1e-12,
        "sun_azimuth_deg": (120.0, 240.0),
        "path_loss": "none",
        "tone_snr_db": 57.3,  # 0.97 mm of each range, as in the paper on a field of this size
    }
    scenario = site(mirror, simulation, tone_hz=(0.75e6,))
    heliostat = [h.changed(pivot_enu_m=(*p, 2.0)) for h, p in zip(scenario.heliostat, OUTER, strict=True)]
    scenario = scenario.changed(radio={"frame_samples": 8000}, heliostat=heliostat)
    path = recorded(scenario, tmp_path_factory.mktemp("delays"), "drift")
    return process(path, path.with_name("r.h5"), estimator="correlator")


def test_learned_delays_reach_the_shared_clock(learned: Result) -> None:
    assert learned.truth is not None
    found = evaluate(learned)
    assert found.failed == 0
    known = {"receiver_delay_drift_s_per_sqrt_min": None, "receiver_delay_sigma_s": 0.0}
    shared = normal_bound_rad(
        learned.scenario.changed(heliostat=known),
        PoseChoice(pose="rigid", reflection="none", integrity=True),
        phase_noise(learned, learned.truth, np.arange(60)),
        normal_enu=learned.truth.normal_enu,
        receiver_enu_m=learned.truth.receiver_enu_m,
        frame_start_index=learned.frame_start_index,
        sample_rate=learned.sample_rate,
    )
    late = slice(45, None)
    error = np.sqrt(np.mean(found.normal_error_rad[late] ** 2))
    assert error <= 1.3 * np.sqrt(np.mean(shared[late] ** 2))
    assert np.sqrt(np.mean(found.normal_error_rad[0] ** 2)) > 1.5 * np.sqrt(np.mean(shared[0] ** 2))
    # 240 mirror-frames whose learned part is common to neighbours: about 60 independent pairs of angles
    assert found.ratio_to_bound == pytest.approx(1.0, abs=4.0 / np.sqrt(2.0 * 120.0))


def test_learned_covariance_and_delays_tell_the_truth(learned: Result) -> None:
    assert learned.truth is not None
    assert learned.delays is not None
    error = np.linalg.norm(learned.poses.normal_enu - learned.truth.normal_enu, axis=-1)
    ratio = error / learned.poses.sigma_rad
    assert np.sqrt(np.mean(ratio**2)) == pytest.approx(1.0, abs=4.0 / np.sqrt(2.0 * 120.0))
    true = learned.truth.receiver_delay_s[:, :12].reshape(60, 4, 3)
    true = (true - true[..., :1]).reshape(60, 12)
    off = (learned.delays.delay_s[:, :12, 0] - true)[:, [1, 2, 4, 5, 7, 8, 10, 11]]
    sigma = learned.delays.sigma_s[:, :12, 0][:, [1, 2, 4, 5, 7, 8, 10, 11]]
    assert np.sqrt(np.mean((off / sigma)[-1] ** 2)) < 2.0
    assert sigma[-1].max() < 0.7 * sigma[0].min()
    assert not learned.delays.jumped.any()
    assert np.all(np.isnan(learned.delays.delay_s[:, 12:]))


def test_delays_learned_are_the_same_from_the_file(learned: Result, tmp_path: Path) -> None:
    write_result(learned, tmp_path / "r.h5")
    again = open_result(tmp_path / "r.h5")
    assert again.delays is not None
    assert learned.delays is not None
    np.testing.assert_array_equal(again.delays.delay_s, learned.delays.delay_s)
    assert evaluate(again).as_dict() == evaluate(learned).as_dict()


# -- sites that cannot be right ------------------------------------------------------------------------------


def test_a_transmitter_below_the_ground_is_named() -> None:
    with pytest.raises(GeometryError, match=r"transmitter `T1` lies 5 m behind reflector `ground`.*height_m"):
        check_solvable(site({}, {}).changed(reflection={"model": "estimate", "height_m": 25.0}), pose="rigid")
    wall = {"name": "wall", "point_enu_m": (0.0, 30.0, 0.0), "normal_enu": (0.0, 1.0, 0.0)}
    with pytest.raises(GeometryError, match="behind reflector `wall`"):
        check_solvable(site({}, {}).changed(reflection={"model": "estimate", "plane": [wall]}), pose="rigid")


def test_two_mirrors_with_one_receiver_are_named() -> None:
    plain = site({}, {})
    one, other, *more = plain.heliostat
    other = other.changed(receiver_ids=("H02_r0", "H01_r1", "H02_r2"))
    with pytest.raises(ValueError, match=r"receiver `H01_r1` appears twice: .*heliostat `H01` and to heliostat `H02`"):
        plain.changed(heliostat=[one, other, *more])


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"model": "known"}, "coefficient"),
        ({"model": "fresnel"}, "permittivity"),
        ({"model": "estimate", "coefficient": (0.1, 0.0)}, "coefficient"),
        ({"model": "known", "coefficient": (1.0, 0.5)}, "exceed one"),
        ({"model": "estimate", "scaled": True}, "scaled"),
        ({"model": "none", "plane": [{"name": "w", "point_enu_m": (0, 0, 0), "normal_enu": (1, 0, 0)}]}, "model"),
        ({"model": "estimate", "normal_enu": (0.0, 0.0, 0.0)}, "must not be zero"),
    ],
)
def test_contradictory_reflections_are_refused(table: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        site({}, {}).changed(reflection=table)


@pytest.mark.parametrize("mirror", [{"receiver_delay_sigma_s": 0.0}, {"oscillator": "separate"}])
def test_delays_are_known_or_learned(mirror: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="receiver_delay_drift_s_per_sqrt_min"):
        site({"receiver_delay_drift_s_per_sqrt_min": 1e-12, **mirror}, {})


def test_independent_receivers_follow_no_such_choice() -> None:
    with pytest.raises(InvalidInputError, match="`reflection` is of pose `rigid`"):
        choose(site({}, {}), pose="independent", reflection="estimate")
    with pytest.raises(InvalidInputError, match="`integrity` is of pose `rigid`"):
        choose(site({}, {}), pose="independent", integrity=True)
    assert choose(site({}, {}), pose="independent").integrity is False
