"""How alike what nothing foresees is in two postures of a mirror.

What reaches a receiver off things that nobody foresaw changes with the posture, and slowly: its directions and the
plate behind the antenna turn by a few degrees, and hardly anything happens. Errors of near postures therefore go
together, and so many frames of one posture tell little more than one. How fast they part is seen in what poses leave of
the carriers, link by link: the product of two frames' residuals, over the angle between their normals.

References
----------
Journel and Huijbregts, Mining Geostatistics, Academic Press 1978, ch. III, for the exponential model with a nugget.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.multilat.site.fit import SitePoses

__all__ = ["PostureCorrelation", "found_correlation"]

_MOST_MIRRORS = 200
_MOST_FRAMES = 300
"""So many, spread over all, are looked at: pairs grow as the square."""
_ANGLES_RAD = np.radians(np.geomspace(0.25, 60.0, 60))


@dataclass(frozen=True, slots=True, kw_only=True)
class PostureCorrelation:
    """Correlation of a link's errors in two postures: ``share`` · exp(−angle between the normals / ``angle_rad``).

    Attributes
    ----------
    share
        Of the errors' variance, what turns with the posture; the rest is new in every frame. 0 to 1.
    angle_rad
        Over which that falls to 1/e [rad].
    """

    share: float
    angle_rad: float

    def between(self, normal_enu: FloatArray) -> FloatArray:
        """Return the correlation of postures (frame, frame); NaN where a normal is."""
        angle = _angles_rad(normal_enu)
        out = self.share * np.exp(-angle / self.angle_rad)
        np.fill_diagonal(out, 1.0)
        return np.asarray(out)

    def worth(self, normal_enu: FloatArray) -> FloatArray:
        """Return how many independent frames each frame is worth (frame,); 0 where its normal is NaN.

        Frames that are alike share: each counts one over the number of frames like it.
        """
        alike = np.nansum(self.between(normal_enu), axis=1)
        return np.where(np.isfinite(normal_enu[:, 0]), 1.0 / np.maximum(alike, 1.0), 0.0)


def found_correlation(poses: SitePoses, n_mirror: int) -> PostureCorrelation:
    """Find how residuals of mirrors' links go together over posture.

    Parameters
    ----------
    poses
        Of whole frames, mirrors fastest.
    n_mirror
        Mirrors of a frame.

    Returns
    -------
    PostureCorrelation
        With share 0 where no mirror has two frames.
    """
    left = poses.residual_rad / poses.sigma_rad * np.sqrt(poses.weight)
    left = left.reshape(len(left) // n_mirror, n_mirror, -1)
    normal = poses.normal_enu.reshape(len(left), n_mirror, 3)
    frames, mirrors = _spread(len(left), _MOST_FRAMES), _spread(n_mirror, _MOST_MIRRORS)
    upper = np.triu_indices(len(frames), 1)
    angle, product, weight = [], [], []
    for m in mirrors:
        one = left[frames, m]
        used = np.isfinite(one)
        one = np.where(used, one, 0.0)
        norm = np.sqrt((one**2 @ used.T) * (used @ (one**2).T))[upper]
        both = (used.astype(np.float64) @ used.T)[upper]
        told = (norm > 0.0) & (both > 0.0)
        angle.append(_angles_rad(normal[frames, m])[upper][told])
        product.append((one @ one.T)[upper][told] / norm[told])
        weight.append(both[told])
    return _fitted(np.concatenate(angle), np.concatenate(product), np.concatenate(weight))


def _fitted(angle: FloatArray, product: FloatArray, weight: FloatArray) -> PostureCorrelation:
    """Fit share and angle to products by least squares."""
    if not len(angle):
        return PostureCorrelation(share=0.0, angle_rad=float(_ANGLES_RAD[0]))
    best = (np.inf, 0.0, float(_ANGLES_RAD[0]))
    for scale in _ANGLES_RAD.tolist():
        falling = np.exp(-angle / scale)
        power = float(weight @ falling**2)
        share = float(np.clip(weight @ (falling * product) / power, 0.0, 1.0)) if power > 0.0 else 0.0
        cost = float(weight @ (product - share * falling) ** 2)
        if cost < best[0]:
            best = (cost, share, scale)
    return PostureCorrelation(share=best[1], angle_rad=best[2])


def _angles_rad(normal_enu: FloatArray) -> FloatArray:
    """(frame, frame) between unit normals [rad]."""
    chord = np.linalg.norm(normal_enu[:, None] - normal_enu[None], axis=2)
    return np.asarray(2.0 * np.arcsin(np.minimum(0.5 * chord, 1.0)))


def _spread(n: int, most: int) -> npt.NDArray[np.int64]:
    return np.unique(np.linspace(0, n - 1, min(n, most)).astype(np.int64))
