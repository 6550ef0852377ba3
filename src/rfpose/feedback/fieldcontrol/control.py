"""The highest tier: one controller for the whole field, which orders, watches wind and sun, and raises alarms."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, as_float_array, read_only
from rfpose.errors import InvalidInputError
from rfpose.feedback.fieldcontrol.bus import BusSettings, MessageStatus
from rfpose.feedback.fieldcontrol.local import NOTHING, Heliostats
from rfpose.feedback.fieldcontrol.modes import COMMANDS, Mode, ModeEvent, refusal
from rfpose.feedback.fieldcontrol.records import BoolArray, FieldSettings, Messages, ModeArray, Orders, Reply
from rfpose.feedback.fieldcontrol.wire import Wire
from rfpose.feedback.servo.rules import EARTH_RADPS

__all__ = ["ControlledField", "FieldSettings", "Messages", "Orders", "Reply"]

_SAFETY = {ModeEvent.EMERGENCY: 3, ModeEvent.STOW: 2, ModeEvent.DEFOCUS: 1}
_ALLOWED_IN_ALARM = frozenset({ModeEvent.STOW, ModeEvent.EMERGENCY, ModeEvent.ZERO_COUNTS})
_WIND, _WIND_UNKNOWN, _NIGHT = "strong wind", "wind unknown", "sun below the horizon"
_CENTRE_SILENT = "centre silent"
_BY_ITSELF = frozenset({_WIND, _WIND_UNKNOWN, _NIGHT, _CENTRE_SILENT})
_SUN_MARGIN_RAD = 1e-4
_COUNTED = tuple(f"{what}_{status.name.lower()}" for what in ("sun", "question", "answer") for status in MessageStatus)


class ControlledField:
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
        modes = np.asarray(mode)
        if modes.shape not in ((), (n,)) or not np.isin(modes, list(Mode)).all():
            raise InvalidInputError(f"`mode` must be one `Mode`, or one for each of {n} heliostats, got {mode!r:.60}")
        calibration = (
            None if calibration_enu_m is None else as_float_array("calibration_enu_m", calibration_enu_m, (3,))
        )
        aim = np.array(np.broadcast_to(aim, (n, 3)))
        self.settings = settings or FieldSettings()
        self.bus = bus or BusSettings()
        self.n_heliostat = n
        self._has_calibration = calibration is not None
        self._lowest_sine = float(np.sin(self.settings.sun_lowest_rad))
        self._heliostats = Heliostats(
            aim_enu_m=aim,
            right_enu=_level_right(aim - pivot),
            calibration_enu_m=calibration,
            slot=np.arange(n) % self.bus.cluster_size,
            settings=self.settings,
            mode=np.array(np.broadcast_to(modes.astype(np.int8), (n,))),
            start_s=start_s,
        )
        self._wire = Wire(self._heliostats, bus=self.bus, settings=self.settings, start_s=start_s, rng=rng)
        self._alarms: dict[str, float] = {}
        self._time_s = float(start_s)
        self._wind_known_s = self._time_s
        self._wind_calm_s = self._time_s
        self._centre_lost_s: float | None = None

    # what the centre orders

    def command(self, command: ModeEvent, heliostats: npt.ArrayLike | None = None) -> Reply:
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
        why_all = self._centre_refuses(command)
        if why_all is not None:
            return Reply(accepted=accepted, reasons=dict.fromkeys(index.tolist(), why_all))
        by_mode = [refusal(mode, command) for mode in Mode]
        room = self.settings.calibration_places - int(self._at_calibration().sum())
        new_there = (command == ModeEvent.CALIBRATE) & ~self._at_calibration()
        for i in index.tolist():
            why = by_mode[self._wire.reported_mode[i]] or self._contradicts(command, i)
            if why is None and new_there[i]:
                why = None if room > 0 else f"{command.name} refused: the calibration target is taken"
                room -= 1
            if why is None:
                accepted[i] = True
            else:
                reasons[i] = why
        self._wire.send(command, accepted, self._time_s, urgent=command == ModeEvent.EMERGENCY)
        return Reply(accepted=accepted, reasons=reasons)

    def emergency(self, why: str = "emergency") -> None:
        """Defocus and stow the whole field by urgent orders; keeps until `release`."""
        self._check_centre()
        if why in _BY_ITSELF:
            raise InvalidInputError(f"`why` must not be one of {sorted(_BY_ITSELF)}, which come and go by themselves")
        self._raise_alarm(why, ModeEvent.EMERGENCY)

    def release(self) -> None:
        """End every alarm that was raised by hand; heliostats stay as they are until ordered."""
        self._alarms = {name: since for name, since in self._alarms.items() if name in _BY_ITSELF}

    # what happens to the hardware

    def fail_centre(self) -> None:
        """Let the centre die: no orders, nobody watches wind and sun; clusters go on, then help themselves."""
        self._centre_lost_s = self._time_s if self._centre_lost_s is None else self._centre_lost_s

    def repair_centre(self) -> None:
        """Let the centre work again."""
        self._centre_lost_s = None
        self._alarms.pop(_CENTRE_SILENT, None)

    def fail_cluster(self, cluster: int) -> None:
        """Let a cluster's controller die at once; its heliostats hear nothing more."""
        self._check_cluster(cluster)
        self._wire.fail(cluster)

    def repair_cluster(self, cluster: int) -> None:
        """Let a cluster's controller work again."""
        self._check_cluster(cluster)
        self._wire.alive[cluster] = True

    def power_off(self, heliostats: npt.ArrayLike | None = None, *, axis_rad: npt.ArrayLike | None = None) -> None:
        """Take the power; step counts are stored while a buffer lasts, and orders on the wire are not heard.

        ``axis_rad`` (heliostat, axis): where the axes are by now [rad]; None: as at the last step.
        """
        index = self._indices(heliostats)
        if axis_rad is not None:
            now = as_float_array("axis_rad", axis_rad, (self.n_heliostat, 2), finite=False)
            self._heliostats.axis_rad[index] = now[index]
        self._heliostats.stored_rad[index] = self._heliostats.axis_rad[index]
        self._heliostats.apply(index, ModeEvent.POWER_OFF, self._time_s)
        self._wire.silence(index)

    def power_on(self, heliostats: npt.ArrayLike | None = None, *, counts_kept: bool = True) -> None:
        """Give the power back; without their step counts heliostats do not move until homed and zeroed."""
        index = self._indices(heliostats)
        stored = self._heliostats.stored_rad
        self._heliostats.heard_s[index] = self._time_s
        if not counts_kept:
            stored[index] = np.nan
        good = np.isfinite(stored[index]).all(axis=1)
        self._heliostats.apply(index[good], ModeEvent.POWER_ON, self._time_s)
        self._heliostats.apply(index[~good], ModeEvent.COUNTS_LOST, self._time_s)

    # what is known

    @property
    def cluster(self) -> npt.NDArray[np.int64]:
        """Bus of each heliostat (heliostat,)."""
        return read_only(self._wire.cluster)

    @property
    def mode(self) -> ModeArray:
        """`Mode` of each heliostat as it is (heliostat,)."""
        return self._heliostats.mode.copy()

    @property
    def reported_mode(self) -> ModeArray:
        """`Mode` of each heliostat as the centre knows it (heliostat,)."""
        return self._wire.reported_mode.copy()

    @property
    def reported_axis_rad(self) -> FloatArray:
        """Axis angles as last reported, in sixteen-bit counts (heliostat, axis) [rad]; NaN: never."""
        return self._wire.reported_axis_rad.copy()

    @property
    def report_age_s(self) -> FloatArray:
        """Time since each heliostat's last report (heliostat,) [s]; infinite: never."""
        return np.asarray(self._time_s - self._wire.reported_s)

    @property
    def waiting(self) -> BoolArray:
        """Whether an order is on its way that is not acknowledged (heliostat,)."""
        return np.asarray(self._wire.pending != NOTHING)

    @property
    def centre_dead(self) -> bool:
        """Whether the centre orders nothing, until it is repaired."""
        return self._centre_lost_s is not None

    @property
    def alarms(self) -> tuple[str, ...]:
        """What keeps the centre from other orders than stow."""
        return tuple(self._alarms)

    @property
    def messages(self) -> Messages:
        """How many messages and orders there have been, and what became of them."""
        counts = dict(zip(_COUNTED, self._wire.n_fate.ravel().tolist(), strict=True))
        return Messages(
            **counts,
            orders_sent=self._wire.n_sent,
            orders_refused=self._heliostats.n_refused,
            watchdog_emergencies=self._heliostats.n_watchdog,
        )

    # time goes on

    def step(
        self,
        time_s: float,
        *,
        axis_rad: npt.ArrayLike,
        aim_axis_rad: npt.ArrayLike,
        sun_enu: npt.ArrayLike,
        wind_mps: float = 0.0,
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
        wind_mps
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
        if wind_mps < 0.0:
            raise InvalidInputError(f"`wind_mps` must not be negative, got {wind_mps}")
        axis = as_float_array("axis_rad", axis_rad, (n, 2), finite=False)
        aim_axis = as_float_array("aim_axis_rad", aim_axis_rad, (n, 2), finite=False)
        sun = as_float_array("sun_enu", sun_enu, (3,))
        feedback = _flags(feedback_valid, n)
        seen = _flags(found, n)
        self._time_s = float(time_s)
        self._heliostats.count_steps(axis)
        if self._centre_lost_s is None:
            self._watch_wind(wind_mps)
            self._watch_sun(sun)
        elif self._time_s - self._centre_lost_s >= self.settings.centre_silence_s:
            self._raise_alarm(_CENTRE_SILENT, ModeEvent.EMERGENCY)
        self._wire.communicate(self._time_s, sun)
        self._heliostats.watchdog(self._time_s, self._wire.watchdog_s)
        self._heliostats.notice(self._time_s, aim_axis, feedback, seen)
        return self._orders(aim_axis)

    def quiet_until(self, time_s: float) -> float:
        """Return up to when nothing happens, so that one step may take the place of many.

        Stepping once, from the present time straight to any time up to the one returned, leaves the same `state`
        as stepping there through times between, random numbers included, but for ``wire.reported_axis_rad``: a
        report holds the axes of the step that took it up, so it differs where axes move, which those that follow
        their aim do. The orders of the last step stand meanwhile. Messages that arrive meanwhile are taken up in the
        step there: whoever steers by `Orders.sun_enu` steps once more within the interval, when the round is over, or
        steers by a sun that is one round older. This holds while, up to that time,

        - wind and feedback stay as given in the last step; feedback may change in the step there itself. Known wind may
          vary below ``wind_stow_mps`` while there is no wind alarm: only the time in the state when it was last above
          ``wind_release_mps`` differs then, which the next strong wind sets anew;
        - the sun moves no faster than the sky turns;
        - nobody calls `command`, `emergency`, `fail_cluster` or another method that changes something.

        Parameters
        ----------
        time_s
            Up to when the caller would go at once, not before the last step [s].

        Returns
        -------
        float
            ``time_s``, or the beginning of the next round of questions if that is before it [s]: the sun is
            read then. The present time: step as finely as events shall be seen. It is cautious: some of those times
            would have been quiet. Not quiet are fields

            - before the first step, and after a step in which a mode changed;
            - with heliostats on their way to stow or to an aim, searching, or in an emergency;
            - with an urgent order on the wire, a question to a heliostat for which an order waits, or a message with
              wrong bits that the checksum missed. An order that waits for the next round is quiet;
            - where a watchdog, the centre's silence, unknown wind or the end of a wind alarm would be due;
            - whose sun is so near to ``sun_lowest_rad`` that it may cross it.

        Raises
        ------
        InvalidInputError
            Time going back.
        """
        if not time_s >= self._time_s:
            raise InvalidInputError(f"`time_s` must not go back, got {time_s} after {self._time_s}")
        until_s = min(float(time_s), self._wire.next_round_s)
        quiet = (
            until_s > self._time_s
            and self._heliostats.rest(self._time_s, until_s, watchdog_s=self._wire.watchdog_s)
            and self._wire.rest(until_s)
            and self._centre_rests(until_s)
        )
        return until_s if quiet else self._time_s

    def _orders(self, aim_axis: FloatArray) -> Orders:
        local = self._heliostats
        target, unreachable = local.targets(aim_axis)
        changed = local.mode != local.before
        local.before[:] = local.mode
        return Orders(
            time_s=self._time_s,
            mode=local.mode.copy(),
            target_axis_rad=target,
            aim_enu_m=local.aims_enu_m(),
            sun_enu=local.sun_enu.copy(),
            sun_age_s=self._time_s - local.sun_s,
            changed=changed,
            refused=local.refused.copy(),
            unreachable=unreachable,
            alarms=self.alarms,
        )

    # state, to go on later

    def state(self) -> dict[str, npt.NDArray[Any]]:
        """Return all that changes, as arrays; `restore` takes it and goes on as if nothing had been."""
        out = {f"{part}.{name}": np.array(getattr(owner, name)) for part, owner, name in self._names()}
        text = json.dumps(
            {
                "alarms": self._alarms,
                "rng": self._wire.rng.bit_generator.state,
                "times_s": [self._time_s, self._wind_known_s, self._wind_calm_s, self._centre_lost_s],
            },
            default=lambda words: [int(word) for word in words],  # some generators keep their state in arrays
        )
        out["centre"] = np.frombuffer(text.encode(), np.uint8).copy()
        return out

    def restore(self, state: Mapping[str, npt.NDArray[Any]]) -> None:
        """Take over what `state` gave.

        Raises
        ------
        InvalidInputError
            The state is of another field.
        """
        for part, owner, name in self._names():
            key = f"{part}.{name}"
            if key not in state or np.shape(state[key]) != np.shape(getattr(owner, name)):
                raise InvalidInputError(f"`state` does not fit this field: {key} is missing or of another shape")
        for part, owner, name in self._names():
            value = np.array(state[f"{part}.{name}"])
            setattr(owner, name, value if value.ndim else value.item())
        centre = json.loads(bytes(state["centre"]).decode())
        self._alarms = centre["alarms"]
        self._wire.rng.bit_generator.state = _with_arrays(centre["rng"])
        self._time_s, self._wind_known_s, self._wind_calm_s, self._centre_lost_s = centre["times_s"]
        self._heliostats.forget_derived()

    def _names(self) -> list[tuple[str, object, str]]:
        return [
            (part, owner, name)
            for part, owner in (("heliostats", self._heliostats), ("wire", self._wire))
            for name in owner.STATE
        ]

    # how the centre decides

    def _indices(self, heliostats: npt.ArrayLike | None) -> npt.NDArray[np.int64]:
        if heliostats is None:
            return np.arange(self.n_heliostat)
        given = np.atleast_1d(np.asarray(heliostats))
        if given.dtype == np.bool_:
            if given.shape != (self.n_heliostat,):
                raise InvalidInputError(f"`heliostats` must be a mask of {self.n_heliostat}, got {given.shape}")
            return np.flatnonzero(given)
        if given.size and (given.dtype.kind not in "iu" or given.min() < 0 or given.max() >= self.n_heliostat):
            raise InvalidInputError(f"`heliostats` must be indices below {self.n_heliostat}, got {heliostats!r:.60}")
        return np.unique(given.astype(np.int64))

    def _check_cluster(self, cluster: int) -> None:
        if not 0 <= cluster < len(self._wire.alive):
            raise InvalidInputError(f"`cluster` must be 0 … {len(self._wire.alive) - 1}, got {cluster}")

    def _check_centre(self) -> None:
        if self._centre_lost_s is not None:
            raise InvalidInputError(
                f"the centre is dead since {self._centre_lost_s:g} s and orders nothing; repair_centre() first"
            )

    def _centre_refuses(self, command: ModeEvent) -> str | None:
        if self._centre_lost_s is not None:
            return f"{command.name} refused: the centre is dead since {self._centre_lost_s:g} s"
        if self._alarms and command not in _ALLOWED_IN_ALARM:
            name, since = next(iter(self._alarms.items()))
            return f"{command.name} refused: {name} since {since:g} s; only stow is possible"
        if command in (ModeEvent.CALIBRATE, ModeEvent.SEARCH) and not self._has_calibration:
            return f"{command.name} refused: the field has no calibration target"
        return None

    def _contradicts(self, command: ModeEvent, i: int) -> str | None:
        other = int(self._wire.pending[i])
        if other in (NOTHING, command) or _SAFETY.get(command, 0) > _SAFETY.get(ModeEvent(other), 0):
            return None
        return f"{command.name} refused: contradicts {ModeEvent(other).name}, which is on its way"

    def _at_calibration(self) -> BoolArray:
        """Whether heliostats are on the calibration target or sent there."""
        there = np.isin(self._wire.reported_mode, (Mode.CALIBRATE, Mode.SEARCH))
        return np.asarray(there | (self._wire.pending == ModeEvent.CALIBRATE))

    def _raise_alarm(self, name: str, command: ModeEvent) -> None:
        if name not in self._alarms:
            self._alarms[name] = self._time_s
            weaker = [_SAFETY.get(ModeEvent(p), 0) < _SAFETY[command] if p != NOTHING else True for p in range(-1, 11)]
            to = np.array(weaker)[self._wire.pending + 1]
            self._wire.send(command, to, self._time_s, urgent=True, from_centre=self._centre_lost_s is None)

    def _watch_wind(self, wind_mps: float) -> None:
        now, settings = self._time_s, self.settings
        if math.isfinite(wind_mps):
            self._wind_known_s = now
            self._alarms.pop(_WIND_UNKNOWN, None)
        elif now - self._wind_known_s >= settings.wind_gap_s:
            self._raise_alarm(_WIND_UNKNOWN, ModeEvent.STOW)
        if not wind_mps < settings.wind_release_mps:
            self._wind_calm_s = now
        if wind_mps >= settings.wind_stow_mps:
            self._raise_alarm(_WIND, ModeEvent.STOW)
        elif now - self._wind_calm_s >= settings.wind_release_s:
            self._alarms.pop(_WIND, None)

    def _watch_sun(self, sun_enu: FloatArray) -> None:
        if sun_enu[2] < self._lowest_sine * math.sqrt(sun_enu @ sun_enu):
            self._raise_alarm(_NIGHT, ModeEvent.STOW)
        else:
            self._alarms.pop(_NIGHT, None)

    def _centre_rests(self, until_s: float) -> bool:
        """Whether until a time none of the centre's clocks runs out and the sun does not cross its limit."""
        settings, alarms = self.settings, self._alarms
        if self._centre_lost_s is not None:
            return _CENTRE_SILENT in alarms or until_s - self._centre_lost_s < settings.centre_silence_s
        if max(self._wind_known_s, self._wind_calm_s) < self._time_s:
            return False  # repaired since the last step: it has seen neither wind nor sun yet
        if _WIND_UNKNOWN not in alarms and until_s - self._wind_known_s >= settings.wind_gap_s:
            return False
        if _WIND in alarms and until_s - self._wind_calm_s >= settings.wind_release_s:
            return False
        # the sun as last sent out, which has moved since and will: twice that way, and a packet's last digit
        above = self._wire.round_sun_enu[2] - self._lowest_sine
        margin = _SUN_MARGIN_RAD + 2.0 * EARTH_RADPS * (until_s - self._wire.round_s)
        return bool(abs(above) > margin)


def _flags(value: npt.ArrayLike, n: int) -> BoolArray:
    """Return one flag a heliostat."""
    flags = np.asarray(value, np.bool_)
    return flags if flags.shape == (n,) else np.broadcast_to(flags, (n,))


def _with_arrays(state: Any) -> Any:
    """Give a generator's state back the arrays that JSON made lists of."""
    if isinstance(state, dict):
        return {name: _with_arrays(value) for name, value in state.items()}
    return np.array(state, np.uint64) if isinstance(state, list) else state


def _level_right(way_m: FloatArray) -> FloatArray:
    """Level unit vectors to the right of lines of sight (heliostat, xyz); east below the target."""
    length = np.hypot(way_m[:, 0], way_m[:, 1])
    under = length < 1e-9
    safe = np.where(under, 1.0, length)
    right = np.stack([way_m[:, 1] / safe, -way_m[:, 0] / safe, np.zeros(len(way_m))], axis=1)
    right[under] = (1.0, 0.0, 0.0)
    return right
