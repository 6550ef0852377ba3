"""An emergency of a whole field over simulated buses, and what the buses can carry.

10 000 heliostats in rings about a tower, Malan's site, clear noon; receiver 12 m high and wide at 60 m. The alarm comes
at 0 s; the cluster that brings most flux dies in the same moment. Usage:

    python benchmarks/field_emergency.py [--heliostats 10000] [--seed 1] [--only-speed]
"""

from __future__ import annotations

import argparse
import dataclasses
import resource
import time

import numpy as np
from rich.console import Console
from rich.table import Table

from rfpose.feedback.fieldcontrol.bus import BusSettings, capacity
from rfpose.feedback.fieldcontrol.control import ControlledField, FieldSettings
from rfpose.feedback.fieldcontrol.emergency import EmergencyField, EmergencyRun, TowerReceiver, play, ring_field
from rfpose.feedback.fieldcontrol.modes import Mode
from rfpose.feedback.fieldcontrol.motion import PROTOTYPE_RATE_RAD_S
from rfpose.feedback.fieldcontrol.packets import RESOLUTION_RAD
from rfpose.sun import Location, sun_position, unix_seconds

SITE = Location(latitude_rad=np.radians(-33.93), longitude_rad=np.radians(18.865))
NOON_S = unix_seconds(["2024-03-21T10:50:00Z"])[0]
STEP_S = 0.5
START_S = -9.5
EARTH_RAD_S = 2.0 * np.pi / 86400.0


def make_field(n: int, rate_rad_s: float = PROTOTYPE_RATE_RAD_S) -> EmergencyField:
    """Return rings about a tower."""
    receiver = TowerReceiver(centre_enu_m=np.array([0.0, 0.0, 60.0]), width_m=12.0, height_m=12.0)
    return EmergencyField(pivot_enu_m=ring_field(n), receiver=receiver, rate_rad_s=rate_rad_s)


def run(
    field: EmergencyField,
    bus: BusSettings,
    *,
    seed: int,
    dead: bool,
    noon_s: float = NOON_S,
    until_s: float = 300.0,
    settings: FieldSettings | None = None,
) -> EmergencyRun:
    """Play one emergency at 0 s, after 9.5 s of tracking; every heliostat was heard just before."""
    control = ControlledField(
        aim_enu_m=field.receiver.centre_enu_m,
        pivot_enu_m=field.pivot_enu_m,
        mode=Mode.TRACK,
        bus=bus,
        settings=settings,
        start_s=START_S,
        rng=np.random.default_rng(seed),
    )
    times = np.arange(START_S, until_s + STEP_S, STEP_S)

    def alarm(control: ControlledField) -> None:
        if dead:
            control.fail_cluster(0)  # the innermost ring: shortest way, most flux
        control.emergency()

    return play(
        control,
        field,
        time_s=times,
        sun_enu=sun_position(noon_s + times, SITE).direction_enu,
        happenings={0.0: alarm},
    )


def row(result: EmergencyRun) -> list[str]:
    """Return the times of one emergency as text."""
    return [
        f"{result.time_below_s(0.1):.1f}",
        f"{result.time_below_s(0.001):.1f}",
        f"{np.max(result.off_receiver_s):.1f}",
        f"{np.median(result.stowed_s):.0f}",
        f"{np.max(result.stowed_s):.0f}",
    ]


HEAD = ["flux < 10 % [s]", "flux < 0.1 % [s]", "last mirror off [s]", "stowed, median [s]", "stowed, last [s]"]


def emergencies(console: Console, n: int, seed: int) -> None:
    """Print times by faults of the bus, by hour and by rate of the axes."""
    field = make_field(n)
    table = Table("messages lost", "bit errors", "cluster dead", *HEAD, title=f"Emergency, {n} heliostats")
    for lost, ber, dead in ((0.0, 0.0, False), (0.05, 0.0, True), (0.05, 1e-3, True), (0.3, 0.0, True)):
        began = time.perf_counter()
        result = run(field, BusSettings(lost=lost, bit_error_rate=ber), seed=seed, dead=dead)
        console.print(f"[dim]{lost:.0%} lost: {time.perf_counter() - began:.1f} s for 310 s of field[/]")
        table.add_row(f"{lost:.0%}", f"{ber:g}", "yes" if dead else "no", *row(result))
    console.print(table)
    table = Table("hours from noon", *HEAD, title="5 % lost, one cluster dead: time of the day")
    for hours in (-5.0, -2.5, 2.5, 5.0):
        result = run(field, BusSettings(lost=0.05), seed=seed, dead=True, noon_s=NOON_S + 3600.0 * hours)
        table.add_row(f"{hours:+g}", *row(result))
    console.print(table)
    table = Table("rate of an axis [°/s]", *HEAD, title="5 % lost, one cluster dead: how slow may the drives be")
    for rate in (0.25, 0.5, 0.75, 1.0, 1.5, 2.25, 4.0):
        result = run(make_field(n, np.radians(rate)), BusSettings(lost=0.05), seed=seed, dead=True, until_s=400.0)
        table.add_row(f"{rate:g}", *row(result))
    console.print(table)


def power_loss(console: Console, n: int, seed: int) -> None:
    """Print what mirrors do that stand still while the sun goes on."""
    field = make_field(n)
    control = ControlledField(
        aim_enu_m=field.receiver.centre_enu_m,
        pivot_enu_m=field.pivot_enu_m,
        mode=Mode.TRACK,
        rng=np.random.default_rng(seed),
    )
    times = np.arange(0.0, 3600.0, 10.0)
    sun = sun_position(NOON_S + times, SITE).direction_enu
    result = play(control, field, time_s=times, sun_enu=sun, happenings={5.0: lambda c: c.power_off()})
    console.print(
        f"Power lost in the whole field, mirrors stand still: flux below half after {result.time_below_s(0.5):.0f} s, "
        f"below a tenth after {result.time_below_s(0.1):.0f} s"
    )


def buses(console: Console, n: int) -> None:
    """Print what each tier carries, and how short its interval can be."""
    limit = 1e-3 / EARTH_RAD_S
    console.print(
        f"Control interval for 1 mrad of the sun's way: {limit:.2f} s. Axis count: {RESOLUTION_RAD * 1e3:.3f} mrad"
    )
    table = Table(
        "baud", "tier", "channels", "need at that interval [bit/s]", "have [bit/s]", "shortest interval [s]", ""
    )
    for baud in (9600, 19200, 57600, 115200):
        bus = BusSettings(baud=baud, control_interval_s=limit)
        for tier in capacity(bus, n):
            table.add_row(
                f"{baud}",
                tier.tier,
                f"{tier.n_channel}",
                f"{tier.need_bps:.0f}",
                f"{tier.have_bps:.0f}",
                f"{tier.shortest_interval_s:.2f}",
                "reaches it" if tier.shortest_interval_s <= limit else "too slow",
            )
    console.print(table)


def faults(console: Console, n: int, seed: int) -> None:
    """Print what faults do to a field that tracks: old sun angles, missed reports, false alarms."""
    table = Table(
        "lost", "bit errors", "late", "sun angles missed", "reports missed", "wrong sun taken", "false defocus",
        title=f"One hour of tracking, {n} heliostats, interval 4 s",
    )  # fmt: skip
    cases = ((0, 0, 0), (0.05, 0, 0), (0.2, 0, 0), (0.5, 0, 0), (0, 1e-4, 0), (0, 1e-3, 0), (0, 1e-2, 0), (0, 0, 0.05))
    field = make_field(n)
    for lost, ber, late in cases:
        bus = BusSettings(lost=lost, bit_error_rate=ber, late=late)
        control = ControlledField(
            aim_enu_m=field.receiver.centre_enu_m,
            pivot_enu_m=field.pivot_enu_m,
            mode=Mode.TRACK,
            bus=bus,
            rng=np.random.default_rng(seed),
        )
        table.add_row(f"{lost:.0%}", f"{ber:g}", f"{late:.0%}", *_hour(control, bus))
    console.print(table)


def _hour(control: ControlledField, bus: BusSettings) -> list[str]:
    """Return the parts of heliostat-intervals with each kind of trouble."""
    n = control.n_heliostat
    axis = np.zeros((n, 2))
    times = np.arange(1, 901) * bus.interval_s - 0.5
    sun = sun_position(NOON_S + times, SITE).direction_enu
    old = missed = wrong = 0
    for i, now in enumerate(times):
        orders = control.step(now, axis_rad=axis, aim_axis_rad=axis, sun_enu=sun[i])
        old += int((orders.sun_age_s > bus.interval_s).sum())
        missed += int((control.report_age_s > bus.interval_s).sum())
        fresh = orders.sun_age_s <= bus.interval_s
        wrong += int((np.abs(orders.sun_enu[fresh] - sun[i]).max(axis=1) > 1e-3).sum())
    total = n * len(times)
    false = int((control.mode != Mode.TRACK).sum())
    return [f"{old / total:.2e}", f"{missed / total:.2e}", f"{wrong / total:.1e}", f"{false} of {n}"]


def speed(console: Console, seed: int) -> None:
    """Print what a servo step of the field's control costs."""
    for n in (1000, 10_000):
        field = make_field(n)
        control = ControlledField(
            aim_enu_m=field.receiver.centre_enu_m,
            pivot_enu_m=field.pivot_enu_m,
            mode=Mode.TRACK,
            bus=BusSettings(lost=0.05, bit_error_rate=1e-4, late=0.01),
            rng=np.random.default_rng(seed),
        )
        axis = np.full((n, 2), 0.5)
        sun = sun_position(np.array([NOON_S]), SITE).direction_enu[0]
        began = time.process_time()
        for second in range(600):
            control.step(float(second), axis_rad=axis, aim_axis_rad=axis, sun_enu=sun)
        each_s = (time.process_time() - began) / 600
        day = each_s * 43200
        console.print(f"{n} heliostats: {each_s * 1e3:.2f} ms of one core a step of 1 s, {day:.0f} s for a day of 12 h")


def watchdog(console: Console, seed: int) -> None:
    """Print a small field, where one cluster in three dies: the watchdog decides."""
    table = Table("watchdog [intervals]", *HEAD, title="96 heliostats, one cluster in three dead, 5 % lost")
    for n_interval in (2.0, 3.0, 4.0, 6.0):
        settings = dataclasses.replace(FieldSettings(), watchdog_intervals=n_interval)
        result = run(make_field(96), BusSettings(lost=0.05), seed=seed, dead=True, settings=settings)
        table.add_row(f"{n_interval:g}", *row(result))
    console.print(table)


def main() -> None:
    """Print all tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--heliostats", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only-speed", action="store_true", help="measure the cost of a step and nothing else")
    options = parser.parse_args()
    console = Console(width=140)
    if options.only_speed:
        speed(console, options.seed)
        return
    buses(console, options.heliostats)
    emergencies(console, options.heliostats, options.seed)
    watchdog(console, options.seed)
    power_loss(console, options.heliostats, options.seed)
    faults(console, min(options.heliostats, 1000), options.seed)
    speed(console, options.seed)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    console.print(f"Peak memory {peak:.0f} MB")


if __name__ == "__main__":
    main()
