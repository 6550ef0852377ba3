"""The file of a result: format ``rfpose-result``, HDF5, described in ``docs/result-format.md``.

Every name in the file stands in `KEYS`, with axes, unit and meaning; writer and reader both follow it.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from fractions import Fraction
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from rfpose.checks import read_only
from rfpose.dsp import Calibration, CalibrationStatus, LineStatus, TonePhases
from rfpose.errors import RecordingError, RfposeError, ScenarioError
from rfpose.files import write_atomically
from rfpose.kinds import check_kind, kind_of
from rfpose.multilat import FixStatus, PoseStatus, RangeDifferences, RangeStatus, TrackStatus
from rfpose.multilat.integrity import IntegrityStatus, TransmitterStatus
from rfpose.multilat.rigid.integers import IntegerMethod
from rfpose.pipeline.choice import PoseChoice
from rfpose.pipeline.hdf5_values import DAMAGES, array_of, text_of
from rfpose.pipeline.result import (
    LAST_TIME_S,
    DelayTable,
    FilteredTable,
    FixTable,
    IntegrityTable,
    PoseTable,
    ReflectionTable,
    Result,
    rate_of,
)
from rfpose.recording.hdf5 import find_item
from rfpose.scenario import MAX_SAMPLE_INDEX, Scenario, parse_scenario
from rfpose.truth import Truth

__all__ = [
    "FORMAT",
    "KEYS",
    "OPTIONAL",
    "VERSION",
    "Key",
    "is_result",
    "read_result",
    "write_result",
]

FORMAT = "rfpose-result"
VERSION = 1


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


_TRANSMITTER_INDEX = ("ranges/reference", "integrity/worst_transmitter")


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
    return kind_of(path) == "result"


def read_result(path: str | Path) -> Result:
    """Read a result.

    Raises
    ------
    RecordingError
        Missing, truncated, not HDF5, another format or version, or something in it is missing, of another type or
        shape, or says what no result says; the message names the file and the place.
    """
    path = Path(path)
    check_kind(path, wanted="result")
    try:
        with h5py.File(path, "r") as file:
            return _Reader(path, file).result()
    except RecordingError:
        raise
    except DAMAGES as error:
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
        settings = self._settings(scenario)
        start_index = self._start_index(Fraction(settings["sample_rate"]))
        tones = self._group("tones")
        return Result(
            scenario=scenario,
            settings=settings,
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
        try:
            return parse_scenario(text_of(self._file, "/scenario"), source=f"{self._path}:/scenario")
        except ScenarioError as error:
            raise RecordingError(f"{error}; the result is damaged: process again") from error
        except ValueError as error:
            raise self._error(f"`/scenario` {error}", "process again") from error

    def _settings(self, scenario: Scenario) -> dict[str, str]:
        group = find_item(self._file, "/settings", follow_links=False)
        found = dict(group.attrs.items()) if isinstance(group, h5py.Group) else {}
        for name, value in found.items():
            if not isinstance(value, str):
                raise self._error(f"attribute `{name}` of `/settings` is no text", "process again")
        for name in ("sample_rate", "estimator", "pose"):
            if name not in found:
                raise self._error(f"`/settings` is missing or lacks `{name}`", "process again")
        try:
            rate_of(found)
            PoseChoice.of(found, scenario)
        except RfposeError as error:
            raise self._error(f"`/settings`: {error}", "process again") from error
        return found

    def _start_index(self, sample_rate: Fraction) -> npt.NDArray[np.int64]:
        starts = self._array("frames/start_index")
        late = np.flatnonzero((starts < 0) | (starts > min(LAST_TIME_S * sample_rate, MAX_SAMPLE_INDEX)))
        if late.size:
            value = starts[late[0]]
            raise self._error(
                f"`/frames/start_index` [{late[0]}] is {value}, no time until the year 9999", "process again"
            )
        back = np.flatnonzero(np.diff(starts) <= 0)
        if back.size:
            raise self._error(f"`/frames/start_index` [{back[0] + 1}] is not after the one before", "process again")
        return starts

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
        dataset = find_item(self._file, f"/{path}", follow_links=False)
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
        try:
            values = array_of(self._file, f"/{path}", key.dtype)
        except RecordingError:
            raise
        except DAMAGES as error:
            raise self._error(f"`/{path}` {error}", "process again") from error
        self._check_codes(path, values)
        return read_only(values)

    def _check_codes(self, path: str, values: npt.NDArray[Any]) -> None:
        """Refuse codes that mean nothing, and transmitters that do not exist."""
        if path in _STATUS:
            good = np.isin(values, [int(code) for code in _STATUS[path]])
        elif path in _TRANSMITTER_INDEX:
            good = (values >= -1) & (values < self._length["transmitter"])
        else:
            return
        if not good.all():
            at = tuple(int(i) for i in np.argwhere(~good)[0])
            raise self._error(f"`/{path}` {list(at)} is {values[at]}, which means nothing", "process again")
