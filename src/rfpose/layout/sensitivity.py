"""What each transmitter means to a field: lose it, survey it wrongly, move it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, as_float_array, as_positive, read_only
from rfpose.layout.gain import gain_of
from rfpose.layout.maps import PosedMirrors, normal_map, normal_without_each
from rfpose.measurement import Estimator, Noise

__all__ = ["TransmitterSensitivity", "transmitter_sensitivity"]


@dataclass(frozen=True, slots=True, kw_only=True)
class TransmitterSensitivity:
    """Rms over a field, for each transmitter; angles of the mirror normal; arrays are read-only.

    Attributes
    ----------
    normal_rad
        Bound of the normal with all transmitters [rad].
    lost_rad : (transmitter,)
        The same without this one; infinity where some mirror is then undetermined [rad].
    survey_rad_per_m : (transmitter, xyz)
        Error of the normal for each metre that its survey is off along an axis [rad/m].
    move_rad_per_m : (transmitter, xyz)
        What a metre along an axis adds to the bound [rad/m]; negative: moving it there helps.
    """

    normal_rad: float
    lost_rad: FloatArray
    survey_rad_per_m: FloatArray
    move_rad_per_m: FloatArray


def transmitter_sensitivity(
    transmitter_enu_m: npt.ArrayLike,
    mirrors: PosedMirrors,
    noise: Noise,
    estimator: Estimator,
    *,
    calibration_enu_m: npt.ArrayLike | None = None,
    step_m: float = 0.01,
) -> TransmitterSensitivity:
    """Return how a field's normals respond to each transmitter.

    Parameters
    ----------
    transmitter_enu_m : (transmitter, xyz)
        [m].
    mirrors, noise, estimator
        See `rfpose.layout.maps.normal_map`.
    calibration_enu_m : (calibration receiver, xyz), optional
        Their phases were made with the same wrong survey, which takes off most of the error of a nearby receiver
        [m]. Without: electronic phases known from elsewhere.
    step_m
        Of the differences for ``move_rad_per_m`` [m].

    Raises
    ------
    InvalidInputError
        As `rfpose.layout.maps.normal_map`.
    """
    transmitter = as_float_array("transmitter_enu_m", transmitter_enu_m, ("transmitter", 3))
    step = as_positive("step_m", step_m)
    lost = np.array([_rms(row) for row in normal_without_each(transmitter, mirrors, noise, estimator)])
    move = np.empty(transmitter.shape)
    for place in np.ndindex(transmitter.shape):
        ends = []
        for sign in (1.0, -1.0):
            moved = transmitter.copy()
            moved[place] += sign * step
            ends.append(_rms(normal_map(moved, mirrors, noise, estimator)))
        move[place] = (ends[0] - ends[1]) / (2.0 * step)
    return TransmitterSensitivity(
        normal_rad=_rms(normal_map(transmitter, mirrors, noise, estimator)),
        lost_rad=read_only(lost),
        survey_rad_per_m=read_only(_survey_slope(transmitter, mirrors, noise, estimator, calibration_enu_m)),
        move_rad_per_m=read_only(move),
    )


def _survey_slope(
    transmitter: FloatArray,
    mirrors: PosedMirrors,
    noise: Noise,
    estimator: Estimator,
    calibration_enu_m: npt.ArrayLike | None,
) -> FloatArray:
    """(transmitter, xyz) rms over the field [rad/m]."""
    slope = gain_of(transmitter, mirrors, noise, estimator).range_slope
    offset = mirrors.receiver_enu_m[:, :, None] - transmitter
    direction = offset / np.linalg.norm(offset, axis=-1, keepdims=True)
    turn = -np.einsum("mkgrt,mrtx->mktx", slope, direction)
    there = (
        np.empty((0, 3))
        if calibration_enu_m is None
        else as_float_array("calibration_enu_m", calibration_enu_m, ("calibration", 3))
    )
    if len(there):
        offset = there[:, None] - transmitter
        mean = (offset / np.linalg.norm(offset, axis=-1, keepdims=True)).mean(axis=0)
        tones = slope[:, :, : len(noise.tone_sigma_m)].sum(axis=(2, 3))
        turn = turn + tones[..., None] * mean
    return np.asarray(np.sqrt(np.nanmean((turn**2).sum(axis=1), axis=0)))


def _rms(sigma: FloatArray) -> float:
    return float(np.sqrt(np.mean(sigma**2))) if np.isfinite(sigma).all() else np.inf
