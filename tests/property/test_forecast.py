"""What a layout study forecasts of a scenario is what `rfpose process` states of phases that hold nothing but noise."""

from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from rfpose import geometry
from rfpose.dsp import TonePhases
from rfpose.layout import maps
from rfpose.layout.budget import noise_bound, working_point
from rfpose.measurement import SCENARIO
from rfpose.multilat import PoseStatus
from rfpose.multilat.ground import Reflector, range_shift_m
from rfpose.multilat.integrity import IntegrityStatus
from rfpose.pipeline.choice import choose
from rfpose.pipeline.solve import solve
from rfpose.scenario import Scenario
from sites import TABLE_2

TONES_HZ = ((0.75e6,), (0.75e6, 7.5e6), (7.5e6, 0.75e6, 2.9e6))
"""One, two, three; the last not in the solver's order."""
COEFFICIENT, GROUND_M = -0.12 + 0.05j, -2.0
SNR_DB, N_SAMPLE, REFERENCE_M = 60.0, 20_000, 100.0


def drawn(rng: np.random.Generator, *, ground: str, centre_hz: float) -> Scenario:
    """Return a site about Table 2's transmitters whose radio, clocks, surveys and mounts are drawn."""
    tones = TONES_HZ[rng.integers(3)]
    n_calibration = int(rng.integers(1 if ground != "none" else 0, 3))
    mirror: dict[str, Any] = {
        "oscillator": rng.choice(["shared", "separate"]).item(),
        "carrier_phase": bool(rng.random() < 0.7),
        "mount": rng.choice(["free", "azimuth_elevation"]).item(),
        "arm_m": 0.3,
    }
    delay = (None, 0.0, 5e-11)[rng.integers(3)]
    if delay is not None:
        mirror["receiver_delay_sigma_s"] = delay
    if n_calibration == 0 or ground != "none" or rng.random() < 0.5:
        mirror["pivot_sigma_m"] = 0.005
    places = np.array([[0.9988, 0.0, 0.0], [-0.4994, 0.865, 0.0], [-0.4994, -0.865, 0.0], [0.4, 0.6, 0.0]])
    places = places[: rng.integers(3, 5)]
    simulation: dict[str, Any] = {
        "tone_snr_db": SNR_DB,
        "path_loss": rng.choice(["none", "free_space"]).item(),
        "reference_range_m": REFERENCE_M,
        "sample_format": "complex64",
    }
    data: dict[str, Any] = {
        "name": "drawn",
        "radio": {
            "sample_rate_hz": 64e6, "centre_frequency_hz": centre_hz, "frame_samples": N_SAMPLE,
            "clock_search_ppm": 2.0,
        },
        "tone": [{"frequency_hz": f, "modulation_index": m} for f, m in zip(tones, (0.4, 0.3, 0.2), strict=False)],
        "transmitter": [
            {
                "id": f"T{k}", "position_enu_m": (100.0 * place).tolist(), "carrier_hz": -16.2e6 + 3.6e6 * k,
                "amplitude": rng.uniform(0.7, 1.0),
            }
            for k, place in enumerate(TABLE_2)
        ],
        "calibration_receiver": [
            {
                "id": f"C{k}", "position_enu_m": [15.0 - 40.0 * k, -20.0, 2.5],
                "survey_sigma_m": rng.choice([0.0, 0.002]).item(),
            }
            for k in range(n_calibration)
        ],
        "heliostat": [
            {
                "id": f"H{k}", "pivot_enu_m": [*rng.uniform(-50.0, 50.0, 2), 2.0], "receiver_mirror_m": places.tolist(),
                "receiver_ids": [f"H{k}.{r}" for r in range(len(places))],
                "normal_enu": [*rng.uniform(-0.5, 0.5, 2), 1.0], **mirror,
            }
            for k in range(3)
        ],
        "simulation": simulation,
    }  # fmt: skip
    if ground != "none":
        part = [COEFFICIENT.real, COEFFICIENT.imag]
        simulation["ground"] = {"coefficient": part, "height_m": GROUND_M}
        data["reflection"] = {
            "model": "estimate" if ground == "estimated" else "known",
            "height_m": GROUND_M,
            "spreading": simulation["path_loss"],
            **({} if ground == "estimated" else {"coefficient": part}),
        }
    return Scenario.model_validate(data)


def places_of(scenario: Scenario) -> np.ndarray:
    """(receiver, xyz) along the scenario's axis."""
    rows = []
    for heliostat in scenario.heliostat:
        rot = geometry.rot_enu_from_mirror(heliostat.normal_enu)
        arm = np.array([0.0, 0.0, heliostat.arm_m])
        rows.append(np.array(heliostat.pivot_enu_m) + (np.array(heliostat.receiver_mirror_m) + arm) @ rot.T)
    return np.concatenate([*rows, scenario.calibration_enu_m])


def measured(scenario: Scenario, rng: np.random.Generator) -> TonePhases:
    """Return one frame of phases as receivers would measure them: geometry, clocks, electronic phases and noise."""
    place, tower = places_of(scenario), scenario.transmitter_enu_m
    n_receiver, n_tone = len(place), len(scenario.tone)
    distance = np.linalg.norm(place[:, None] - tower, axis=-1)
    range_m = np.repeat(distance[..., None], n_tone + 1, axis=2)
    if scenario.simulation.ground is not None:
        range_m += range_shift_m(
            tower,
            place,
            reflectors=[Reflector(point_enu_m=(0.0, 0.0, GROUND_M), coefficient=COEFFICIENT)],
            carrier_rf_hz=scenario.carrier_rf_hz,
            tone_hz=np.append(scenario.tone_hz, 0.0),
            free_space=scenario.simulation.path_loss == "free_space",
        )
    clock_m, delay_m = rng.normal(0.0, 30.0, n_receiver), np.zeros((n_receiver, n_tone + 1))
    for i, heliostat in enumerate(scenario.heliostat):
        rows = scenario.receiver_rows(i)
        if heliostat.oscillator == "shared":
            clock_m[rows] = clock_m[rows][0]
            sigma_s = 1e-9 if heliostat.receiver_delay_sigma_s is None else heliostat.receiver_delay_sigma_s
            delay_m[rows] = 299_792_458.0 * sigma_s * rng.normal(size=delay_m[rows].shape)
    range_m += (clock_m[:, None] + delay_m)[:, None]
    index, amplitude = (np.array([getattr(r, n) for r in rs]) for rs, n in (
        (scenario.tone, "modulation_index"), (scenario.transmitter, "amplitude")
    ))  # fmt: skip
    loss = distance / REFERENCE_M if scenario.simulation.path_loss == "free_space" else np.ones_like(distance)
    sigma = 1.0 / (np.sqrt(N_SAMPLE * 10.0 ** (SNR_DB / 10.0)) * amplitude[:, None] * index / index[0])
    sigma = sigma * loss[..., None]
    electronic = rng.uniform(-np.pi, np.pi, (len(tower), n_tone + 1))
    with np.errstate(divide="ignore"):
        k = 2.0 * np.pi / np.vstack([np.tile(scenario.wavelength_m[:, None], len(tower)), 299_792_458.0 / np.where(
            scenario.carrier_rf_hz > 0.0, scenario.carrier_rf_hz, 1.0)]).T  # fmt: skip
    phase = electronic - k * range_m
    carrier_sigma = sigma[..., 0] * index[0] / np.sqrt(2.0)
    phase[..., :-1] += sigma * rng.normal(size=sigma.shape)
    phase[..., -1] += carrier_sigma * rng.normal(size=carrier_sigma.shape)
    tones = TonePhases.empty(
        receiver_ids=scenario.receiver_ids,
        transmitter_ids=scenario.transmitter_ids,
        tone_hz=scenario.tone_hz,
        frame_start_index=np.zeros(1, np.int64),
    )
    tones.phase_rad[0], tones.sigma_rad[0] = np.angle(np.exp(1j * phase[..., :-1])), sigma
    tones.carrier[0], tones.carrier_sigma[0] = np.exp(1j * phase[..., -1]), carrier_sigma
    tones.status[:] = 0
    return tones


def as_built(scenario: Scenario, rng: np.random.Generator) -> Scenario:
    """Return the site as it is: what was surveyed lies elsewhere, by what surveys are off."""

    def off(place_m: tuple[float, ...], sigma_m: float | None) -> list[float]:
        return (np.array(place_m) + rng.normal(0.0, 1.0, 3) * (sigma_m or 0.0)).tolist()

    return scenario.changed(
        heliostat=[{**h.model_dump(), "pivot_enu_m": off(h.pivot_enu_m, h.pivot_sigma_m)} for h in scenario.heliostat],
        calibration_receiver=[
            {**c.model_dump(), "position_enu_m": off(c.position_enu_m, c.survey_sigma_m)}
            for c in scenario.calibration_receiver
        ],
    )


CASES = [("none", 100e6, k) for k in range(6)] + [("none", 0.0, k) for k in range(2)]
CASES += [(ground, 100e6, k) for ground in ("known", "estimated") for k in range(3)]


@pytest.mark.parametrize(("ground", "centre_hz", "seed"), CASES)
def test_the_forecast_is_what_process_states(ground: str, centre_hz: float, seed: int) -> None:
    rng = np.random.default_rng(["none", "known", "estimated"].index(ground) + 10 * seed + 100 * (centre_hz == 0.0))
    scenario = drawn(rng, ground=ground, centre_hz=centre_hz)
    tones, mirrors = measured(scenario, rng), maps.mirrors_of(scenario)
    how = {"sample_rate": Fraction(64_000_000), "settings": {"estimator": "correlator"}}
    found = solve(tones, scenario, choose(scenario, pose="rigid"), **how)
    assert found.integrity is not None
    plan = working_point(scenario, mirrors)
    # a pose that rests on less than all phases states more
    whole = (found.poses.status == PoseStatus.OK)[0] & (found.integrity.status == IntegrityStatus.OK)[0]
    whole &= found.poses.n_wavelength[0] == len(plan.waves.tone)
    assert np.count_nonzero(whole) >= 2
    stated = found.poses.sigma_rad[0][whole]
    np.testing.assert_allclose(noise_bound(plan)[whole], stated, rtol=0.05)
    if ground != "none":
        return
    np.testing.assert_allclose(maps.study_of(scenario, SCENARIO).bound(mirrors)[whole], stated, rtol=0.05)
    if scenario.calibration_receiver:
        stated = solve(tones, scenario, choose(scenario, pose="independent"), **how).poses.sigma_rad[0]
        np.testing.assert_allclose(maps.study_of(scenario, "independent").bound(mirrors), stated, rtol=0.05)
        np.testing.assert_allclose(noise_bound(working_point(scenario, mirrors, pose="independent")), stated, rtol=0.05)


@pytest.mark.parametrize("seed", [7, 12, 15])
def test_surveys_that_are_off_by_what_they_say_raise_no_alarm(seed: int) -> None:
    """With a known ground: what a calibration receiver sees of it depends on where that truly stands."""
    rng = np.random.default_rng([7, seed])
    scenario = drawn(rng, ground="known", centre_hz=100e6)
    truth = np.array([geometry.unit(np.array(h.normal_enu)) for h in scenario.heliostat])
    assert all(c.survey_sigma_m > 0.0 for c in scenario.calibration_receiver)
    spoke, error2 = [], []
    for _ in range(15):
        built = as_built(scenario, rng)
        tones = measured(built, rng)
        found = solve(tones, scenario, choose(scenario, pose="rigid"), sample_rate=Fraction(64_000_000),
                      settings={"estimator": "correlator"})  # fmt: skip
        assert found.integrity is not None
        assert (found.poses.status == PoseStatus.OK).all()
        spoke += (found.integrity.status[0] != IntegrityStatus.OK).tolist()
        stated = found.poses.sigma_rad[0]
        # of the site as it stands: with the ground, sigma itself depends on the place within millimetres
        np.testing.assert_allclose(noise_bound(working_point(built, maps.mirrors_of(built))), stated, rtol=0.02)
        error2 += (np.sum((found.poses.normal_enu[0] - truth) ** 2, axis=1) / stated**2).tolist()
    assert np.mean(spoke) <= 0.05
    assert 0.75 < np.sqrt(np.mean(error2)) < 1.25


@pytest.mark.parametrize("seed", [8, 16])
def test_poses_are_found_where_the_direct_ray_leaves_all_in_false_minima(seed: int) -> None:
    rng = np.random.default_rng([7, seed])
    scenario = drawn(rng, ground="known", centre_hz=100e6)
    found = solve(measured(scenario, rng), scenario, choose(scenario, pose="rigid"), sample_rate=Fraction(64_000_000),
                  settings={"estimator": "correlator"})  # fmt: skip
    assert found.integrity is not None
    assert (found.poses.status == PoseStatus.OK).all()
    assert (found.integrity.status == IntegrityStatus.OK).all()
