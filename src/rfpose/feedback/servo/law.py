"""The PI law of a sampled servo and its stepper, as records a user can set, and one step of a whole field."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, as_float_array, as_positive, read_only
from rfpose.errors import InvalidInputError
from rfpose.feedback.servo import _kernels

__all__ = ["PiLaw", "ServoState", "Stepper", "servo_step"]


def _not_negative(name: str, value: float) -> None:
    if not (np.isfinite(value) and value >= 0.0):
        raise InvalidInputError(f"`{name}` must be finite and zero or greater, got {value}")


@dataclass(frozen=True, slots=True, kw_only=True)
class PiLaw:
    """Speed from a quantised error: K0 e + K1 ∫e dt while the error is within the sensor's range, else full speed [1]_.

    Attributes
    ----------
    gain_per_s
        K0 [rad/s per rad].
    integral_gain_per_s2
        K1 [rad/s² per rad].
    speed_radps
        Greatest speed asked for [rad/s].
    range_rad
        The error saturates at plus and minus this [rad].
    levels
        Levels over the whole range, an even number, so that no level sits at zero (an odd number leaves a dead
        zone); 0: not quantised.
    speed_step_radps
        Least change of the speed asked for [rad/s]; 0: none.
    dead_band_rad
        Errors smaller than this count as none [rad].

    Raises
    ------
    InvalidInputError
        A negative number, no gain at all, or an odd number of levels.

    References
    ----------
    .. [1] Edwards, Arrays of paraboloidal collectors, §6.3.
    """

    gain_per_s: float = 0.2
    integral_gain_per_s2: float = 0.01
    speed_radps: float = 1e-3
    range_rad: float = 5e-3
    levels: int = 32
    speed_step_radps: float = 0.0
    dead_band_rad: float = 0.0

    def __post_init__(self) -> None:
        as_positive("gain_per_s", self.gain_per_s)
        as_positive("speed_radps", self.speed_radps)
        as_positive("range_rad", self.range_rad)
        _not_negative("integral_gain_per_s2", self.integral_gain_per_s2)
        _not_negative("speed_step_radps", self.speed_step_radps)
        _not_negative("dead_band_rad", self.dead_band_rad)
        if self.levels < 0 or self.levels % 2:
            raise InvalidInputError(f"`levels` must be even (an odd number has a dead zone) or 0, got {self.levels}")

    @property
    def level_rad(self) -> float:
        """Width of one level [rad]; zero if not quantised."""
        return 2.0 * self.range_rad / self.levels if self.levels else 0.0

    def numbers(self) -> _kernels.LawNumbers:
        """Return what the kernels read."""
        return _kernels.LawNumbers(
            float(self.gain_per_s),
            float(self.integral_gain_per_s2),
            self.level_rad,
            self.levels / 2.0,
            float(self.speed_radps),
            float(self.speed_step_radps),
            float(self.dead_band_rad),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Stepper:
    """A stepper motor behind a gear.

    Attributes
    ----------
    steps_per_turn
        Smallest steps for one turn of the axis; 48 000 is Malan's, of 0.13 mrad.
    microsteps
        How many of these the motor always takes together: 8 is his full-step mode, of 1.05 mrad.
    speed_radps
        Greatest speed of the axis [rad/s].
    backlash_rad
        Whole width within which the axis lies loose [rad].
    stiction_rad
        How far the gear winds up before the axis breaks loose [rad].
    dead_band_rad
        The motor rests until it is further than this from where it should be [rad]; None: half a step.
    lead_rad
        Once it starts, it goes over the wanted place by this [rad]: step and wait, with the error centred on zero
        if the lead is as great as the dead band.

    Raises
    ------
    InvalidInputError
        A number that is negative or, where it must be positive, zero; a speed below one step a second.

    References
    ----------
    .. [1] Malan, A heliostat field control system, §5 (30:1 worm, 200 steps a turn, 1/8 microstepping).
    """

    steps_per_turn: float = 48_000.0
    microsteps: int = 1
    speed_radps: float = 10e-3
    backlash_rad: float = 0.0
    stiction_rad: float = 0.0
    dead_band_rad: float | None = None
    lead_rad: float = 0.0

    def __post_init__(self) -> None:
        as_positive("steps_per_turn", self.steps_per_turn)
        as_positive("microsteps", self.microsteps)
        as_positive("speed_radps", self.speed_radps)
        for name in ("backlash_rad", "stiction_rad", "lead_rad"):
            _not_negative(name, getattr(self, name))
        if self.dead_band_rad is not None:
            _not_negative("dead_band_rad", self.dead_band_rad)
            if self.lead_rad > self.dead_band_rad:
                raise InvalidInputError(
                    f"`lead_rad` must not exceed `dead_band_rad` (the motor would hunt), got {self.lead_rad} and "
                    f"{self.dead_band_rad}"
                )

    @property
    def step_rad(self) -> float:
        """Turn of the axis by one move of the motor [rad]."""
        return 2.0 * np.pi * self.microsteps / self.steps_per_turn

    def numbers(self, interval_s: float) -> _kernels.DriveNumbers:
        """Return what the kernels read, for this servo interval [s].

        Raises
        ------
        InvalidInputError
            The motor cannot make one step in an interval.
        """
        if self.speed_radps * as_positive("interval_s", interval_s) < self.step_rad * (1.0 - 1e-9):
            raise InvalidInputError(
                f"`speed_radps` {self.speed_radps:g} must allow one step of {self.step_rad:.3g} rad in an interval of "
                f"{interval_s:g} s"
            )
        dead_band = 0.5 * self.step_rad if self.dead_band_rad is None else self.dead_band_rad
        return _kernels.DriveNumbers(
            self.step_rad,
            float(self.speed_radps),
            0.5 * self.backlash_rad,
            float(self.stiction_rad),
            float(dead_band),
            float(self.lead_rad),
        )


@dataclass(frozen=True, slots=True)
class ServoState:
    """All axes of a field, updated in place by `servo_step`.

    Attributes
    ----------
    axes : (heliostat, axis, 6)
        Integral [rad/s], wanted motor angle, motor angle, axis angle, goal [rad], direction last moved in.
    counts : (heliostat, axis, 4)
        Motor steps, starts, reversals, intervals in motion.
    """

    axes: FloatArray
    counts: FloatArray

    @classmethod
    def at(cls, axis_rad: npt.ArrayLike, stepper: Stepper) -> ServoState:
        """Return resting axes (heliostat, axis) at the motor steps nearest to these angles [rad]."""
        angle = as_float_array("axis_rad", axis_rad, ("heliostat", "axis"))
        angle = np.rint(angle / stepper.step_rad) * stepper.step_rad
        axes = np.zeros((*angle.shape, _kernels.N_STATE))
        for name in (_kernels.WANTED, _kernels.MOTOR, _kernels.AXIS, _kernels.GOAL):
            axes[..., name] = angle
        return cls(axes=axes, counts=np.zeros((*angle.shape, _kernels.N_COUNT)))

    @property
    def axis_rad(self) -> FloatArray:
        """Axis angles behind the gear (heliostat, axis) [rad], read-only, of the moment."""
        return read_only(self.axes[..., _kernels.AXIS])

    @property
    def motor_rad(self) -> FloatArray:
        """Motor angles, as turns of the axis (heliostat, axis) [rad], read-only, of the moment."""
        return read_only(self.axes[..., _kernels.MOTOR])

    def copy(self) -> ServoState:
        """Return a state of its own."""
        return dataclasses.replace(self, axes=self.axes.copy(), counts=self.counts.copy())


def servo_step(
    command_rad: npt.ArrayLike,
    measured_rad: npt.ArrayLike,
    state: ServoState,
    *,
    law: PiLaw,
    stepper: Stepper,
    interval_s: float = 1.0,
    feed_radps: npt.ArrayLike = 0.0,
) -> FloatArray:
    """Take all axes of a field through one interval of the servo, in place of ``state``.

    Parameters
    ----------
    command_rad, measured_rad : (heliostat, axis)
        Where the axis should be and is measured to be [rad]; NaN: unknown, the axis goes on at the integral's speed.
    state
        Of all axes.
    law, stepper
        The same for all.
    interval_s
        Since the last step [s].
    feed_radps : (heliostat, axis) or one number
        Speed known beforehand, of the sun's path [rad/s].

    Returns
    -------
    (heliostat, axis)
        Axis angles at the end of the interval [rad].

    Raises
    ------
    InvalidInputError
        Shapes that differ from the state's, or an interval too short for one step.
    """
    shape = state.axes.shape[:2]
    command = as_float_array("command_rad", command_rad, shape, finite=False)
    measured = as_float_array("measured_rad", measured_rad, shape, finite=False)
    feed = np.ascontiguousarray(np.broadcast_to(as_float_array("feed_radps", feed_radps, ("...",)), shape))
    numbers = stepper.numbers(interval_s)
    _kernels.servo_field(
        command.ravel().copy(),  # kernels are compiled for arrays that can be written
        measured.ravel().copy(),
        feed.ravel().copy(),
        state.axes.reshape(-1, _kernels.N_STATE),
        state.counts.reshape(-1, _kernels.N_COUNT),
        law.numbers(),
        numbers,
        float(interval_s),
    )
    return state.axes[..., _kernels.AXIS].copy()
