"""What a fit leaves unknown: covariance of what the data determine, and the directions that they do not."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.special import erfc

from rfpose.checks import FloatArray
from rfpose.feedback import _kernels
from rfpose.feedback.calibrated import FitSettings

__all__ = ["uncertainty"]


def uncertainty(
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
