"""Checks on arguments, each with a message in the user's words."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from rfpose.errors import InvalidInputError

__all__ = ["FloatArray", "as_float_array", "as_positive", "read_only"]

FloatArray = npt.NDArray[np.float64]


def as_float_array(
    name: str,
    value: npt.ArrayLike,
    shape: Sequence[int | str],
    *,
    finite: bool = True,
    positive: bool = False,
) -> FloatArray:
    """Return ``value`` as a C-contiguous float64 array of the wanted shape.

    Parameters
    ----------
    name
        The argument's name as the caller knows it, for the message.
    value
        Anything numpy can read as numbers.
    shape
        One entry a dimension: an integer that must match, or the axis's name, which may have any length.
        ``"..."`` first allows any number of leading dimensions.
    finite
        Refuse NaN and infinity.
    positive
        Refuse entries that are not greater than zero (NaN passes when ``finite`` is false).

    Raises
    ------
    InvalidInputError
        Not numeric, wrong shape, or a forbidden value; the message gives name, shape and first bad index.
    """
    try:
        array = np.asarray(value, dtype=np.float64, order="C")
    except (TypeError, ValueError) as error:
        raise InvalidInputError(f"`{name}` must be numeric, got {value!r:.80}") from error
    wanted = list(shape)
    open_front = bool(wanted) and wanted[0] == "..."
    tail = wanted[1:] if open_front else wanted
    n_tail = len(tail)
    fits = array.ndim >= n_tail if open_front else array.ndim == n_tail
    if fits and n_tail:
        fits = all(
            isinstance(want, str) or want == got
            for want, got in zip(tail, array.shape[array.ndim - n_tail :], strict=True)
        )
    if not fits:
        text = ", ".join(str(item) for item in wanted)
        raise InvalidInputError(f"`{name}` must have shape ({text}), got {array.shape}")
    if finite and not np.all(np.isfinite(array)):
        where = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise InvalidInputError(f"`{name}` must be finite, got {array[where]} at index {where}")
    if positive and np.any(array <= 0.0):
        where = tuple(int(i) for i in np.argwhere(array <= 0.0)[0])
        raise InvalidInputError(f"`{name}` must be greater than zero, got {array[where]} at index {where}")
    return array


def as_positive(name: str, value: Any) -> float:
    """Return ``value`` as a finite float greater than zero, or raise `InvalidInputError`."""
    try:
        number = float(value)
    except (TypeError, ValueError) as error:
        raise InvalidInputError(f"`{name}` must be a number, got {value!r:.80}") from error
    if not (np.isfinite(number) and number > 0.0):
        raise InvalidInputError(f"`{name}` must be a finite number greater than zero, got {value!r:.80}")
    return number


def read_only(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return a view of ``array`` that cannot be written through."""
    view = array.view()
    view.flags.writeable = False
    return view
