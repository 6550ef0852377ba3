"""The file of a result: format ``rfpose-result``, HDF5, described in ``docs/result-format.md``.

Every name in the file stands in `KEYS`, with dimensions, unit and meaning; writer, reader and Dataset follow it.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np
import numpy.typing as npt

from rfpose.dsp import CalibrationStatus, LineStatus, PhaseCalibration, TonePhases
from rfpose.errors import InvalidInputError, RfposeError
from rfpose.files import write_atomically
from rfpose.kinds import kind_of
from rfpose.multilat import FilterStatus, FixStatus, PoseStatus, RangeDifferences, RangeStatus
from rfpose.multilat.integrity import IntegrityStatus, TransmitterStatus
from rfpose.multilat.rigid.integers import IntegerMethod
from rfpose.multilat.rigid.problem import PRIORS
from rfpose.pipeline.formats.choice_text import choice_of
from rfpose.pipeline.formats.columns import (
    ENU,
    FIXED,
    Column,
    ColumnWriter,
    Labels,
    dataset_of,
    seconds_since,
    text_label,
    write_names,
)
from rfpose.pipeline.formats.hdf5_values import FileReader, opened
from rfpose.pipeline.formats.result import (
    LAST_TIME_S,
    DelayTable,
    FilteredTable,
    FixTable,
    IntegrityTable,
    PoseTable,
    ReflectionTable,
    Result,
    SiteTable,
    rate_of,
)
from rfpose.propagation import RayKind
from rfpose.recording.hdf5 import find_item
from rfpose.scenario import MAX_SAMPLE_INDEX, Scenario
from rfpose.truth import Truth

if TYPE_CHECKING:
    import xarray as xr

__all__ = [
    "FORMAT",
    "KEYS",
    "OPTIONAL",
    "VERSION",
    "columns_of",
    "dataset",
    "is_result",
    "labels_of",
    "open_result",
    "result_of",
    "write_result",
]

FORMAT = "rfpose-result"
VERSION = 1


# -- the names in the file -----------------------------------------------------------------------------------


_FR = ("frame", "receiver")
_FRT = (*_FR, "transmitter")
_FRTQ = (*_FRT, "tone")
_FTQ = ("frame", "transmitter", "tone")
_FH = ("frame", "heliostat")

KEYS: Mapping[str, Column] = {
    "frames/start_index": Column(("frame",), "i8", "sample", "first sample since the Unix epoch at the nominal rate"),
    "tones/phase_rad": Column(_FRTQ, "f8", "rad", "tone phase, not yet calibrated"),
    "tones/sigma_rad": Column(_FRTQ, "f8", "rad", "its standard deviation"),
    "tones/carrier": Column(_FRT, "c16", "counts", "complex amplitude of the carrier"),
    "tones/carrier_sigma": Column(_FRT, "f8", "counts", "standard deviation of its real and imaginary part"),
    "tones/sideband": Column((*_FRTQ, "side"), "c16", "counts", "complex amplitude of upper and lower sideband"),
    "tones/sideband_sigma": Column((*_FRTQ, "side"), "f8", "counts", "standard deviation of real and imaginary part"),
    "tones/clock_ppm": Column(_FR, "f8", "1e-6", "offset of the receiver's clock"),
    "tones/clock_sigma_ppm": Column(_FR, "f8", "1e-6", "its standard deviation"),
    "tones/noise_variance": Column(_FR, "f8", "counts2", "variance of the complex noise in the band"),
    "tones/clipped_fraction": Column(_FR, "f8", "1", "part of the samples at full scale"),
    "tones/status": Column(_FRT, "u1", "code", "what is wrong with the line, 0 nothing", LineStatus),
    "calibration/phase_rad": Column(_FTQ, "f8", "rad", "electronic phase of the transmitter's tone"),
    "calibration/sigma_rad": Column(_FTQ, "f8", "rad", "its standard deviation"),
    "calibration/drift_rad_per_sqrt_s": Column(("tone",), "f8", "rad/s^0.5", "random-walk rate seen between frames"),
    "calibration/status": Column(
        ("frame", "transmitter"), "u1", "code", "where it comes from, 0 measured in this frame", CalibrationStatus
    ),
    "ranges/range_difference_m": Column(_FRT, "f8", "m", "range less that to the reference, up to one constant a row"),
    "ranges/sigma_m": Column(_FRT, "f8", "m", "standard deviation of ONE transmitter's range, receiver noise"),
    "ranges/calibration_sigma_m": Column(_FRT, "f8", "m", "the same from calibration, common to a frame's receivers"),
    "ranges/reference": Column(_FR, "i8", "index", "reference transmitter, -1 none"),
    "ranges/status": Column(
        _FRT, "i1", "code", "why a range is missing or poorer, 0 measured with every tone", RangeStatus
    ),
    "fixes/position_enu_m": Column((*_FR, "xyz"), "f8", "m", "receiver position, east, north, up"),
    "fixes/cov_enu_m2": Column((*_FR, "xyz", "xyz_other"), "f8", "m2", "its covariance"),
    "fixes/clock_m": Column(_FR, "f8", "m", "range to the reference transmitter"),
    "fixes/dop": Column(_FR, "f8", "1", "position RMS over the deviation of one range"),
    "fixes/residual_m": Column(_FRT, "f8", "m", "computed less measured range"),
    "fixes/chi2": Column(_FR, "f8", "1", "sum of squared residuals over variances"),
    "fixes/n_transmitter": Column(_FR, "i2", "1", "transmitters used"),
    "fixes/n_iteration": Column(_FR, "i2", "1", "Gauss-Newton steps"),
    "fixes/status": Column(_FR, "i1", "code", "why a fix is missing, 0 solved", FixStatus),
    "poses/normal_enu": Column((*_FH, "xyz"), "f8", "1", "mirror normal, unit length, east, north, up"),
    "poses/cov_enu": Column((*_FH, "xyz", "xyz_other"), "f8", "rad2", "its covariance"),
    "poses/sigma_rad": Column(_FH, "f8", "rad", "RMS angle of the normal's error, both axes together"),
    "poses/azimuth_rad": Column(_FH, "f8", "rad", "azimuth of the normal, from north, clockwise"),
    "poses/elevation_rad": Column(_FH, "f8", "rad", "elevation of the normal"),
    "poses/centre_enu_m": Column((*_FH, "xyz"), "f8", "m", "mean position of the located receivers"),
    "poses/n_receiver": Column(_FH, "i2", "1", "receivers used"),
    "poses/n_wavelength": Column(_FH, "i2", "1", "wavelengths (tones, carrier) with resolved integers; 0: independent"),
    "poses/integer_risk": Column(_FH, "f8", "1", "largest probability of a wrong integer beforehand"),
    "poses/integer_method": Column(
        (*_FH, "clock"), "i1", "code", "how its whole wavelengths were found, 0 left out", IntegerMethod
    ),
    "poses/status": Column(_FH, "i1", "code", "why a pose is missing, 0 solved", PoseStatus),
    "integrity/status": Column(_FH, "i1", "code", "what tests of the residuals say, 0 consistent", IntegrityStatus),
    "integrity/transmitter_status": Column(
        (*_FH, "transmitter"), "i1", "code", "what was left out and why, 0 used", TransmitterStatus
    ),
    "integrity/used": Column(_FRT, "?", "1", "whether any of its phases is in the pose"),
    "integrity/prior_rejected": Column(
        (*_FH, "prior"), "?", "1", "pivot, mount, clocks: contradicts the data, left out"
    ),
    "integrity/prior_testable": Column((*_FH, "prior"), "?", "1", "pivot, mount, clocks: the data could contradict it"),
    "integrity/probability_all": Column(_FH, "f8", "1", "of residuals so large by chance, with everything"),
    "integrity/probability": Column(_FH, "f8", "1", "of residuals so large by chance, with what was used"),
    "integrity/protection_level_rad": Column(_FH, "f8", "rad", "what the normal's error does not exceed unnoticed"),
    "integrity/worst_transmitter": Column(_FH, "i2", "index", "transmitter that sets the protection level, -1 none"),
    "reflection/coefficient": Column((*_FH, "reflector"), "c16", "1", "reflection coefficient; the ground first"),
    "reflection/coefficient_sigma": Column(
        (*_FH, "reflector", "part"), "f8", "1", "of real and imaginary part; 0 given"
    ),
    "reflection/probability_direct": Column(
        _FH, "f8", "1", "of residuals so large by chance, with the direct ray alone"
    ),
    "site/weight": Column(_FRT, "f8", "1", "what the link counts, beside one without surprises"),
    "site/residual_rad": Column(_FRT, "f8", "rad", "phase that neither pose nor foreseen rays explain"),
    "site/sigma_rad": Column(_FRT, "f8", "rad", "its expected standard deviation"),
    "site/floor": Column(_FH, "f8", "1", "field that nothing foresees, relative to the direct one"),
    "site/tail": Column(("heliostat",), "f8", "1", "degrees of freedom of its distribution, Student's t"),
    "site/factor_scale": Column(("heliostat", "ray_kind"), "f8", "1", "errors of rays' factors over the stated"),
    "site/permittivity_change": Column(
        ("heliostat",), "c16", "1", "relative change of the ground's complex permittivity against the scenario's"
    ),
    "site/permittivity_sigma": Column(("heliostat", "part"), "f8", "1", "of its real and imaginary part"),
    "delays/delay_s": Column((*_FR, "clock"), "f8", "s", "delay less that of the mirror's first receiver"),
    "delays/sigma_s": Column((*_FR, "clock"), "f8", "s", "its standard deviation"),
    "delays/jumped": Column(_FH, "?", "1", "a delay had jumped and was learned anew"),
    "filtered/normal_enu": Column((*_FH, "xyz"), "f8", "1", "filtered mirror normal, unit length, east, north, up"),
    "filtered/cov_enu": Column((*_FH, "xyz", "xyz_other"), "f8", "rad2", "its covariance"),
    "filtered/sigma_rad": Column(_FH, "f8", "rad", "RMS angle of its error, both axes together"),
    "filtered/pivot_enu_m": Column((*_FH, "xyz"), "f8", "m", "filtered pivot, east, north, up"),
    "filtered/rate_enu_radps": Column((*_FH, "xyz"), "f8", "rad/s", "turning rate, about east, north, up"),
    "filtered/status": Column(_FH, "i1", "code", "what became of the frame, 1 measured and taken in", FilterStatus),
    "truth/frame_start_index": Column(("truth_frame",), "i8", "sample", "frames of the truth"),
    "truth/normal_enu": Column(("truth_frame", "heliostat", "xyz"), "f8", "1", "true mirror normal"),
    "truth/receiver_enu_m": Column(("truth_frame", "receiver", "xyz"), "f8", "m", "true receiver position"),
    "truth/transmitter_phase_rad": Column(("truth_frame", "transmitter", "tone"), "f8", "rad", "true electronic phase"),
    "truth/clock_ppm": Column(("receiver",), "f8", "1e-6", "true clock offset"),
    "truth/receiver_delay_s": Column(("truth_frame", "receiver"), "f8", "s", "true hardware delay"),
    "truth/tone_snr": Column(("truth_frame", "receiver", "transmitter", "tone"), "f8", "1", "true SNR per sample"),
}
"""Datasets by path. Those under ``truth/`` may be absent, each on its own; those of `OPTIONAL` all together."""

OPTIONAL: Mapping[str, type[Any]] = {
    "integrity": IntegrityTable,
    "reflection": ReflectionTable,
    "site": SiteTable,
    "delays": DelayTable,
    "filtered": FilteredTable,
}
"""Groups that are there where the estimator of poses makes them."""

_ALWAYS = ("tones", "calibration", "ranges", "fixes", "poses")

_TRANSMITTER_INDEX = ("ranges/reference", "integrity/worst_transmitter")


def _group_keys(group: str) -> list[str]:
    return [path.partition("/")[2] for path in KEYS if path.startswith(f"{group}/")]


# -- writing -------------------------------------------------------------------------------------------------


def write_result(result: Result, path: str | Path, *, force: bool = True) -> None:
    """Write a result in one go; the same result gives the same bytes. Without ``force`` nothing is replaced.

    Raises
    ------
    RecordingError
        The file cannot be written; what stood under ``path`` is untouched.
    """
    image = io.BytesIO()
    with h5py.File(image, "w", libver=("v110", "v110")) as file:
        file.attrs["format"] = FORMAT
        file.attrs["version"] = VERSION
        file.create_dataset("scenario", data=result.scenario.to_toml())
        settings = file.create_group("settings")
        for name, text in sorted(result.settings.items()):
            settings.attrs[name] = text
        for name in ("receiver_ids", "transmitter_ids", "heliostat_ids"):
            write_names(file, f"ids/{name}", getattr(result.scenario, name))
        writer = ColumnWriter(file, labels_of(result))
        for place, (column, values) in columns_of(result).items():
            writer.write(file, place, column, values)
    write_atomically(path, image.getvalue(), force=force)


def columns_of(result: Result) -> dict[str, tuple[Column, npt.NDArray[Any]]]:
    """Return what a result has of `KEYS`, by path."""
    found = {}
    for path, column in KEYS.items():
        group, _, name = path.partition("/")
        record = {"start_index": result.frame_start_index} if group == "frames" else getattr(result, group)
        values = record[name] if group == "frames" else None if record is None else getattr(record, name)
        if values is not None:
            found[path] = (column, values)
    return found


def dataset(result: Result, group: str | None) -> xr.Dataset:
    """Return a result, or one group of it, as a labelled Dataset; see `Result.to_xarray`."""
    columns = columns_of(result)
    groups = list(dict.fromkeys(path.partition("/")[0] for path in columns))
    if group is not None and group not in groups:
        raise InvalidInputError(f"`group` must be one of {', '.join(groups)}, got {group!r}")
    named = {
        path.partition("/")[2] if group else path.replace("/", "_"): column
        for path, column in columns.items()
        if group in (None, path.partition("/")[0])
    }
    return dataset_of(named, labels_of(result), {"scenario": result.scenario.name, **result.settings})


def labels_of(result: Result) -> Labels:
    """Return what the entries along each dimension are called."""
    scenario, truth = result.scenario, result.truth
    clocks = [f"{1e-6 * f:.9g} MHz" for f in np.sort(scenario.tone_hz)] + ["carrier"]
    truth_start = np.zeros(1, np.int64) if truth is None else truth.frame_start_index
    n_truth = 0 if truth is None else len(truth.normal_enu)

    def instants(starts: npt.NDArray[np.int64], meaning: str) -> tuple[npt.NDArray[Any], Mapping[str, str]]:
        microseconds = [int(int(start) * 1_000_000 / result.sample_rate) for start in starts]
        return seconds_since(np.array(microseconds, np.int64), "microseconds", meaning)

    return {
        "frame": instants(result.frame_start_index, "first sample of the frame, UTC"),
        "receiver": text_label(scenario.receiver_ids, "receiver"),
        "transmitter": text_label(scenario.transmitter_ids, "transmitter"),
        "heliostat": text_label(scenario.heliostat_ids, "heliostat"),
        "tone": (np.array(scenario.tone_hz), {"long_name": "frequency of the tone", "units": "Hz"}),
        "xyz": text_label(ENU, "axis of the site's frame"),
        "xyz_other": text_label(ENU, "axis of the site's frame"),
        "side": text_label(("upper", "lower"), "side of the carrier"),
        "part": text_label(("real", "imaginary"), "part of a complex number"),
        "clock": text_label(clocks[: result.poses.integer_method.shape[-1]], "wavelength, the coarsest first"),
        "prior": text_label(PRIORS, "what is known beforehand"),
        "reflector": text_label(("ground", *(p.name for p in scenario.reflection.plane)), "what reflects"),
        "ray_kind": text_label([kind.name.lower() for kind in RayKind], "what a foreseen ray met"),
        "truth_frame": (np.arange(n_truth), {"long_name": "frame of the truth"})
        if truth_start is None
        else instants(truth_start, "from when on the truth holds, UTC"),
    }


# -- reading -------------------------------------------------------------------------------------------------


def is_result(path: str | Path) -> bool:
    """Tell whether a file says that it is an rfpose-result; false for whatever cannot be opened."""
    return kind_of(path) == "result"


def open_result(path: str | Path) -> Result:
    """Read a result, or the frames so far of one that is being made (``RESULT.partial`` of `rfpose process --follow`).

    Raises
    ------
    RecordingError
        Missing, truncated, not HDF5, another format or version, or something in it is missing, of another type or
        shape, or says what no result says; the message names the file and the place.

    Examples
    --------
    >>> import rfpose as rf
    >>> rf.open_result("result.h5").to_pandas()  # doctest: +SKIP
    """
    path = Path(path)
    if path.is_dir():
        from rfpose.pipeline.formats.live_result import open_live

        return open_live(path)
    with opened(path, wanted="result", version=VERSION, again=_AGAIN) as file:
        return _Reader(path, file, length=FIXED, again=_AGAIN).result()


_AGAIN = "run `rfpose process` again"


def result_of(
    scenario: Scenario,
    settings: Mapping[str, str],
    columns: Mapping[str, npt.NDArray[Any]],
    *,
    truth: Truth | None = None,
) -> Result:
    """Return a result made of the columns of `KEYS`; the inverse of `columns_of`."""

    def group(name: str) -> dict[str, npt.NDArray[Any]]:
        return {key: columns[f"{name}/{key}"] for key in _group_keys(name)}

    return Result(
        scenario=scenario,
        sample_rate=rate_of(settings),
        choice=choice_of(settings, scenario),
        settings=settings,
        frame_start_index=columns["frames/start_index"],
        tones=TonePhases(
            **group("tones"),
            receiver_ids=scenario.receiver_ids,
            transmitter_ids=scenario.transmitter_ids,
            tone_hz=scenario.tone_hz,
            frame_start_index=columns["frames/start_index"],
        ),
        calibration=PhaseCalibration(**group("calibration")),
        ranges=RangeDifferences(**group("ranges")),
        fixes=FixTable(**group("fixes")),
        poses=PoseTable(**group("poses")),
        **{
            name: record(**group(name))
            for name, record in OPTIONAL.items()
            if f"{name}/{_group_keys(name)[0]}" in columns
        },
        truth=truth,
    )


class _Reader(FileReader):
    """Reads a result."""

    def result(self) -> Result:
        scenario = self.scenario()
        self.length |= {
            "receiver": len(scenario.receiver_ids),
            "transmitter": len(scenario.transmitter_ids),
            "tone": len(scenario.tone_hz),
            "heliostat": len(scenario.heliostat_ids),
            "ray_kind": len(RayKind),
        }
        settings, sample_rate = self._settings(scenario)
        columns = {"frames/start_index": self._start_index(sample_rate)}
        for group in (*_ALWAYS, *(name for name in OPTIONAL if name in self.file)):
            columns |= {f"{group}/{name}": values for name, values in self._group(group).items()}
        return result_of(scenario, settings, columns, truth=self._truth(scenario))

    def _settings(self, scenario: Scenario) -> tuple[dict[str, str], Fraction]:
        group = find_item(self.file, "/settings", follow_links=False)
        found = dict(group.attrs.items()) if isinstance(group, h5py.Group) else {}
        for name, value in found.items():
            if not isinstance(value, str):
                raise self.error("settings", f"has an attribute `{name}` that is no text")
        for name in ("sample_rate", "estimator", "pose"):
            if name not in found:
                raise self.error("settings", f"is missing or lacks `{name}`")
        try:
            choice_of(found, scenario)
            return found, rate_of(found)
        except RfposeError as error:
            raise self.error("settings", f"cannot be: {error}") from error

    def _start_index(self, sample_rate: Fraction) -> npt.NDArray[np.int64]:
        starts = self._array("frames/start_index")
        late = np.flatnonzero((starts < 0) | (starts > min(LAST_TIME_S * sample_rate, MAX_SAMPLE_INDEX)))
        if late.size:
            value = starts[late[0]]
            raise self.error("frames/start_index", f"[{late[0]}] is {value}, no time until the year 9999")
        back = np.flatnonzero(np.diff(starts) <= 0)
        if back.size:
            raise self.error("frames/start_index", f"[{back[0] + 1}] is not after the one before")
        return starts

    def _group(self, group: str) -> dict[str, npt.NDArray[Any]]:
        return {name: self._array(f"{group}/{name}") for name in _group_keys(group)}

    def _truth(self, scenario: Scenario) -> Truth | None:
        if "truth" not in self.file:
            return None
        arrays = {name: self._array(f"truth/{name}") for name in _group_keys("truth") if name in self.file["truth"]}
        for name in ("normal_enu", "receiver_enu_m"):
            if name not in arrays:
                raise self.error(f"truth/{name}", "is missing")
        return Truth(
            heliostat_ids=scenario.heliostat_ids,
            receiver_ids=scenario.receiver_ids,
            transmitter_ids=scenario.transmitter_ids,
            **arrays,
        )

    def _array(self, path: str) -> npt.NDArray[Any]:
        values = self.array(path, KEYS[path])
        self._check_codes(path, values)
        return values

    def _check_codes(self, path: str, values: npt.NDArray[Any]) -> None:
        """Refuse codes that mean nothing, and transmitters that do not exist."""
        codes = KEYS[path].codes
        if codes is not None:
            good = np.isin(values, [int(code) for code in codes])
        elif path in _TRANSMITTER_INDEX:
            good = (values >= -1) & (values < self.length["transmitter"])
        else:
            return
        if not good.all():
            at = tuple(int(i) for i in np.argwhere(~good)[0])
            raise self.error(path, f"{list(at)} is {values[at]}, which means nothing")
