"""Calibration of heliostats from files: fit, judge, watch, write the model, draw."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

import numpy as np

from rfpose.drawing import blank_figure
from rfpose.engine import gathered
from rfpose.errors import ClusterError, InvalidInputError, RecordingError, RfposeError
from rfpose.feedback.alarms import Alarm, alarms
from rfpose.feedback.calibration import CalibratedMount, FitSettings, fit, resolve_free, sun_convention
from rfpose.feedback.measurements import Measurements, join
from rfpose.feedback.mount import Mount
from rfpose.feedback.paint import PaintHeliostat, heliostat_ids, read_heliostat
from rfpose.feedback.selection import AUTO, fit_chosen, held_out_sigma
from rfpose.feedback.validation import HeldOut, chronological_split, random_splits
from rfpose.pipeline.calibration_sources import SourceMeasurements, read_camera, read_drone, read_paint, read_radio
from rfpose.pipeline.formats.mount_file import MountFile, read_models, write_model_file
from rfpose.shown import Shown, counted, number
from rfpose.sun import Location
from rfpose.tables import Tabled

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from rfpose.pipeline.formats.result import Result

__all__ = ["Calibrations", "HeliostatReport", "calibrate"]

RECEIVER_PLANE = ("receiver_plane_up_rad", "receiver_plane_right_rad")
RADIO_ALONE = (
    "radio sees the receivers' plane: how that lies to the mirror cannot be told without a camera, a drone or PAINT "
    "records in the same fit; the beam is off by twice whatever it is"
)
_FAR_RAD = 0.15
_OVERFITTED = 1.5
_PAINT_COUNTED = {
    (1.0, -1.0): "from north, clockwise; PAINT's is 180° minus that",
    (-1.0, -1.0): "from north, counter-clockwise; PAINT's is 180° more",
    (-1.0, 1.0): "from south, west positive; PAINT's has the other sign",
}


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
    site: Location | None
    calibration: CalibratedMount
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
            "noise_assumed": self.calibration.noise_assumed,
            "parameters_carried": float(found.carried[0]),
            "redundancy": float(found.redundancy[0]),
            "choice": self._choice(),
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
                name: {"estimate": value, "sigma": self.calibration.sigma[name]} | self._prior(name)
                for name, value in self.calibration.estimate.items()
            },
            "undetermined": [list(group) for group in self.calibration.undetermined],
            "alarms": [self._alarm(alarm) for alarm in self.alarms],
            "notes": list(self.notes),
        }

    def _choice(self) -> dict[str, Any] | None:
        choice = self.calibration.choice
        if choice is None:
            return None
        return {
            "chosen": choice.chosen,
            "reason": choice.reason,
            "held_out_mrad": {name: 1e3 * value for name, value in choice.held_out_rad.items()},
        }

    def _prior(self, name: str) -> dict[str, float]:
        priors = self.calibration.settings.priors
        return {"prior_sigma": priors[name][1]} if name in priors else {}

    def _alarm(self, alarm: Alarm) -> dict[str, Any]:
        first, last = self.record_names[alarm.first], self.record_names[alarm.last]
        return {
            "kind": alarm.kind,
            "first_record": int(first) if first.isdigit() else first,
            "last_record": int(last) if last.isdigit() else last,
            "axis": alarm.axis,
            "size_mrad": 1e3 * alarm.size_rad,
        }


@dataclass(frozen=True, slots=True, repr=False)
class Calibrations(Shown, Tabled, Sequence[HeliostatReport]):
    """Reports of the heliostats that could be fitted, as a sequence, and why others could not.

    Attributes
    ----------
    reports
        One a heliostat.
    skipped
        Reason by heliostat's name.
    parameters
        Which were to be fitted.
    """

    reports: tuple[HeliostatReport, ...]
    skipped: Mapping[str, str]
    parameters: str = AUTO

    def __len__(self) -> int:
        return len(self.reports)

    @overload
    def __getitem__(self, index: int) -> HeliostatReport: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[HeliostatReport, ...]: ...
    def __getitem__(self, index: int | slice) -> HeliostatReport | tuple[HeliostatReport, ...]:
        return self.reports[index]

    def headline(self) -> str:
        """Return how many were fitted, and how well they predict."""
        held = np.array([report.held_out_median_rad for report in self.reports])
        median = number(1e3 * float(np.median(held[np.isfinite(held)]))) if np.isfinite(held).any() else "unknown"
        return f"{counted(len(self.reports), 'heliostat')} fitted, {len(self.skipped)} left out; held out {median} mrad"

    def figures(self) -> tuple[list[str], list[list[str]]]:
        """Return one row a heliostat, of the figures of `table`."""
        header, rows = self.table()
        return header, [[cell if isinstance(cell, str) else number(float(cell)) for cell in row] for row in rows]

    def table(self) -> tuple[list[str], list[list[Any]]]:
        """Return one row a heliostat: records used, median errors [mrad of the normal], parameters determined."""
        keys = ("used", "train_median_mrad", "held_out_median_mrad", "chronological_median_mrad", "noise_mrad", "rank")
        found = [report.as_dict() for report in self.reports]
        return ["heliostat", *keys], [[each["heliostat"], *(each[key] for key in keys)] for each in found]

    def save(self, path: str | Path, *, force: bool = False) -> None:
        """Write the calibrated mounts as JSON or TOML, by the ending of ``path``.

        Raises
        ------
        RecordingError
            Another ending, or the file exists and ``force`` is not set.
        """
        sites = [report.site for report in self.reports]
        write_model_file(
            path,
            {report.id: report.calibration for report in self.reports},
            site=sites[0] if sites else None,
            settings={"parameters": self.parameters},
            undetermined={report.id: report.calibration.undetermined for report in self.reports},
            force=force,
        )

    def plot(self) -> Figure:
        """Draw each heliostat's errors in the order of its records, held-out median grey, shifts red."""
        figure = blank_figure(9.0, 2.6 * len(self.reports))
        for i, report in enumerate(self.reports, start=1):
            axes = figure.add_subplot(len(self.reports), 1, i)
            axes.semilogy(1e3 * report.calibration.error_rad, ".", color="tab:blue", markersize=4)
            for alarm in report.alarms:
                if alarm.kind == "shift":
                    axes.axvline(alarm.first - 0.5, color="tab:red", linewidth=0.8)
            axes.axhline(1e3 * report.held_out_median_rad, color="0.5", linewidth=0.8)
            axes.set_ylabel("normal error [mrad]")
            axes.set_title(f"{report.id}: grey = held-out median, red = shift", fontsize=9, loc="left")
        axes.set_xlabel("record, in the order of time")
        return figure


def calibrate(
    paint: str | Path | None = None,
    *,
    mounts: MountFile | str | Path | None = None,
    radio: Sequence[Result | str | Path] = (),
    motors: str | Path | None = None,
    camera: str | Path | None = None,
    drone: str | Path | None = None,
    heliostats: Sequence[str] = (),
    parameters: str | Sequence[str] = AUTO,
    algorithm: str = "both",
    settings: FitSettings | None = None,
    seed: int = 0,
) -> Calibrations:
    """Fit heliostats' mounts to measurements, all of a heliostat's in one fit, and judge the fits.

    A heliostat that cannot be read or fitted is left out, with the reason; the others go on.

    Parameters
    ----------
    paint
        Folder of PAINT records, with the heliostats' folders in it.
    mounts
        As planned or as calibrated before, or the file of them: where the fit begins. None: those that PAINT describes.
    radio, motors
        Results, or their files, and the CSV of motor positions that belongs to them.
    camera
        Folder of pictures of a target.
    drone
        CSV of a drone's log.
    heliostats
        Names; none: all that were measured.
    parameters
        ``"auto"``: as many as the records carry, chosen for each heliostat; or a parameter set, or names.
    algorithm
        Focal spot of PAINT records: ``both``, ``any``, ``HeliOS`` or ``UTIS``.
    settings
        Of the fit.
    seed
        Of the random splits that judge it.

    Raises
    ------
    InvalidInputError
        Nothing to fit, mounts or motor positions missing, a heliostat that has no mount or was not measured.
    RfposeError
        A file cannot be read; no heliostat at all could be fitted.

    Examples
    --------
    >>> import rfpose as rf
    >>> rf.calibrate("paint/", heliostats=["BF57"]).save("models.json")  # doctest: +SKIP
    """
    _check_free(parameters)
    if paint is None and mounts is None:
        raise InvalidInputError("nothing says where the fit begins: give `paint=DIRECTORY` or `mounts=FILE`")
    if bool(radio) != (motors is not None):
        raise InvalidInputError("`radio=` and `motors=` belong together: a pose alone does not say what the motors did")
    how = _How(parameters, settings, seed)
    if paint is not None and mounts is None and not (radio or camera or drone):
        return _calibrate_paint(Path(paint), heliostats, algorithm, how)
    sources = []
    if paint is not None:
        records, planned = read_paint(Path(paint), heliostats, algorithm=algorithm)
        sources.append(records)
    if mounts is not None:
        planned = mounts if isinstance(mounts, MountFile) else read_models(mounts)
    known = {name: stored.mount for name, stored in planned.heliostats.items()}
    if motors is not None:
        sources.append(read_radio(radio, Path(motors)))
    if camera is not None:
        sources.append(read_camera(Path(camera), known, planned.site))
    if drone is not None:
        sources.append(read_drone(Path(drone), known))
    if not sources:
        raise InvalidInputError("nothing was measured: besides mounts give `paint=`, `radio=`, `camera=` or `drone=`")
    return _calibrate_mounts(planned, sources, heliostats, how)


def _calibrate_paint(directory: Path, heliostats: Sequence[str], algorithm: str, how: _How) -> Calibrations:
    return _each(_paint_names(directory, heliostats), _Paint(directory.absolute(), algorithm, how), how)


@dataclass(frozen=True, slots=True)
class _Paint:
    """Calibrates a heliostat from its PAINT records alone."""

    directory: Path
    algorithm: str
    how: _How

    def __call__(self, name: str) -> HeliostatReport:
        if not self.directory.is_dir():
            raise ClusterError(
                f"{self.directory}: is no directory here; give a path that leads to the same one everywhere"
            )
        data = read_heliostat(self.directory, name, algorithm=self.algorithm)
        made = Measurements.from_spots(
            data.count, sun_enu=data.sun_enu, spot_enu_m=data.spot_enu_m, unix_s=data.order_s
        )
        _check_paint_sun(self.directory / name, data, made)
        part = _Part("PAINT", made, tuple(map(str, data.record_ids)))
        return _report(name, data.mount, data.site, [part], dict(data.skipped), self.how, data.notes)


def _check_free(free: str | Sequence[str]) -> None:
    """Refuse an unknown set before anything is read."""
    if free != AUTO:
        try:
            resolve_free(free)
        except InvalidInputError as error:
            raise InvalidInputError(f"{error}; or {AUTO}") from error


def _paint_names(directory: Path, heliostats: Sequence[str]) -> Sequence[str]:
    found = heliostat_ids(directory)
    for name in heliostats:
        if name not in found:
            raise RecordingError(f"{directory}: no calibration records of {name!r}; known are {', '.join(found[:8])}")
    return heliostats or found


def _each(names: Sequence[str], one: Callable[[str], HeliostatReport], how: _How) -> Calibrations:
    """Calibrate each; who cannot be does not keep the others from it."""
    found = dict(zip(names, gathered(_tried, names, one), strict=True))
    reports = [report for report in found.values() if isinstance(report, HeliostatReport)]
    errors = {name: error for name, error in found.items() if isinstance(error, RfposeError)}
    if not reports:
        name, first = next(iter(errors.items()))
        others = f" ({len(errors) - 1} more could not be fitted either)" if len(errors) > 1 else ""
        raise type(first)(f"heliostat {name}: {first}{others}") from first
    skipped = {name: str(error) for name, error in errors.items()}
    named = how.free if isinstance(how.free, str) else ",".join(how.free)
    return Calibrations(reports=tuple(reports), skipped=skipped, parameters=named)


def _tried(one: Callable[[str], HeliostatReport], name: str) -> HeliostatReport | RfposeError:
    """Calibrate a heliostat, or return what is wrong with it."""
    try:
        return one(name)
    except ClusterError:
        raise
    except RfposeError as error:
        return error


def _check_paint_sun(folder: Path, data: PaintHeliostat, made: Measurements) -> None:
    """Refuse records whose azimuth is not counted as PAINT's, in terms of what stands in them."""
    _, signs = sun_convention(data.mount, made)
    if signs is not None:
        raise RecordingError(
            f"{folder}: the records' sun_azimuth evidently runs {_PAINT_COUNTED[signs]}: "
            "write it as PAINT does: degrees, zero in the south, east positive"
        )


def _calibrate_mounts(
    mounts: MountFile, sources: Sequence[SourceMeasurements], heliostats: Sequence[str], how: _How
) -> Calibrations:
    """Calibrate mounts from all sources; the receivers' plane, too, where radio and another source meet."""
    measured = {name for source in sources for name in source.measurements}
    skipped = {name: why for source in sources for name, why in source.left_out.items()}
    for name in heliostats:
        if name not in mounts.heliostats:
            raise InvalidInputError(_no_mount(name, mounts))
        if name not in measured:
            raise InvalidInputError(f"heliostat {name!r} was not measured; measured were {', '.join(sorted(measured))}")

    found = _each(heliostats or sorted(measured), _Measured(mounts, sources, skipped, how), how)
    failed = {name: why for source in sources for name, why in source.failed.items()}
    return replace(found, skipped={**failed, **found.skipped})


@dataclass(frozen=True, slots=True)
class _Measured:
    """Calibrates a heliostat from all that measured it."""

    mounts: MountFile
    sources: Sequence[SourceMeasurements]
    skipped: Mapping[str, str]
    how: _How

    def __call__(self, name: str) -> HeliostatReport:
        if name not in self.mounts.heliostats:
            raise InvalidInputError(_no_mount(name, self.mounts))
        parts = []
        for source in self.sources:
            if name in source.measurements:
                made = source.measurements[name]
                parts.append(_Part(source.source, made, tuple(f"{source.source} {i}" for i in range(len(made)))))
        mount = self.mounts.heliostats[name].mount
        return _report(name, mount, self.mounts.site, parts, self.skipped, self.how)


def _no_mount(name: str, mounts: MountFile) -> str:
    known = ", ".join(list(mounts.heliostats)[:8])
    return f"heliostat {name!r} has no mount; known are {known}; add it to the file of mounts"


@dataclass(frozen=True, slots=True)
class _Part:
    """One source's share of a heliostat's measurements."""

    source: str
    measurements: Measurements
    names: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class _How:
    """What every heliostat of a run is fitted with."""

    free: str | Sequence[str]
    settings: FitSettings | None
    seed: int


def _report(
    name: str,
    mount: Mount,
    site: Location | None,
    parts: Sequence[_Part],
    skipped: Mapping[str, str],
    how: _How,
    notes: Sequence[str] = (),
) -> HeliostatReport:
    """Fit one heliostat and judge the fit."""
    made = join([part.measurements for part in parts])
    names = [label for part in parts for label in part.names]
    order = np.argsort(np.concatenate([part.measurements.unix_s for part in parts]), kind="stable")
    sources = {part.source: len(part.measurements) for part in parts}
    also = RECEIVER_PLANE if "radio" in sources and len(sources) > 1 else ()
    split: dict[str, Any] = {"settings": how.settings}
    if how.free == AUTO:
        calibration = fit_chosen(mount, made, also=also, settings=how.settings)
        split |= {"free": AUTO, "also": also}
    else:
        free = resolve_free(how.free)
        split["free"] = (*free, *(plane for plane in also if plane not in free))
        calibration = fit(mount, made, free=split["free"], settings=how.settings)
    return HeliostatReport(
        id=name,
        record_names=tuple(names[i] for i in order),
        skipped=skipped,
        sources=sources,
        site=site,
        calibration=calibration,
        random=_try_split(random_splits, mount, made, rng=np.random.default_rng(how.seed), **split),
        chronological=_try_split(chronological_split, mount, made, **split),
        alarms=alarms(calibration),
        notes=(*notes, *_notes(mount, calibration, radio_alone=set(sources) == {"radio"})),
    )


def _notes(mount: Mount, calibration: CalibratedMount, *, radio_alone: bool) -> list[str]:
    """Tell what a reader must know before believing the numbers."""
    notes = [RADIO_ALONE] if radio_alone else []
    made, found = calibration.measurements, calibration.field
    before, _ = sun_convention(mount, made)
    if before > _FAR_RAD:
        notes.append(
            f"the mount as given is {1e3 * before:.0f} mrad off in the median; the measurements agree with each other "
            "and were fitted: check its nominal values"
        )
    if calibration.noise_assumed:
        notes.append(
            f"{int(calibration.used.sum())} measurements carry {found.carried[0]:.1f} of {len(found.free)} parameters "
            f"and leave {found.redundancy[0]:.1f} components to tell the noise: it rests on the stated "
            f"{1e3 * float(np.median(made.sigma_rad)):.2g} mrad; measure more"
        )
    if calibration.choice is None:
        own = held_out_sigma(mount, made, free=calibration.free, settings=calibration.settings)
        chosen = fit_chosen(mount, made).choice
        best = chosen.held_out_sigma if chosen else 0.0
        if own > _OVERFITTED * best > 0.0:
            unit = 1e3 * float(np.median(made.sigma_rad))
            notes.append(
                f"the measurements do not carry these {len(found.free)} parameters: time-blocks held out scatter by "
                f"{unit * own:.2f} mrad, with auto by {unit * best:.2f}; use `parameters={AUTO}`"
            )
    return notes


def _try_split(split: Any, mount: Mount, made: Measurements, **how: Any) -> HeldOut | None:
    """Split, or nothing where there are too few measurements to do so."""
    try:
        found: HeldOut = split(mount, made, **how)
    except InvalidInputError:
        return None
    return found
