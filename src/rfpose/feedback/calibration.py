"""Fit of mounts to measurements: robust, bounded, for thousands of heliostats at once.

The residual is the difference of the modelled mirror normal and the one that the measurement asks for, over its
sigma. Huber's loss is minimised by Levenberg-Marquardt; with sigma unknown the scale is the median residual's.
What the data cannot tell apart is found by the singular values of the Jacobian with columns of equal length, and
named: no number is given for it.

All milliradians here are of the mirror normal; the beam moves by twice as much.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Protocol

import numpy as np
import numpy.typing as npt
from scipy.special import erfc

from rfpose.checks import FloatArray, as_positive, read_only
from rfpose.errors import InvalidInputError
from rfpose.feedback import _kernels
from rfpose.feedback.measurements import Measurements
from rfpose.feedback.mount import PARAMETERS, Mount, check_names, stack_mounts

__all__ = [
    "PARAMETER_SETS",
    "Calibration",
    "FieldCalibration",
    "FitSettings",
    "FitStatus",
    "Known",
    "Prediction",
    "RowStatus",
    "fit",
    "fit_many",
    "normal_errors_rad",
    "predict",
]

_PEDESTAL = ("pedestal_tilt_north_rad", "pedestal_tilt_east_rad")
_ZEROS = ("axis_1_zero_rad", "axis_2_zero_rad")
_LOCATION = ("location_up_m", "location_east_m", "location_north_m")
_STROKES = ("actuator_1_stroke_m", "actuator_2_stroke_m")
_RADII = ("actuator_1_radius_m", "actuator_2_radius_m")
_LEVEL = ("pedestal_tilt_east_rad", "pedestal_twist_rad")

PARAMETER_SETS: dict[str, tuple[str, ...]] = {
    "offsets": _ZEROS,
    "edwards-4": (*_PEDESTAL, *_ZEROS),
    "edwards-6": (*_PEDESTAL, *_ZEROS, "axis_1_gain", "axis_2_gain"),
    "edwards-7": (*_PEDESTAL, *_ZEROS, "axis_1_gain", "axis_2_gain", "nonorthogonality_rad"),
    # in Malan's order (4.2.1): tilts, biases, non-orthogonality, location
    "malan": (*_PEDESTAL, *_ZEROS, "nonorthogonality_rad", *_LOCATION),
    "gouws": (
        *_LOCATION, *_PEDESTAL, *_ZEROS, "arm_normal_m", "arm_up_m",
    ),
    # his tenth, in three components: where the drone's camera sits
    "gouws-camera": (
        *_LOCATION, *_PEDESTAL, *_ZEROS, "arm_normal_m", "arm_up_m", "drone_camera_east_m", "drone_camera_north_m",
        "drone_camera_up_m",
    ),
    "level-4": (*_LEVEL, *_ZEROS),
    "level-7": (*_LEVEL, *_ZEROS, "nonorthogonality_rad", *_STROKES),
    "level-8": (*_PEDESTAL, "pedestal_twist_rad", *_ZEROS, "nonorthogonality_rad", *_STROKES),
    "level-location": (*_LEVEL, *_ZEROS, "nonorthogonality_rad", *_STROKES, *_LOCATION, *_RADII),
    "level-full": (*_LEVEL, *_ZEROS, "nonorthogonality_rad", *_STROKES, "canting_right_rad", *_LOCATION),
}  # fmt: skip
"""Usual sets of free parameters. ``level-…`` are for an axis 1 that lies east-west, as PAINT's."""


class FitStatus(IntEnum):
    """What became of a heliostat's fit."""

    OK = 0
    TOO_FEW = 1
    NOT_SETTLED = 2


class RowStatus(IntEnum):
    """Whether a measurement took part."""

    USED = 0
    NOT_FINITE = 1
    SUN_BELOW_HORIZON = 2
    BEYOND_LIMITS = 3
    ACTUATOR_OPEN = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class FitSettings:
    """How a fit goes about it.

    Attributes
    ----------
    sigma_known
        The measurements' sigmas are absolute. Otherwise they only weigh the measurements against each other and
        the noise is estimated from the residuals.
    huber
        Residuals beyond this many sigma count linearly. One loses 11 % of the information if the noise is
        Gaussian, and is the better for it where the model's own errors dominate. Infinity: plain least squares.
    bounds
        Lowest and highest value by parameter.
    priors
        Mean and standard deviation by parameter.
    rank_tolerance
        A singular value below this part of the largest is none; columns have length one.
    max_iteration
        Most steps.

    Raises
    ------
    InvalidInputError
        An unknown name, a bound that is not ascending, a sigma or tolerance that is not positive.
    """

    sigma_known: bool = False
    huber: float = 1.0
    bounds: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    priors: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    rank_tolerance: float = 1e-5
    max_iteration: int = 60

    def __post_init__(self) -> None:
        check_names(self.bounds)
        check_names(self.priors)
        for name, (low, high) in self.bounds.items():
            if not low < high:
                raise InvalidInputError(f"`bounds` of {name} must be ascending, got {(low, high)}")
        for name, (_, sigma) in self.priors.items():
            as_positive(f"priors[{name}] sigma", sigma)
        if not self.huber > 0.0:
            raise InvalidInputError(f"`huber` must be greater than zero, got {self.huber}")
        as_positive("rank_tolerance", self.rank_tolerance)


@dataclass(frozen=True, slots=True, kw_only=True)
class FieldCalibration:
    """Fits of many heliostats, one row each.

    Attributes
    ----------
    free
        Names of the free parameters.
    estimate : (heliostat, free)
        NaN for what the data cannot tell apart.
    working : (heliostat, free)
        Values that the fit ended with. Undetermined ones are one choice of many that predict the same.
    sigma : (heliostat, free)
        Standard deviations; infinite for what is undetermined.
    covariance : (heliostat, free, free)
        On the subspace that the data determine (pseudo-inverse), so that predictions may use it.
    rank : (heliostat,)
        Combinations of parameters that the data determine.
    condition : (heliostat,)
        Largest over smallest singular value among those that count.
    ambiguity : (heliostat, free, free)
        Projection onto what is undetermined, for columns of the Jacobian of length one; zero where all is
        determined.
    column_length : (heliostat, free)
        Lengths of the Jacobian's columns, in sigma by unit of the parameter.
    noise : (heliostat,)
        Sigma of the residuals in units of the stated sigma: estimated, or one.
    iterations : (heliostat,)
        Steps taken.
    status : (heliostat,)
        `FitStatus`.
    """

    free: tuple[str, ...]
    estimate: FloatArray
    working: FloatArray
    sigma: FloatArray
    covariance: FloatArray
    rank: npt.NDArray[np.int64]
    condition: FloatArray
    ambiguity: FloatArray
    column_length: FloatArray
    noise: FloatArray
    iterations: npt.NDArray[np.int64]
    status: npt.NDArray[np.int8]

    def undetermined(self, heliostat: int) -> tuple[tuple[str, ...], ...]:
        """Name groups of parameters that a heliostat's data cannot tell apart; a group of one is not seen at all."""
        linked = np.abs(self.ambiguity[heliostat]) > 0.02
        left = [i for i in range(len(self.free)) if linked[i, i]]
        groups = []
        while left:
            group = {left[0]}
            while True:
                grown = {j for j in left if any(linked[i, j] for i in group)} | group
                if grown == group:
                    break
                group = grown
            groups.append(tuple(self.free[i] for i in sorted(group)))
            left = [i for i in left if i not in group]
        return tuple(groups)


@dataclass(frozen=True, slots=True, kw_only=True)
class Calibration:
    """A calibrated heliostat.

    Attributes
    ----------
    mount
        The mount with the fitted parameters, ready to predict and to command.
    measurements
        What it was fitted to.
    field
        Estimates with their uncertainty; one row.
    row_status : (measurement,)
        `RowStatus` of each measurement.
    error_rad : (measurement,)
        Angle between modelled and measured normal [rad], also of rows that did not take part; NaN if unknown.
    settings
        How it was fitted.
    """

    mount: Mount
    measurements: Measurements
    field: FieldCalibration
    row_status: npt.NDArray[np.int8]
    error_rad: FloatArray
    settings: FitSettings

    @property
    def free(self) -> tuple[str, ...]:
        """Names of the free parameters."""
        return self.field.free

    @property
    def undetermined(self) -> tuple[tuple[str, ...], ...]:
        """Groups of parameters that the data cannot tell apart."""
        return self.field.undetermined(0)

    @property
    def estimate(self) -> dict[str, float]:
        """Fitted values by name; NaN where undetermined."""
        return dict(zip(self.free, self.field.estimate[0].tolist(), strict=True))

    @property
    def sigma(self) -> dict[str, float]:
        """Standard deviations by name."""
        return dict(zip(self.free, self.field.sigma[0].tolist(), strict=True))

    @property
    def covariance(self) -> FloatArray:
        """Of the free parameters, on the subspace that the data determine (free, free)."""
        return np.asarray(self.field.covariance[0])

    @property
    def ambiguity(self) -> FloatArray:
        """Projection onto what is undetermined (free, free)."""
        return np.asarray(self.field.ambiguity[0])

    @property
    def column_length(self) -> FloatArray:
        """Lengths of the Jacobian's columns (free,)."""
        return np.asarray(self.field.column_length[0])

    @property
    def noise_rad(self) -> float:
        """Standard deviation of one measured normal, one component, about the model [rad]."""
        return float(self.field.noise[0] * np.median(self.measurements.sigma_rad))

    @property
    def used(self) -> npt.NDArray[np.bool_]:
        """Which measurements took part."""
        return np.asarray(self.row_status == RowStatus.USED)


class Known(Protocol):
    """What is known of a mount: a `Calibration`, or one read back from a file."""

    @property
    def mount(self) -> Mount: ...  # noqa: D102
    @property
    def free(self) -> tuple[str, ...]: ...  # noqa: D102
    @property
    def covariance(self) -> FloatArray: ...  # noqa: D102
    @property
    def ambiguity(self) -> FloatArray: ...  # noqa: D102
    @property
    def column_length(self) -> FloatArray: ...  # noqa: D102
    @property
    def noise_rad(self) -> float: ...  # noqa: D102


@dataclass(frozen=True, slots=True, kw_only=True)
class Prediction:
    """Modelled normals and how far to trust them.

    Attributes
    ----------
    normal_enu : (posture, xyz)
        Modelled normals.
    error_rad : (posture,)
        Angle between the modelled normal and the one that the posture's source and target ask for [rad].
    cov_enu_rad2 : (posture, xyz, xyz)
        Of that difference, from the uncertainty of the parameters [rad²].
    sigma_rad : (posture,)
        Root of its trace: RMS angle by which the model is uncertain [rad].
    """

    normal_enu: FloatArray
    error_rad: FloatArray
    cov_enu_rad2: FloatArray
    sigma_rad: FloatArray


def resolve_free(free: str | Sequence[str]) -> tuple[str, ...]:
    """Return parameter names of a set's name or of a list of names.

    Raises
    ------
    InvalidInputError
        Unknown set or parameter, none, or one twice.
    """
    if isinstance(free, str):
        if free not in PARAMETER_SETS:
            raise InvalidInputError(f"no parameter set is called {free!r}; known are {', '.join(PARAMETER_SETS)}")
        return PARAMETER_SETS[free]
    names = tuple(free)
    check_names(names)
    if not names or len(set(names)) != len(names):
        raise InvalidInputError(f"`free` must name one or more parameters, each once, got {names}")
    return names


def fit(
    mount: Mount,
    measurements: Measurements,
    *,
    free: str | Sequence[str],
    settings: FitSettings | None = None,
) -> Calibration:
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
        Fewer usable measurements than the free parameters need; a sun azimuth of another convention.
    """
    chosen = settings or FitSettings()
    names = resolve_free(free)
    status = row_status(mount, measurements)
    used = status == RowStatus.USED
    _check_convention(mount, measurements.take(used))
    field_fit = fit_many([mount], [measurements], free=names, settings=chosen)
    if field_fit.status[0] == FitStatus.TOO_FEW:
        raise InvalidInputError(
            f"{len(names)} free parameters need {_least(names, chosen)} or more measurements, got "
            f"{int(used.sum())} usable of {len(measurements)}{_reasons(status)}; free fewer or give priors"
        )
    fitted = mount.replace(**dict(zip(names, field_fit.working[0].tolist(), strict=True)))
    return Calibration(
        mount=fitted,
        measurements=measurements,
        field=field_fit,
        row_status=status,
        error_rad=normal_errors_rad(fitted, measurements),
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
    row[..., 8] = 1.0
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
    index = np.array([list(PARAMETERS).index(name) for name in free])
    scale = np.array([PARAMETERS[name] for name in free])
    low, high, mean, weight = _limits(p[:, index], free, settings)
    enough = use.sum(axis=1) >= _least(free, settings)
    masked = use & enough[:, None]
    start = p.copy()
    start[:, index] = np.clip(start[:, index], low, high)
    fitted, iterations, noise = _kernels.fit_batch(
        start, k, count, row, masked, index, scale, low, high, mean, weight,
        settings.huber, settings.sigma_known, settings.max_iteration,
    )  # fmt: skip
    status = np.where(iterations < 0, FitStatus.NOT_SETTLED, FitStatus.OK).astype(np.int8)
    status[~enough] = FitStatus.TOO_FEW
    if not settings.sigma_known:
        components = 2.0 * masked.sum(axis=1)
        noise *= np.sqrt(components / np.maximum(components - len(free), 1.0))
    working = fitted[:, index]
    working[~enough] = np.nan
    noise[~enough] = np.nan
    spread = np.where(enough & (noise > 0.0), noise, 1.0)
    known = _uncertainty(fitted, k, count, row, masked, index, scale, spread, weight, settings)
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
        noise=read_only(noise),
        iterations=read_only(np.abs(iterations)),
        status=read_only(status),
    )


def _limits(
    start: FloatArray, free: tuple[str, ...], settings: FitSettings
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Bounds and priors of the free parameters as arrays."""
    low, high = np.full_like(start, -np.inf), np.full_like(start, np.inf)
    mean, weight = start.copy(), np.zeros(len(free))
    for f, name in enumerate(free):
        if name in settings.bounds:
            low[:, f], high[:, f] = settings.bounds[name]
        if name in settings.priors:
            mean[:, f], sigma = settings.priors[name]
            weight[f] = 1.0 / sigma**2
    return low, high, mean, weight


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


def _uncertainty(
    p: FloatArray,
    k: FloatArray,
    count: FloatArray,
    row: FloatArray,
    use: npt.NDArray[np.bool_],
    index: npt.NDArray[np.int64],
    scale: FloatArray,
    noise: FloatArray,
    prior_weight: FloatArray,
    settings: FitSettings,
) -> tuple[FloatArray, FloatArray, npt.NDArray[np.int64], FloatArray, FloatArray]:
    """Covariance, projection onto what is undetermined, rank, condition, lengths; in blocks, to bound the memory."""
    parts = []
    block = max(1, 4_000_000 // (row.shape[1] * 3 * len(index)))
    for i in range(0, len(p), block):
        s = slice(i, i + block)
        residual = _kernels.residuals_batch(p[s], k[s], count[s], row[s], use[s])
        jacobian = _kernels.jacobian_batch(p[s], k[s], count[s], row[s], use[s], index, scale)
        norm = np.linalg.norm(residual, axis=-1)
        spread = _efficiency(norm / noise[s, None], use[s], settings) * noise[s] ** 2
        # an exact fit has no scatter of its own; keep clear of zero
        jacobian *= (use[s] / np.sqrt(np.maximum(spread, 1e-18))[:, None])[..., None, None]
        prior = np.broadcast_to(np.diag(np.sqrt(prior_weight)), (len(jacobian), len(index), len(index)))
        rows = np.concatenate([jacobian.reshape(len(jacobian), -1, len(index)), prior], axis=1)
        parts.append(_subspaces(np.nan_to_num(rows), settings.rank_tolerance))
    covariance, ambiguity, rank, condition, length = (np.concatenate(items) for items in zip(*parts, strict=True))
    return covariance, ambiguity, rank, condition, length


def _efficiency(norm: FloatArray, use: npt.NDArray[np.bool_], settings: FitSettings) -> FloatArray:
    """Variance of Huber's estimate over that of least squares on the same Jacobian, both for sigma one.

    Mean square of the loss's slope over the squared mean of its curvature, in two dimensions: expected for Gaussian
    noise where sigma is known, else of the residuals themselves.
    """
    cut = settings.huber
    if settings.sigma_known:
        tail = float(np.exp(-0.5 * cut**2))
        linear = 0.5 * cut * np.sqrt(0.5 * np.pi) * erfc(cut / np.sqrt(2.0)) if np.isfinite(cut) else 0.0
        return np.full(len(norm), (1.0 - tail) / (1.0 - tail + linear) ** 2)
    n = np.maximum(use.sum(axis=1), 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        curvature = np.where(norm <= cut, 1.0, 0.5 * cut / norm)
        slope = 0.5 * np.sum(np.where(use, np.minimum(norm, cut) ** 2, 0.0), axis=1) / n
        return np.asarray(slope / (np.sum(np.where(use, curvature, 0.0), axis=1) / n) ** 2)


def _subspaces(
    jacobian: FloatArray, tolerance: float
) -> tuple[FloatArray, FloatArray, npt.NDArray[np.int64], FloatArray, FloatArray]:
    """Split parameter space by the singular values of a Jacobian with columns of length one."""
    length = np.linalg.norm(jacobian, axis=1)
    safe = np.where(length > 0.0, length, 1.0)
    _, singular, vt = np.linalg.svd(jacobian / safe[:, None, :], full_matrices=False)
    counts = singular > tolerance * np.maximum(singular[:, :1], np.finfo(float).tiny)
    inverse = np.where(counts, 1.0 / np.where(counts, singular, 1.0), 0.0)
    half = vt * inverse[..., None] / safe[:, None, :]
    null = np.where(counts[..., None], 0.0, vt)
    smallest = np.min(np.where(counts, singular, np.inf), axis=1)
    return (
        np.swapaxes(half, 1, 2) @ half,
        np.swapaxes(null, 1, 2) @ null,
        counts.sum(axis=1),
        singular[:, 0] / smallest,
        length,
    )


def normal_errors_rad(mount: Mount, measurements: Measurements) -> FloatArray:
    """Return the angle between modelled and measured normals [rad]; NaN where either is unknown.

    Parameters
    ----------
    mount
        The heliostat.
    measurements
        Its measurements.
    """
    difference = normal_differences(mount, measurements)
    half = 0.5 * np.linalg.norm(difference, axis=-1)
    return np.asarray(2.0 * np.arcsin(np.minimum(half, 1.0)))


def normal_differences(mount: Mount, measurements: Measurements) -> FloatArray:
    """Return modelled minus measured normals (measurement, xyz)."""
    residual: FloatArray = _kernels.residuals_batch(
        mount.parameter_vector()[None],
        mount.constant_vector()[None],
        measurements.count.copy()[None],  # kernels are compiled for arrays that can be written
        measurements.row.copy()[None],
        np.ones((1, len(measurements)), np.bool_),
    )[0]
    return residual * measurements.sigma_rad[:, None]


def predict(calibration: Known, postures: Measurements) -> Prediction:
    """Return modelled normals of postures with the uncertainty that the parameters leave.

    Parameters
    ----------
    calibration
        A fitted heliostat.
    postures
        Motor positions with source and target. With a target at a finite distance the mirror's own place counts:
        a place and a zero that were fitted together make up for each other, and what matters is their sum.
    """
    jacobian = posture_jacobian(calibration.mount, postures, calibration.free)
    covariance = jacobian @ calibration.covariance @ np.swapaxes(jacobian, -1, -2)
    p, k = stack_mounts([calibration.mount])
    normal = _kernels.posture_batch(p, k, postures.count.copy()[None], 0.0)[0, :, 2:5]
    return Prediction(
        normal_enu=normal,
        error_rad=normal_errors_rad(calibration.mount, postures),
        cov_enu_rad2=covariance,
        sigma_rad=np.sqrt(np.trace(covariance, axis1=-2, axis2=-1)),
    )


def posture_jacobian(mount: Mount, postures: Measurements, free: tuple[str, ...]) -> FloatArray:
    """Return the derivative of modelled minus wanted normals by parameters (posture, xyz, free)."""
    row = postures.row.copy()
    row[:, 8] = 1.0
    p, k = stack_mounts([mount])
    index = np.array([list(PARAMETERS).index(name) for name in free], np.int64)
    scale = np.array([PARAMETERS[name] for name in free], np.float64)
    use = np.ones((1, len(postures)), np.bool_)
    count = postures.count.copy()
    jacobian: FloatArray = _kernels.jacobian_batch(p, k, count[None], row[None], use, index, scale)[0]
    return jacobian


def _check_convention(mount: Mount, measurements: Measurements) -> None:
    """Refuse a sun whose azimuth is evidently counted otherwise, and say how."""
    sunny = measurements.take((measurements.row[:, 3] == 0.0) & (measurements.row[:, 7] == 1.0))
    if not len(sunny):
        return
    before = float(np.nanmedian(normal_errors_rad(mount, sunny)))
    if not before > 0.15:
        return
    changes = {
        "is counted from south (add π)": (-1.0, -1.0),
        "runs counter-clockwise (change its sign)": (-1.0, 1.0),
        "is counted from south and counter-clockwise (π minus it)": (1.0, -1.0),
    }
    for text, (east, north) in changes.items():
        row = sunny.row.copy()
        row[:, 0] *= east
        row[:, 1] *= north
        changed = Measurements(count=sunny.count, row=row, unix_s=sunny.unix_s)
        if float(np.nanmedian(normal_errors_rad(mount, changed))) < 0.3 * before:
            raise InvalidInputError(f"the sun's azimuth evidently {text}; rfpose counts from north, clockwise")
    raise InvalidInputError(
        f"measured and nominal normals differ by {1e3 * before:.0f} mrad in the median: check that angles are "
        "radians, motor positions are in the mount's counts and positions are in the site frame"
    )
