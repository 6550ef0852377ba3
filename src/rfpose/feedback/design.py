"""Which postures to measure next, and how the calibrated mount will do over a day or a year."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.errors import InvalidInputError
from rfpose.feedback.calibration import KnownMount, posture_jacobian, predict
from rfpose.feedback.measurements import Measurements
from rfpose.feedback.mount import PARAMETERS, Commands, command
from rfpose.sun import Location, Sun, sun_position

__all__ = ["Design", "Forecast", "forecast", "next_postures"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Design:
    """Postures in the order in which they are worth measuring.

    Attributes
    ----------
    chosen : (posture,)
        Indices into the candidates.
    trace : (posture + 1,)
        Criterion before the first and after each [rad² or, for ``"parameters"``, in squared usual sizes].
    """

    chosen: npt.NDArray[np.int64]
    trace: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Forecast:
    """Corrected commands and what is left uncertain, over times.

    Attributes
    ----------
    sun
        The sun at those times.
    commands
        Motor positions; NaN and a status where the sun is down or out of reach.
    sigma_normal_rad : (time,)
        RMS angle of the normal left by the parameters' uncertainty [rad].
    sigma_total_rad : (time,)
        The same with the measurements' own residual noise, which the model does not explain, added [rad].
    """

    sun: Sun
    commands: Commands
    sigma_normal_rad: FloatArray
    sigma_total_rad: FloatArray


def next_postures(
    calibration: KnownMount,
    candidates: Measurements,
    *,
    n_posture: int,
    criterion: Literal["prediction", "parameters"] = "prediction",
) -> Design:
    """Choose, one after the other, the posture that shrinks the covariance's trace most.

    Parameters
    ----------
    calibration
        What is known so far. Combinations that its data leave undetermined count as a hundred usual sizes uncertain.
    candidates
        Postures that can be measured: motor positions, source, target, and the sigma to be expected.
    n_posture
        How many to choose; one may be chosen again.
    criterion
        ``"prediction"``: trace of the pointing's covariance, mean over the candidates. ``"parameters"``: trace of the
        parameters' covariance in their usual sizes.
    """
    if n_posture < 1:
        raise InvalidInputError(f"`n_posture` must be one or more, got {n_posture}")
    usual = np.array([PARAMETERS[name] for name in calibration.free])
    covariance = calibration.covariance / np.outer(usual, usual)
    covariance = covariance + 100.0**2 * _scaled_ambiguity(calibration, usual)
    jacobian = posture_jacobian(calibration.mount, candidates, calibration.free) * usual
    if not np.all(np.isfinite(jacobian)):
        raise InvalidInputError("`candidates` must lie within the actuators' reach and have a finite source and target")
    goal = (
        np.eye(len(usual))
        if criterion == "parameters"
        else np.einsum("nxf,nxg->fg", jacobian, jacobian) / len(candidates)
    )
    noise = candidates.sigma_rad[:, None, None] ** 2 * np.eye(3)
    chosen, trace = [], [float(np.trace(goal @ covariance))]
    for _ in range(n_posture):
        # the update of a Kalman filter for each candidate; only its trace is needed to choose
        spread = jacobian @ covariance
        innovation = spread @ np.swapaxes(jacobian, 1, 2) + noise
        gain = np.linalg.solve(innovation, spread)
        saved = np.einsum("nxf,fg,nxg->n", spread, goal, gain)
        best = int(np.argmax(saved))
        covariance = covariance - spread[best].T @ gain[best]
        chosen.append(best)
        trace.append(float(np.trace(goal @ covariance)))
    return Design(chosen=np.array(chosen, np.int64), trace=np.array(trace))


def _scaled_ambiguity(calibration: KnownMount, usual: FloatArray) -> FloatArray:
    """Projection onto the undetermined combinations, in usual sizes of the parameters."""
    values, vectors = np.linalg.eigh(calibration.ambiguity)
    null = vectors[:, values > 0.5]
    if not null.shape[1]:
        return np.zeros((len(usual), len(usual)))
    # the projection is for columns of length one: go back to parameters, then to usual sizes
    lengths = np.where(calibration.column_length > 0.0, calibration.column_length, 1.0)  # zero: not seen at all
    basis, _ = np.linalg.qr(null / (lengths * usual)[:, None])
    return np.asarray(basis @ basis.T)


def forecast(
    calibration: KnownMount,
    *,
    site: Location,
    unix_s: npt.ArrayLike,
    target_enu_m: npt.ArrayLike,
    mode: Literal["heliostat", "dish"] = "heliostat",
) -> Forecast:
    """Return corrected commands for an aim point and times, and the pointing that remains uncertain.

    Parameters
    ----------
    calibration
        A fitted heliostat.
    site
        For the sun.
    unix_s : (time,)
        Times of a day, or sampled over a year [s since 1970 UTC].
    target_enu_m : (xyz)
        Aim point, site ENU [m]; not used by a dish.
    mode
        As for `mount.command`.
    """
    sun = sun_position(unix_s, site)
    target = None if mode == "dish" else np.broadcast_to(np.asarray(target_enu_m, np.float64), sun.direction_enu.shape)
    wanted = command(calibration.mount, sun_enu=sun.direction_enu, target_enu_m=target, mode=mode)
    good = (wanted.status == 0) & (sun.elevation_rad > 0.0)
    count = np.where(good[:, None], wanted.count, np.nan)
    postures = (
        Measurements.from_normals(count, normal_enu=sun.direction_enu)
        if target is None
        else Measurements.from_spots(count, sun_enu=sun.direction_enu, spot_enu_m=target)
    )
    sigma = np.full(len(good), np.nan)
    if good.any():
        sigma[good] = predict(calibration, postures.take(good)).sigma_rad
    return Forecast(
        sun=sun,
        commands=Commands(count=count, status=wanted.status),
        sigma_normal_rad=sigma,
        sigma_total_rad=np.sqrt(sigma**2 + 2.0 * calibration.noise_rad**2),
    )
