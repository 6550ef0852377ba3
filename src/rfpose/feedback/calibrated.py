"""What a calibration is told and what it tells: sets of parameters, settings, results."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Protocol

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, as_positive
from rfpose.errors import InvalidInputError
from rfpose.feedback.measurements import Measurements
from rfpose.feedback.mount import Mount, check_names

__all__ = [
    "LEAST_REDUNDANCY",
    "PARAMETER_SETS",
    "CalibratedMount",
    "FieldCalibration",
    "FitSettings",
    "FitStatus",
    "KnownMount",
    "ParameterChoice",
    "RowStatus",
    "resolve_free",
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
    # what real ones need first beyond the four: canting about the mirror's upright
    "level-5": (*_LEVEL, *_ZEROS, "canting_right_rad"),
    "level-7": (*_LEVEL, *_ZEROS, "nonorthogonality_rad", *_STROKES),
    "level-8": (*_PEDESTAL, "pedestal_twist_rad", *_ZEROS, "nonorthogonality_rad", *_STROKES),
    "level-canting": (*_LEVEL, *_ZEROS, "nonorthogonality_rad", *_STROKES, "canting_right_rad"),
    "level-location": (*_LEVEL, *_ZEROS, "nonorthogonality_rad", *_STROKES, *_LOCATION, *_RADII),
    "level-full": (*_LEVEL, *_ZEROS, "nonorthogonality_rad", *_STROKES, "canting_right_rad", *_LOCATION),
}  # fmt: skip
"""Usual sets of free parameters. ``level-…`` are for an axis 1 that lies east-west, as PAINT's."""

LEAST_REDUNDANCY = 8.0
"""Components beyond what the parameters take up, from which on residuals alone tell the noise."""


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
        the noise is estimated from the residuals. What these lack of `LEAST_REDUNDANCY` components is made up by
        the stated sigma: a fit through every point says nothing of the noise.
    huber
        Residuals beyond this many sigma count linearly. One loses 11 % of the information if the noise is
        Gaussian, and is the better for it where the model's own errors dominate. Infinity: plain least squares.
    bounds
        Lowest and highest value by parameter.
    priors
        Mean and standard deviation by parameter.
    least_noise
        The noise is no less than this, in units of the stated sigma; what held-out measurements tell, where the
        residuals of the fit flatter it.
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
    least_noise: float = 0.0
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
        if not 0.0 <= self.least_noise < float("inf"):
            raise InvalidInputError(f"`least_noise` must be zero or greater and finite, got {self.least_noise}")
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
    carried : (heliostat,)
        Parameters that the data carry: the rank, less what priors tell.
    redundancy : (heliostat,)
        Measured components, two a measurement, less `carried`.
    noise : (heliostat,)
        Sigma of the residuals in units of the stated sigma: estimated, or one. Below `LEAST_REDUNDANCY` what is
        missing counts as one.
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
    carried: FloatArray
    redundancy: FloatArray
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
class ParameterChoice:
    """Which set of parameters was chosen for a heliostat, and why.

    Attributes
    ----------
    chosen
        Name of the set.
    free
        Its parameters.
    held_out_rad
        Mean error of the normal by set, each time-block predicted from the others, outliers capped [rad]; empty
        where there were too few measurements to hold any out.
    held_out_sigma
        Scatter of those errors under the chosen set, one component, in units of the stated sigma; zero where none
        were held out.
    reason
        The same in words.
    """

    chosen: str
    free: tuple[str, ...]
    held_out_rad: Mapping[str, float]
    held_out_sigma: float
    reason: str


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibratedMount:
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
    choice
        How its parameters were chosen; None where the caller named them.
    """

    mount: Mount
    measurements: Measurements
    field: FieldCalibration
    row_status: npt.NDArray[np.int8]
    error_rad: FloatArray
    settings: FitSettings
    choice: ParameterChoice | None = None

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
    def noise_assumed(self) -> bool:
        """Whether the noise rests on the stated sigma, for want of redundant measurements."""
        return not self.settings.sigma_known and bool(self.field.redundancy[0] < LEAST_REDUNDANCY)

    @property
    def used(self) -> npt.NDArray[np.bool_]:
        """Which measurements took part."""
        return np.asarray(self.row_status == RowStatus.USED)


class KnownMount(Protocol):
    """What is known of a mount: a `CalibratedMount`, or one read back from a file."""

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
    @property
    def noise_assumed(self) -> bool: ...  # noqa: D102
    @property
    def choice(self) -> ParameterChoice | None: ...  # noqa: D102


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
