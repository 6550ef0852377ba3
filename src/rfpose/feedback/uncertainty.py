"""What a fit leaves unknown: covariance of what the data determine, and the directions that they do not."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.feedback import _kernels
from rfpose.feedback.calibrated import LEAST_REDUNDANCY, FitSettings

__all__ = ["RAYLEIGH_MEDIAN", "FitBatch", "noise_with_assumed", "uncertainty"]

RAYLEIGH_MEDIAN = float(np.sqrt(2.0 * np.log(2.0)))


@dataclass(frozen=True, slots=True, kw_only=True)
class FitBatch:
    """What a batch of fits is about, as the kernels read it.

    Attributes
    ----------
    k : (heliostat, constant)
        Constants of the mounts.
    count : (heliostat, measurement, axis)
        Motor positions.
    row : (heliostat, measurement, 10)
        Sources, targets and sigmas.
    use : (heliostat, measurement)
        What takes part.
    index, scale : (free,)
        Free parameters and their usual size.
    prior_weight : (free,)
        One over the priors' variances; zero without.
    """

    k: FloatArray
    count: FloatArray
    row: FloatArray
    use: npt.NDArray[np.bool_]
    index: npt.NDArray[np.int64]
    scale: FloatArray
    prior_weight: FloatArray

    def blocks(self) -> Iterator[slice]:
        """Heliostats in blocks, to bound the memory of their Jacobians."""
        size = max(1, 4_000_000 // (self.row.shape[1] * 3 * len(self.index)))
        return (slice(i, i + size) for i in range(0, len(self.k), size))

    def residual(self, p: FloatArray, s: slice) -> FloatArray:
        """Residuals of a block in stated sigmas (heliostat, measurement, xyz)."""
        out: FloatArray = _kernels.residuals_batch(p[s], self.k[s], self.count[s], self.row[s], self.use[s])
        return out

    def jacobian(self, p: FloatArray, s: slice) -> FloatArray:
        """Their derivatives by the free parameters (heliostat, measurement, xyz, free)."""
        out: FloatArray = _kernels.jacobian_batch(
            p[s], self.k[s], self.count[s], self.row[s], self.use[s], self.index, self.scale
        )
        # zero where nothing takes part; beyond an actuator's reach there is no number
        finite = np.isfinite(out)
        if not finite.all():
            out[~finite] = 0.0
        return out

    def scatter(self, p: FloatArray) -> FloatArray:
        """Sigma of the residuals by their median, in stated sigmas (heliostat,); zero without measurements."""
        norm = np.linalg.norm(self.residual(p, slice(None)), axis=-1)
        # numpy's own median goes row by row where some are left out
        known = self.use & ~np.isnan(norm)
        ordered, n, row = np.sort(np.where(known, norm, np.inf), axis=1), known.sum(axis=1), np.arange(len(norm))
        median = 0.5 * (ordered[row, np.maximum(n - 1, 0) // 2] + ordered[row, np.minimum(n // 2, norm.shape[1] - 1)])
        return np.where(n > 0, median, 0.0) / RAYLEIGH_MEDIAN

    def carried(self, p: FloatArray, noise: FloatArray) -> FloatArray:
        """Parameters that the data carry, priors left out (heliostat,): the trace of their share of the information."""
        parts = []
        for s in self.blocks():
            jacobian = self.jacobian(p, s).reshape(-1, self.row.shape[1] * 3, len(self.index))
            data = np.swapaxes(jacobian, 1, 2) @ jacobian
            # in units of the noise; without priors it does not matter
            prior = self.prior_weight * np.maximum(np.nan_to_num(noise[s, None]), 1e-9) ** 2
            length = np.sqrt(np.einsum("hff->hf", data) + prior)
            safe = np.where(length > 0.0, length, 1.0)
            data /= safe[:, :, None] * safe[:, None, :]
            both = data + np.einsum("hf,fg->hfg", prior / safe**2, np.eye(len(self.index)))
            parts.append(np.einsum("hfg,hgf->h", data, np.linalg.pinv(both, rcond=1e-10, hermitian=True)))
        return np.concatenate(parts)


def noise_with_assumed(scatter: FloatArray, use: npt.NDArray[np.bool_], redundancy: FloatArray) -> FloatArray:
    """Return the noise in stated sigmas: the residuals', freed of what the parameters took up.

    What the redundancy lacks of `LEAST_REDUNDANCY` components is made up by the stated sigma itself.
    """
    components = 2.0 * use.sum(axis=1)
    missing = np.clip(LEAST_REDUNDANCY - redundancy, 0.0, LEAST_REDUNDANCY)
    return np.asarray(np.sqrt((missing + components * scatter**2) / np.maximum(redundancy, LEAST_REDUNDANCY)))


def uncertainty(
    problem: FitBatch, p: FloatArray, noise: FloatArray, redundancy: FloatArray, settings: FitSettings
) -> tuple[FloatArray, FloatArray, npt.NDArray[np.int64], FloatArray, FloatArray]:
    """Covariance, projection onto what is undetermined, rank, condition, lengths."""
    parts = []
    for s in problem.blocks():
        norm = np.linalg.norm(problem.residual(p, s), axis=-1)
        efficiency = _efficiency(norm / noise[s, None], problem.use[s], redundancy[s], settings)
        spread = efficiency * np.maximum(noise[s], settings.least_noise) ** 2
        # an exact fit has no scatter of its own; keep clear of zero
        jacobian = problem.jacobian(p, s) / np.sqrt(np.maximum(spread, 1e-18))[:, None, None, None]
        n_free = len(problem.index)
        prior = np.broadcast_to(np.diag(np.sqrt(problem.prior_weight)), (len(jacobian), n_free, n_free))
        rows = np.concatenate([jacobian.reshape(len(jacobian), -1, n_free), prior], axis=1)
        parts.append(_subspaces(rows, settings.rank_tolerance))
    covariance, ambiguity, rank, condition, length = (np.concatenate(items) for items in zip(*parts, strict=True))
    return covariance, ambiguity, rank, condition, length


def _efficiency(
    norm: FloatArray, use: npt.NDArray[np.bool_], redundancy: FloatArray, settings: FitSettings
) -> FloatArray:
    """Variance of Huber's estimate over that of least squares on the same Jacobian, both for sigma one.

    Mean square of the loss's slope over the squared mean of its curvature, in two dimensions: expected for Gaussian
    noise where sigma is known or assumed, else of the residuals themselves, freed of what the parameters took up.
    """
    cut = settings.huber
    tail = float(np.exp(-0.5 * cut**2))
    linear = 0.5 * cut * np.sqrt(0.5 * np.pi) * math.erfc(cut / np.sqrt(2.0)) if np.isfinite(cut) else 0.0
    expected = np.full(len(norm), (1.0 - tail) / (1.0 - tail + linear) ** 2)
    if settings.sigma_known:
        return expected
    n = np.maximum(use.sum(axis=1), 1)
    with np.errstate(divide="ignore", invalid="ignore"):  # a heliostat with too few measurements
        curvature = np.where(norm <= cut, 1.0, 0.5 * cut / norm)
        slope = 0.5 * np.sum(np.where(use, np.minimum(norm, cut) ** 2, 0.0), axis=1) / n
        own = slope / (np.sum(np.where(use, curvature, 0.0), axis=1) / n) ** 2
    own = np.nan_to_num(own) * 2.0 * n / np.maximum(redundancy, LEAST_REDUNDANCY)
    missing = np.clip(1.0 - redundancy / LEAST_REDUNDANCY, 0.0, 1.0)
    return np.asarray(missing * expected + own)


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
