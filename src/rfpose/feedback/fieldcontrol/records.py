"""What field control is told, what it answers, and what it wants: records of settings, replies and orders."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, as_float_array, as_positive
from rfpose.errors import InvalidInputError

__all__ = ["BoolArray", "FieldSettings", "Messages", "ModeArray", "Orders", "Reply"]

BoolArray = npt.NDArray[np.bool_]
ModeArray = npt.NDArray[np.int8]


@dataclass(frozen=True, slots=True, kw_only=True)
class FieldSettings:
    """What heliostats and centre do by themselves.

    Attributes
    ----------
    stow_axis_rad
        Azimuth and elevation of the park position [rad]; zero is Malan's, the normal level and towards north.
    arrived_rad
        A movement is over when both axes are this close to their goal [rad].
    emergency_drop_rad
        How far elevation goes towards the park position to take the beam off the receiver [rad].
    emergency_hold_s
        From then to the way to stow [s].
    stow_stagger_s
        Heliostats of a bus go to stow this much after each other, so that not all motors start at once [s].
    watchdog_intervals
        Control intervals without a message after which a heliostat defocuses by itself.
    centre_silence_s
        Time without the centre after which clusters defocus and stow their heliostats by themselves [s].
    defocus_offset_m
        Sideways from the aim point, level [m].
    calibration_places
        How many heliostats may be on the calibration target at a time.
    search_step_m
        Cell of the spiral search, half the target's side [m].
    search_dwell_s
        Time at each cell [s].
    search_cells
        Cells after which the search gives up.
    wind_stow_mps
        Wind at which the field is stowed [m/s].
    wind_release_mps, wind_release_s
        The wind alarm ends when the wind stayed below this for so long.
    wind_gap_s
        Unknown wind for so long counts as strong [s].
    sun_lowest_rad
        Elevation of the sun below which the field is stowed [rad].
    sun_jump_rad
        Sun angles that are this much further from the last ones heard than the sun can have moved are not believed,
        unless those are older than the watchdog's time [rad].

    Raises
    ------
    InvalidInputError
        A value that is not positive where it must be.
    """

    stow_axis_rad: tuple[float, float] = (0.0, 0.0)
    arrived_rad: float = 2e-3
    emergency_drop_rad: float = 0.15
    emergency_hold_s: float = 30.0
    stow_stagger_s: float = 0.5
    watchdog_intervals: float = 3.0
    centre_silence_s: float = 30.0
    defocus_offset_m: float = 15.0
    calibration_places: int = 1
    search_step_m: float = 1.0
    search_dwell_s: float = 5.0
    search_cells: int = 81
    wind_stow_mps: float = 10.0
    wind_release_mps: float = 8.0
    wind_release_s: float = 600.0
    wind_gap_s: float = 60.0
    sun_lowest_rad: float = 0.0
    sun_jump_rad: float = 5e-3

    def __post_init__(self) -> None:
        for name in self.__slots__:
            value = getattr(self, name)
            if name == "stow_axis_rad":
                as_float_array(name, value, (2,))
            elif name in ("emergency_hold_s", "stow_stagger_s"):
                if not value >= 0.0:
                    raise InvalidInputError(f"`{name}` must not be negative, got {value}")
            elif name != "sun_lowest_rad":
                as_positive(name, value)
        if self.wind_release_mps > self.wind_stow_mps:
            raise InvalidInputError(
                f"`wind_release_mps` must not exceed `wind_stow_mps`, got {self.wind_release_mps} and "
                f"{self.wind_stow_mps} m/s"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class Reply:
    """What the centre says to a command.

    Attributes
    ----------
    accepted : (heliostat,)
        Whether the command goes out to that heliostat; False too for those not named.
    reasons
        Why it does not, by heliostat.
    """

    accepted: BoolArray
    reasons: Mapping[int, str]


@dataclass(frozen=True, slots=True, kw_only=True)
class Orders:
    """What every heliostat's local controller wants at one time.

    Attributes
    ----------
    time_s
        The time asked for [s].
    mode : (heliostat,)
        `Mode`.
    target_axis_rad : (heliostat, axis)
        Where the axes shall go at full speed, order of axes included [rad]; NaN where the heliostat follows its aim
        point and the caller's own controller steers.
    aim_enu_m : (heliostat, xyz)
        Where the beam shall go [m]: receiver, beside it, calibration target, cell of a search; NaN where it does not
        matter.
    sun_enu : (heliostat, xyz)
        Direction of the sun as last heard, to the thousandth of a degree that a packet carries; NaN: never.
    sun_age_s : (heliostat,)
        Since then [s].
    changed : (heliostat,)
        Mode is not that of the step before.
    refused : (heliostat,)
        `ModeEvent` that the heliostat itself refused since the step before; −1: none.
    unreachable : (heliostat,)
        Approaches an aim that its axes cannot reach, and waits.
    alarms
        What keeps the centre from other orders than stow, in words.
    """

    time_s: float
    mode: ModeArray
    target_axis_rad: FloatArray
    aim_enu_m: FloatArray
    sun_enu: FloatArray
    sun_age_s: FloatArray
    changed: BoolArray
    refused: ModeArray
    unreachable: BoolArray
    alarms: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Messages:
    """How many messages the whole field's buses have carried since the start, and what became of them.

    Attributes
    ----------
    sun_ok, sun_lost, sun_corrupted, sun_undetected, sun_late, sun_silent
        Sun's angles by `MessageStatus`, one a heliostat and round, as drawn when the round began; one that is still on
        its way at the next round, or when its heliostat loses power, stays counted. Only answers are called late.
    question_ok, question_lost, question_corrupted, question_undetected, question_late, question_silent
        Questions, likewise.
    answer_ok, answer_lost, answer_corrupted, answer_undetected, answer_late, answer_silent
        Answers, likewise.
    orders_sent
        Orders to single heliostats that were put on their way, by commands and by alarms; not their repetitions.
    orders_refused
        Those that a heliostat refused, forged ones included.
    watchdog_emergencies
        How often a heliostat went to `Mode.EMERGENCY` by itself, since it heard nothing.
    """

    sun_ok: int
    sun_lost: int
    sun_corrupted: int
    sun_undetected: int
    sun_late: int
    sun_silent: int
    question_ok: int
    question_lost: int
    question_corrupted: int
    question_undetected: int
    question_late: int
    question_silent: int
    answer_ok: int
    answer_lost: int
    answer_corrupted: int
    answer_undetected: int
    answer_late: int
    answer_silent: int
    orders_sent: int
    orders_refused: int
    watchdog_emergencies: int

    def as_dict(self) -> dict[str, int]:
        """Return all counts by name."""
        return asdict(self)
