"""Calibration of heliostats from files: fit, judge, watch, write the model, draw."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from rfpose.errors import InvalidInputError
from rfpose.feedback.alarms import Alarm, alarms
from rfpose.feedback.calibration import Calibration, FitSettings, fit, resolve_free
from rfpose.feedback.measurements import Measurements, join
from rfpose.feedback.mount import Mount
from rfpose.feedback.paint import PaintHeliostat, heliostat_ids, read_heliostat
from rfpose.feedback.sun import Site
from rfpose.feedback.validation import HeldOut, chronological_split, random_splits
from rfpose.pipeline.calibration_sources import Gathered
from rfpose.pipeline.mount_file import MountFile, write_model_file

__all__ = ["HeliostatReport", "calibrate_mounts", "calibrate_paint", "draw_errors", "write_models"]

RECEIVER_PLANE = ("receiver_plane_up_rad", "receiver_plane_right_rad")
RADIO_ALONE = (
    "radio sees the receivers' plane: how that lies to the mirror cannot be told without a camera, a drone or PAINT "
    "records in the same fit; the beam is off by twice whatever it is"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class HeliostatReport:
    """One heliostat's calibration and how far to trust it.

    Attributes
    ----------
    id
        The heliostat's name.
    record_names : (measurement,)
        What names each measurement, in their order.
    skipped
        Why records were left out, by name.
    sources
        Measurements by source.
    site
        Where the site frame's origin lies; None if unknown.
    calibration
        Fit to all usable records.
    random
        Ten random splits, 60 % fitted; None with too few measurements to split.
    chronological
        The earlier 60 % fitted, the later 40 % predicted; None likewise.
    alarms
        What a steady mount does not do.
    notes
        What a reader must know.
    """

    id: str
    record_names: tuple[str, ...]
    skipped: Mapping[str, str]
    sources: Mapping[str, int]
    site: Site | None
    calibration: Calibration
    random: HeldOut | None
    chronological: HeldOut | None
    alarms: tuple[Alarm, ...]
    notes: tuple[str, ...] = field(default=())

    @property
    def held_out_median_rad(self) -> float:
        """Mean of the random splits' held-out medians [rad]; NaN without splits."""
        return float(self.random.test_median_rad.mean()) if self.random else float("nan")

    def as_dict(self) -> dict[str, Any]:
        """Plain values for JSON; milliradians are of the mirror normal."""
        found = self.calibration.field
        none = float("nan")
        return {
            "heliostat": self.id,
            "records": len(self.record_names),
            "sources": dict(self.sources),
            "used": int(self.calibration.used.sum()),
            "skipped": dict(self.skipped),
            "fit_status": int(found.status[0]),
            "noise_mrad": 1e3 * self.calibration.noise_rad,
            "median_mrad": 1e3 * float(np.nanmedian(self.calibration.error_rad)),
            "train_median_mrad": 1e3 * float(self.random.train_median_rad.mean()) if self.random else none,
            "held_out_median_mrad": 1e3 * self.held_out_median_rad,
            "held_out_median_each_mrad": (1e3 * self.random.test_median_rad).tolist() if self.random else [],
            "chronological_median_mrad": 1e3 * float(self.chronological.test_median_rad[0])
            if self.chronological
            else none,
            "rank": int(found.rank[0]),
            "condition": float(found.condition[0]),
            "parameters": {
                name: {"estimate": value, "sigma": self.calibration.sigma[name]}
                for name, value in self.calibration.estimate.items()
            },
            "undetermined": [list(group) for group in self.calibration.undetermined],
            "alarms": [self._alarm(alarm) for alarm in self.alarms],
            "notes": list(self.notes),
        }

    def _alarm(self, alarm: Alarm) -> dict[str, Any]:
        first, last = self.record_names[alarm.first], self.record_names[alarm.last]
        return {
            "kind": alarm.kind,
            "first_record": int(first) if first.isdigit() else first,
            "last_record": int(last) if last.isdigit() else last,
            "axis": alarm.axis,
            "size_mrad": 1e3 * alarm.size_rad,
        }


def calibrate_paint(
    directory: Path,
    *,
    heliostats: Sequence[str] = (),
    free: str | Sequence[str] = "level-full",
    settings: FitSettings | None = None,
    seed: int = 0,
) -> tuple[HeliostatReport, ...]:
    """Calibrate heliostats of a PAINT directory.

    Parameters
    ----------
    directory
        Folder with the heliostats' folders.
    heliostats
        Names; empty: all.
    free
        Parameter set, or names.
    settings
        Of the fit.
    seed
        Of the random splits.
    """
    reports = []
    for name in heliostats or heliostat_ids(directory):
        data = read_heliostat(directory, name)
        part = _Part("PAINT", _spots(data, data.record_ids.astype(np.float64)), tuple(map(str, data.record_ids)))
        reports.append(_report(name, data.mount, data.site, [part], dict(data.skipped), free, settings, seed))
    return tuple(reports)


def calibrate_mounts(
    mounts: MountFile,
    gathered: Sequence[Gathered],
    *,
    heliostats: Sequence[str] = (),
    free: str | Sequence[str] = "edwards-4",
    settings: FitSettings | None = None,
    seed: int = 0,
) -> tuple[HeliostatReport, ...]:
    """Calibrate mounts from whatever sources there are, all of a heliostat's in one fit.

    Parameters
    ----------
    mounts
        As planned, or as calibrated before: where the fit begins.
    gathered
        Measurements by source and heliostat. The receivers' plane is fitted along where radio and another source meet.
    heliostats
        Names; empty: all that were measured.
    free
        Parameter set, or names.
    settings
        Of the fit.
    seed
        Of the random splits.

    Raises
    ------
    InvalidInputError
        A heliostat without a mount, or without a measurement.
    """
    measured = {name for source in gathered for name in source.measurements}
    skipped = {name: why for source in gathered for name, why in source.left_out.items()}
    reports = []
    for name in heliostats or sorted(measured):
        if name not in mounts.heliostats:
            known = ", ".join(list(mounts.heliostats)[:8])
            raise InvalidInputError(f"heliostat {name!r} has no mount; known are {known}")
        if name not in measured:
            raise InvalidInputError(f"heliostat {name!r} was not measured; measured were {', '.join(sorted(measured))}")
        parts = []
        for source in gathered:
            if name in source.measurements:
                made = source.measurements[name]
                parts.append(_Part(source.source, made, tuple(f"{source.source} {i}" for i in range(len(made)))))
        mount = mounts.heliostats[name].mount
        reports.append(_report(name, mount, mounts.site, parts, skipped, free, settings, seed))
    return tuple(reports)


@dataclass(frozen=True, slots=True)
class _Part:
    """One source's share of a heliostat's measurements."""

    source: str
    measurements: Measurements
    names: tuple[str, ...]


def _spots(data: PaintHeliostat, order: Any) -> Measurements:
    return Measurements.from_spots(data.count, sun_enu=data.sun_enu, spot_enu_m=data.spot_enu_m, unix_s=order)


def _report(
    name: str,
    mount: Mount,
    site: Site | None,
    parts: Sequence[_Part],
    skipped: Mapping[str, str],
    free: str | Sequence[str],
    settings: FitSettings | None,
    seed: int,
) -> HeliostatReport:
    """Fit one heliostat and judge the fit."""
    made = join([part.measurements for part in parts])
    names = [label for part in parts for label in part.names]
    order = np.argsort(np.concatenate([part.measurements.unix_s for part in parts]), kind="stable")
    sources = {part.source: len(part.measurements) for part in parts}
    chosen, notes = resolve_free(free), []
    if "radio" in sources:
        if len(sources) > 1:
            chosen = (*chosen, *(plane for plane in RECEIVER_PLANE if plane not in chosen))
        else:
            notes.append(RADIO_ALONE)
    calibration = fit(mount, made, free=chosen, settings=settings)
    return HeliostatReport(
        id=name,
        record_names=tuple(names[i] for i in order),
        skipped=skipped,
        sources=sources,
        site=site,
        calibration=calibration,
        random=_try_split(random_splits, mount, made, free=chosen, settings=settings, rng=np.random.default_rng(seed)),
        chronological=_try_split(chronological_split, mount, made, free=chosen, settings=settings),
        alarms=alarms(calibration),
        notes=tuple(notes),
    )


def _try_split(split: Any, mount: Mount, made: Measurements, **how: Any) -> HeldOut | None:
    """Split, or nothing where there are too few measurements to do so."""
    try:
        found: HeldOut = split(mount, made, **how)
    except InvalidInputError:
        return None
    return found


def write_models(
    path: Path,
    reports: Sequence[HeliostatReport],
    *,
    settings: Mapping[str, Any] | None = None,
    force: bool = False,
) -> None:
    """Write calibrated mounts as JSON or TOML, by the file's ending.

    Raises
    ------
    RecordingError
        Another ending, or the file exists and ``force`` is not set.
    """
    sites = [report.site for report in reports]
    write_model_file(
        path,
        {report.id: report.calibration for report in reports},
        site=sites[0] if sites else None,
        settings=settings,
        undetermined={report.id: report.calibration.undetermined for report in reports},
        force=force,
    )


def draw_errors(path: Path, reports: Sequence[HeliostatReport]) -> None:
    """Draw each heliostat's errors in the order of its records, shifts marked, to an image file."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 2.6 * len(reports)), layout="constrained")
    FigureCanvasAgg(figure)
    for i, report in enumerate(reports, start=1):
        axes = figure.add_subplot(len(reports), 1, i)
        axes.semilogy(1e3 * report.calibration.error_rad, ".", color="tab:blue", markersize=4)
        for alarm in report.alarms:
            if alarm.kind == "shift":
                axes.axvline(alarm.first - 0.5, color="tab:red", linewidth=0.8)
        axes.axhline(1e3 * report.held_out_median_rad, color="0.5", linewidth=0.8)
        axes.set_ylabel("normal error [mrad]")
        axes.set_title(f"{report.id}: grey = held-out median, red = shift", fontsize=9, loc="left")
    axes.set_xlabel("record, in the order of time")
    figure.savefig(path, dpi=120)
