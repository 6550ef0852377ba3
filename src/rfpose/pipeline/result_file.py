"""What processing found, and its file: format ``rfpose-result``, HDF5, described in ``docs/result-format.md``.

Every name in the file stands in `KEYS`, with axes, unit and meaning; writer and reader both follow it.
"""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from enum import IntEnum
from fractions import Fraction
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, read_only
from rfpose.dsp import Calibration, CalibrationStatus, LineStatus, TonePhases
from rfpose.errors import RecordingError, ScenarioError
from rfpose.multilat import FixStatus, PoseStatus, RangeDifferences, RangeStatus, TrackStatus
from rfpose.multilat.integrity import IntegrityStatus, TransmitterStatus
from rfpose.multilat.integrity.hypotheses import PRIORS
from rfpose.multilat.rigid.integers import IntegerMethod
from rfpose.pipeline.files import write_atomically
from rfpose.scenario import Scenario, parse_scenario
from rfpose.truth import Truth

__all__ = [
    "FORMAT",
    "KEYS",
    "OPTIONAL",
    "VERSION",
    "DelayTable",
    "FilteredTable",
    "FixTable",
    "IntegrityTable",
    "Key",
    "PoseTable",
    "ReflectionTable",
    "Result",
    "StatusArray",
    "count_reasons",
    "frame_time",
    "is_result",
    "read_result",
    "summarise",
    "write_poses_csv",
    "write_result",
]

FORMAT = "rfpose-result"
VERSION = 1

NEEDED_PROBABILITY = 1e-3
"""Residuals of the direct ray alone that are rarer than this say that a reflection is needed."""

EXPLAINED = (IntegrityStatus.EXCLUDED, IntegrityStatus.PRIOR_REJECTED, IntegrityStatus.AMBIGUOUS)
"""Where what was left out explains the residuals; elsewhere its names mean nothing."""

StatusArray = npt.NDArray[np.int8]


# -- records -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class FixTable:
    """Positions of the receivers, each located on its own: `rfpose.multilat.Fixes` with a frame axis.

    Attributes
    ----------
    position_enu_m : (frame, receiver, xyz)
        Site ENU [m]. NaN = not solved.
    cov_enu_m2 : (frame, receiver, xyz, xyz)
        Covariance, calibration included [m²].
    clock_m : (frame, receiver)
        Range to the reference transmitter [m].
    dop : (frame, receiver)
        Position RMS over the standard deviation of one transmitter's range, all alike.
    residual_m : (frame, receiver, transmitter)
        Computed less measured range [m].
    chi2 : (frame, receiver)
        Sum of squared residuals over their variances.
    n_transmitter, n_iteration : (frame, receiver)
        Transmitters used, Gauss-Newton steps taken.
    status : (frame, receiver)
        `rfpose.multilat.FixStatus`.
    """

    position_enu_m: FloatArray
    cov_enu_m2: FloatArray
    clock_m: FloatArray
    dop: FloatArray
    residual_m: FloatArray
    chi2: FloatArray
    n_transmitter: npt.NDArray[np.int16]
    n_iteration: npt.NDArray[np.int16]
    status: StatusArray


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseTable:
    """Mirror normals: `rfpose.multilat.Normals` with the mirrors' places.

    Attributes
    ----------
    normal_enu : (frame, heliostat, xyz)
        Unit length, out of the mirror's front. NaN = not solved.
    cov_enu : (frame, heliostat, xyz, xyz)
        Covariance of ``normal_enu`` (singular along the normal) [rad²].
    sigma_rad : (frame, heliostat)
        RMS angle of the normal's error, both axes together [rad].
    azimuth_rad, elevation_rad : (frame, heliostat)
        Of the normal; azimuth from north, clockwise [rad].
    centre_enu_m : (frame, heliostat, xyz)
        Mean position of the located receivers, site ENU [m].
    n_receiver : (frame, heliostat)
        Receivers used.
    n_wavelength : (frame, heliostat)
        Wavelengths that pose ``rigid`` rests on: tones, and the carrier, whose whole wavelengths were resolved.
    integer_risk : (frame, heliostat)
        Largest probability, beforehand, that one of them has a wrong whole wavelength. NaN for pose ``independent``.
    integer_method : (frame, heliostat, clock)
        `rfpose.multilat.rigid.integers.IntegerMethod` of each tone, the coarsest first, then of the carrier.
    status : (frame, heliostat)
        `rfpose.multilat.PoseStatus`.
    """

    normal_enu: FloatArray
    cov_enu: FloatArray
    sigma_rad: FloatArray
    azimuth_rad: FloatArray
    elevation_rad: FloatArray
    centre_enu_m: FloatArray
    n_receiver: npt.NDArray[np.int16]
    n_wavelength: npt.NDArray[np.int16]
    integer_risk: FloatArray
    integer_method: npt.NDArray[np.int8]
    status: StatusArray


@dataclass(frozen=True, slots=True, kw_only=True)
class IntegrityTable:
    """What tests of the residuals found, of pose ``rigid``.

    Attributes
    ----------
    status : (frame, heliostat)
        `rfpose.multilat.integrity.IntegrityStatus`.
    transmitter_status : (frame, heliostat, transmitter)
        `rfpose.multilat.integrity.TransmitterStatus`: what was left out, and why.
    used : (frame, receiver, transmitter)
        Whether any of its phases is in the pose; false for calibration receivers.
    prior_rejected, prior_testable : (frame, heliostat, prior)
        Pivot, mount and clocks: which contradicts the data and was left out; which the data could contradict.
    probability_all, probability : (frame, heliostat)
        Of residuals as large or larger by noise alone, with everything, and with what was used.
    protection_level_rad : (frame, heliostat)
        The normal is off by more, without a warning, no more often than the scenario's ``missed_detection``, one
        transmitter being wrong by whatever amount. Infinite where nothing protects it, NaN where there is no pose.
    worst_transmitter : (frame, heliostat)
        The one that sets it; −1: another explanation of an error found, or no pose.
    """

    status: StatusArray
    transmitter_status: StatusArray
    used: npt.NDArray[np.bool_]
    prior_rejected: npt.NDArray[np.bool_]
    prior_testable: npt.NDArray[np.bool_]
    probability_all: FloatArray
    probability: FloatArray
    protection_level_rad: FloatArray
    worst_transmitter: npt.NDArray[np.int16]


@dataclass(frozen=True, slots=True, kw_only=True)
class ReflectionTable:
    """Coefficients of what reflects, as each pose was solved with.

    Attributes
    ----------
    coefficient : (frame, heliostat, reflector)
        Complex, at RF; the ground first, then the scenario's planes. With Fresnel's formulas the factor on them.
    coefficient_sigma : (frame, heliostat, reflector, 2)
        Standard deviation of real and imaginary part; 0 where given, NaN where not determined.
    probability_direct : (frame, heliostat)
        Of the residuals that the direct ray alone leaves in the tones: small says that the reflection is needed.
    """

    coefficient: npt.NDArray[np.complex128]
    coefficient_sigma: FloatArray
    probability_direct: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class DelayTable:
    """Delays between a mirror's receivers, learned over frames.

    Attributes
    ----------
    delay_s : (frame, receiver, clock)
        Less that of the mirror's first receiver, after the frame [s]. Clocks: tones from the coarsest on, then the
        carrier. NaN: not learned, or nothing seen yet.
    sigma_s : (frame, receiver, clock)
        Its standard deviation [s].
    jumped : (frame, heliostat)
        A delay had jumped: all of the mirror's were learned anew from this frame.
    """

    delay_s: FloatArray
    sigma_s: FloatArray
    jumped: npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True, kw_only=True)
class FilteredTable:
    """Poses filtered over frames, each of the frame's middle: `rfpose.multilat.TrackedPoses`.

    Attributes
    ----------
    normal_enu : (frame, heliostat, xyz)
        Unit length; NaN = nothing known yet, or no longer.
    cov_enu : (frame, heliostat, xyz, xyz)
        Covariance of ``normal_enu`` (singular along the normal) [rad²].
    sigma_rad : (frame, heliostat)
        RMS angle of the normal's error, both axes together [rad].
    pivot_enu_m, rate_enu_radps : (frame, heliostat, xyz)
        Pivot [m]; turning rate [rad/s].
    status : (frame, heliostat)
        `rfpose.multilat.TrackStatus`.
    """

    normal_enu: FloatArray
    cov_enu: FloatArray
    sigma_rad: FloatArray
    pivot_enu_m: FloatArray
    rate_enu_radps: FloatArray
    status: StatusArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Result:
    """All that processing a recording found.

    Attributes
    ----------
    scenario
        The site as it was processed; its receiver axis is the receiver axis here.
    settings
        What the result depends on besides the recording, as text.
    frame_start_index : (frame,)
        First sample of each frame, counted from the Unix epoch at the recording's sample rate.
    tones, calibration, ranges, fixes, poses
        The stages in order.
    integrity, reflection, delays, filtered
        What else the chosen estimator of poses found; None where it does not look for it.
    truth
        What was really there, copied from a simulated recording; else None.
    """

    scenario: Scenario
    settings: Mapping[str, str]
    frame_start_index: npt.NDArray[np.int64]
    tones: TonePhases
    calibration: Calibration
    ranges: RangeDifferences
    fixes: FixTable
    poses: PoseTable
    integrity: IntegrityTable | None = None
    reflection: ReflectionTable | None = None
    delays: DelayTable | None = None
    filtered: FilteredTable | None = None
    truth: Truth | None = None

    @property
    def sample_rate(self) -> Fraction:
        """Nominal sample rate [1/s]."""
        return Fraction(self.settings["sample_rate"])


def frame_time(start_index: int, sample_rate: Fraction) -> datetime:
    """Return the UTC time of a sample counted from the Unix epoch, to the microsecond."""
    microseconds = int(start_index * 1_000_000 / sample_rate)
    return datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=microseconds)


# -- the names in the file -----------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Key:
    """One dataset: its axes (a number is a fixed length), numpy type, unit and meaning."""

    axes: tuple[str | int, ...]
    dtype: str
    unit: str
    meaning: str


_FR = ("frame", "receiver")
_FRT = (*_FR, "transmitter")
_FRTQ = (*_FRT, "tone")
_FTQ = ("frame", "transmitter", "tone")
_FH = ("frame", "heliostat")

KEYS: Mapping[str, Key] = {
    "frames/start_index": Key(("frame",), "i8", "sample", "first sample since the Unix epoch at the nominal rate"),
    "tones/phase_rad": Key(_FRTQ, "f8", "rad", "tone phase, not yet calibrated"),
    "tones/sigma_rad": Key(_FRTQ, "f8", "rad", "its standard deviation"),
    "tones/carrier": Key(_FRT, "c16", "counts", "complex amplitude of the carrier"),
    "tones/carrier_sigma": Key(_FRT, "f8", "counts", "standard deviation of its real and imaginary part"),
    "tones/sideband": Key((*_FRTQ, 2), "c16", "counts", "complex amplitude of upper and lower sideband"),
    "tones/sideband_sigma": Key((*_FRTQ, 2), "f8", "counts", "standard deviation of real and imaginary part"),
    "tones/clock_ppm": Key(_FR, "f8", "1e-6", "offset of the receiver's clock"),
    "tones/clock_sigma_ppm": Key(_FR, "f8", "1e-6", "its standard deviation"),
    "tones/noise_variance": Key(_FR, "f8", "counts2", "variance of the complex noise in the band"),
    "tones/clipped_fraction": Key(_FR, "f8", "1", "part of the samples at full scale"),
    "tones/status": Key(_FRT, "u1", "code", "what is wrong with the line, 0 nothing"),
    "calibration/phase_rad": Key(_FTQ, "f8", "rad", "electronic phase of the transmitter's tone"),
    "calibration/sigma_rad": Key(_FTQ, "f8", "rad", "its standard deviation"),
    "calibration/drift_rad_per_sqrt_s": Key(("tone",), "f8", "rad/s^0.5", "random-walk rate seen between frames"),
    "calibration/status": Key(("frame", "transmitter"), "u1", "code", "where it comes from, 0 measured in this frame"),
    "ranges/range_difference_m": Key(_FRT, "f8", "m", "range less that to the reference, up to one constant a row"),
    "ranges/sigma_m": Key(_FRT, "f8", "m", "standard deviation of ONE transmitter's range, receiver noise"),
    "ranges/calibration_sigma_m": Key(_FRT, "f8", "m", "the same from calibration, common to a frame's receivers"),
    "ranges/reference": Key(_FR, "i8", "index", "reference transmitter, -1 none"),
    "ranges/status": Key(_FRT, "i1", "code", "why a range is missing or poorer, 0 measured with every tone"),
    "fixes/position_enu_m": Key((*_FR, 3), "f8", "m", "receiver position, east, north, up"),
    "fixes/cov_enu_m2": Key((*_FR, 3, 3), "f8", "m2", "its covariance"),
    "fixes/clock_m": Key(_FR, "f8", "m", "range to the reference transmitter"),
    "fixes/dop": Key(_FR, "f8", "1", "position RMS over the deviation of one range"),
    "fixes/residual_m": Key(_FRT, "f8", "m", "computed less measured range"),
    "fixes/chi2": Key(_FR, "f8", "1", "sum of squared residuals over variances"),
    "fixes/n_transmitter": Key(_FR, "i2", "1", "transmitters used"),
    "fixes/n_iteration": Key(_FR, "i2", "1", "Gauss-Newton steps"),
    "fixes/status": Key(_FR, "i1", "code", "why a fix is missing, 0 solved"),
    "poses/normal_enu": Key((*_FH, 3), "f8", "1", "mirror normal, unit length, east, north, up"),
    "poses/cov_enu": Key((*_FH, 3, 3), "f8", "rad2", "its covariance"),
    "poses/sigma_rad": Key(_FH, "f8", "rad", "RMS angle of the normal's error, both axes together"),
    "poses/azimuth_rad": Key(_FH, "f8", "rad", "azimuth of the normal, from north, clockwise"),
    "poses/elevation_rad": Key(_FH, "f8", "rad", "elevation of the normal"),
    "poses/centre_enu_m": Key((*_FH, 3), "f8", "m", "mean position of the located receivers"),
    "poses/n_receiver": Key(_FH, "i2", "1", "receivers used"),
    "poses/n_wavelength": Key(_FH, "i2", "1", "wavelengths (tones, carrier) with resolved integers; 0: independent"),
    "poses/integer_risk": Key(_FH, "f8", "1", "largest probability of a wrong integer beforehand"),
    "poses/integer_method": Key((*_FH, "clock"), "i1", "code", "how its whole wavelengths were found, 0 left out"),
    "poses/status": Key(_FH, "i1", "code", "why a pose is missing, 0 solved"),
    "integrity/status": Key(_FH, "i1", "code", "what tests of the residuals say, 0 consistent"),
    "integrity/transmitter_status": Key((*_FH, "transmitter"), "i1", "code", "what was left out and why, 0 used"),
    "integrity/used": Key(_FRT, "?", "1", "whether any of its phases is in the pose"),
    "integrity/prior_rejected": Key((*_FH, 3), "?", "1", "pivot, mount, clocks: contradicts the data, left out"),
    "integrity/prior_testable": Key((*_FH, 3), "?", "1", "pivot, mount, clocks: the data could contradict it"),
    "integrity/probability_all": Key(_FH, "f8", "1", "of residuals so large by chance, with everything"),
    "integrity/probability": Key(_FH, "f8", "1", "of residuals so large by chance, with what was used"),
    "integrity/protection_level_rad": Key(_FH, "f8", "rad", "what the normal's error does not exceed unnoticed"),
    "integrity/worst_transmitter": Key(_FH, "i2", "index", "transmitter that sets the protection level, -1 none"),
    "reflection/coefficient": Key((*_FH, "reflector"), "c16", "1", "reflection coefficient; the ground first"),
    "reflection/coefficient_sigma": Key((*_FH, "reflector", 2), "f8", "1", "of real and imaginary part; 0 given"),
    "reflection/probability_direct": Key(_FH, "f8", "1", "of residuals so large by chance, with the direct ray alone"),
    "delays/delay_s": Key((*_FR, "clock"), "f8", "s", "delay less that of the mirror's first receiver"),
    "delays/sigma_s": Key((*_FR, "clock"), "f8", "s", "its standard deviation"),
    "delays/jumped": Key(_FH, "?", "1", "a delay had jumped and was learned anew"),
    "filtered/normal_enu": Key((*_FH, 3), "f8", "1", "filtered mirror normal, unit length, east, north, up"),
    "filtered/cov_enu": Key((*_FH, 3, 3), "f8", "rad2", "its covariance"),
    "filtered/sigma_rad": Key(_FH, "f8", "rad", "RMS angle of its error, both axes together"),
    "filtered/pivot_enu_m": Key((*_FH, 3), "f8", "m", "filtered pivot, east, north, up"),
    "filtered/rate_enu_radps": Key((*_FH, 3), "f8", "rad/s", "turning rate, about east, north, up"),
    "filtered/status": Key(_FH, "i1", "code", "what became of the frame, 1 measured and taken in"),
    "truth/frame_start_index": Key(("truth_frame",), "i8", "sample", "frames of the truth"),
    "truth/normal_enu": Key(("truth_frame", "heliostat", 3), "f8", "1", "true mirror normal"),
    "truth/receiver_enu_m": Key(("truth_frame", "receiver", 3), "f8", "m", "true receiver position"),
    "truth/transmitter_phase_rad": Key(("truth_frame", "transmitter", "tone"), "f8", "rad", "true electronic phase"),
    "truth/clock_ppm": Key(("receiver",), "f8", "1e-6", "true clock offset"),
    "truth/receiver_delay_s": Key(("truth_frame", "receiver"), "f8", "s", "true hardware delay"),
    "truth/tone_snr": Key(("truth_frame", "receiver", "transmitter", "tone"), "f8", "1", "true SNR per sample"),
}
"""Datasets by path. Those under ``truth/`` may be absent, each on its own; those of `OPTIONAL` all together."""

OPTIONAL: Mapping[str, type[Any]] = {
    "integrity": IntegrityTable,
    "reflection": ReflectionTable,
    "delays": DelayTable,
    "filtered": FilteredTable,
}
"""Groups that are there where the estimator of poses makes them."""

_STATUS: Mapping[str, type[IntEnum]] = {
    "tones/status": LineStatus,
    "calibration/status": CalibrationStatus,
    "ranges/status": RangeStatus,
    "fixes/status": FixStatus,
    "poses/integer_method": IntegerMethod,
    "poses/status": PoseStatus,
    "integrity/status": IntegrityStatus,
    "integrity/transmitter_status": TransmitterStatus,
    "filtered/status": TrackStatus,
}


def _group_keys(group: str) -> list[str]:
    return [path.partition("/")[2] for path in KEYS if path.startswith(f"{group}/")]


# -- writing -------------------------------------------------------------------------------------------------


def write_result(result: Result, path: str | Path) -> None:
    """Write a result in one go; the same result gives the same bytes.

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
            file.create_dataset(f"ids/{name}", data=np.array(getattr(result.scenario, name), dtype=object), dtype=_TEXT)
        _write(file, "frames/start_index", result.frame_start_index)
        for group in ("tones", "calibration", "ranges", "fixes", "poses"):
            record = getattr(result, group)
            for name in _group_keys(group):
                _write(file, f"{group}/{name}", getattr(record, name))
        for group in OPTIONAL:
            record = getattr(result, group)
            for name in _group_keys(group) if record is not None else ():
                _write(file, f"{group}/{name}", getattr(record, name))
        if result.truth is not None:
            for name in _group_keys("truth"):
                values = getattr(result.truth, name)
                if values is not None:
                    _write(file, f"truth/{name}", values)
    write_atomically(path, image.getvalue())


_TEXT = h5py.string_dtype()


def _write(file: h5py.File, path: str, values: npt.ArrayLike) -> None:
    key = KEYS[path]
    dataset = file.create_dataset(path, data=np.asarray(values, dtype=key.dtype))
    dataset.attrs["unit"] = key.unit
    dataset.attrs["axes"] = ", ".join(str(axis) for axis in key.axes)
    dataset.attrs["meaning"] = key.meaning
    if path in _STATUS:
        dataset.attrs["codes"] = "; ".join(f"{code.value} {code.reason}" for code in _STATUS[path])  # type: ignore[attr-defined]


# -- reading -------------------------------------------------------------------------------------------------


def is_result(path: str | Path) -> bool:
    """Tell whether a file says that it is an rfpose-result; false for whatever cannot be opened."""
    try:
        with h5py.File(path, "r") as file:
            return bool(file.attrs.get("format") == FORMAT)
    except OSError:
        return False


def read_result(path: str | Path) -> Result:
    """Read a result.

    Raises
    ------
    RecordingError
        Missing, truncated, not HDF5, another format or version, or a dataset that is missing or has the wrong
        type or shape; the message names the file and the place.
    """
    path = Path(path)
    if not path.exists():
        raise RecordingError(f"{path}: no such file; make it with `rfpose process`")
    try:
        with h5py.File(path, "r") as file:
            return _Reader(path, file).result()
    except RecordingError:
        raise
    except (OSError, RuntimeError, KeyError) as error:
        raise RecordingError(
            f"{path}: cannot be read as HDF5 ({error}); it is truncated or another kind of file: process again"
        ) from error


class _Reader:
    """Reads one open file; each complaint names the file and the place in it."""

    def __init__(self, path: Path, file: h5py.File) -> None:
        self._path = path
        self._file = file
        self._length: dict[str, int] = {}

    def result(self) -> Result:
        found = self._file.attrs.get("format")
        if found != FORMAT:
            raise self._error(f"is no {FORMAT} file (format: {found or 'none'})", "give what `rfpose process` wrote")
        version = self._file.attrs.get("version")
        if version != VERSION:
            raise self._error(f"has version {version} of {FORMAT}, this rfpose reads {VERSION}", "process again")
        scenario = self._scenario()
        self._length = {
            "receiver": len(scenario.receiver_ids),
            "transmitter": len(scenario.transmitter_ids),
            "tone": len(scenario.tone_hz),
            "heliostat": len(scenario.heliostat_ids),
        }
        start_index = self._array("frames/start_index")
        tones = self._group("tones")
        return Result(
            scenario=scenario,
            settings=self._settings(),
            frame_start_index=start_index,
            tones=TonePhases(
                **tones,
                receiver_ids=scenario.receiver_ids,
                transmitter_ids=scenario.transmitter_ids,
                tone_hz=scenario.tone_hz,
                frame_start_index=start_index,
            ),
            calibration=Calibration(**self._group("calibration")),
            ranges=RangeDifferences(**self._group("ranges")),
            fixes=FixTable(**self._group("fixes")),
            poses=PoseTable(**self._group("poses")),
            **{name: record(**self._group(name)) for name, record in OPTIONAL.items() if name in self._file},
            truth=self._truth(scenario),
        )

    def _error(self, what: str, remedy: str) -> RecordingError:
        return RecordingError(f"{self._path}: {what}; {remedy}")

    def _scenario(self) -> Scenario:
        dataset = self._file.get("scenario")
        if not isinstance(dataset, h5py.Dataset) or dataset.shape != ():
            raise self._error("`/scenario` is missing or no text", "process again")
        try:
            return parse_scenario(dataset.asstr()[()], source=f"{self._path}:/scenario")
        except (ScenarioError, TypeError) as error:
            raise RecordingError(str(error)) from error

    def _settings(self) -> dict[str, str]:
        group = self._file.get("settings")
        settings = {} if group is None else {name: str(value) for name, value in group.attrs.items()}
        if "sample_rate" not in settings:
            raise self._error("`/settings` is missing or lacks `sample_rate`", "process again")
        return settings

    def _group(self, group: str) -> dict[str, npt.NDArray[Any]]:
        return {name: self._array(f"{group}/{name}") for name in _group_keys(group)}

    def _truth(self, scenario: Scenario) -> Truth | None:
        if "truth" not in self._file:
            return None
        arrays = {name: self._array(f"truth/{name}") for name in _group_keys("truth") if name in self._file["truth"]}
        for name in ("normal_enu", "receiver_enu_m"):
            if name not in arrays:
                raise self._error(f"`/truth/{name}` is missing", "process again")
        return Truth(
            heliostat_ids=scenario.heliostat_ids,
            receiver_ids=scenario.receiver_ids,
            transmitter_ids=scenario.transmitter_ids,
            **arrays,
        )

    def _array(self, path: str) -> npt.NDArray[Any]:
        key = KEYS[path]
        dataset = self._file.get(path)
        if not isinstance(dataset, h5py.Dataset):
            raise self._error(f"`/{path}` is missing", "process again")
        if dataset.dtype.kind != np.dtype(key.dtype).kind:
            raise self._error(f"`/{path}` holds {dataset.dtype}, not {np.dtype(key.dtype)}", "process again")
        expected = tuple(axis if isinstance(axis, int) else self._length.get(axis) for axis in key.axes)
        fits = len(expected) == dataset.ndim and all(
            want is None or want == got for want, got in zip(expected, dataset.shape, strict=True)
        )
        if not fits:
            axes = ", ".join(str(axis) for axis in key.axes)
            raise self._error(f"`/{path}` has shape {dataset.shape}, not ({axes})", "process again")
        for axis, got in zip(key.axes, dataset.shape, strict=True):
            if isinstance(axis, str):
                self._length.setdefault(axis, got)
        return read_only(np.asarray(dataset[()], dtype=key.dtype))


# -- for people ----------------------------------------------------------------------------------------------


def count_reasons(status: npt.NDArray[Any], codes: type[IntEnum]) -> dict[str, int]:
    """Count what went wrong, most frequent first; what went well is left out."""
    counted = Counter(int(code) for code in status.ravel() if code != 0)
    return {codes(code).reason: n for code, n in counted.most_common()}  # type: ignore[attr-defined]


def summarise(result: Result) -> dict[str, Any]:
    """Return counts of what was solved and what was not, with reasons; keys are part of the command line."""
    is_mirror = np.array([row.heliostat is not None for row in result.scenario.receivers], bool)
    parts = {
        "poses": (result.poses.status, PoseStatus),
        "fixes": (result.fixes.status[:, is_mirror], FixStatus),
        "tones": (result.tones.status, LineStatus),
    }
    summary: dict[str, Any] = {
        "frames": len(result.frame_start_index),
        "heliostats": len(result.scenario.heliostat_ids),
        "receivers": len(result.scenario.receiver_ids),
        "estimator": result.settings["estimator"],
        "pose": result.settings["pose"],
    }
    for name, (status, codes) in parts.items():
        solved = int(np.count_nonzero(status == 0))
        summary[name] = {"solved": solved, "failed": status.size - solved, "reasons": count_reasons(status, codes)}
    choice = {"reflection": "none", "integrity": "off", "delays": "as the scenario says", "filter": "off"}
    summary["choice"] = {name: result.settings.get(name, default) for name, default in choice.items()}
    if result.settings["pose"] == "rigid":
        summary["integers"] = _summary_of_integers(result)
    if result.integrity is not None:
        summary["integrity"] = _summary_of_integrity(result, result.integrity)
    if result.reflection is not None:
        summary["reflection"] = _summary_of_reflection(result, result.reflection)
    if result.delays is not None:
        summary["delays"] = _summary_of_delays(result.delays)
    if result.filtered is not None:
        summary["filtered"] = _summary_of_filtered(result.filtered)
    return summary


def _summary_of_integers(result: Result) -> dict[str, Any]:
    """Count, by wavelength, how integers of solved mirror-frames were found."""
    scenario = result.scenario
    names = [f"{f / 1e6:.9g} MHz" for f in np.sort(scenario.tone_hz)]
    if any(h.oscillator == "shared" and h.carrier_phase for h in scenario.heliostat):
        names.append("carrier")
    method = result.poses.integer_method[result.poses.status == PoseStatus.OK]
    return {
        name: {IntegerMethod(code).reason: n for code, n in Counter(method[:, k].tolist()).most_common()}
        for k, name in enumerate(names)
    }


def _summary_of_filtered(table: FilteredTable) -> dict[str, Any]:
    sigma = table.sigma_rad[np.isfinite(table.sigma_rad)]
    counted = Counter(table.status.ravel().tolist())
    return {
        "reasons": {TrackStatus(code).reason: n for code, n in counted.most_common()},
        "sigma_mrad": 1e3 * float(np.median(sigma)) if sigma.size else None,
    }


def _summary_of_integrity(result: Result, table: IntegrityTable) -> dict[str, Any]:
    excluded = {}
    explained = np.isin(table.status, EXPLAINED)
    for i, name in enumerate(result.scenario.transmitter_ids):
        status = np.where(explained, table.transmitter_status[..., i], 0)
        reasons = count_reasons(np.where(status > TransmitterStatus.NOT_RECEIVED, status, 0), TransmitterStatus)
        if reasons:
            excluded[name] = reasons
    level = table.protection_level_rad[np.isfinite(table.protection_level_rad)]
    return {
        "reasons": count_reasons(table.status, IntegrityStatus),
        "excluded": excluded,
        "priors_rejected": {
            name: int(np.count_nonzero(table.prior_rejected[..., k]))
            for k, name in enumerate(PRIORS)
            if np.any(table.prior_rejected[..., k])
        },
        "protected": int(level.size),
        "protection_level_mrad": 1e3 * float(np.median(level)) if level.size else None,
    }


def _summary_of_reflection(result: Result, table: ReflectionTable) -> dict[str, Any]:
    names = ("ground", *(plane.name for plane in result.scenario.reflection.plane))
    needed = table.probability_direct < NEEDED_PROBABILITY
    return {
        "needed": int(np.count_nonzero(needed)),
        "coefficients": {
            name: _summary_of_coefficient(table.coefficient[..., p], table.coefficient_sigma[..., p, :])
            for p, name in enumerate(names)
        },
    }


def _summary_of_coefficient(coefficient: npt.NDArray[np.complex128], sigma: FloatArray) -> dict[str, Any]:
    known = np.isfinite(coefficient.real) & np.isfinite(sigma).all(axis=-1)
    if not np.any(known):
        return {"status": "not determined", "real": None, "imag": None, "sigma": None}
    value, spread = coefficient[known], np.hypot(sigma[known][:, 0], sigma[known][:, 1])
    return {
        "status": "given" if np.all(spread == 0.0) else "estimated",
        "real": float(np.median(value.real)),
        "imag": float(np.median(value.imag)),
        "sigma": float(np.median(spread)),
    }


def _summary_of_delays(table: DelayTable) -> dict[str, Any]:
    last = table.sigma_s[-1]
    # the first receiver's delay is zero by definition
    learned = last[np.isfinite(last) & (last > 0.0)]
    return {
        "jumps": int(np.count_nonzero(table.jumped)),
        "last_sigma_ps": 1e12 * float(np.median(learned)) if learned.size else None,
    }


CSV_COLUMNS = (
    "frame",
    "time_utc",
    "heliostat",
    "azimuth_deg",
    "elevation_deg",
    "normal_east",
    "normal_north",
    "normal_up",
    "normal_sigma_mrad",
    "status",
)


def write_poses_csv(result: Result, path: str | Path) -> None:
    """Write the mirror normals for people: degrees, milliradians of the normal, one row a frame and heliostat.

    Raises
    ------
    RecordingError
        The file cannot be written.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(CSV_COLUMNS)
    poses = result.poses
    for i_frame, start in enumerate(result.frame_start_index):
        time = frame_time(int(start), result.sample_rate).isoformat(timespec="microseconds")
        for i, heliostat in enumerate(result.scenario.heliostat_ids):
            row = (i_frame, i)
            numbers = [
                f"{np.degrees(poses.azimuth_rad[row]):.6f}",
                f"{np.degrees(poses.elevation_rad[row]):.6f}",
                *(f"{value:.9f}" for value in poses.normal_enu[row]),
                f"{1e3 * poses.sigma_rad[row]:.6f}",
            ]
            blank = ["" if number == "nan" else number for number in numbers]
            status = PoseStatus(int(poses.status[row])).reason
            writer.writerow([i_frame, time.replace("+00:00", "Z"), heliostat, *blank, status])
    write_atomically(path, text.getvalue().encode())
