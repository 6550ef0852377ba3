"""Draw the pictures of docs/servo-and-wind.md and print its numbers.

Run ``python scripts/figures_servo.py --help``.
"""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from rfpose.feedback.energy import combine_errors_rad, dish_efficiency, heliostat_intercept
from rfpose.feedback.servo import PiLaw, Stepper, design_law, limit_cycle_rad, margins, run_loop, sensitivity
from rfpose.feedback.servo.margins import sampled_plant, sampled_response
from rfpose.feedback.structure import EDWARDS_MODE, StructureMode
from rfpose.feedback.wind import gust_process, perfect_servo, rigidity_gain, sunshine_deflection, wind_bend

STIFF = StructureMode(natural_hz=2.0, damping=0.013)
SIZE_M = 4.43
LATENCY_S = (0.0, 1.0, 2.0, 3.0, 4.0)


def canvas(width: float = 8.0, height: float = 4.2) -> Figure:
    """Return an empty figure."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def loop_margins(path: Path) -> None:
    """Open loop of Edwards' servo with latencies."""
    figure = canvas(8.0, 5.6)
    top, bottom = figure.subplots(2, 1, sharex=True)
    frequency = np.geomspace(2e-3, 0.49, 600)
    click.echo("latency_s gain_margin_db phase_margin_deg unity_hz spare_latency_s longest_interval_s")
    for latency in LATENCY_S:
        found = margins(PiLaw(), EDWARDS_MODE, latency_s=latency)
        click.echo(
            f"{latency:9.0f} {found.gain_db:14.2f} {np.rad2deg(found.phase_rad):16.1f} {found.unity_hz:8.4f} "
            f"{found.latency_s:15.2f} {found.interval_s:18.2f}"
        )
        response = sampled_response(PiLaw(), sampled_plant(EDWARDS_MODE, interval_s=1.0, latency_s=latency), frequency)
        phase = np.unwrap(np.angle(response))
        phase += 2.0 * np.pi * np.rint((-np.pi - phase[0]) / (2.0 * np.pi))
        top.semilogx(frequency, 20.0 * np.log10(np.abs(response)), color="k")
        bottom.semilogx(frequency, np.rad2deg(phase), label=f"{latency:.0f} s")
    top.axhline(0.0, color="0.6", lw=0.8)
    top.set_ylabel("open loop [dB]")
    bottom.axhline(-180.0, color="0.6", lw=0.8)
    bottom.set_ylim(-360.0, -90.0)
    bottom.set_ylabel("phase [degrees]")
    bottom.set_xlabel("frequency [Hz]")
    bottom.legend(title="latency", fontsize=8)
    top.set_title(
        "PI servo, K0 = 0.2/s, K1 = 0.01/s², sampled every second; structure 0.1 Hz, damping 0.3", fontsize=10
    )
    figure.savefig(path / "servo_margins.png", dpi=120)


def step_response(path: Path) -> None:
    """Step of 3 mrad, as levels and motor steps leave it."""
    figure = canvas()
    axes = figure.subplots()
    command = np.full((1, 300), 3e-3)
    click.echo("levels K0 amplitude_mrad rms_mrad described_mrad")
    for levels, gain in ((32, 0.2), (8, 0.05)):
        law = PiLaw(levels=levels, gain_per_s=gain, integral_gain_per_s2=0.05 * gain)
        error = 1e3 * run_loop(law, EDWARDS_MODE, command_rad=command).error_rad[0]
        axes.plot(error, label=f"{levels} levels, K0 = {gain:g}/s")
        steady = 1e3 * run_loop(law, EDWARDS_MODE, command_rad=np.full((1, 6000), 3e-3)).error_rad[0, 4000:]
        described = 1e3 * limit_cycle_rad(law, EDWARDS_MODE)
        click.echo(f"{levels:6d} {gain:4.2f} {np.ptp(steady) / 2:14.3f} {np.std(steady):8.3f} {described:14.3f}")
    law = PiLaw(levels=0)
    error = 1e3 * run_loop(law, EDWARDS_MODE, command_rad=command, stepper=Stepper()).error_rad[0]
    axes.plot(error, label="no levels, motor of 1:48 000")
    axes.axhline(0.0, color="0.6", lw=0.8)
    axes.set_xlabel("time [s]")
    axes.set_ylabel("error of the axis [mrad]")
    axes.set_title("Step of 3 mrad", fontsize=10)
    axes.legend(fontsize=8)
    figure.savefig(path / "servo_step.png", dpi=120)


def gust_response(path: Path) -> None:
    """Ten minutes of gusts, with and without the loop."""
    deflection = 0.05e-3
    process = gust_process(6.0, size_m=SIZE_M)
    rng = np.random.default_rng(5)
    gust = process.run(process.start(rng, 40), rng, 4096)
    bend = wind_bend(deflection, np.maximum(6.0 + gust, 0.0))
    bend -= bend.mean(axis=1, keepdims=True)
    laws = {
        "K0 = 0.2/s, structure 0.1 Hz": (PiLaw(levels=0), EDWARDS_MODE),
        "designed, structure 2 Hz, latency 0.3 s": (
            design_law(STIFF, latency_s=0.3, template=PiLaw(levels=0, speed_radps=10e-3, range_rad=0.1)),
            STIFF,
        ),
    }
    figure = canvas()
    axes = figure.subplots()
    axes.plot(1e3 * bend[0, :600], color="0.6", label="no feedback")
    click.echo(
        f"gusts: mean 6 m/s, {deflection * 1e3:g} mrad at 1 m/s, rms without feedback {1e3 * bend.std():.3f} mrad"
    )
    for name, (law, mode) in laws.items():
        run = run_loop(
            law, mode, command_rad=np.zeros_like(bend), disturbance_rad=bend, latency_s=0.3 if mode is STIFF else 0.0
        )
        found = margins(law, mode, latency_s=0.3 if mode is STIFF else 0.0)
        left = run.error_rad[:, 300:].std()
        click.echo(f"  {name}: K0 {law.gain_per_s:.3f}/s, unity {found.unity_hz:.3f} Hz, rms {1e3 * left:.3f} mrad")
        axes.plot(1e3 * run.error_rad[0, :600], lw=1.0, label=name)
    axes.set_xlabel("time [s]")
    axes.set_ylabel("error of the axis [mrad]")
    axes.set_title("Gusts about 6 m/s on a structure that 1 m/s bends by 0.05 mrad", fontsize=10)
    axes.legend(fontsize=8)
    figure.savefig(path / "servo_gusts.png", dpi=120)


def rigidity() -> None:
    """Print V55's numbers."""
    click.echo("natural_hz damping background resonant [x1] softer_by(0.1 Hz) softer_by(real servo)")
    for natural, damping in ((0.5, 0.05), (1.0, 0.026), (2.0, 0.013)):
        mode = StructureMode(natural_hz=natural, damping=damping)
        found = sunshine_deflection(1.0, mode, size_m=SIZE_M)
        law = design_law(mode, latency_s=0.3)

        def left(frequency: np.ndarray, law: PiLaw = law, mode: StructureMode = mode) -> np.ndarray:
            inside = sensitivity(law, mode, np.minimum(frequency, 0.49), latency_s=0.3)
            return np.where(frequency < 0.49, inside, 1.0)

        ideal = rigidity_gain(mode, perfect_servo(0.1), against=perfect_servo(0.001), size_m=SIZE_M)
        real = rigidity_gain(mode, left, size_m=SIZE_M)
        click.echo(
            f"{natural:10.1f} {damping:7.3f} {found.background_rad:10.2f} {found.resonant_rad:8.2f} "
            f"{ideal:12.2f} {real:12.2f}"
        )


def energy_against_error(path: Path) -> None:
    """Draw what errors cost."""
    sigma = np.linspace(0.0, 3e-3, 121)
    figure = canvas()
    axes = figure.subplots()
    axes.plot(1e3 * sigma, 100.0 * (1.0 - heliostat_intercept(sigma)), label="heliostat, intercept (3.3)")
    for loss in (5e4, 2e5):
        best = dish_efficiency(h_per_deg=3.9, loss_w_m2=loss)[0]
        now = dish_efficiency(h_per_deg=3.9, sigma_rad=sigma, loss_w_m2=loss)[0]
        axes.plot(1e3 * sigma, 100.0 * (1.0 - now / best), label=f"dish, cavity suited, {loss / 1e4:g} W/cm²")
    axes.set_xlabel("standard deviation of the normal (heliostat) or axis (dish), each direction [mrad]")
    axes.set_ylabel("energy lost [%]")
    axes.set_ylim(bottom=0.0)
    axes.legend(fontsize=8)
    figure.savefig(path / "energy_error.png", dpi=120)
    parts = {"radio": 0.05e-3, "servo": 0.05e-3, "motor": 0.04e-3, "wind": 0.2e-3, "canting": 0.2e-3}
    total = float(combine_errors_rad(parts))
    click.echo(
        f"budget {total * 1e3:.3f} mrad each direction: loses {100 * (1 - float(heliostat_intercept(total))):.2f} %"
    )
    for value in (0.1e-3, 0.3e-3, 1e-3):
        dish = dish_efficiency(h_per_deg=3.9, sigma_rad=value)[0] / dish_efficiency(h_per_deg=3.9)[0]
        click.echo(
            f"{value * 1e3:.1f} mrad: heliostat loses {100 * (1 - float(heliostat_intercept(value))):.2f} %, "
            f"dish at 20 W/cm² {100 * (1 - float(dish)):.2f} %"
        )


@click.command(context_settings={"help_option_names": ["-h", "--help"]})
@click.option("--out", type=click.Path(file_okay=False, path_type=Path), default=Path("docs/images"), show_default=True)
def main(out: Path) -> None:
    """Write servo_margins, servo_step, servo_gusts and energy_error (PNG), and print the tables."""
    out.mkdir(parents=True, exist_ok=True)
    loop_margins(out)
    step_response(out)
    gust_response(out)
    rigidity()
    energy_against_error(out)


if __name__ == "__main__":
    main()
