"""Control of a whole field: orders from the centre, over simulated buses, to a mode and targets of every heliostat."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from rfpose import geometry
from rfpose.checks import FloatArray, as_float_array, as_positive, read_only
from rfpose.errors import InvalidInputError
from rfpose.feedback.fieldcontrol import packets
from rfpose.feedback.fieldcontrol.bus import BusSettings, Delivery, MessageStatus, poll
from rfpose.feedback.fieldcontrol.modes import COMMANDS, Event, Mode, follow, refusal
from rfpose.feedback.fieldcontrol.packets import MessageType

__all__ = ["FieldControl", "FieldSettings", "Orders", "Reply", "spiral_cells"]

BoolArray = npt.NDArray[np.bool_]
ModeArray = npt.NDArray[np.int8]

_NOTHING = -1
_EARTH_RAD_S = 2.0 * np.pi / 86400.0
_SAFETY = {Event.EMERGENCY: 3, Event.STOW: 2, Event.DEFOCUS: 1}
_ALLOWED_IN_ALARM = frozenset({Event.STOW, Event.EMERGENCY, Event.ZERO_COUNTS})
_FOLLOWS_AIM = (Mode.POINT, Mode.TRACK, Mode.CALIBRATE, Mode.SEARCH, Mode.DEFOCUS)
_TYPE_OF_COMMAND = {
    Event.STOW: MessageType.STOW,
    Event.APPROACH: MessageType.STATE_APPROACH,
    Event.POINT: MessageType.POINT,
    Event.TRACK: MessageType.STATE_TRACK,
    Event.CALIBRATE: MessageType.CALIBRATE,
    Event.SEARCH: MessageType.SEARCH,
    Event.DEFOCUS: MessageType.DEFOCUS,
    Event.REFOCUS: MessageType.REFOCUS,
    Event.HOLD: MessageType.STATE_IDLE,
    Event.EMERGENCY: MessageType.STOW_ALL,
    Event.ZERO_COUNTS: MessageType.ZERO_COUNTS,
}
_COMMAND_OF_TYPE = {kind: event for event, kind in _TYPE_OF_COMMAND.items()}


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
    wind_stow_m_s
        Wind at which the field is stowed [m/s].
    wind_release_m_s, wind_release_s
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
    defocus_offset_m: float = 15.0
    calibration_places: int = 1
    search_step_m: float = 1.0
    search_dwell_s: float = 5.0
    search_cells: int = 81
    wind_stow_m_s: float = 10.0
    wind_release_m_s: float = 8.0
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
        if self.wind_release_m_s > self.wind_stow_m_s:
            raise InvalidInputError(
                f"`wind_release_m_s` must not exceed `wind_stow_m_s`, got {self.wind_release_m_s} and "
                f"{self.wind_stow_m_s} m/s"
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
        `Event` that the heliostat itself refused since the step before; −1: none.
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


def spiral_cells(n: int) -> npt.NDArray[np.int64]:
    """Return the cells of an outward square spiral (cell, right-up), the middle first [1]_.

    References
    ----------
    .. [1] Malan, A heliostat field control system, Appendix E.2.
    """
    cells = np.zeros((n, 2), np.int64)
    heading, here, run, left, turns = np.array([1, 0]), np.zeros(2, np.int64), 1, 1, 0
    for i in range(1, n):
        here = here + heading
        cells[i] = here
        left -= 1
        if left == 0:
            heading = np.array([-heading[1], heading[0]])
            turns += 1
            run += turns % 2 == 0
            left = run
    return cells


class FieldControl:
    """The three tiers of a field: the centre's orders, the clusters' buses and the heliostats' modes.

    Parameters
    ----------
    aim_enu_m : (heliostat, xyz) or (xyz)
        Aim points on the receiver, site ENU [m].
    pivot_enu_m : (heliostat, xyz)
        Where the heliostats stand [m]; neighbours in this order share a bus.
    calibration_enu_m : (xyz)
        Centre of the calibration target [m]; None: calibration and search are refused.
    settings, bus
        Behaviour of the field and of its buses.
    mode
        Mode at the start, one or (heliostat,).
    start_s
        Time at the start [s].
    rng
        Source of the buses' faults.

    Raises
    ------
    InvalidInputError
        No heliostats, or arrays that do not fit each other.
    """

    def __init__(
        self,
        *,
        aim_enu_m: npt.ArrayLike,
        pivot_enu_m: npt.ArrayLike,
        calibration_enu_m: npt.ArrayLike | None = None,
        settings: FieldSettings | None = None,
        bus: BusSettings | None = None,
        mode: Mode | npt.ArrayLike = Mode.STOW,
        start_s: float = 0.0,
        rng: np.random.Generator,
    ) -> None:
        pivot = as_float_array("pivot_enu_m", pivot_enu_m, ("heliostat", 3))
        n = len(pivot)
        if n == 0:
            raise InvalidInputError("`pivot_enu_m` must hold at least one heliostat")
        aim = as_float_array("aim_enu_m", aim_enu_m, ("...", 3))
        if aim.shape not in ((3,), (n, 3)):
            raise InvalidInputError(f"`aim_enu_m` must have shape (3,) or ({n}, 3), got {aim.shape}")
        self.settings = settings or FieldSettings()
        self.bus = bus or BusSettings()
        self.n_heliostat = n
        self._aim = np.array(np.broadcast_to(aim, (n, 3)))
        self._calibration = (
            None if calibration_enu_m is None else as_float_array("calibration_enu_m", calibration_enu_m, (3,))
        )
        self._right = _level_right(self._aim - pivot)
        self._cells = spiral_cells(self.settings.search_cells)
        self.cluster = read_only(np.arange(n) // self.bus.cluster_size)
        self._slot = np.arange(n) % self.bus.cluster_size
        self._rng = rng
        self._alarms: dict[str, float] = {}
        modes = np.asarray(mode)
        if not np.isin(modes, list(Mode)).all():
            raise InvalidInputError(f"`mode` must be one of {[m.name for m in Mode]}, got {mode!r:.60}")
        self._start(np.array(np.broadcast_to(modes.astype(np.int8), (n,))), float(start_s))

    def _start(self, mode: ModeArray, start_s: float) -> None:
        """Set the state of a field that starts now."""
        n = self.n_heliostat
        self._time_s = start_s
        self._next_round_s = start_s
        self._wind_known_s = start_s
        self._wind_calm_s = start_s
        self._mode = mode
        self._since_s = np.full(n, start_s)
        self._heard_s = np.full(n, start_s)
        self._hold = np.full((n, 2), np.nan)
        self._axis = np.full((n, 2), np.nan)
        self._stored = np.full((n, 2), np.nan)
        self._sun = np.full((n, 3), np.nan)
        self._sun_s = np.full(n, -np.inf)
        self._open_loop = np.zeros(n, np.bool_)
        self._cell = np.zeros(n, np.int64)
        self._pending = np.full(n, _NOTHING, np.int8)
        self._pending_s = np.full(n, np.inf)
        self._done = np.zeros(n, np.bool_)
        self._urgent_s = np.full(n, np.inf)
        self._reported = mode.copy()
        self._reported_axis = np.full((n, 2), np.nan)
        self._reported_s = np.full(n, -np.inf)
        self._alive = np.ones(int(self.cluster[-1]) + 1, np.bool_)
        self._refused = np.full(n, _NOTHING, np.int8)
        self._before = mode.copy()
        self._round_sun = np.full(3, np.nan)
        self._round_sun_s = start_s
        self._arrival = np.full((3, n), np.inf)
        self._fate = np.zeros((2, n), np.int8)

    # what the centre orders

    def command(self, command: Event, heliostats: npt.ArrayLike | None = None) -> Reply:
        """Order something; it is on its way from now on and repeated until acknowledged.

        Parameters
        ----------
        command
            One of `COMMANDS`.
        heliostats : (k,)
            Indices or a mask (heliostat,); None: all.

        Returns
        -------
        Reply
            Who is not ordered, and why: the mode last reported does not allow it, an alarm is on, another order is
            on its way that this one contradicts, or the calibration target is taken. An order towards safety
            (defocus, stow, emergency, in this order) replaces another.
        """
        if command not in COMMANDS:
            raise InvalidInputError(f"`command` must be one of {[c.name for c in COMMANDS]}, got {command!r}")
        index = self._indices(heliostats)
        accepted = np.zeros(self.n_heliostat, np.bool_)
        reasons: dict[int, str] = {}
        reason = self._centre_refuses(command)
        if reason is not None:
            return Reply(accepted=accepted, reasons=dict.fromkeys(index.tolist(), reason))
        by_mode = [refusal(mode, command) for mode in Mode]
        room = self._calibration_room() if command == Event.CALIBRATE else self.n_heliostat
        for i in index.tolist():
            why = by_mode[self._reported[i]] or self._contradicts(command, i)
            if why is None and command == Event.CALIBRATE and not self._at_calibration(i):
                why = None if room > 0 else f"{command.name} refused: the calibration target is taken"
                room -= 1
            if why is None:
                accepted[i] = True
            else:
                reasons[i] = why
        self._send(command, accepted, urgent=command == Event.EMERGENCY)
        return Reply(accepted=accepted, reasons=reasons)

    def emergency(self, why: str = "emergency") -> None:
        """Defocus and stow the whole field by urgent orders; keeps until `release`."""
        self._raise_alarm(why, Event.EMERGENCY)

    def release(self) -> None:
        """End every alarm that was raised by hand; heliostats stay as they are until ordered."""
        self._alarms = {name: since for name, since in self._alarms.items() if name in _BY_ITSELF}

    # what happens to the hardware

    def fail_cluster(self, cluster: int) -> None:
        """Let a cluster's controller die at once; its heliostats hear nothing more."""
        self._check_cluster(cluster)
        self._alive[cluster] = False
        self._arrival[:, self.cluster == cluster] = np.inf
        self._urgent_s[self.cluster == cluster] = np.inf

    def repair_cluster(self, cluster: int) -> None:
        """Let a cluster's controller work again."""
        self._check_cluster(cluster)
        self._alive[cluster] = True

    def power_off(self, heliostats: npt.ArrayLike | None = None) -> None:
        """Take the power; step counts are stored while a buffer lasts, and what was ordered is forgotten."""
        index = self._indices(heliostats)
        self._stored[index] = self._axis[index]
        self._apply(index, Event.POWER_OFF, self._time_s)
        self._pending[index], self._urgent_s[index] = _NOTHING, np.inf
        self._arrival[:, index] = np.inf

    def power_on(self, heliostats: npt.ArrayLike | None = None, *, counts_kept: bool = True) -> None:
        """Give the power back; without their step counts heliostats do not move until homed and zeroed."""
        index = self._indices(heliostats)
        self._heard_s[index] = self._time_s
        if not counts_kept:
            self._stored[index] = np.nan
        good = np.isfinite(self._stored[index]).all(axis=1)
        self._apply(index[good], Event.POWER_ON, self._time_s)
        self._apply(index[~good], Event.COUNTS_LOST, self._time_s)

    # what is known

    @property
    def mode(self) -> ModeArray:
        """`Mode` of each heliostat as it is (heliostat,)."""
        return self._mode.copy()

    @property
    def reported_mode(self) -> ModeArray:
        """`Mode` of each heliostat as the centre knows it (heliostat,)."""
        return self._reported.copy()

    @property
    def reported_axis_rad(self) -> FloatArray:
        """Axis angles as last reported, in sixteen-bit counts (heliostat, axis) [rad]; NaN: never."""
        return self._reported_axis.copy()

    @property
    def report_age_s(self) -> FloatArray:
        """Time since each heliostat's last report (heliostat,) [s]."""
        return self._time_s - self._reported_s

    @property
    def stored_axis_rad(self) -> FloatArray:
        """Axis angles by the step counts stored at the last loss of power (heliostat, axis) [rad]; NaN: none."""
        return self._stored.copy()

    @property
    def waiting(self) -> BoolArray:
        """Whether an order is on its way that is not acknowledged (heliostat,)."""
        return np.asarray(self._pending != _NOTHING)

    @property
    def alarms(self) -> tuple[str, ...]:
        """What keeps the centre from other orders than stow."""
        return tuple(self._alarms)

    # time goes on

    def step(
        self,
        time_s: float,
        *,
        axis_rad: npt.ArrayLike,
        aim_axis_rad: npt.ArrayLike,
        sun_enu: npt.ArrayLike,
        wind_m_s: float = 0.0,
        feedback_valid: npt.ArrayLike = True,
        found: npt.ArrayLike = False,
    ) -> Orders:
        """Let time pass: deliver messages, follow events, return what every heliostat wants.

        Parameters
        ----------
        time_s
            Time of this step, not before that of the last [s].
        axis_rad : (heliostat, axis)
            Azimuth and elevation by the heliostats' own step counts [rad].
        aim_axis_rad : (heliostat, axis)
            Axis angles that send the sun to the last ``aim_enu_m``, or to the receiver [rad]; used on approach.
            NaN: cannot be reached.
        sun_enu : (xyz)
            Direction towards the sun.
        wind_m_s
            Wind at the field [m/s]; NaN: unknown.
        feedback_valid : (heliostat,) or one
            Whether normals are measured now; where not, track becomes point and back.
        found : (heliostat,) or one
            Whether the beam was seen on the calibration target in this step.

        Raises
        ------
        InvalidInputError
            Wrong shapes, time going back, negative wind.
        """
        n = self.n_heliostat
        if not time_s >= self._time_s:
            raise InvalidInputError(f"`time_s` must not go back, got {time_s} after {self._time_s}")
        axis = as_float_array("axis_rad", axis_rad, (n, 2), finite=False)
        aim_axis = as_float_array("aim_axis_rad", aim_axis_rad, (n, 2), finite=False)
        sun = as_float_array("sun_enu", sun_enu, (3,))
        self._time_s = float(time_s)
        self._axis[:] = axis
        np.copyto(self._hold, axis, where=np.isnan(self._hold))
        self._refused[:] = _NOTHING
        self._watch_wind(wind_m_s)
        self._watch_sun(sun)
        self._communicate(sun)
        self._watchdog()
        self._local_events(aim_axis, np.broadcast_to(feedback_valid, (n,)), np.broadcast_to(found, (n,)))
        return self._orders(aim_axis)

    def _orders(self, aim_axis: FloatArray) -> Orders:
        target, unreachable = self._targets(aim_axis)
        changed = self._mode != self._before
        self._before[:] = self._mode
        return Orders(
            time_s=self._time_s,
            mode=self._mode.copy(),
            target_axis_rad=target,
            aim_enu_m=self._aims(),
            sun_enu=self._sun.copy(),
            sun_age_s=self._time_s - self._sun_s,
            changed=changed,
            refused=self._refused.copy(),
            unreachable=unreachable,
            alarms=self.alarms,
        )

    # state, to go on later

    def state(self) -> dict[str, npt.NDArray[Any]]:
        """Return all that changes, as arrays; `restore` takes it and goes on as if nothing had been."""
        out = {name: np.array(getattr(self, name)) for name in _STATE}
        text = json.dumps({"rng": self._rng.bit_generator.state, "alarms": self._alarms})
        out["_json"] = np.frombuffer(text.encode(), np.uint8).copy()
        return out

    def restore(self, state: Mapping[str, npt.NDArray[Any]]) -> None:
        """Take over what `state` gave.

        Raises
        ------
        InvalidInputError
            The state is of another field.
        """
        for name in _STATE:
            if name not in state or np.shape(state[name]) != np.shape(getattr(self, name)):
                raise InvalidInputError(f"`state` does not fit this field: {name} is missing or of another shape")
        for name in _STATE:
            value = np.array(state[name])
            setattr(self, name, value if value.ndim else float(value))
        rest = json.loads(bytes(state["_json"]).decode())
        self._rng.bit_generator.state = rest["rng"]
        self._alarms = rest["alarms"]

    # the centre

    def _indices(self, heliostats: npt.ArrayLike | None) -> npt.NDArray[np.int64]:
        if heliostats is None:
            return np.arange(self.n_heliostat)
        given = np.atleast_1d(np.asarray(heliostats))
        if given.dtype == np.bool_:
            if given.shape != (self.n_heliostat,):
                raise InvalidInputError(f"`heliostats` must be a mask of {self.n_heliostat}, got {given.shape}")
            return np.flatnonzero(given)
        if given.size and (given.dtype.kind not in "iu" or given.min() < 0 or given.max() >= self.n_heliostat):
            raise InvalidInputError(f"`heliostats` must be indices below {self.n_heliostat}, got {given!r:.60}")
        return np.unique(given.astype(np.int64))

    def _check_cluster(self, cluster: int) -> None:
        if not 0 <= cluster < len(self._alive):
            raise InvalidInputError(f"`cluster` must be 0 … {len(self._alive) - 1}, got {cluster}")

    def _centre_refuses(self, command: Event) -> str | None:
        if self._alarms and command not in _ALLOWED_IN_ALARM:
            name, since = next(iter(self._alarms.items()))
            return f"{command.name} refused: {name} since {since:g} s; only stow is possible"
        if command in (Event.CALIBRATE, Event.SEARCH) and self._calibration is None:
            return f"{command.name} refused: the field has no calibration target"
        return None

    def _contradicts(self, command: Event, i: int) -> str | None:
        other = int(self._pending[i])
        if other in (_NOTHING, command) or _SAFETY.get(command, 0) > _SAFETY.get(Event(other), 0):
            return None
        return f"{command.name} refused: contradicts {Event(other).name}, which is on its way"

    def _at_calibration(self, i: int) -> bool:
        return bool(self._pending[i] == Event.CALIBRATE or self._reported[i] in (Mode.CALIBRATE, Mode.SEARCH))

    def _calibration_room(self) -> int:
        taken = np.isin(self._reported, (Mode.CALIBRATE, Mode.SEARCH)) | (self._pending == Event.CALIBRATE)
        return self.settings.calibration_places - int(taken.sum())

    def _raise_alarm(self, name: str, command: Event) -> None:
        if name not in self._alarms:
            self._alarms[name] = self._time_s
            self._send(command, np.ones(self.n_heliostat, np.bool_), urgent=True)

    def _send(self, command: Event, to: BoolArray, *, urgent: bool) -> None:
        """Put an order on its way: the centre repeats it to each cluster until that has it."""
        fresh = to & (self._pending != command)
        if not fresh.any():
            return
        bus = self.bus
        fails = bus.lost + bus.corrupted * (1.0 - bus.lost)
        tries = self._rng.geometric(1.0 - fails, len(self._alive)) - 1
        at_cluster_s = self._time_s + bus.packet_s + bus.central_retry_s * tries
        self._pending[fresh] = command
        self._pending_s[fresh] = at_cluster_s[self.cluster[fresh]]
        self._done[fresh] = False
        self._urgent_s[fresh] = np.inf
        if urgent:
            # it waits for the end of the question in progress, then is sent to all, several times
            heard = self._rng.random((bus.urgent_repeats, self.n_heliostat)) >= fails
            first = np.where(heard.any(axis=0), heard.argmax(axis=0) + 1.0, np.inf)
            wait = bus.slot_s + first * (bus.packet_s + bus.gap_s)
            reachable = fresh & self._alive[self.cluster] & (self._mode != Mode.POWER_LOSS)
            self._urgent_s[reachable] = (at_cluster_s[self.cluster] + wait)[reachable]

    def _watch_wind(self, wind_m_s: float) -> None:
        if wind_m_s < 0.0:
            raise InvalidInputError(f"`wind_m_s` must not be negative, got {wind_m_s}")
        now, settings = self._time_s, self.settings
        if np.isfinite(wind_m_s):
            self._wind_known_s = now
            self._alarms.pop(_WIND_UNKNOWN, None)
        elif now - self._wind_known_s >= settings.wind_gap_s:
            self._raise_alarm(_WIND_UNKNOWN, Event.STOW)
        if not wind_m_s < settings.wind_release_m_s:
            self._wind_calm_s = now
        if wind_m_s >= settings.wind_stow_m_s:
            self._raise_alarm(_WIND, Event.STOW)
        elif now - self._wind_calm_s >= settings.wind_release_s:
            self._alarms.pop(_WIND, None)

    def _watch_sun(self, sun: FloatArray) -> None:
        if sun[2] < np.sin(self.settings.sun_lowest_rad) * np.linalg.norm(sun):
            self._raise_alarm(_NIGHT, Event.STOW)
        else:
            self._alarms.pop(_NIGHT, None)

    # the buses

    def _communicate(self, sun: FloatArray) -> None:
        while self._next_round_s <= self._time_s:
            self._deliver(self._next_round_s)
            self._begin_round(self._next_round_s, sun)
            self._next_round_s += self.bus.interval_s
        self._deliver(self._time_s)

    def _begin_round(self, start_s: float, sun: FloatArray) -> None:
        """Draw a round; what of the last one is still on its way is out of date and dropped."""
        round_: Delivery = poll(
            self.bus,
            start_s,
            slot=self._slot,
            master_alive=self._alive[self.cluster],
            listening=self._mode != Mode.POWER_LOSS,
            rng=self._rng,
        )
        self._arrival[0], self._arrival[1], self._arrival[2] = round_.sun_s, round_.question_s, round_.answer_s
        self._fate[0], self._fate[1] = round_.sun, round_.question
        azimuth, elevation = geometry.azimuth_elevation_from_enu(sun)
        said = packets.sun_from_payload(packets.sun_payload(float(azimuth), float(elevation)))
        self._round_sun = geometry.enu_from_azimuth_elevation(*said)
        self._round_sun_s = start_s

    def _deliver(self, until_s: float) -> None:
        """Let everything arrive that does until a time."""
        urgent = np.flatnonzero(self._urgent_s <= until_s)
        if urgent.size:
            self._heard_s[urgent] = self._urgent_s[urgent]
            self._urgent_s[urgent] = np.inf
            self._obey(urgent)
        for which, receive in enumerate((self._hear_sun, self._hear_question, self._hear_answer)):
            index = np.flatnonzero(self._arrival[which] <= until_s)
            if index.size:
                receive(index, self._arrival[which, index])
                self._arrival[which, index] = np.inf

    def _hear_sun(self, index: npt.NDArray[np.int64], at_s: FloatArray) -> None:
        good = self._fate[0, index] == MessageStatus.OK
        self._believe_sun(index[good], np.broadcast_to(self._round_sun, (int(good.sum()), 3)), at_s[good])
        if not good.all():
            self._hear_forged_sun(index[~good], at_s[~good])

    def _believe_sun(self, index: npt.NDArray[np.int64], sun: FloatArray, at_s: FloatArray) -> None:
        """Take sun angles over, unless they are far from fresh ones heard before."""
        self._heard_s[index] = at_s
        fresh = at_s - self._sun_s[index] <= self.settings.watchdog_intervals * self.bus.interval_s
        farthest = self.settings.sun_jump_rad + _EARTH_RAD_S * (at_s - self._sun_s[index])
        near = ((sun - self._sun[index]) ** 2).sum(axis=1) <= farthest**2
        ok = near | ~fresh
        self._sun[index[ok]], self._sun_s[index[ok]] = sun[ok], self._round_sun_s

    def _hear_forged_sun(self, index: npt.NDArray[np.int64], at_s: FloatArray) -> None:
        """Sun angles with wrong bits that the checksum missed: taken for what they say."""
        azimuth, elevation = geometry.azimuth_elevation_from_enu(self._round_sun)
        payload = np.frombuffer(packets.sun_payload(float(azimuth), float(elevation)), np.uint8)
        for i, raw, at in zip(
            index, self._forged(packets.BROADCAST, MessageType.SOLAR_ANGLES, payload, len(index)), at_s, strict=True
        ):
            if raw[0] == packets.BROADCAST and raw[4] == MessageType.SOLAR_ANGLES:
                said = packets.sun_from_payload(raw[5:11].tobytes())
                self._believe_sun(np.array([i]), geometry.enu_from_azimuth_elevation(*said)[None], np.array([at]))

    def _forged(
        self, receiver: int, kind: MessageType, payload: npt.NDArray[np.uint8], n: int
    ) -> npt.NDArray[np.uint8]:
        stamp = int(self._round_sun_s * 100.0) & 0xFFFF
        raw = packets.encode_many(np.full(n, receiver), packets.MASTER, stamp, kind, payload)
        return packets.forge(raw, self._rng)

    def _hear_question(self, index: npt.NDArray[np.int64], at_s: FloatArray) -> None:
        self._heard_s[index] = at_s
        good = self._fate[1, index] == MessageStatus.OK
        ordered = (self._pending[index] != _NOTHING) & (self._pending_s[index] <= at_s)
        self._obey(index[good & ordered])
        for i in index[~good]:
            self._hear_forged_question(int(i))

    def _hear_forged_question(self, i: int) -> None:
        """Do as a question with wrong bits says that the checksum missed, if it still is for this heliostat."""
        pending = int(self._pending[i])
        kind = MessageType.QUERY_STEP_COUNTS if pending == _NOTHING else _TYPE_OF_COMMAND[Event(pending)]
        address = int(self._slot[i]) + 1
        raw = self._forged(address, kind, np.zeros(6, np.uint8), 1)[0]
        if raw[0] == address and int(raw[4]) in _COMMAND_OF_TYPE:
            self._apply(np.array([i]), _COMMAND_OF_TYPE[MessageType(int(raw[4]))], self._time_s)

    def _hear_answer(self, index: npt.NDArray[np.int64], at_s: FloatArray) -> None:
        """Take a report over; an order that was obeyed or refused is done with."""
        self._reported[index] = self._mode[index]
        self._reported_axis[index] = packets.angles_from_counts(
            packets.counts_from_angles(np.nan_to_num(self._axis[index]))
        )
        self._reported_s[index] = at_s
        done = index[self._done[index]]
        self._pending[done] = _NOTHING
        self._done[done] = False

    # the heliostats

    def _obey(self, index: npt.NDArray[np.int64]) -> None:
        """Do what is ordered, once: the time stamp tells a repeated order."""
        index = index[(self._pending[index] != _NOTHING) & ~self._done[index]]
        self._done[index] = True
        for event in np.unique(self._pending[index]):
            self._apply(index[self._pending[index] == event], Event(event), self._time_s)

    def _apply(self, index: npt.NDArray[np.int64], event: Event, now_s: float) -> None:
        """Let one event happen to heliostats."""
        if index.size == 0:
            return
        before = self._mode[index]
        after, refused = follow(before, np.full(index.size, event, np.int8))
        self._refused[index[refused]] = event
        done = index[~refused]
        if event in (Event.POINT, Event.TRACK, Event.REFOCUS, Event.ARRIVED):
            self._open_loop[done] = event == Event.POINT
        changed = index[after != before]
        self._mode[changed] = after[after != before]
        self._since_s[changed] = now_s
        self._hold[changed] = self._axis[changed]
        self._cell[changed] = 0

    def _watchdog(self) -> None:
        silent = self._time_s - self._heard_s > self.settings.watchdog_intervals * self.bus.interval_s
        if silent.any():
            self._apply(np.flatnonzero(silent), Event.HEARTBEAT_LOST, self._time_s)

    def _local_events(self, aim_axis: FloatArray, feedback: BoolArray, found: BoolArray) -> None:
        now, settings, mode = self._time_s, self.settings, self._mode
        self._apply(np.flatnonzero((mode == Mode.TRACK) & ~feedback), Event.FEEDBACK_LOST, now)
        back = (mode == Mode.POINT) & feedback & ~self._open_loop
        self._apply(np.flatnonzero(back), Event.FEEDBACK_BACK, now)
        search = np.flatnonzero(mode == Mode.SEARCH)
        if search.size:
            self._search(search, found)
        for moving, goal in ((Mode.STOWING, np.array(settings.stow_axis_rad)), (Mode.APPROACH, aim_axis)):
            index = np.flatnonzero(mode == moving)
            if index.size:
                away = np.abs(self._axis[index] - (goal if goal.ndim == 1 else goal[index]))
                self._apply(index[(away <= settings.arrived_rad).all(axis=1)], Event.ARRIVED, now)
        index = np.flatnonzero(mode == Mode.EMERGENCY)
        if index.size:
            wait = settings.emergency_hold_s + settings.stow_stagger_s * self._slot[index]
            self._apply(index[now - self._since_s[index] >= wait], Event.HOLD_OVER, now)

    def _search(self, index: npt.NDArray[np.int64], found: BoolArray) -> None:
        settings = self.settings
        self._apply(index[found[index]], Event.FOUND, self._time_s)
        index = index[~found[index]]
        cell = ((self._time_s - self._since_s[index]) / settings.search_dwell_s).astype(np.int64)
        over = cell >= settings.search_cells
        self._apply(index[over], Event.NOT_FOUND, self._time_s)
        self._cell[index[~over]] = cell[~over]

    def _targets(self, aim_axis: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Where the axes shall go, in the safe order: azimuth first from stow, elevation first to stow."""
        settings, mode = self.settings, self._mode
        stow = np.array(settings.stow_axis_rad)
        target = self._hold.copy()
        target[np.isin(mode, _FOLLOWS_AIM)] = np.nan
        target[mode == Mode.STOW] = stow
        index = np.flatnonzero(mode == Mode.STOWING)
        if index.size:
            target[index, 1] = stow[1]
            level = np.abs(self._axis[index, 1] - stow[1]) <= settings.arrived_rad
            target[index[level], 0] = stow[0]
        index = np.flatnonzero(mode == Mode.EMERGENCY)
        if index.size:
            way = stow[1] - self._hold[index, 1]
            target[index, 1] += np.clip(way, -settings.emergency_drop_rad, settings.emergency_drop_rad)
        unreachable = np.zeros(self.n_heliostat, np.bool_)
        index = np.flatnonzero(mode == Mode.APPROACH)
        if index.size:
            unreachable[index] = ~np.isfinite(aim_axis[index]).all(axis=1)
            index = index[~unreachable[index]]
            target[index, 0] = aim_axis[index, 0]
            turned = np.abs(self._axis[index, 0] - aim_axis[index, 0]) <= settings.arrived_rad
            target[index[turned], 1] = aim_axis[index[turned], 1]
        return target, unreachable

    def _aims(self) -> FloatArray:
        """Where the beams shall go."""
        mode = self._mode
        aim = np.full((self.n_heliostat, 3), np.nan)
        on_receiver = np.isin(mode, (Mode.APPROACH, Mode.POINT, Mode.TRACK, Mode.DEFOCUS))
        aim[on_receiver] = self._aim[on_receiver]
        aside = mode == Mode.DEFOCUS
        aim[aside] += self.settings.defocus_offset_m * self._right[aside]
        if self._calibration is not None:
            index = np.flatnonzero((mode == Mode.CALIBRATE) | (mode == Mode.SEARCH))
            step = self._cells[self._cell[index]] * self.settings.search_step_m
            aim[index] = self._calibration + step[:, :1] * self._right[index]
            aim[index, 2] += step[:, 1]
        return aim


_WIND, _WIND_UNKNOWN, _NIGHT = "strong wind", "wind unknown", "sun below the horizon"
_BY_ITSELF = frozenset({_WIND, _WIND_UNKNOWN, _NIGHT})
_STATE = (
    "_time_s",
    "_next_round_s",
    "_wind_known_s",
    "_wind_calm_s",
    "_mode",
    "_since_s",
    "_heard_s",
    "_hold",
    "_axis",
    "_stored",
    "_sun",
    "_sun_s",
    "_open_loop",
    "_cell",
    "_pending",
    "_pending_s",
    "_done",
    "_urgent_s",
    "_reported",
    "_reported_axis",
    "_reported_s",
    "_alive",
    "_refused",
    "_before",
    "_round_sun",
    "_round_sun_s",
    "_arrival",
    "_fate",
)


def _level_right(way_m: FloatArray) -> FloatArray:
    """Level unit vectors to the right of lines of sight (heliostat, xyz); east below the target."""
    length = np.hypot(way_m[:, 0], way_m[:, 1])
    under = length < 1e-9
    safe = np.where(under, 1.0, length)
    right = np.stack([way_m[:, 1] / safe, -way_m[:, 0] / safe, np.zeros(len(way_m))], axis=1)
    right[under] = (1.0, 0.0, 0.0)
    return right
