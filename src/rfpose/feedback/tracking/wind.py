"""What the wind does to mirrors: a steady part, and gusts about it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.errors import ScenarioError
from rfpose.feedback.innovation import one_kick
from rfpose.feedback.structure import StructureMode, swing_transition
from rfpose.feedback.tracking.timeline import Day
from rfpose.feedback.wind.gusts import gust_process
from rfpose.feedback.wind.record import WindRecord, read_wind_csv
from rfpose.feedback.wind.spectrum import wind_deflection
from rfpose.scenario import Scenario
from rfpose.scenario.tracking import Tracking

__all__ = ["Gusts", "structure_of"]

_BLOCK = 50
"""Mirrors drawn at a time: their random numbers, several a second, stay in the processor's cache."""


def structure_of(scenario: Scenario) -> StructureMode | None:
    """Return what lies between drive and mirror; None: nothing that swings."""
    mode = scenario.tracking.structure
    return StructureMode(natural_hz=mode.natural_hz, damping=mode.damping) if mode.natural_hz > 0.0 else None


class Gusts:
    """Gusts about a steady wind, one series a mirror, and the deflection that they cause.

    What is slower than the structure's mode bends it as if it were stiff (5.20); what excites the mode lets it swing
    with the variance of (5.19).

    Attributes
    ----------
    mean_mps
        Steady wind; of a record the root of its mean square [m/s].
    bend : (2,)
        Deflection in a steady wind of 1 m/s, right and up [rad/(m/s)²].
    swings
        Whether the structure has a mode.
    swing_sigma_rad : (2,)
        Standard deviation of its swing by wind, right and up [rad].
    transition : (2, 2)
        See `rfpose.feedback.structure.swing_transition`.
    kick : (2,)
        What a random number of variance one adds to its deflection and speed, so that the deflection has that
        swing's statistics; see `rfpose.feedback.innovation.one_kick`.

    References
    ----------
    .. [1] Edwards, Arrays of paraboloidal collectors, (5.14)-(5.24).
    """

    def __init__(self, scenario: Scenario) -> None:
        plan = scenario.tracking
        self.mean_mps = plan.wind.mean_speed_mps
        self._record: WindRecord | None = None
        if plan.wind.record is not None:
            self._record = read_wind_csv(plan.wind.record, interval_s=plan.servo_interval_s)
            self.mean_mps = float(np.sqrt(np.nanmean(self._record.speed_mps**2)))
        self.bend = 1e-3 * np.array(plan.wind.deflection_mrad_per_mps2)
        self.process = gust_process(
            self.mean_mps, interval_s=plan.servo_interval_s, size_m=float(np.sqrt(plan.mirror_area_m2))
        )
        mode = structure_of(scenario)
        self.swings = mode is not None
        self.swing_sigma_rad: FloatArray = np.zeros(2)
        self.transition, self.kick = np.zeros((2, 2)), np.zeros(2)
        if mode is not None:
            self._structure(plan, mode)

    def _structure(self, plan: Tracking, mode: StructureMode) -> None:
        self.transition, root = swing_transition(mode, interval_s=plan.servo_interval_s)
        self.kick = one_kick(self.transition, root @ root.T, np.array([1.0, 0.0]))
        if self.mean_mps > 0.0:
            size_m = float(np.sqrt(plan.mirror_area_m2))
            resonant = wind_deflection(1.0, self.mean_mps, mode, size_m=size_m)[1]
            self.swing_sigma_rad = np.sqrt(float(resonant)) * self.bend

    @property
    def variance_rad2(self) -> float:
        """Mean variance of the deflection, right and up, the steady part left out [rad²]."""
        sigma = self.process.sigma_mps if self._record is None else float(np.std(self._recorded()))
        slow = (2.0 * self.mean_mps * sigma * self.bend) ** 2
        return float(np.mean(slow + self.swing_sigma_rad**2))

    def draw(self, rng: np.random.Generator, shape: tuple[int, ...]) -> FloatArray:
        """Return gusts that know nothing of each other [m/s]."""
        if self._record is not None:
            return np.asarray(rng.choice(self._recorded(), shape))
        return np.asarray(self.process.sigma_mps * rng.standard_normal(shape))

    def _recorded(self) -> FloatArray:
        """Return the record's known samples as gusts about the mean, so that V² + 2 V u is the square of the speed."""
        assert self._record is not None
        speed = self._record.speed_mps[np.isfinite(self._record.speed_mps)]
        return np.asarray((speed**2 - self.mean_mps**2) / (2.0 * max(self.mean_mps, 1e-9)))

    def check_covers(self, days: Sequence[Day]) -> None:
        """Refuse a record that ends before the field does.

        Raises
        ------
        ScenarioError
            It does not reach over all days.
        """
        if self._record is None:
            return
        first, last = self._record.unix_s[[0, -1]]
        for day in days:
            if not (first <= day.unix_s[0] and day.unix_s[-1] <= last):
                raise ScenarioError(
                    f"[tracking.wind] `record` does not reach over {day.date}: give a longer one, another `date`, or "
                    "`first_hour` and `last_hour` within it"
                )

    @property
    def recorded(self) -> bool:
        """Whether the wind is that of a record."""
        return self._record is not None

    def draw_swing(self, rng: np.random.Generator, shape: tuple[int, ...]) -> npt.NDArray[np.float32]:
        """Return what excites the swing of mirrors (*shape, 2), of variance one; of a stiff structure nothing."""
        return rng.standard_normal((*shape, 2) if self.swings else (*shape[:-1], 0, 2), dtype=np.float32)

    def swing_rad(self, rng: np.random.Generator, shape: tuple[int, ...]) -> FloatArray:
        """Return swings that know nothing of each other, right and up (*shape, 2) [rad]."""
        if not self.swings:
            return np.zeros((*shape, 2))
        return np.asarray(self.swing_sigma_rad * rng.standard_normal((*shape, 2)))

    def speed_mps(self, gust_mps: FloatArray) -> FloatArray:
        """Return the wind's speed with gusts as `run` gives them [m/s]."""
        if self._record is None:
            return np.maximum(self.mean_mps + gust_mps, 0.0)
        return np.sqrt(np.maximum(self.mean_mps**2 + 2.0 * self.mean_mps * gust_mps, 0.0))

    def known(self, unix_s: FloatArray) -> npt.NDArray[np.bool_]:
        """Return whether the wind is known at times (time,): not in gaps of a record."""
        if self._record is None:
            return np.ones(len(unix_s), np.bool_)
        nearest = np.interp(unix_s, self._record.unix_s, np.arange(len(self._record.unix_s)))
        return np.asarray(np.isfinite(self._record.speed_mps[np.rint(nearest).astype(np.int64)]))

    def bend_rad(self, gust_mps: FloatArray) -> FloatArray:
        """Return the deflection of normals, right and up (…, 2) [rad]."""
        return np.asarray((self.mean_mps**2 + 2.0 * self.mean_mps * gust_mps)[..., None] * self.bend)

    def run(self, state: FloatArray, rng: np.random.Generator, unix_s: FloatArray) -> npt.NDArray[np.float32]:
        """Go on from a state of the process, in place; gusts (mirror, step) [m/s].

        With a record all mirrors feel the same wind; in its gaps it is steady.
        """
        n_step = len(unix_s)
        out = np.empty((len(state), n_step), np.float32)
        if self._record is not None:
            known = np.isfinite(self._record.speed_mps)
            gust = np.zeros(len(known))
            gust[known] = self._recorded()
            out[:] = np.interp(unix_s, self._record.unix_s, gust)
            return out
        for first in range(0, len(state), _BLOCK):
            block = slice(first, first + _BLOCK)
            out[block] = self.process.run(state[block], rng, n_step)
        return out
