"""What a layout study forecasts, what `rfpose process` states, and what errors are, on phases that hold noise alone.

    python benchmarks/forecast.py [--scenarios 10] [--draws 40] [--ground none]

Scenarios are those of tests/property/test_forecast.py, with other seeds: tones, clocks, delays, surveys, mounts and
ground drawn; surveys are off by what they say. Of each kind: the forecast over what is stated, mean, farthest from one
and how many are over 3 % off, of the site as it is surveyed and of the site as it stands; what is stated with the
guard over without it, mean and farthest; the errors' rms over what is stated, with its standard error; how often the
guard left something out.
"""

from __future__ import annotations

import argparse
import runpy
import sys
from fractions import Fraction
from pathlib import Path

import numpy as np

from rfpose import geometry
from rfpose.layout import maps
from rfpose.layout.budget import noise_bound, working_point
from rfpose.multilat import PoseStatus
from rfpose.multilat.integrity import IntegrityStatus
from rfpose.pipeline.choice import choose
from rfpose.pipeline.formats.result import Result
from rfpose.pipeline.solve import solve
from rfpose.scenario import Scenario

ROOT = Path(__file__).resolve().parents[1]
HOW = {"sample_rate": Fraction(64_000_000), "settings": {"estimator": "correlator"}}
KINDS = (("none", 100e6), ("none", 0.0), ("known", 100e6), ("estimated", 100e6))


def whole(found: Result, n_wavelength: int) -> np.ndarray:
    """(mirror,) whether a pose is solved and rests on all wavelengths."""
    return (found.poses.status == PoseStatus.OK)[0] & (found.poses.n_wavelength[0] == n_wavelength)


def ratios(scenario: Scenario, drawn_phases: dict, rng: np.random.Generator, draws: int) -> dict[str, list[float]]:
    """Return every mirror's ratios in every draw."""
    plan = working_point(scenario, maps.mirrors_of(scenario))
    forecast, n_wavelength = noise_bound(plan), len(plan.waves.tone)
    truth = np.array([geometry.unit(np.array(h.normal_enu)) for h in scenario.heliostat])
    out: dict[str, list[float]] = {"forecast": [], "built": [], "guard": [], "error2": [], "spoke": []}
    for _ in range(draws):
        built = drawn_phases["as_built"](scenario, rng)
        tones = drawn_phases["measured"](built, rng)
        found, plain = (
            solve(tones, scenario, choose(scenario, pose="rigid", integrity=guarded), **HOW)
            for guarded in (True, False)
        )
        assert found.integrity is not None
        kept = whole(found, n_wavelength) & whole(plain, n_wavelength)
        quiet = found.integrity.status[0] == IntegrityStatus.OK
        out["spoke"] += (~quiet[kept]).tolist()
        kept &= quiet
        stated = found.poses.sigma_rad[0, kept]
        out["forecast"] += (forecast[kept] / stated).tolist()
        out["built"] += (noise_bound(working_point(built, maps.mirrors_of(built)))[kept] / stated).tolist()
        out["guard"] += (stated / plain.poses.sigma_rad[0, kept]).tolist()
        error = np.linalg.norm(found.poses.normal_enu[0, kept] - truth[kept], axis=1)
        if kept.any():  # mirrors of a frame share its calibration: one number a frame
            out["error2"].append(float(np.mean((error / stated) ** 2)))
    return out


def spread(ratio: np.ndarray) -> str:
    """Return mean, the one farthest from one, and how many are over 3 % off."""
    far = ratio[np.argmax(np.abs(ratio - 1.0))]
    return f"{ratio.mean():.4f}, {far:.4f}, {100.0 * np.mean(np.abs(ratio - 1.0) > 0.03):.2f} %"


def main() -> None:
    """Print a row a kind of scenario."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenarios", type=int, default=10)
    parser.add_argument("--draws", type=int, default=40)
    parser.add_argument("--ground", choices=("none", "known", "estimated"), help="this kind alone")
    asked = parser.parse_args()
    sys.path.append(str(ROOT / "tests"))  # where the test's fields are
    made = runpy.run_path(str(ROOT / "tests" / "property" / "test_forecast.py"))
    print(
        "ground, RF [MHz] | poses | forecast / stated, farthest, over 3 % off | as built | guarded / plain, farthest | "
        "error / stated | spoke"
    )
    for ground, centre_hz in KINDS:
        if asked.ground not in (None, ground):
            continue
        all_of: dict[str, list[float]] = {}
        for seed in range(asked.scenarios):
            rng = np.random.default_rng([7, seed])
            scenario = made["drawn"](rng, ground=ground, centre_hz=centre_hz)
            for name, values in ratios(scenario, made, rng, asked.draws).items():
                all_of.setdefault(name, []).extend(values)
        names = ("forecast", "built", "guard", "error2", "spoke")
        forecast, built, guard, error2, spoke = (np.array(all_of[name], float) for name in names)
        far_guard = guard[np.argmax(np.abs(guard - 1.0))]
        rms = np.sqrt(error2.mean())
        uncertain = 0.5 * error2.std() / np.sqrt(len(error2)) / rms
        print(
            f"{ground}, {centre_hz / 1e6:g} | {len(forecast)} | {spread(forecast)} | {spread(built)} | "
            f"{guard.mean():.6f}, {far_guard:.6f} | {rms:.3f} ± {uncertain:.3f} | {100.0 * spoke.mean():.2f} %"
        )


if __name__ == "__main__":
    main()
