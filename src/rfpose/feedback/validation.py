"""How well a calibration predicts what it has not seen: held-out parts, one left out, a window that rolls on.

All refits of one question run side by side in one batch. Errors are angles of the mirror normal.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, read_only
from rfpose.errors import InvalidInputError
from rfpose.feedback.calibration import FieldCalibration, FitSettings, FitStatus, resolve_free, row_status
from rfpose.feedback.measurements import Measurements
from rfpose.feedback.mount import Mount
from rfpose.feedback.selection import AUTO, chosen_errors_rad, refit, refit_errors_rad

__all__ = ["HeldOut", "Rolling", "chronological_split", "leave_one_out_rad", "random_splits", "rolling_refit"]


@dataclass(frozen=True, slots=True, kw_only=True)
class HeldOut:
    """Errors of splits into a part that was fitted and a part that was not.

    Attributes
    ----------
    train_median_rad, test_median_rad : (split,)
        Median errors of the two parts [rad].
    test_rms_rad : (split,)
        RMS error of the part held out [rad].
    error_rad : (split, measurement)
        Errors of all; NaN where unusable.
    is_train : (split, measurement)
        Which part was fitted.
    """

    train_median_rad: FloatArray
    test_median_rad: FloatArray
    test_rms_rad: FloatArray
    error_rad: FloatArray
    is_train: npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True, kw_only=True)
class Rolling:
    """Fits to a window of the latest measurements, each judged by the measurement that came next.

    Attributes
    ----------
    unix_s : (step,)
        Times of the measurements judged.
    error_rad : (step,)
        Their errors [rad].
    calibration
        The fits, one row a step: how parameters went in time.
    """

    unix_s: FloatArray
    error_rad: FloatArray
    calibration: FieldCalibration


def random_splits(
    mount: Mount,
    measurements: Measurements,
    *,
    free: str | Sequence[str],
    rng: np.random.Generator,
    train_part: float = 0.6,
    n_split: int = 10,
    settings: FitSettings | None = None,
    also: Sequence[str] = (),
) -> HeldOut:
    """Fit a random part and test on the rest, several times.

    Parameters
    ----------
    mount, measurements, settings
        As for `calibration.fit`.
    free, also
        Likewise; or ``"auto"``: each part that is fitted chooses for itself, as `selection.fit_chosen` does, with
        ``also`` free besides.
    rng
        Draws the parts.
    train_part
        Part of the usable measurements that is fitted, between 0 and 1.
    n_split
        Number of splits.
    """
    usable = _usable(mount, measurements, train_part)
    masks = np.zeros((n_split, len(measurements)), np.bool_)
    for mask in masks:
        mask[rng.permutation(usable)[: int(train_part * len(usable))]] = True
    return _held_out(mount, measurements, masks, free, settings, also)


def chronological_split(
    mount: Mount,
    measurements: Measurements,
    *,
    free: str | Sequence[str],
    train_part: float = 0.6,
    settings: FitSettings | None = None,
    also: Sequence[str] = (),
) -> HeldOut:
    """Fit the earlier part and test on the later one: what a plant would have seen."""
    usable = _usable(mount, measurements, train_part)
    order = usable[np.argsort(measurements.unix_s[usable], kind="stable")]
    masks = np.zeros((1, len(measurements)), np.bool_)
    masks[0, order[: int(train_part * len(usable))]] = True
    return _held_out(mount, measurements, masks, free, settings, also)


def leave_one_out_rad(
    mount: Mount,
    measurements: Measurements,
    *,
    free: str | Sequence[str],
    settings: FitSettings | None = None,
) -> FloatArray:
    """Return the error of each measurement under the fit to all others (measurement,) [rad]; NaN where unusable."""
    usable = row_status(mount, measurements) == 0
    masks = usable & ~np.eye(len(measurements), dtype=np.bool_)
    error = refit_errors_rad(mount, measurements, masks, resolve_free(free), settings or FitSettings())
    return np.where(usable, np.diagonal(error), np.nan)


def rolling_refit(
    mount: Mount,
    measurements: Measurements,
    *,
    free: str | Sequence[str],
    window: int,
    settings: FitSettings | None = None,
) -> Rolling:
    """Refit to the latest ``window`` measurements at each step and predict the next one.

    Raises
    ------
    InvalidInputError
        The window is not shorter than the usable measurements.
    """
    usable = np.flatnonzero(row_status(mount, measurements) == 0)
    usable = usable[np.argsort(measurements.unix_s[usable], kind="stable")]
    if not 1 <= window < len(usable):
        raise InvalidInputError(f"`window` must be from 1 to {len(usable) - 1} usable measurements, got {window}")
    steps = len(usable) - window
    masks = np.zeros((steps, len(measurements)), np.bool_)
    for i, mask in enumerate(masks):
        mask[usable[i : i + window]] = True
    error, found = refit(mount, measurements, masks, resolve_free(free), settings or FitSettings())
    judged = usable[window:]
    return Rolling(
        unix_s=read_only(measurements.unix_s[judged]),
        error_rad=read_only(error[np.arange(steps), judged]),
        calibration=found,
    )


def _usable(mount: Mount, measurements: Measurements, train_part: float) -> npt.NDArray[np.int64]:
    if not 0.0 < train_part < 1.0:
        raise InvalidInputError(f"`train_part` must lie between 0 and 1, got {train_part}")
    usable = np.flatnonzero(row_status(mount, measurements) == 0)
    if not 0 < int(train_part * len(usable)) < len(usable):
        raise InvalidInputError(f"{len(usable)} usable measurements cannot be split; measure more")
    return usable


def _held_out(
    mount: Mount,
    measurements: Measurements,
    masks: npt.NDArray[np.bool_],
    free: str | Sequence[str],
    settings: FitSettings | None,
    also: Sequence[str],
) -> HeldOut:
    if free == AUTO:
        error = chosen_errors_rad(mount, measurements, masks, also=also, settings=settings)
    else:
        names = resolve_free(free)
        error, found = refit(mount, measurements, masks, names, settings or FitSettings())
        if np.any(found.status == FitStatus.TOO_FEW):
            raise InvalidInputError(
                f"{len(names)} free parameters need more than the {int(masks[0].sum())} measurements of the part "
                "to be fitted; free fewer"
            )
    test = np.where(~masks & (row_status(mount, measurements) == 0), error, np.nan)
    return HeldOut(
        train_median_rad=read_only(np.nanmedian(np.where(masks, error, np.nan), axis=1)),
        test_median_rad=read_only(np.nanmedian(test, axis=1)),
        test_rms_rad=read_only(np.sqrt(np.nanmean(test**2, axis=1))),
        error_rad=read_only(error),
        is_train=read_only(masks),
    )
