"""Draw the table of modes and the course of an emergency; print the table in graphviz's language on demand.

Run ``python scripts/figures_fieldcontrol.py --help``.
"""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from rfpose.feedback.fieldcontrol.bus import BusSettings
from rfpose.feedback.fieldcontrol.control import ControlledField
from rfpose.feedback.fieldcontrol.diagram import draw_modes
from rfpose.feedback.fieldcontrol.emergency import EmergencyField, EmergencyRun, TowerReceiver, play, ring_field
from rfpose.feedback.fieldcontrol.modes import Mode, dot
from rfpose.sun import Location, sun_position, unix_seconds

SITE = Location(latitude_rad=np.radians(-33.93), longitude_rad=np.radians(18.865))
COLOURS = {Mode.TRACK: "#E69F00", Mode.EMERGENCY: "#D55E00", Mode.STOWING: "#56B4E9", Mode.STOW: "#0072B2"}


def emergency(n: int, seed: int) -> EmergencyRun:
    """Play an alarm at 0 s with one message in twenty lost and the innermost cluster dead."""
    receiver = TowerReceiver(centre_enu_m=np.array([0.0, 0.0, 60.0]), width_m=12.0, height_m=12.0)
    field = EmergencyField(pivot_enu_m=ring_field(n), receiver=receiver)
    control = ControlledField(
        aim_enu_m=receiver.centre_enu_m,
        pivot_enu_m=field.pivot_enu_m,
        mode=Mode.TRACK,
        bus=BusSettings(lost=0.05),
        start_s=-9.5,
        rng=np.random.default_rng(seed),
    )
    times = np.arange(-9.5, 180.0, 0.25)
    noon_s = unix_seconds(["2024-03-21T10:50:00Z"])[0]

    def alarm(control: ControlledField) -> None:
        control.fail_cluster(0)
        control.emergency()

    sun = sun_position(noon_s + times, SITE).direction_enu
    return play(control, field, time_s=times, sun_enu=sun, happenings={0.0: alarm})


def draw_emergency(result: EmergencyRun) -> Figure:
    """Draw flux and modes over time."""
    figure = Figure(figsize=(9.0, 6.4), layout="constrained")
    FigureCanvasAgg(figure)
    upper, lower = figure.subplots(2, 1, sharex=True)
    upper.semilogy(result.time_s, np.maximum(result.flux, 1e-6), color="#D55E00")
    upper.axhline(0.1, color="0.4", ls=":", lw=1)
    upper.axvline(30.0, color="0.4", ls=":", lw=1)
    upper.text(60.0, 0.12, "a tenth of the flux", color="0.3", fontsize=9)
    upper.text(31.0, 2e-5, "30 s", color="0.3", fontsize=9)
    upper.set(ylabel="flux on the receiver / flux before", ylim=(1e-5, 2.0))
    n = result.n_mode[0].sum()
    lower.stackplot(
        result.time_s,
        [result.n_mode[:, mode] / n for mode in COLOURS],
        labels=[mode.name for mode in COLOURS],
        colors=list(COLOURS.values()),
    )
    lower.set(xlabel="time since the alarm [s]", ylabel="part of the heliostats", ylim=(0.0, 1.0))
    lower.set_xlim(result.time_s[0], result.time_s[-1])
    lower.legend(loc="center right", framealpha=0.9)
    upper.set_title(f"{n} heliostats, 5 % of messages lost, the innermost cluster dead from 0 s", fontsize=11)
    return figure


@click.command(context_settings={"help_option_names": ["-h", "--help"]})
@click.option("--out", type=click.Path(file_okay=False, path_type=Path), default=Path("docs/images"), show_default=True)
@click.option("--heliostats", type=click.IntRange(min=32), default=10_000, show_default=True)
@click.option("--seed", type=int, default=1, show_default=True)
@click.option("--dot", "as_dot", is_flag=True, help="Print the modes for graphviz and draw nothing.")
def main(out: Path, heliostats: int, seed: int, as_dot: bool) -> None:
    """Write field-modes.png and field-emergency.png."""
    if as_dot:
        click.echo(dot(), nl=False)
        return
    out.mkdir(parents=True, exist_ok=True)
    draw_modes().savefig(out / "field-modes.png", dpi=110)
    draw_emergency(emergency(heliostats, seed)).savefig(out / "field-emergency.png", dpi=110)
    click.echo(f"{out / 'field-modes.png'}, {out / 'field-emergency.png'}")


if __name__ == "__main__":
    main()
