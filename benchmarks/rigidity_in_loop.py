"""Print how much softer a closed loop lets a structure be, in the tracking simulation and by frequencies (Edwards V55).

    python benchmarks/rigidity_in_loop.py [--hours 9 12] [--mirrors 48] [--wind 5] [--only loop|reading|limit-cycle]

Loop: data/tracking_100m.toml with perfect mounts, no play, fine steps, no lost frames. Deflection and rms grow alike:
the ratio of the rms without feedback to that with it is what the deflection may grow by, and one case is run again with
the deflection grown by that much. The mean deflection, which any calibration takes away, is taken off the rms without
feedback. Reading: what models come to Edwards' 3 to 10. Limit cycle: rows V43 and V45.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import brentq

from rfpose.feedback.servo import PiLaw, run_loop
from rfpose.feedback.servo.margins import design_law
from rfpose.feedback.structure import EDWARDS_MODE, StructureMode, plate_mode_hz
from rfpose.feedback.tracking import TrackingSimulation, score
from rfpose.feedback.tracking.budget import SampledLoop, track_budget
from rfpose.feedback.wind import perfect_servo, rigidity_gain, sunshine_deflection
from rfpose.feedback.wind.spectrum import wind_deflection
from rfpose.scenario import Scenario, load_scenario

SCENARIO = Path(__file__).resolve().parents[1] / "data" / "tracking_100m.toml"
BEND_MRAD = (0.003, 0.006)
DISH_M = 4.43
NO_ERRORS = {
    "tilt_sigma_mrad": 0.0, "zero_sigma_mrad": 0.0, "nonorthogonality_sigma_mrad": 0.0, "canting_sigma_mrad": 0.0,
    "location_sigma_mm": 0.0, "worm_sigma_mrad": 0.0, "sag_sigma_mrad": 0.0, "thermal_sigma_mrad": 0.0,
    "creep_sigma_mrad_per_month": 0.0,
}  # fmt: skip
# Appendix G: ζ = 0.026/f at 5 m/s. No whole multiples of the servo's rate, whose samples would see them stand.
MODES_HZ: tuple[float, ...] = (0.0, 0.6, 1.1, 2.2)


def damping(natural_hz: float, wind_mps: float) -> float:
    """Return Edwards' damping by air."""
    return 0.026 * wind_mps / 5.0 / natural_hz


def field(hours: Sequence[float], wind_mps: float, mode_hz: float, interval_s: float, law: PiLaw | None,
          grown: float = 1.0) -> Scenario:  # fmt: skip
    """Return the shipped scenario with nothing wrong but the wind."""
    radio: dict[str, Any] = {"plate_sigma_mrad": 0.0, "plate_calibration": "none", "lost_frames": 0.0, "ground": "none"}
    if law is not None:  # designed ones stand at the least margin, give or take a rounding
        radio["force_gains"] = True
        radio |= {"gain_per_s": law.gain_per_s, "integral_gain_per_s2": law.integral_gain_per_s2}
    return load_scenario(SCENARIO).changed(tracking={
        "first_hour": hours[0], "last_hour": hours[1], "control_interval_s": interval_s, "mount_errors": NO_ERRORS,
        "field_control": None, "drive": {"steps_per_turn": 4e6, "backlash_mrad": (0.0, 0.0)},
        "wind": {"mean_speed_mps": wind_mps, "deflection_mrad_per_mps2": [grown * each for each in BEND_MRAD]},
        "structure": {"natural_hz": mode_hz, "damping": damping(mode_hz, wind_mps) if mode_hz else 0.02},
        "radio": radio,
    })  # fmt: skip


def rms_mrad(scenario: Scenario, method: str, mirrors: int) -> float:
    """Return the simulated rms, for open loop without the mean deflection."""
    simulation = TrackingSimulation(scenario, methods=(method,), count=mirrors, seed=1)
    while simulation.done < simulation.n_segment:
        simulation.advance()
    square = score(simulation.sums(method)).normal_rms_rad ** 2
    if method == "open-loop":
        square -= float(np.sum((simulation.plant.gusts.mean_mps**2 * simulation.plant.gusts.bend) ** 2))
    return 1e3 * float(np.sqrt(square))


def by_frequency(loop: SampledLoop, mode_hz: float, wind_mps: float, size_m: float) -> tuple[float, float]:
    """Return the gain of rigidity in this wind, and in all sunny hours; no mode: of the background alone."""
    mode = StructureMode(natural_hz=mode_hz or 2.2, damping=damping(mode_hz or 2.2, wind_mps))
    parts = [wind_deflection(1e-3, wind_mps, mode, size_m=size_m, residual=each) for each in (None, loop.left)]
    here = [float(back) + (float(swing) if mode_hz else 0.0) for back, swing in parts]
    if mode_hz:
        return float(np.sqrt(here[0] / here[1])), rigidity_gain(mode, loop.left, size_m=size_m)
    sunny = [sunshine_deflection(1e-3, mode, size_m=size_m, residual=each).background_rad for each in (None, loop.left)]
    return float(np.sqrt(here[0] / here[1])), sunny[0] / sunny[1]


def designed(interval_s: float, mode_hz: float, wind_mps: float) -> PiLaw:
    """Return the law of the highest gain that keeps the margins, with the structure in the loop and without."""
    mode = StructureMode(natural_hz=mode_hz, damping=damping(mode_hz, wind_mps)) if mode_hz else None
    laws = [design_law(each, interval_s=interval_s) for each in (None, mode)]
    return min(laws, key=lambda law: law.gain_per_s)


def by_budget(scenario: Scenario, mirrors: int) -> float:
    """Return the gain of rigidity by the predicted budget: the gusts as drawn, and the mode as the loop samples it."""
    loose, closed = (track_budget(scenario, method, count=mirrors) for method in ("open-loop", "radio"))
    return float(np.hypot(loose.gusts_rad, loose.resonance_rad)) / closed.total_rad


def in_loop(hours: Sequence[float], mirrors: int, wind_mps: float) -> None:
    """Print the simulation beside budget and frequencies."""
    print(
        "| interval, K0 | mode [Hz], ζ | open loop [mrad] | closed [mrad] | softer: simulated | by the budget "
        "| `rigidity_gain`'s sums, this wind | sunny hours |\n|---|---|---|---|---|---|---|---|"
    )
    size = float(np.sqrt(load_scenario(SCENARIO).tracking.mirror_area_m2))
    loose = {m: rms_mrad(field(hours, wind_mps, m, 4.0, None), "open-loop", mirrors) for m in MODES_HZ}
    for interval in (1.0, 4.0):
        for part in (1.0, 0.6):
            for mode in MODES_HZ:
                full = designed(interval, mode, wind_mps)
                law = PiLaw(gain_per_s=part * full.gain_per_s, integral_gain_per_s2=part * full.integral_gain_per_s2)
                loop = SampledLoop(
                    gain_per_s=law.gain_per_s, integral_gain_per_s2=law.integral_gain_per_s2, interval_s=interval
                )
                scenario = field(hours, wind_mps, mode, interval, law)
                closed = rms_mrad(scenario, "radio", mirrors)
                here, sunny = by_frequency(loop, mode, wind_mps, size)
                name = f"{mode:g}, {damping(mode, wind_mps):.3f}" if mode else "none"
                ratio = loose[mode] / closed
                print(
                    f"| {interval:g} s, {law.gain_per_s:.2f}/s | {name} | {loose[mode]:.3f} | {closed:.3f} "
                    f"| {ratio:.2f} | {by_budget(scenario, mirrors):.2f} | {here:.2f} | {sunny:.2f} |",
                    flush=True,
                )
    law = designed(1.0, 2.2, wind_mps)
    ratio = loose[2.2] / rms_mrad(field(hours, wind_mps, 2.2, 1.0, law), "radio", mirrors)
    grown = rms_mrad(field(hours, wind_mps, 2.2, 1.0, law, grown=ratio), "radio", mirrors)
    print(f"1 s, 2.2 Hz, deflection {ratio:.2f} times as great: {grown:.4f} mrad closed, {loose[2.2]:.4f} open before")


def background(edge_hz: float, *, size_m: float = DISH_M, wind_mps: float | None = None) -> float:
    """Return rms of the background at a perfect servo's edge of 0.001 Hz over that at this edge."""
    mode = StructureMode(natural_hz=2.0, damping=0.013)

    def rms(edge: float) -> float:
        servo = perfect_servo(edge)
        if wind_mps is not None:
            return float(np.sqrt(wind_deflection(1.0, wind_mps, mode, size_m=size_m, residual=servo)[0]))
        return sunshine_deflection(1.0, mode, size_m=size_m, residual=servo).background_rad

    return rms(1e-3) / rms(edge_hz)


def stiffness_with_its_mode(density_kg_m2: float, edge_hz: float) -> tuple[float, float]:
    """Return x̄₁ [mrad] that bends 1 mrad rms in sunny hours, and the mode of (5.25) that goes with it [Hz]."""

    def mode(bend_rad: float) -> StructureMode:
        natural = plate_mode_hz(
            0.6, density_kg_m3=density_kg_m2, thickness_m=1.0, deflection_1mps_rad=bend_rad, diameter_m=5.0
        )
        return StructureMode(natural_hz=natural, damping=min(0.026 * 18.0 / density_kg_m2 / natural, 0.9))

    def beyond(bend_rad: float) -> float:
        return (
            sunshine_deflection(bend_rad, mode(bend_rad), size_m=DISH_M, residual=perfect_servo(edge_hz)).total_rad
            - 1e-3
        )

    bend = float(brentq(beyond, 1e-7, 1e-2))
    return 1e3 * bend, mode(bend).natural_hz


def reading() -> None:
    """Print what comes to 3, and what to 10."""
    print("background alone, perfect servo of 0.1 Hz against 0.001 Hz, sunny hours:", f"{background(0.1):.2f}")
    print(
        "  by mean wind [m/s]:",
        ", ".join(f"{v:g}: {background(0.1, wind_mps=v):.1f}" for v in (1, 1.5, 2, 3, 5, 8, 10)),
    )
    print("  by edge [Hz]:", ", ".join(f"{e:g}: {background(e):.1f}" for e in (0.05, 0.1, 0.2, 0.3, 0.5)))
    print(
        "  by side of the plate [m]:",
        ", ".join(f"{s:g}: {background(0.1, size_m=s):.1f}" for s in (2, 4.43, 10, 20, 57)),
    )
    print("mode by (5.25), ζ = 0.026/f at 18 kg/m², 1 mrad in all: kg/m², x̄₁ [mrad] and mode [Hz] slow, fast, ratio")
    for density in (5.0, 18.0, 50.0):
        (slow, slow_hz), (fast, fast_hz) = (stiffness_with_its_mode(density, edge) for edge in (1e-3, 0.1))
        print(f"  {density:g}: {slow:.3f} at {slow_hz:.1f}, {fast:.3f} at {fast_hz:.1f}, {fast / slow:.2f}")


def limit_cycle() -> None:
    """Print half the peaks and the rms of the error for readings of §6.3."""
    print("levels, sampled each, sun: half peak to peak, rms of the error, mean |error|, rms of the motor's [mrad]")
    for levels in (32, 16):
        for interval, speed in ((1.0, 0.0), (1.0, 7.3e-5), (0.5, 0.0), (0.1, 0.0), (0.02, 0.0)):
            time = np.arange(0.0, 6000.0, interval)
            command = (3e-3 + speed * time)[None]
            found = run_loop(PiLaw(levels=levels), EDWARDS_MODE, command_rad=command, interval_s=interval)
            late = time >= 4000.0
            error = 1e3 * found.error_rad[0, late]
            motor = np.concatenate([[0.0], np.cumsum(found.speed_radps[0] * interval)[:-1]])
            off = 1e3 * (command[0] - motor)[late]
            print(f"{levels}, {interval:g} s, {'moves' if speed else 'stands'}: {0.5 * np.ptp(error):.3f}, "
                  f"{np.std(error):.3f}, {np.mean(np.abs(error)):.3f}, {np.std(off):.3f}")  # fmt: skip
    print("sine of 0.13 mrad: rms 0.092; triangle 0.075")


def main() -> None:
    """Print what is asked for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--hours", type=float, nargs=2, default=(9.0, 12.0), help="in which no mirror passes the zenith"
    )
    parser.add_argument("--mirrors", type=int, default=48)
    parser.add_argument("--wind", type=float, default=5.0)
    parser.add_argument("--only", choices=("loop", "reading", "limit-cycle"))
    arguments = parser.parse_args()
    if arguments.only in (None, "limit-cycle"):
        limit_cycle()
    if arguments.only in (None, "reading"):
        reading()
    if arguments.only in (None, "loop"):
        in_loop(arguments.hours, arguments.mirrors, arguments.wind)


if __name__ == "__main__":
    main()
