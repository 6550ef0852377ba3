"""What a picture tells of a heliostat's image, or why it tells nothing; reading pictures from files."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, read_only
from rfpose.errors import InvalidInputError, RecordingError, install_remedy

__all__ = ["Spot", "SpotStatus", "as_grey", "no_spot", "read_picture", "skimage"]

LEAST_PX = 40


class SpotStatus(IntEnum):
    """What became of a picture."""

    OK = 0
    WRONG_SIZE = 1
    NO_MARKERS = 2
    SATURATED = 3
    NO_SPOT = 4
    TWO_SPOTS = 5
    OFF_TARGET = 6
    NO_TARGET = 7


@dataclass(frozen=True, slots=True, kw_only=True)
class Spot:
    """A heliostat's image found in a picture.

    Attributes
    ----------
    status
        Whether it was found, or why not.
    centre_m : (right, up)
        Centroid on the target, from its centre [m]; NaN unless OK.
    centre_px : (column, row)
        The same in the picture that was given [pixel].
    area_m2
        Of the part above the threshold [m²].
    text
        The reason in words, with what was seen.
    """

    status: SpotStatus
    centre_m: FloatArray
    centre_px: FloatArray
    area_m2: float
    text: str = ""


def no_spot(status: SpotStatus, text: str) -> Spot:
    """Return what is said of a picture that tells nothing."""
    nowhere = read_only(np.full(2, np.nan))
    return Spot(status=status, centre_m=nowhere, centre_px=nowhere, area_m2=float("nan"), text=text)


def skimage(part: str) -> Any:
    """Import a part of scikit-image, or say how to get it.

    Raises
    ------
    InvalidInputError
        scikit-image is not installed.
    """
    try:
        return importlib.import_module(f"skimage.{part}")
    except ImportError as error:
        raise InvalidInputError(f"pictures need scikit-image; install it, {install_remedy('images')}") from error


def as_grey(image: npt.ArrayLike) -> FloatArray:
    """Return brightness from 0 to 255 of a grey or coloured picture (row, column).

    Raises
    ------
    InvalidInputError
        Not a picture of two dimensions, or of three with one, three or four channels.
    """
    pixels = np.asarray(image)
    full = {np.dtype(np.uint8): 255.0, np.dtype(np.uint16): 65535.0, np.dtype(np.bool_): 1.0}.get(pixels.dtype)
    if full is None and not np.issubdtype(pixels.dtype, np.floating):
        raise InvalidInputError(f"`image` must have 8 or 16 bits or be floating from 0 to 255, got {pixels.dtype}")
    grey = pixels.astype(np.float64) * (255.0 / full if full else 1.0)
    if grey.ndim == 3 and grey.shape[2] in (1, 2):
        grey = grey[..., 0]
    elif grey.ndim == 3 and grey.shape[2] in (3, 4):
        grey = grey[..., :3] @ np.array([0.299, 0.587, 0.114])
    if grey.ndim != 2:
        raise InvalidInputError(f"`image` must be (row, column) or (row, column, channel), got shape {pixels.shape}")
    return np.asarray(grey)


def read_picture(path: str | Path) -> FloatArray:
    """Read a PNG (or JPEG, TIFF) as brightness from 0 to 255 (row, column).

    Raises
    ------
    RecordingError
        Missing, or not a picture.
    InvalidInputError
        scikit-image is not installed.
    """
    path = Path(path)
    if not path.is_file():
        raise RecordingError(f"{path}: no such picture")
    reader = skimage("io")
    try:
        return as_grey(reader.imread(path))
    except InvalidInputError:
        raise
    except Exception as error:  # every decoder has errors of its own
        raise RecordingError(f"{path}: is no picture that can be read ({error}); save it as PNG") from error
