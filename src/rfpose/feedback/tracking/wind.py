"""What the wind does to mirrors: a steady part, and gusts about it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.feedback.wind.gusts import gust_process
from rfpose.scenario import Scenario

__all__ = ["Gusts"]

_BLOCK = 2000
"""Mirrors drawn at a time, to bound the memory."""


class Gusts:
    """Gusts about a steady wind, one series a mirror, and the deflection that they cause.

    References
    ----------
    .. [1] Edwards, Arrays of paraboloidal collectors, (5.14)-(5.24).
    """

    def __init__(self, scenario: Scenario) -> None:
        plan = scenario.tracking
        self.mean_mps = plan.wind.mean_speed_mps
        self.bend = 1e-3 * np.array(plan.wind.deflection_mrad_per_mps2)
        self.process = gust_process(
            self.mean_mps, interval_s=plan.servo_interval_s, size_m=float(np.sqrt(plan.mirror_area_m2))
        )

    @property
    def variance_rad2(self) -> float:
        """Mean variance of the deflection, right and up, the steady part left out [rad²]."""
        return float(np.mean((2.0 * self.mean_mps * self.process.sigma_mps * self.bend) ** 2))

    def draw(self, rng: np.random.Generator, shape: tuple[int, ...]) -> FloatArray:
        """Return gusts that know nothing of each other [m/s]."""
        return np.asarray(self.process.sigma_mps * rng.standard_normal(shape))

    def bend_rad(self, gust_mps: FloatArray) -> FloatArray:
        """Return the deflection of normals, right and up (…, 2) [rad]."""
        return np.asarray((self.mean_mps**2 + 2.0 * self.mean_mps * gust_mps)[..., None] * self.bend)

    def run(self, state: FloatArray, rng: np.random.Generator, n_step: int) -> npt.NDArray[np.float32]:
        """Go on from a state of the process, in place; gusts (mirror, step) [m/s]."""
        out = np.empty((len(state), n_step), np.float32)
        for first in range(0, len(state), _BLOCK):
            block = slice(first, first + _BLOCK)
            out[block] = self.process.run(state[block], rng, n_step)
        return out
