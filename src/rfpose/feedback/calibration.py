"""Fit of mounts to measurements: robust, bounded, for thousands of heliostats at once.

The residual is the difference of the modelled mirror normal and the one that the measurement asks for, over its
sigma. Huber's loss is minimised by Levenberg-Marquardt; with sigma unknown the scale is the median residual's.
What the data cannot tell apart is found by the singular values of the Jacobian with columns of equal length, and
named: no number is given for it.

All milliradians here are of the mirror normal; the beam moves by twice as much.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, read_only
from rfpose.errors import InvalidInputError
from rfpose.feedback import _kernels
from rfpose.feedback.calibrated import (
    PARAMETER_SETS,
    CalibratedMount,
    FieldCalibration,
    FitSettings,
    FitStatus,
    KnownMount,
    RowStatus,
    resolve_free,
)
from rfpose.feedback.columns import M, columns_of, scales_of
from rfpose.feedback.measurements import Measurements
from rfpose.feedback.mount import Mount, stack_mounts
from rfpose.feedback.prediction import (
    PredictedNormals,
    normal_differences,
    normal_errors_rad,
    posture_jacobian,
    predict,
)
from rfpose.feedback.uncertainty import FitBatch, noise_with_assumed, uncertainty

__all__ = [
    "PARAMETER_SETS",
    "CalibratedMount",
    "FieldCalibration",
    "FitSettings",
    "FitStatus",
    "KnownMount",
    "PredictedNormals",
    "RowStatus",
    "fit",
    "fit_many",
    "normal_differences",
    "normal_errors_rad",
    "pad",
    "posture_jacobian",
    "predict",
    "resolve_free",
    "row_status",
    "solve",
    "sun_convention",
    "working_alone",
]

_TURNS = 4
_FAR_RAD = 0.15
_CONSISTENT_RAD = 0.02
_COUNTED = {
    (-1.0, -1.0): "is counted from south (add π)",
    (-1.0, 1.0): "runs counter-clockwise (change its sign)",
    (1.0, -1.0): "is counted from south and counter-clockwise (π minus it)",
}


def fit(
    mount: Mount,
    measurements: Measurements,
    *,
    free: str | Sequence[str],
    settings: FitSettings | None = None,
) -> CalibratedMount:
    """Fit one heliostat's mount to measurements.

    Parameters
    ----------
    mount
        The mount as planned or as last calibrated: the start.
    measurements
        From one or several sources.
    free
        Name of one of `PARAMETER_SETS`, or names of parameters.
    settings
        Loss, bounds, priors.

    Raises
    ------
    InvalidInputError
        Fewer usable measurements than the free parameters need; a sun azimuth of another convention; measurements
        that are far from the mount and from each other.
    """
    chosen = settings or FitSettings()
    names = resolve_free(free)
    status = row_status(mount, measurements)
    used = status == RowStatus.USED
    before, signs = sun_convention(mount, measurements)
    if signs is not None:
        raise InvalidInputError(f"the sun's azimuth evidently {_COUNTED[signs]}; rfpose counts from north, clockwise")
    field_fit = fit_many([mount], [measurements], free=names, settings=chosen)
    if field_fit.status[0] == FitStatus.TOO_FEW:
        raise InvalidInputError(
            f"{len(names)} free parameters need {_least(names, chosen)} or more measurements, got "
            f"{int(used.sum())} usable of {len(measurements)}{_reasons(status)}; free fewer or give priors"
        )
    fitted = mount.replace(**dict(zip(names, field_fit.working[0].tolist(), strict=True)))
    error_rad = normal_errors_rad(fitted, measurements)
    after = float(np.nanmedian(error_rad[used]))
    if before > _FAR_RAD and after > _CONSISTENT_RAD:
        raise InvalidInputError(
            f"measured and planned normals differ by {1e3 * before:.0f} mrad in the median, and fitted ones still by "
            f"{1e3 * after:.0f}: check that motor positions are in the mount's counts, positions in the site frame, "
            "and angles in the unit that is asked for (radians or degrees)"
        )
    return CalibratedMount(
        mount=fitted,
        measurements=measurements,
        field=field_fit,
        row_status=status,
        error_rad=error_rad,
        settings=chosen,
    )


def fit_many(
    mounts: Sequence[Mount],
    measurements: Sequence[Measurements],
    *,
    free: str | Sequence[str],
    settings: FitSettings | None = None,
) -> FieldCalibration:
    """Fit many heliostats in parallel, each to its own measurements.

    Parameters
    ----------
    mounts, measurements : (heliostat)
        One of each a heliostat; numbers of measurements may differ.
    free
        As for `fit`; the same for all.
    settings
        Loss, bounds, priors.

    Notes
    -----
    A heliostat that cannot be fitted is NaN with its reason in ``status``; the others go on.
    """
    if len(mounts) != len(measurements) or not mounts:
        raise InvalidInputError(
            f"`mounts` and `measurements` must be of one length and not empty, got {len(mounts)}, {len(measurements)}"
        )
    names = resolve_free(free)
    p, k = stack_mounts(mounts)
    count, row, use = pad(mounts, measurements)
    return solve(p, k, count, row, use, names, settings or FitSettings())


def pad(
    mounts: Sequence[Mount], measurements: Sequence[Measurements]
) -> tuple[FloatArray, FloatArray, npt.NDArray[np.bool_]]:
    """Return counts, rows and the mask of what takes part, all heliostats of one length."""
    longest = max(1, *(len(m) for m in measurements))
    count = np.zeros((len(mounts), longest, 2))
    row = np.zeros((len(mounts), longest, _kernels.N_ROW))
    row[..., M.sigma_rad] = 1.0
    use = np.zeros((len(mounts), longest), np.bool_)
    for i, (mount, m) in enumerate(zip(mounts, measurements, strict=True)):
        count[i, : len(m)], row[i, : len(m)] = m.count, m.row
        use[i, : len(m)] = row_status(mount, m) == RowStatus.USED
    return count, row, use


def row_status(mount: Mount, measurements: Measurements) -> npt.NDArray[np.int8]:
    """Return for each measurement whether it can take part (`RowStatus`)."""
    row, count = measurements.row, measurements.count
    status = np.zeros(len(row), np.int8)
    limits = np.array([actuator.limits_count for actuator in mount.actuators])
    status[np.any((count < limits[:, 0]) | (count > limits[:, 1]), axis=1)] = RowStatus.BEYOND_LIMITS
    with np.errstate(invalid="ignore"):
        sun = (row[:, 3] == 0.0) & (row[:, 7] == 1.0) & (row[:, 2] <= 0.0)
    status[sun] = RowStatus.SUN_BELOW_HORIZON
    open_triangle = np.zeros(len(row), np.bool_)
    for i, actuator in enumerate(mount.actuators):
        if actuator.kind == "linear":
            length = actuator.stroke_m + count[:, i] / actuator.counts_per_unit
            low, high = abs(actuator.radius_m - actuator.offset_m), actuator.radius_m + actuator.offset_m
            open_triangle |= ~((length > low) & (length < high))
    status[open_triangle & (status == RowStatus.USED)] = RowStatus.ACTUATOR_OPEN
    status[~(np.isfinite(row).all(axis=1) & np.isfinite(count).all(axis=1))] = RowStatus.NOT_FINITE
    return status


def solve(
    p: FloatArray,
    k: FloatArray,
    count: FloatArray,
    row: FloatArray,
    use: npt.NDArray[np.bool_],
    free: tuple[str, ...],
    settings: FitSettings,
) -> FieldCalibration:
    """Fit rows of parameters to rows of measurements and say what is known of the result."""
    problem, enough = _problem(k, count, row, use, free, settings)
    fitted, iterations, noise = _minimise(p, problem, free, settings)
    if settings.priors and not settings.sigma_known:
        noise = _noise(problem, fitted, noise)
    carried = problem.carried(fitted, noise)
    redundancy = 2.0 * problem.use.sum(axis=1) - carried
    if not settings.sigma_known and not settings.priors:
        noise = noise_with_assumed(noise, problem.use, redundancy)
    status = np.where(iterations < 0, FitStatus.NOT_SETTLED, FitStatus.OK).astype(np.int8)
    status[~enough] = FitStatus.TOO_FEW
    working = fitted[:, problem.index]
    working[~enough] = np.nan
    residual_noise = np.where(enough & (noise > 0.0), noise, 1.0)
    noise = np.where(enough, np.maximum(noise, settings.least_noise), np.nan)
    known = uncertainty(problem, fitted, residual_noise, redundancy, settings)
    covariance, ambiguity, rank, condition, length = known
    blind = np.einsum("hff->hf", ambiguity) > 0.02
    sigma = np.sqrt(np.einsum("hff->hf", covariance))
    sigma[blind] = np.inf
    covariance[~enough] = np.nan
    sigma[~enough] = np.nan
    return FieldCalibration(
        free=free,
        estimate=read_only(np.where(blind, np.nan, working)),
        working=read_only(working),
        sigma=read_only(sigma),
        covariance=read_only(covariance),
        rank=read_only(rank),
        condition=read_only(condition),
        ambiguity=read_only(ambiguity),
        column_length=read_only(length),
        carried=read_only(carried),
        redundancy=read_only(redundancy),
        noise=read_only(noise),
        iterations=read_only(np.abs(iterations)),
        status=read_only(status),
    )


def working_alone(
    p: FloatArray,
    k: FloatArray,
    count: FloatArray,
    row: FloatArray,
    use: npt.NDArray[np.bool_],
    free: tuple[str, ...],
    settings: FitSettings,
) -> FloatArray:
    """Fit as `solve` does and return its ``working`` (heliostat, free), without working out what is known of it."""
    problem, enough = _problem(k, count, row, use, free, settings)
    working = _minimise(p, problem, free, settings)[0][:, problem.index]
    working[~enough] = np.nan
    return working


def _problem(
    k: FloatArray,
    count: FloatArray,
    row: FloatArray,
    use: npt.NDArray[np.bool_],
    free: tuple[str, ...],
    settings: FitSettings,
) -> tuple[FitBatch, npt.NDArray[np.bool_]]:
    """Return what is to be fitted, and for which heliostats enough was measured (heliostat,)."""
    enough = use.sum(axis=1) >= _least(free, settings)
    weight = np.array([1.0 / settings.priors[name][1] ** 2 if name in settings.priors else 0.0 for name in free])
    problem = FitBatch(
        k=k,
        count=count,
        row=row,
        use=use & enough[:, None],
        index=columns_of(free),
        scale=scales_of(free),
        prior_weight=weight,
    )
    return problem, enough


def _minimise(
    p: FloatArray, problem: FitBatch, free: tuple[str, ...], settings: FitSettings
) -> tuple[FloatArray, npt.NDArray[np.int64], FloatArray]:
    """Return parameters fitted from ``p``, iterations, and the noise that weighed them, in units of the stated sigma.

    Priors and residuals are weighed by the noise, and how much of the residuals the parameters took up depends on
    the priors: the noise is found in turns with the fit, beginning with what is stated. Found inside the fit it
    would go to zero, and the priors with it, as soon as the parameters reach every point.
    """
    low, high, mean = _limits(p[:, problem.index], free, settings)
    start = p.copy()
    start[:, problem.index] = np.clip(start[:, problem.index], low, high)

    def kernel(p: FloatArray, row: FloatArray, known: bool) -> Any:
        return _kernels.fit_batch(
            p, problem.k, problem.count, row, problem.use, problem.index, problem.scale, low, high, mean,
            problem.prior_weight, settings.huber, known, settings.max_iteration,
        )  # fmt: skip

    if settings.sigma_known or not settings.priors:
        found: tuple[FloatArray, npt.NDArray[np.int64], FloatArray] = kernel(start, problem.row, settings.sigma_known)
        return found
    noise, fitted = np.ones(len(start)), start
    row = problem.row.copy()
    for turn in range(_TURNS):
        if turn:
            noise = _noise(problem, fitted, noise)
        row[..., M.sigma_rad] = problem.row[..., M.sigma_rad] * noise[:, None]
        fitted, iterations, _ = kernel(fitted, row, True)
    return fitted, iterations, noise


def _noise(problem: FitBatch, fitted: FloatArray, weighed_by: FloatArray) -> FloatArray:
    """Return the noise by a fit that was weighed by another one, in units of the stated sigma (heliostat,)."""
    redundancy = 2.0 * problem.use.sum(axis=1) - problem.carried(fitted, weighed_by)
    return noise_with_assumed(problem.scatter(fitted), problem.use, redundancy)


def _limits(
    start: FloatArray, free: tuple[str, ...], settings: FitSettings
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Bounds and means of the free parameters as arrays."""
    low, high = np.full_like(start, -np.inf), np.full_like(start, np.inf)
    mean = start.copy()
    for f, name in enumerate(free):
        if name in settings.bounds:
            low[:, f], high[:, f] = settings.bounds[name]
        if name in settings.priors:
            mean[:, f] = settings.priors[name][0]
    return low, high, mean


def _least(free: tuple[str, ...], settings: FitSettings) -> int:
    """Fewest measurements, of two components each; a prior stands in for half a measurement."""
    without_prior = sum(name not in settings.priors for name in free)
    return max(1, (without_prior + 1) // 2)


def _reasons(status: npt.NDArray[np.int8]) -> str:
    """Why measurements do not take part, in words."""
    texts = [
        f"{int(n)} {RowStatus(s).name.lower().replace('_', ' ')}"
        for s, n in zip(*np.unique(status[status != RowStatus.USED], return_counts=True), strict=True)
    ]
    return f" ({', '.join(texts)})" if texts else ""


def sun_convention(mount: Mount, measurements: Measurements) -> tuple[float, tuple[float, float] | None]:
    """Say whether the sun's azimuth is evidently counted otherwise than from north, clockwise.

    Parameters
    ----------
    mount, measurements
        As for `fit`.

    Returns
    -------
    median_rad
        Median error of the nominal mount's normals [rad]; zero without measurements of the sun.
    signs
        By which east and north must be multiplied to mend it; None if that does not help, if other zeros of the axes
        do as well, or if nothing is wrong.
    """
    sunny = measurements.take((measurements.row[:, 3] == 0.0) & (measurements.row[:, 7] == 1.0))
    sunny = sunny.take(row_status(mount, sunny) == RowStatus.USED)
    if not len(sunny):
        return 0.0, None
    before = float(np.nanmedian(normal_errors_rad(mount, sunny)))
    if before > _FAR_RAD:
        for signs in _COUNTED:
            row = sunny.row.copy()
            row[:, :2] *= signs
            changed = Measurements(count=sunny.count, row=row, unix_s=sunny.unix_s)
            after = float(np.nanmedian(normal_errors_rad(mount, changed)))
            if after < min(0.3 * before, _median_with_other_zeros_rad(mount, sunny)):
                return before, signs
    return before, None


def _median_with_other_zeros_rad(mount: Mount, measurements: Measurements) -> float:
    """Median error once the axes' zeros are fitted: a mount far from its plan is told from suns counted otherwise."""
    free = PARAMETER_SETS["offsets"]
    p, k = stack_mounts([mount])
    count, row = measurements.count[None].copy(), measurements.row[None].copy()
    (values,) = working_alone(p, k, count, row, np.ones((1, len(measurements)), np.bool_), free, FitSettings())
    if not np.isfinite(values).all():
        return float("inf")
    turned = mount.replace(**dict(zip(free, values.tolist(), strict=True)))
    return float(np.nan_to_num(np.nanmedian(normal_errors_rad(turned, measurements)), nan=np.inf))
