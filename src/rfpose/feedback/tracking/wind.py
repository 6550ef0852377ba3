"""Gusts and what they do to mirrors: Edwards' spectrum as a sum of first-order processes."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.feedback.tracking import _kernels
from rfpose.scenario import Scenario

__all__ = ["N_PROCESS", "Gusts"]

N_PROCESS = 3
_ROUGHNESS = 0.04


class Gusts:
    """Gusts about a steady wind, one series a mirror.

    References
    ----------
    .. [1] Edwards, Arrays of paraboloidal collectors, (5.14)-(5.24): S(f) f / (k' V²) = 4 b² / (1 + b²)^(4/3),
       b = 1200 f / V, k' = 0.04; the plate averages over gusts smaller than itself.
    """

    def __init__(self, scenario: Scenario) -> None:
        plan = scenario.tracking
        self.mean_mps = plan.wind.mean_speed_mps
        self.bend = 1e-3 * np.array(plan.wind.deflection_mrad_per_mps2)
        time_s, variance = _processes(self.mean_mps, np.sqrt(plan.mirror_area_m2))
        self._keep = np.exp(-plan.servo_interval_s / time_s)
        self._kick = np.sqrt(variance * (1.0 - self._keep**2))
        self._sigma = np.sqrt(variance)
        self.sigma_mps = float(np.sqrt(variance.sum()))

    @property
    def variance_rad2(self) -> float:
        """Mean variance of the deflection, right and up, the steady part left out [rad²]."""
        return float(np.mean((2.0 * self.mean_mps * self.sigma_mps * self.bend) ** 2))

    def begin(self, rng: np.random.Generator, n: int) -> FloatArray:
        """Return a state to start from (mirror, process)."""
        return np.asarray(self._sigma * rng.standard_normal((n, N_PROCESS)))

    def draw(self, rng: np.random.Generator, shape: tuple[int, ...]) -> FloatArray:
        """Return gusts that know nothing of each other [m/s]."""
        return np.asarray(self.sigma_mps * rng.standard_normal(shape))

    def bend_rad(self, gust_mps: FloatArray) -> FloatArray:
        """Return the deflection of normals, right and up (…, 2) [rad]."""
        return np.asarray((self.mean_mps**2 + 2.0 * self.mean_mps * gust_mps)[..., None] * self.bend)

    def run(self, state: FloatArray, rng: np.random.Generator, n_step: int) -> npt.NDArray[np.float32]:
        """Go on from a state, in place; gusts (mirror, step) [m/s]."""
        noise = rng.standard_normal((len(state), n_step, N_PROCESS), dtype=np.float32)
        out = np.empty((len(state), n_step), np.float32)
        _kernels.gusts(state, self._keep, self._kick, noise, out)
        return out


def _processes(mean_mps: float, size_m: float) -> tuple[FloatArray, FloatArray]:
    """Time constants [s] and variances [(m/s)²] whose sum is nearest to Edwards' spectrum."""
    from scipy.optimize import nnls

    speed = max(mean_mps, 0.1)
    frequency = np.geomspace(1e-3, 0.5, 200)
    b = 1200.0 * frequency / speed
    aerodynamic = (1.0 + (2.0 * frequency * size_m / speed) ** (4.0 / 3.0)) ** -2.0
    wanted = _ROUGHNESS * mean_mps**2 * 4.0 * b**2 / (1.0 + b**2) ** (4.0 / 3.0) * aerodynamic
    time_s = 1200.0 / (2.0 * np.pi * speed) * np.array([1.0, 0.22, 0.04])
    turns = 2.0 * np.pi * frequency[:, None] * time_s
    # f S(f) of a process of variance one
    each = 2.0 / np.pi * turns / (1.0 + turns**2)
    variance, _ = nnls(each, wanted)
    return time_s, variance
