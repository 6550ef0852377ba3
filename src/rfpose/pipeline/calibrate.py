"""Calibration of heliostats from files: fit, judge, watch, write the model, draw."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from rfpose.errors import RecordingError
from rfpose.feedback.alarms import Alarm, alarms
from rfpose.feedback.calibration import Calibration, FitSettings, fit
from rfpose.feedback.measurements import Measurements
from rfpose.feedback.paint import PaintHeliostat, heliostat_ids, read_heliostat
from rfpose.feedback.validation import HeldOut, chronological_split, random_splits

__all__ = ["HeliostatReport", "calibrate_paint", "draw_errors", "write_models"]

MODEL_FORMAT = "rfpose-mount"
MODEL_VERSION = 1


@dataclass(frozen=True, slots=True, kw_only=True)
class HeliostatReport:
    """One heliostat's calibration and how far to trust it.

    Attributes
    ----------
    data
        What was read.
    calibration
        Fit to all usable records.
    random
        Ten random splits, 60 % fitted.
    chronological
        The earlier 60 % fitted, the later 40 % predicted.
    alarms
        What a steady mount does not do.
    """

    data: PaintHeliostat
    calibration: Calibration
    random: HeldOut
    chronological: HeldOut
    alarms: tuple[Alarm, ...]

    def as_dict(self) -> dict[str, Any]:
        """Plain values for JSON; milliradians are of the mirror normal."""
        field = self.calibration.field
        return {
            "heliostat": self.data.id,
            "records": len(self.data.record_ids),
            "used": int(self.calibration.used.sum()),
            "skipped": dict(self.data.skipped),
            "fit_status": int(field.status[0]),
            "noise_mrad": 1e3 * float(field.noise[0] * np.median(self.calibration.measurements.sigma_rad)),
            "median_mrad": 1e3 * float(np.nanmedian(self.calibration.error_rad)),
            "train_median_mrad": 1e3 * float(self.random.train_median_rad.mean()),
            "held_out_median_mrad": 1e3 * float(self.random.test_median_rad.mean()),
            "held_out_median_each_mrad": (1e3 * self.random.test_median_rad).tolist(),
            "chronological_median_mrad": 1e3 * float(self.chronological.test_median_rad[0]),
            "rank": int(field.rank[0]),
            "condition": float(field.condition[0]),
            "parameters": {
                name: {"estimate": value, "sigma": self.calibration.sigma[name]}
                for name, value in self.calibration.estimate.items()
            },
            "undetermined": [list(group) for group in self.calibration.undetermined],
            "alarms": [self._alarm(alarm) for alarm in self.alarms],
        }

    def _alarm(self, alarm: Alarm) -> dict[str, Any]:
        return {
            "kind": alarm.kind,
            "first_record": int(self.data.record_ids[alarm.first]),
            "last_record": int(self.data.record_ids[alarm.last]),
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
        measurements = Measurements.from_spots(
            data.count, sun_enu=data.sun_enu, spot_enu_m=data.spot_enu_m, unix_s=data.record_ids
        )
        calibration = fit(data.mount, measurements, free=free, settings=settings)
        rng = np.random.default_rng(seed)
        reports.append(
            HeliostatReport(
                data=data,
                calibration=calibration,
                random=random_splits(data.mount, measurements, free=free, rng=rng, settings=settings),
                chronological=chronological_split(data.mount, measurements, free=free, settings=settings),
                alarms=alarms(calibration),
            )
        )
    return tuple(reports)


def write_models(path: Path, reports: Sequence[HeliostatReport], *, force: bool = False) -> None:
    """Write calibrated mounts as JSON or TOML, by the file's ending.

    Raises
    ------
    RecordingError
        Another ending, or the file exists and ``force`` is not set.
    """
    path = Path(path)
    if path.suffix not in (".json", ".toml"):
        raise RecordingError(f"{path}: a model is written as .json or .toml; change the name's ending")
    if path.exists() and not force:
        raise RecordingError(f"{path}: exists; add --force to overwrite it")
    content = {
        "format": MODEL_FORMAT,
        "version": MODEL_VERSION,
        "heliostat": {report.data.id: _model(report.calibration) for report in reports},
    }
    text = tomli_w.dumps(content) if path.suffix == ".toml" else json.dumps(content, indent=2) + "\n"
    path.write_text(text, encoding="utf-8")


def _model(calibration: Calibration) -> Mapping[str, Any]:
    """Gather what another program needs to steer the heliostat."""
    mount = calibration.mount
    return {
        "pivot_enu_m": mount.pivot_enu_m.tolist(),
        "rot_enu_from_mount": mount.rot_enu_from_mount.tolist(),
        "actuators": [
            {
                "kind": actuator.kind,
                "counts_per_unit": actuator.counts_per_unit,
                "sign": actuator.sign,
                "angle_at_zero_rad": actuator.angle_at_zero_rad,
                "limits_count": list(actuator.limits_count),
                "stroke_m": actuator.stroke_m,
                "radius_m": actuator.radius_m,
                "offset_m": actuator.offset_m,
                "worm_ratio": actuator.worm_ratio,
            }
            for actuator in mount.actuators
        ],
        "parameters": {name: value for name, value in mount.parameters.items() if value != 0.0},
        "sigma": {name: value for name, value in calibration.sigma.items() if np.isfinite(value)},
        "undetermined": [list(group) for group in calibration.undetermined],
    }


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
        axes.axhline(1e3 * float(report.random.test_median_rad.mean()), color="0.5", linewidth=0.8)
        axes.set_ylabel("normal error [mrad]")
        axes.set_title(f"{report.data.id}: grey = held-out median, red = shift", fontsize=9, loc="left")
    axes.set_xlabel("record, in the order of time")
    figure.savefig(path, dpi=120)
