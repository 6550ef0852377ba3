"""Transmitters by which receivers can be located: enough of them, apart, and near enough for the longest tone."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, as_float_array
from rfpose.errors import GeometryError, InvalidInputError

__all__ = ["check_transmitters", "check_unambiguous", "distances_m"]


def check_transmitters(transmitter_enu_m: npt.ArrayLike, wavelength_m: npt.ArrayLike | None = None) -> FloatArray:
    """Return transmitters as (transmitter, xyz or xy); refuse those by which no receiver could be located.

    Parameters
    ----------
    transmitter_enu_m : (transmitter, xyz) or (transmitter, xy)
        Site ENU frame [m].
    wavelength_m : (tone,)
        Wavelengths whose whole numbers must be known, see `check_unambiguous` [m]; None: they need not.

    Raises
    ------
    InvalidInputError
        Wrong shape.
    GeometryError
        Transmitters at too few places, or on a line; ambiguous.
    """
    array = as_float_array("transmitter_enu_m", transmitter_enu_m, ("transmitter", "xyz"))
    n, n_axis = array.shape
    if n_axis not in (2, 3):
        raise InvalidInputError(
            f"`transmitter_enu_m` must have shape (transmitter, 3) or (transmitter, 2), got {array.shape}"
        )
    n = len(np.unique(array, axis=0))  # several carriers of one antenna are one place
    if n < n_axis + 2:
        raise GeometryError(
            f"`transmitter_enu_m` must hold {n_axis + 2} or more transmitters, at places of their own, to solve "
            f"{n_axis} dimensions from range differences, got {n}; add transmitters"
        )
    singular = np.linalg.svd(array - array.mean(axis=0), compute_uv=False)
    if singular[1] <= 1e-9 * singular[0]:
        raise GeometryError("`transmitter_enu_m` must not lie on one line: a line fixes no position; move some aside")
    if wavelength_m is not None:
        check_unambiguous(array, wavelength_m)
    return array


def check_unambiguous(transmitter_enu_m: npt.ArrayLike, wavelength_m: npt.ArrayLike) -> None:
    """Refuse a site on which whole wavelengths cannot be known.

    A range difference never exceeds the distance of the two transmitters. So the longest wavelength is long
    enough when some transmitter has all others within half of it: taken as the reference, it leaves n = 0
    wherever the receiver is.

    Parameters
    ----------
    transmitter_enu_m : (transmitter, xyz)
        Site ENU frame [m].
    wavelength_m : (tone,)
        Wavelengths of the tones [m].

    Raises
    ------
    GeometryError
        No transmitter can serve as reference; the message gives the wavelength to add.
    """
    transmitter = as_float_array("transmitter_enu_m", transmitter_enu_m, ("transmitter", 3))
    longest = float(np.max(as_float_array("wavelength_m", wavelength_m, ("tone",), positive=True)))
    reach = float(np.min(np.max(distances_m(transmitter), axis=1)))
    if reach >= longest / 2.0:
        raise GeometryError(
            f"ambiguous: the field is wider than the longest tone wavelength of {longest:.6g} m allows (no transmitter "
            f"has all others within half of it); add a tone of wavelength above {2.0 * reach:.6g} m"
        )


def distances_m(transmitter_enu_m: FloatArray) -> FloatArray:
    """(transmitter, transmitter) distances [m]."""
    return np.asarray(np.linalg.norm(transmitter_enu_m[:, None] - transmitter_enu_m[None], axis=-1))
