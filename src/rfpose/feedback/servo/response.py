"""The servo in time: closed loops of law, drive and structure along a record, and what the motors did."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, as_float_array, read_only
from rfpose.errors import InvalidInputError
from rfpose.feedback.servo import _kernels
from rfpose.feedback.servo.law import PiLaw, Stepper
from rfpose.feedback.servo.margins import check_law, sampled_plant
from rfpose.feedback.structure import StructureMode

__all__ = ["MotorCounts", "Response", "run_loop"]


@dataclass(frozen=True, slots=True)
class MotorCounts:
    """What motors did over a record, a row each.

    Attributes
    ----------
    steps
        Smallest moves made, whatever the direction.
    starts
        Times that a motor began to move after rest.
    reversals
        Times that it moved the other way than before.
    duty
        Part of the intervals in motion.
    """

    steps: FloatArray
    starts: FloatArray
    reversals: FloatArray
    duty: FloatArray


@dataclass(frozen=True, slots=True)
class Response:
    """Closed loops along a record.

    Attributes
    ----------
    angle_rad : (loop, time)
        Of the mirror [rad].
    error_rad : (loop, time)
        Command minus angle [rad].
    speed_radps : (loop, time)
        Asked for by the law [rad/s].
    counts
        Of the motors; None without a drive.
    """

    angle_rad: FloatArray
    error_rad: FloatArray
    speed_radps: FloatArray
    counts: MotorCounts | None


def run_loop(
    law: PiLaw,
    structure: StructureMode | None,
    *,
    command_rad: npt.ArrayLike,
    disturbance_rad: npt.ArrayLike = 0.0,
    stepper: Stepper | None = None,
    interval_s: float = 1.0,
    latency_s: float = 0.0,
    force: bool = False,
) -> Response:
    """Run closed loops from rest.

    Parameters
    ----------
    law, structure
        Of all loops.
    command_rad : (loop, time)
        Where the mirror should be, one column an interval; NaN: no measurement of it [rad].
    disturbance_rad : (loop, time) or one number
        What the wind bends the mirror by [rad].
    stepper
        Drive between law and structure; None: a motor that turns at the speed asked for. With one, the latency is a
        whole number of intervals.
    force
        Run with gains that leave no margin.

    Raises
    ------
    InvalidInputError
        Gains without margin, or shapes that differ.
    """
    command = as_float_array("command_rad", command_rad, ("loop", "time"), finite=False)
    disturbance = as_float_array("disturbance_rad", disturbance_rad, ("...",))
    try:
        disturbance = np.broadcast_to(disturbance, command.shape).copy()
    except ValueError as error:
        raise InvalidInputError(
            f"`disturbance_rad` must fit `command_rad` {command.shape}, got {disturbance.shape}"
        ) from error
    check_law(law, structure, interval_s=interval_s, latency_s=latency_s, force=force)
    plant = sampled_plant(structure, interval_s=interval_s, latency_s=latency_s)
    drive = (stepper or Stepper()).numbers(interval_s)
    n_loop = len(command)
    out = np.empty((*command.shape, 2))
    state = np.zeros((n_loop, _kernels.N_STATE))
    count = np.zeros((n_loop, _kernels.N_COUNT))
    _kernels.loop_run(
        command.copy(),
        disturbance,
        plant.keep,
        plant.now,
        plant.before,
        plant.row,
        plant.delay,
        law.numbers(),
        drive,
        stepper is not None,
        float(interval_s),
        out,
        state,
        count,
    )
    angle = out[..., 0]
    return Response(
        angle_rad=read_only(angle),
        error_rad=read_only(command - angle),
        speed_radps=read_only(out[..., 1]),
        counts=_counts(count, command.shape[1]) if stepper else None,
    )


def _counts(count: FloatArray, n_interval: int) -> MotorCounts:
    """Name the columns of the kernels' counts."""
    return MotorCounts(
        steps=read_only(np.rint(count[..., _kernels.STEPS])),
        starts=read_only(count[..., _kernels.STARTS]),
        reversals=read_only(count[..., _kernels.REVERSALS]),
        duty=read_only(count[..., _kernels.BUSY] / max(n_interval, 1)),
    )
