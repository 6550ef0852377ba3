"""The file of an antenna pattern: format ``rfpose-antenna``, HDF5 or TOML; see ``docs/antenna-patterns.md``."""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import h5py
import numpy as np

from rfpose import __version__
from rfpose.antenna import AntennaPattern
from rfpose.errors import InvalidInputError, RecordingError
from rfpose.files import write_atomically
from rfpose.kinds import check_kind, is_hdf5
from rfpose.pipeline.formats.antenna_text import read_text_pattern, text_of_pattern
from rfpose.pipeline.formats.columns import Column, ColumnWriter, Labels, text_label
from rfpose.pipeline.formats.hdf5_values import FileReader, opened

__all__ = ["ANTENNA_FORMAT", "ANTENNA_VERSION", "PatternFile", "read_pattern", "write_pattern"]

ANTENNA_FORMAT = "rfpose-antenna"
ANTENNA_VERSION = 1

_AGAIN = "make it again with `scripts/antenna_pattern.py`, or copy it again"
_GRID = ("frequency", "receiver", "polar", "azimuth")
_COLUMNS = {
    "frequency_hz": Column(("frequency",), "f8", "Hz", "frequencies of the waves"),
    "polar_rad": Column(
        ("polar",), "f8", "rad", "angle of the source from the mirror's normal z, seen by the receiver"
    ),
    "azimuth_rad": Column(("azimuth",), "f8", "rad", "angle of the source about z, from x to y"),
    "receiver_mirror_m": Column(("receiver", "xyz"), "f8", "m", "receivers' places, to which phases refer"),
    "axis_mirror": Column(("receiver", "xyz"), "f8", "1", "axes of the dipoles: taken where the response is unknown"),
    "response": Column(
        (*_GRID, "component"), "c8", "1", "voltage for a wave of field 1 along theta or phi; NaN: unknown"
    ),
    "sigma": Column(_GRID, "f4", "1", "error of the response, of real and imaginary part each"),
}
_SAID = {
    "frame": "mirror: x horizontal, y up the mirror, z its normal; directions lead from the receiver to the source",
    "sign": "exp(+j omega t): a way d turns the phase by -k d",
    "phase_reference": "a wave whose phase is 0 at the receiver's own place",
    "unit_of_response": "a short dipole broadside in free space; a factor common to all receivers means nothing",
}
"""Attributes that say how the numbers are meant; another value than these is another meaning."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PatternFile:
    """What a file of an antenna pattern holds.

    Attributes
    ----------
    pattern
        The pattern.
    made_by
        Version and settings that it was made with.
    """

    pattern: AntennaPattern
    made_by: Mapping[str, str] = field(default_factory=dict)


def write_pattern(
    path: str | Path, pattern: AntennaPattern, *, settings: Mapping[str, str] | None = None, force: bool = False
) -> None:
    """Write a pattern.

    Parameters
    ----------
    path
        Text if it ends in .toml, else HDF5.
    pattern
        What to write; HDF5 keeps responses in single precision.
    settings
        What it was made with, by name.
    force
        Replace what exists.

    Raises
    ------
    RecordingError
        The file exists and may not be replaced, or cannot be written.
    InvalidInputError
        The pattern cannot be written as text.
    """
    made_by = {"rfpose": __version__, **(settings or {})}
    if Path(path).suffix == ".toml":
        head = {"format": ANTENNA_FORMAT, "version": ANTENNA_VERSION, "made_by": made_by}
        write_atomically(path, text_of_pattern(pattern, head).encode(), force=force)
        return
    n_polar, n_azimuth = pattern.response.shape[2:4]
    values = {
        "polar_rad": np.linspace(0.0, np.pi, n_polar),
        "azimuth_rad": np.arange(n_azimuth) * (2.0 * np.pi / n_azimuth),
    }
    labels: Labels = {
        "frequency": (pattern.frequency_hz, {"units": "Hz"}),
        "receiver": (np.arange(pattern.n_receiver), {"long_name": "receiver of a mirror, in the scenario's order"}),
        "polar": (np.rad2deg(values["polar_rad"]), {"units": "degree"}),
        "azimuth": (np.rad2deg(values["azimuth_rad"]), {"units": "degree"}),
        "xyz": text_label("xyz", "axis of the mirror frame"),
        "component": text_label(["theta", "phi"], "of the field, along growing polar angle and azimuth"),
    }
    image = io.BytesIO()
    with h5py.File(image, "w", libver=("v110", "v110")) as file:
        file.attrs.update({"format": ANTENNA_FORMAT, "version": ANTENNA_VERSION, **_SAID})
        file.create_group("made_by").attrs.update(made_by)
        writer = ColumnWriter(file, labels)
        for name, column in _COLUMNS.items():
            writer.write(file, name, column, values[name] if name in values else getattr(pattern, name))
    write_atomically(path, image.getvalue(), force=force)


def read_pattern(path: str | Path) -> PatternFile:
    """Read a pattern.

    Raises
    ------
    RecordingError
        Missing, another kind of file or version, meant in another way, damaged, or no pattern: the place is named.
    """
    path = Path(path)
    check_kind(path, wanted="antenna")
    if not is_hdf5(path):
        pattern, made_by = read_text_pattern(path, version=ANTENNA_VERSION)
        return PatternFile(pattern=pattern, made_by=made_by)
    with opened(path, wanted="antenna", version=ANTENNA_VERSION, again=_AGAIN) as file:
        for name, meant in _SAID.items():
            if file.attrs.get(name) != meant:
                raise RecordingError(
                    f"{path}: attribute `{name}` must be {meant!r}, got {str(file.attrs.get(name))!r:.80}; {_AGAIN}"
                )
        reader = FileReader(path, file, length={"xyz": 3, "component": 2}, again=_AGAIN)
        values = {name: reader.array(name, column) for name, column in _COLUMNS.items()}
        made_by = {str(key)[:80]: str(value)[:200] for key, value in reader.group("made_by").attrs.items()}
    n_polar, n_azimuth = reader.length["polar"], reader.length["azimuth"]
    grid = {
        "polar_rad": np.linspace(0.0, np.pi, n_polar),
        "azimuth_rad": np.arange(n_azimuth) * (2.0 * np.pi / max(n_azimuth, 1)),
    }
    for name, expected in grid.items():
        if not np.allclose(values.pop(name), expected, atol=1e-6):
            raise reader.error(name, "must be evenly spaced: 0 to π with both ends, and 0 to 2π without its end")
    try:
        return PatternFile(pattern=AntennaPattern(**values), made_by=made_by)
    except InvalidInputError as error:
        raise RecordingError(f"{path}: {error}; {_AGAIN}") from error
