"""Arrays with names: each column of a file is declared once, and file and labelled Dataset are both made from that.

In the file a column's dimensions are HDF5 dimension scales, as netCDF has them, so that xarray opens it with its
dimensions named. Units, meaning and status codes are attributes after the CF conventions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np
import numpy.typing as npt

from rfpose.tables import labelled_library

if TYPE_CHECKING:
    import xarray as xr

__all__ = [
    "ENU",
    "FIXED",
    "Column",
    "ColumnWriter",
    "Labels",
    "dataset_of",
    "seconds_since",
    "text_label",
    "write_names",
]

Labels = Mapping[str, tuple[npt.NDArray[Any], Mapping[str, str]]]
"""By dimension: what its entries are called, and attributes of that."""


@dataclass(frozen=True, slots=True)
class Column:
    """One array: its dimensions, numpy type, unit, meaning, and the codes that it holds if it is a status."""

    dims: tuple[str, ...]
    dtype: str
    unit: str
    meaning: str
    codes: type[IntEnum] | None = None

    def attributes(self, dtype: np.dtype[Any]) -> dict[str, Any]:
        """Return what stands beside an array of this type, in the file and in a Dataset."""
        if self.codes is None:
            return {"units": self.unit, "long_name": self.meaning}
        return {
            "long_name": self.meaning,
            "flag_values": np.array([code.value for code in self.codes], dtype),
            "flag_meanings": " ".join(code.name.lower() for code in self.codes),
            "codes": "; ".join(f"{code.value} {getattr(code, 'reason', code.name.lower())}" for code in self.codes),
        }


def text_label(names: Any, meaning: str) -> tuple[npt.NDArray[Any], dict[str, str]]:
    """Return names along a dimension."""
    return np.array(list(names), dtype=object), {"long_name": meaning}


def seconds_since(values: npt.ArrayLike, unit: str, meaning: str) -> tuple[npt.NDArray[Any], dict[str, str]]:
    """Return instants along a dimension, as CF has them: ``seconds`` or ``microseconds`` since the Unix epoch."""
    attributes = {"long_name": meaning, "units": f"{unit} since 1970-01-01", "calendar": "proleptic_gregorian"}
    return np.asarray(values), attributes


ENU = ("east", "north", "up")
FIXED: Mapping[str, int] = {"xyz": 3, "xyz_other": 3, "side": 2, "part": 2, "prior": 3}
"""Dimensions whose length is always the same; ``xyz_other`` is the second of a covariance."""


class ColumnWriter:
    """Writes columns into a file; the scale of a dimension is made where the first column needs it."""

    def __init__(self, scales: h5py.Group, labels: Labels) -> None:
        self._scales = scales
        self._labels = labels

    def write(self, group: h5py.Group, name: str, column: Column, values: npt.ArrayLike) -> None:
        """Write one column."""
        dataset = group.create_dataset(name, data=np.asarray(values, dtype=column.dtype))
        for key, value in column.attributes(dataset.dtype).items():
            dataset.attrs[key] = value
        if column.dims == (name,):
            dataset.make_scale(name)
            return
        for i, dim in enumerate(column.dims):
            dataset.dims[i].attach_scale(self._scale(dim))

    def _scale(self, dim: str) -> h5py.Dataset:
        if dim not in self._scales:
            values, attributes = self._labels[dim]
            kind = h5py.string_dtype() if values.dtype == object else None
            scale = self._scales.create_dataset(dim, data=values, dtype=kind)
            scale.attrs.update(attributes)
            scale.make_scale(dim)
        return self._scales[dim]


def write_names(file: h5py.File, place: str, names: Sequence[str]) -> None:
    """Write a list of names, a dimension of its own."""
    dataset = file.create_dataset(place, data=np.array(names, dtype=object), dtype=h5py.string_dtype())
    dataset.make_scale(place.rpartition("/")[2])


def dataset_of(
    columns: Mapping[str, tuple[Column, npt.ArrayLike]], labels: Labels, attributes: Mapping[str, str]
) -> xr.Dataset:
    """Return columns, by the names that they get, as a labelled Dataset; needs xarray.

    Raises
    ------
    InvalidInputError
        xarray is not installed.
    """
    xarray = labelled_library("xarray")
    used = {dim for column, _ in columns.values() for dim in column.dims}
    found: xr.Dataset = xarray.Dataset(
        {
            name: (column.dims, np.asarray(values), column.attributes(np.asarray(values).dtype))
            for name, (column, values) in columns.items()
        },
        coords={
            dim: (dim, values.astype(str) if values.dtype == object else values, dict(about))
            for dim, (values, about) in labels.items()
            if dim in used
        },
        attrs=dict(attributes),
    )
    decoded: xr.Dataset = xarray.decode_cf(found)
    return decoded
