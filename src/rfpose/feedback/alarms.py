"""When a heliostat is no longer the one that was calibrated: single outliers, shifts, drift.

Each measurement's error is told as what the two axes would have to be wrong by. A shift (re-homed, hit, a belt that
jumped) is a change of level from one measurement on; the cheapest partition into runs finds them all. Drift is a slope
(Theil and Sen's) between shifts that adds up to more than the limit of a shift, or goes on at a rate that a year's
drift tells.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, as_positive
from rfpose.feedback.calibration import CalibratedMount, normal_differences, posture_jacobian

__all__ = ["Alarm", "alarms", "axis_errors_rad"]

_YEAR_S = 365.25 * 86400.0
_LEAST_SPAN_S = 90.0 * 86400.0
_LEAST_DRIFT_RAD = 0.4e-3


@dataclass(frozen=True, slots=True, kw_only=True)
class Alarm:
    """Something that a steady mount does not do.

    Attributes
    ----------
    kind
        ``"outlier"``: one measurement; ``"shift"``: from ``first`` on; ``"drift"``: from ``first`` to ``last``.
    first, last
        Measurements concerned, by index, in the order of time.
    axis
        1 or 2; of an outlier the one that is more wrong.
    size_rad
        Error, step, or total change of the axis angle [rad].
    """

    kind: Literal["outlier", "shift", "drift"]
    first: int
    last: int
    axis: int
    size_rad: float


def axis_errors_rad(calibration: CalibratedMount) -> FloatArray:
    """Return what each axis would have to be wrong by to explain the errors (measurement, axis) [rad].

    NaN where the measurement is unknown.
    """
    difference = normal_differences(calibration.mount, calibration.measurements)
    jacobian = posture_jacobian(calibration.mount, calibration.measurements, ("axis_1_zero_rad", "axis_2_zero_rad"))
    known = np.isfinite(difference).all(axis=1) & np.isfinite(jacobian).all(axis=(1, 2))
    out = np.full((len(difference), 2), np.nan)
    out[known] = np.einsum("nax,nx->na", np.linalg.pinv(jacobian[known]), difference[known])
    return out


def alarms(
    calibration: CalibratedMount,
    *,
    outlier_rad: float = 5e-3,
    shift_rad: float = 2e-3,
    drift_rad_per_year: float = 0.45e-3,
    least_run: int = 3,
) -> tuple[Alarm, ...]:
    """Return what happened to a heliostat in the course of its measurements.

    Parameters
    ----------
    calibration
        Fit to measurements in any order; they are taken in the order of time.
    outlier_rad
        Error of the normal from which on a measurement is an outlier [rad].
    shift_rad
        Step or total drift of an axis that is worth an alarm [rad]; it must also stand out of the scatter.
    drift_rad_per_year
        Rate of drift that is worth an alarm even where it has not yet added up to ``shift_rad`` [rad/year]; it must
        have gone on for three months, have added up to 0.4 mrad and be sure.
    least_run
        Fewest measurements on either side of a step.
    """
    as_positive("outlier_rad", outlier_rad)
    as_positive("shift_rad", shift_rad)
    as_positive("drift_rad_per_year", drift_rad_per_year)
    order = np.argsort(calibration.measurements.unix_s, kind="stable")
    error, unix_s = axis_errors_rad(calibration)[order], calibration.measurements.unix_s[order]
    found = [
        Alarm(kind="outlier", first=i, last=i, axis=1 + int(np.argmax(np.abs(error[i]))), size_rad=float(size))
        for i, size in enumerate(calibration.error_rad[order])
        if size > outlier_rad
    ]
    index = np.flatnonzero(np.isfinite(error).all(axis=1))
    for axis in (0, 1):
        series = error[index, axis]
        cuts = _steps(series, _cuts(series, shift_rad, least_run), shift_rad)
        edges = [0, *cuts, len(series)]
        for at, after in itertools.pairwise(edges[1:]):
            step = _step(series, cuts, at)
            last = int(index[after - 1])
            found.append(Alarm(kind="shift", first=int(index[at]), last=last, axis=axis + 1, size_rad=step))
        for a, b in itertools.pairwise(edges):
            drift = _drift(series[a:b], unix_s[index[a:b]], shift_rad, drift_rad_per_year)
            if drift is not None:
                found.append(
                    Alarm(kind="drift", first=int(index[a]), last=int(index[b - 1]), axis=axis + 1, size_rad=drift)
                )
    return tuple(sorted(found, key=lambda alarm: (alarm.first, alarm.kind)))


def _cuts(series: npt.NDArray[np.float64], limit: float, least: int) -> list[int]:
    """Places where the level steps: the cheapest partition into constant runs, found by dynamic programming.

    A step costs what a run of ``least`` measurements saves that is wrong by the limit, or by three sigma of the
    scatter from one measurement to the next. A running median of three takes single outliers out before.
    """
    n = len(series)
    if n < 2 * least:
        return []
    x = np.median(np.lib.stride_tricks.sliding_window_view(np.pad(series, 1, mode="edge"), 3), axis=1)
    sigma = 1.4826 * float(np.median(np.abs(np.diff(series)))) / np.sqrt(2.0)
    penalty = least * max(limit, 3.0 * sigma) ** 2
    first, second = np.concatenate([[0.0], np.cumsum(x)]), np.concatenate([[0.0], np.cumsum(x**2)])
    best, origin = np.full(n + 1, np.inf), np.zeros(n + 1, np.int64)
    best[0] = -penalty
    for stop in range(least, n + 1):
        starts = np.arange(0, stop - least + 1)
        length = stop - starts
        cost = second[stop] - second[starts] - (first[stop] - first[starts]) ** 2 / length
        total = best[starts] + cost + penalty
        origin[stop] = starts[np.argmin(total)]
        best[stop] = total.min()
    cuts = []
    stop = int(origin[n])
    while stop > 0:
        cuts.append(stop)
        stop = int(origin[stop])
    return cuts[::-1]


def _step(series: npt.NDArray[np.float64], cuts: list[int], at: int) -> float:
    """Difference of the medians after and before a cut."""
    edges = [0, *cuts, len(series)]
    i = edges.index(at, 1)
    return float(np.median(series[at : edges[i + 1]]) - np.median(series[edges[i - 1] : at]))


def _steps(series: npt.NDArray[np.float64], cuts: list[int], limit: float) -> list[int]:
    """Cuts without those whose step is within the limit: a slope is no staircase."""
    left = list(cuts)
    while left:
        sizes = [abs(_step(series, left, at)) for at in left]
        smallest = int(np.argmin(sizes))
        if sizes[smallest] > limit:
            break
        left.pop(smallest)
    return left


def _drift(
    part: npt.NDArray[np.float64], unix_s: npt.NDArray[np.float64], limit: float, limit_per_year: float
) -> float | None:
    """Total change along a run, if it is sure and beyond one of the limits."""
    if len(part) < 10:
        return None
    total = _slope(part, np.arange(len(part))) * (len(part) - 1)
    if abs(total) > limit and _is_sure(part, None):
        return total
    at_s = unix_s - unix_s[0]
    span_s = float(at_s[-1])
    if not span_s >= _LEAST_SPAN_S:
        return None
    slope = _slope(part, at_s)
    total = slope * span_s
    fast = abs(slope) * _YEAR_S > limit_per_year and abs(total) > _LEAST_DRIFT_RAD
    return total if fast and _is_sure(part, at_s) else None


def _slope(part: npt.NDArray[np.float64], at: npt.NDArray[Any]) -> float:
    """Median of the slopes between any two (Theil 1950)."""
    later, earlier = np.tril_indices(len(part), -1)
    apart = at[later] - at[earlier]
    slopes = (part[later] - part[earlier])[apart != 0] / apart[apart != 0]
    return float(np.median(slopes)) if len(slopes) else 0.0


def _is_sure(part: npt.NDArray[np.float64], at: npt.NDArray[np.float64] | None) -> bool:
    """Tell whether zero is outside the slope's interval of confidence (Sen 1968)."""
    from scipy.stats import theilslopes  # takes a second to load, which the steady ones are spared

    _, _, low, high = theilslopes(part, at, alpha=0.997)
    return bool(low * high > 0.0)
