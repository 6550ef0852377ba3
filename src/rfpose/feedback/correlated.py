"""Fit of a mount to normals whose errors go together: generalised least squares.

`calibration.fit` takes measurements as independent. Normals by radio are not: what reflections do to them is alike in
near postures, and a turn of the receivers against the plate is the same in all. Twenty such normals tell less than
twenty, and their covariance, which says how much less, is part of the measurement here.

References
----------
Aitken, On least squares and linear combination of observations, Proc. R. Soc. Edinburgh 55 (1936) 42.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rfpose import geometry
from rfpose.checks import FloatArray, as_float_array, read_only
from rfpose.errors import InvalidInputError
from rfpose.feedback.measurements import Measurements
from rfpose.feedback.mount import Mount
from rfpose.feedback.prediction import normal_differences, posture_jacobian

__all__ = ["AXES_AND_ZEROS", "CASES", "CorrelatedFit", "fit_correlated"]

AXES_AND_ZEROS = (
    "pedestal_tilt_north_rad", "pedestal_tilt_east_rad", "axis_1_zero_rad", "axis_2_zero_rad", "nonorthogonality_rad",
)  # fmt: skip
"""What two axes and their zeros are off by."""

CASES = ("before", "now", "one reference pose more")
"""Columns of `CorrelatedFit.normal_sigma_rad`; a reference pose is a normal that a camera measured to 0.1 mrad."""

_REFERENCE_RAD = 1e-4
_MODEL_RAD = 5e-5
"""No mount keeps to its model better; real ones keep to it by a few tenths of a milliradian."""
_STEPS = 8
_SETTLED = 1e-3
"""Of a prior sigma."""
_UNDETERMINED = 0.1
"""A direction of which normals say less than this part of what the prior says is not determined by them."""
_NAMED = 0.2
_LEAST_REDUNDANCY = 8
"""Fewer components left over say nothing of whether the stated covariance is true."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CorrelatedFit:
    """A mount found from normals whose errors go together.

    Attributes
    ----------
    mount
        With what was found.
    free
        Names of the parameters that were fitted.
    covariance : (free, free)
        Of them.
    rank
        How many directions of parameter space normals determine better than they were known.
    undetermined
        The others, in words.
    scatter
        Of residuals, in stated sigmas; NaN: fewer than eight are redundant. Above 1 it is in the covariance.
    normal_sigma_rad : (case,)
        How far the mount's normals are uncertain (both components, rms over the postures); cases are `CASES`.
    n_posture
        Postures that were used.
    """

    mount: Mount
    free: tuple[str, ...]
    covariance: FloatArray
    rank: int
    undetermined: tuple[str, ...]
    scatter: float
    normal_sigma_rad: FloatArray
    n_posture: int

    @property
    def sigma(self) -> FloatArray:
        """(free,) standard deviations."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


def fit_correlated(
    mount: Mount,
    count: npt.ArrayLike,
    normal_enu: npt.ArrayLike,
    cov_rad2: npt.ArrayLike,
    *,
    prior_sigma: Mapping[str, float],
) -> CorrelatedFit:
    """Fit a mount to normals with a joint covariance.

    Parameters
    ----------
    mount
        As planned: the start, and what the priors are about.
    count : (posture, axis)
        Motor positions; NaN: unknown, left out.
    normal_enu : (posture, xyz)
        Measured normals; NaN: none.
    cov_rad2 : (posture, xy, posture, xy)
        Of their components along x and y of a mirror whose x axis lies level [rad²].
    prior_sigma
        Free parameters, and how far each may be from the plan.

    Raises
    ------
    InvalidInputError
        Arrays that do not fit each other, no free parameter, or a covariance that is none.
    """
    normal = as_float_array("normal_enu", normal_enu, ("posture", 3), finite=False)
    n = len(normal)
    counts = as_float_array("count", count, (n, 2), finite=False)
    cov = as_float_array("cov_rad2", cov_rad2, (n, 2, n, 2), finite=False)
    free = tuple(prior_sigma)
    prior = np.array([prior_sigma[name] for name in free])
    if not free or not np.all(prior > 0.0):
        raise InvalidInputError("`prior_sigma` must name one parameter or more, each with a sigma above zero")
    own = np.einsum("papa->pa", cov)
    used = np.flatnonzero(np.isfinite(np.concatenate([counts, normal, own], axis=1)).all(axis=1))
    if not len(used):
        before = np.full(len(CASES), np.nan)
        return CorrelatedFit(
            mount=mount, free=free, covariance=read_only(np.diag(prior**2)), rank=0, undetermined=free,
            scatter=float("nan"), normal_sigma_rad=read_only(before), n_posture=0,
        )  # fmt: skip
    told = _Told(counts[used], normal[used], cov[used][:, :, used])
    planned = np.array([mount.parameters[name] for name in free])
    at = planned.copy()
    for _ in range(_STEPS):
        left, jacobian = told.linear(mount.replace(**dict(zip(free, at.tolist(), strict=True))), free)
        scaled = jacobian * prior
        step = np.linalg.solve(scaled.T @ scaled + np.eye(len(free)), scaled.T @ left - (at - planned) / prior)
        at = at + step * prior
        if np.all(np.abs(step) < _SETTLED):
            break
    found = mount.replace(**dict(zip(free, at.tolist(), strict=True)))
    left, jacobian = told.linear(found, free)
    information = (jacobian * prior).T @ (jacobian * prior)
    inverse = np.linalg.inv(information + np.eye(len(free)))
    redundancy = len(left) - float(np.trace(inverse @ information))
    scatter = float(np.sqrt(left @ left / redundancy)) if redundancy >= _LEAST_REDUNDANCY else float("nan")
    information /= np.fmax(scatter, 1.0) ** 2
    inverse = np.linalg.inv(information + np.eye(len(free)))
    rank, undetermined = _undetermined(information, free)
    covariance = inverse * prior * prior[:, None]
    return CorrelatedFit(
        mount=found, free=free, covariance=read_only(covariance), rank=rank, undetermined=undetermined,
        scatter=scatter, normal_sigma_rad=read_only(told.cases(found, free, covariance, prior)), n_posture=len(used),
    )  # fmt: skip


class _Told:
    """Normals that were measured, as residuals of a mount."""

    def __init__(self, count: FloatArray, normal_enu: FloatArray, cov_rad2: FloatArray) -> None:
        self._measured = Measurements.from_normals(count, normal_enu=normal_enu)
        self._across = geometry.rot_enu_from_mirror(self._measured.row[:, :3])[:, :, :2]
        n = 2 * len(count)
        try:
            self._lower = np.linalg.cholesky(cov_rad2.reshape(n, n) + _MODEL_RAD**2 * np.eye(n))
        except np.linalg.LinAlgError as error:
            raise InvalidInputError("`cov_rad2` must be a covariance, and it is not positive definite") from error

    def linear(self, mount: Mount, free: tuple[str, ...]) -> tuple[FloatArray, FloatArray]:
        """Return whitened residuals (component,) of a mount and the whitened model's slope (component, free)."""
        left = -np.einsum("pxa,px->pa", self._across, normal_differences(mount, self._measured))
        slope = self._slope(mount, free)
        whitened = np.linalg.solve(self._lower, np.column_stack([left.ravel(), slope.reshape(left.size, -1)]))
        return whitened[:, 0], whitened[:, 1:]

    def _slope(self, mount: Mount, free: tuple[str, ...]) -> FloatArray:
        """(posture, xy, free) of the mount's normals."""
        return np.asarray(np.einsum("pxa,pxf->paf", self._across, posture_jacobian(mount, self._measured, free)))

    def cases(self, mount: Mount, free: tuple[str, ...], covariance: FloatArray, prior: FloatArray) -> FloatArray:
        """Return how far the mount's normals are uncertain, by `CASES`."""
        slope = self._slope(mount, free)
        middle = int(np.argmax(self._measured.row[:, :3] @ self._measured.row[:, :3].mean(axis=0)))
        rows = slope[middle]
        gain = covariance @ rows.T @ np.linalg.inv(rows @ covariance @ rows.T + _REFERENCE_RAD**2 * np.eye(2))
        pointed = covariance - gain @ rows @ covariance
        return np.array(
            [
                np.sqrt(np.mean(np.einsum("paf,fg,pag->p", slope, cov, slope)))
                for cov in (np.diag(prior**2), covariance, pointed)
            ]
        )


def _undetermined(information: FloatArray, free: tuple[str, ...]) -> tuple[int, tuple[str, ...]]:
    """Return how many directions are determined, and in words those that are not."""
    value, vector = np.linalg.eigh(information)
    words = []
    for direction in vector[:, value < _UNDETERMINED].T:
        share = direction**2
        largest = [free[k] for k in np.argsort(-share) if share[k] > _NAMED]
        words.append(" with ".join(largest or [free[int(np.argmax(share))]]))
    return len(free) - len(words), tuple(words)
