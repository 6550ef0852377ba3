"""The lowest tier: what every heliostat's local controller knows, notices and does."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, read_only
from rfpose.feedback.fieldcontrol.modes import TABLE, Mode, ModeEvent, follow
from rfpose.feedback.fieldcontrol.records import BoolArray, FieldSettings, ModeArray
from rfpose.feedback.servo.rules import EARTH_RADPS

__all__ = ["NOTHING", "Heliostats", "spiral_cells"]

NOTHING = -1
"""Stands for no event."""


def _modes(*members: Mode) -> BoolArray:
    """Return a table that tells whether a mode is one of these."""
    table = np.zeros(len(Mode), np.bool_)
    table[list(members)] = True
    return table


_FOLLOWS_AIM = _modes(Mode.POINT, Mode.TRACK, Mode.CALIBRATE, Mode.SEARCH, Mode.DEFOCUS)
_ON_RECEIVER = _modes(Mode.APPROACH, Mode.POINT, Mode.TRACK, Mode.DEFOCUS)
_ON_CALIBRATION = _modes(Mode.CALIBRATE, Mode.SEARCH)
_UNDER_WAY = _modes(Mode.STOWING, Mode.APPROACH, Mode.SEARCH, Mode.EMERGENCY)
"""Modes that end by themselves."""
_GUARDED: BoolArray = TABLE[:, ModeEvent.HEARTBEAT_LOST] >= 0
"""Modes that silence ends."""


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


class Heliostats:
    """State of all local controllers, a row a heliostat; times in seconds, axis angles as counted.

    Parameters
    ----------
    aim_enu_m, right_enu : (heliostat, xyz)
        Aim points on the receiver [m], and level unit vectors to the right of the line of sight to them.
    calibration_enu_m : (xyz)
        Centre of the calibration target [m], or None.
    slot : (heliostat,)
        Place on the bus.
    settings
        Behaviour.
    mode : (heliostat,)
        Modes at the start.
    start_s
        Time at the start [s].
    """

    STATE = (
        "mode",
        "since_s",
        "heard_s",
        "hold_rad",
        "axis_rad",
        "stored_rad",
        "sun_enu",
        "sun_s",
        "open_loop",
        "cell",
        "refused",
        "before",
        "n_refused",
        "n_watchdog",
    )

    def __init__(
        self,
        *,
        aim_enu_m: FloatArray,
        right_enu: FloatArray,
        calibration_enu_m: FloatArray | None,
        slot: npt.NDArray[np.int64],
        settings: FieldSettings,
        mode: ModeArray,
        start_s: float,
    ) -> None:
        n = len(aim_enu_m)
        self.settings = settings
        self.slot = slot
        self._aim_enu_m = aim_enu_m
        self._right_enu = right_enu
        self._calibration_enu_m = calibration_enu_m
        self._cells = spiral_cells(settings.search_cells)
        self._stow_rad = np.array(settings.stow_axis_rad)
        self._aims: FloatArray | None = None
        self.mode = mode.copy()
        self.since_s = np.full(n, start_s)
        self.heard_s = np.full(n, start_s)
        self.hold_rad = np.full((n, 2), np.nan)
        self.axis_rad = np.full((n, 2), np.nan)
        self.stored_rad = np.full((n, 2), np.nan)
        self.sun_enu = np.full((n, 3), np.nan)
        self.sun_s = np.full(n, -np.inf)
        self.open_loop = np.zeros(n, np.bool_)
        self.cell = np.zeros(n, np.int64)
        self.refused = np.full(n, NOTHING, np.int8)
        self.before = mode.copy()
        self.n_refused = 0
        self.n_watchdog = 0

    def count_steps(self, axis_rad: FloatArray) -> None:
        """Take over where the axes are by now; forget what was refused before."""
        self.axis_rad[:] = axis_rad
        np.copyto(self.hold_rad, axis_rad, where=np.isnan(self.hold_rad))
        self.refused[:] = NOTHING

    def apply(self, index: npt.NDArray[np.int64], event: ModeEvent, now_s: float) -> int:
        """Let one event happen to heliostats; return how many modes it changed."""
        if index.size == 0:
            return 0
        before = self.mode[index]
        after, refused = follow(before, np.full(index.size, event, np.int8))
        self.refused[index[refused]] = event
        self.n_refused += int(refused.sum())
        if event in (ModeEvent.POINT, ModeEvent.TRACK, ModeEvent.REFOCUS, ModeEvent.ARRIVED):
            self.open_loop[index[~refused]] = event == ModeEvent.POINT
        other = after != before
        changed = index[other]
        self.mode[changed] = after[other]
        self.since_s[changed] = now_s
        self.hold_rad[changed] = self.axis_rad[changed]
        self.cell[changed] = 0
        self._aims = None
        return int(changed.size)

    def hear(self, index: npt.NDArray[np.int64], at_s: FloatArray) -> None:
        """Note when messages reached heliostats; the last counts, in whatever order they are taken up."""
        self.heard_s[index] = np.maximum(self.heard_s[index], at_s)

    def believe_sun(self, index: npt.NDArray[np.int64], sun_enu: FloatArray, said_s: float, *, fresh_s: float) -> None:
        """Take sun angles over, unless they are further from fresh ones than the sun moves."""
        age = said_s - self.sun_s[index]
        farthest = self.settings.sun_jump_rad + EARTH_RADPS * age
        east, north, up = (sun_enu - self.sun_enu.take(index, axis=0)).T
        step = np.sqrt(east * east + north * north + up * up)
        ok = (step <= farthest) | ~(age <= fresh_s)
        if not ok.all():
            index, sun_enu = index[ok], np.broadcast_to(sun_enu, (len(ok), 3))[ok]
        self.sun_enu[index] = sun_enu
        self.sun_s[index] = said_s

    def watchdog(self, now_s: float, limit_s: float) -> None:
        """Let heliostats that heard nothing for too long help themselves."""
        silent = now_s - self.heard_s > limit_s
        if silent.any():
            index = np.flatnonzero(silent & _GUARDED[self.mode])
            self.n_watchdog += self.apply(index, ModeEvent.HEARTBEAT_LOST, now_s)

    def rest(self, now_s: float, until_s: float, *, watchdog_s: float) -> bool:
        """Whether no mode changes until a time, if nothing is heard or seen that was not so before."""
        # what changed in the last step may go on in the next: feedback that is there makes a fresh POINT a TRACK
        if _UNDER_WAY[self.mode].any() or (self.since_s >= now_s).any():
            return False
        silent = until_s - self.heard_s > watchdog_s
        return not (silent.any() and (silent & _GUARDED[self.mode]).any())

    def notice(self, now_s: float, aim_axis_rad: FloatArray, feedback: BoolArray, found: BoolArray) -> None:
        """Let heliostats notice what they can see themselves."""
        settings, mode = self.settings, self.mode
        lost = (mode == int(Mode.TRACK)) & ~feedback
        if lost.any():
            self.apply(np.flatnonzero(lost), ModeEvent.FEEDBACK_LOST, now_s)
        back = (mode == int(Mode.POINT)) & feedback & ~self.open_loop
        if back.any():
            self.apply(np.flatnonzero(back), ModeEvent.FEEDBACK_BACK, now_s)
        if not _UNDER_WAY[mode].any():
            return
        index = np.flatnonzero(mode == Mode.SEARCH)
        if index.size:
            self._search(index, now_s, found)
        index = np.flatnonzero(mode == Mode.STOWING)
        self._arrive(index, self._stow_rad, now_s)
        index = np.flatnonzero(mode == Mode.APPROACH)
        self._arrive(index, aim_axis_rad[index], now_s)
        index = np.flatnonzero(mode == Mode.EMERGENCY)
        wait = settings.emergency_hold_s + settings.stow_stagger_s * self.slot[index]
        self.apply(index[now_s - self.since_s[index] >= wait], ModeEvent.HOLD_OVER, now_s)

    def _arrive(self, index: npt.NDArray[np.int64], goal_rad: FloatArray, now_s: float) -> None:
        there = (np.abs(self.axis_rad[index] - goal_rad) <= self.settings.arrived_rad).all(axis=1)
        self.apply(index[there], ModeEvent.ARRIVED, now_s)

    def _search(self, index: npt.NDArray[np.int64], now_s: float, found: BoolArray) -> None:
        settings = self.settings
        self.apply(index[found[index]], ModeEvent.FOUND, now_s)
        index = index[~found[index]]
        cell = ((now_s - self.since_s[index]) / settings.search_dwell_s).astype(np.int64)
        over = cell >= settings.search_cells
        self.apply(index[over], ModeEvent.NOT_FOUND, now_s)
        self.cell[index[~over]] = cell[~over]
        self._aims = None

    def targets(self, aim_axis_rad: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Where the axes shall go, in the safe order: azimuth first from stow, elevation first to stow.

        Returns
        -------
        (heliostat, axis)
            Axis angles [rad]; NaN where the heliostat follows its aim.
        (heliostat,)
            Whether it is on approach to an aim that its axes cannot reach.
        """
        settings, mode, stow = self.settings, self.mode, self._stow_rad
        target = np.where(_FOLLOWS_AIM[mode][:, None], np.nan, self.hold_rad)
        target[mode == int(Mode.STOW)] = stow
        unreachable = np.zeros(len(mode), np.bool_)
        if not _UNDER_WAY[mode].any():
            return target, unreachable
        index = np.flatnonzero(mode == Mode.STOWING)
        target[index, 1] = stow[1]
        lowered = np.abs(self.axis_rad[index, 1] - stow[1]) <= settings.arrived_rad
        target[index[lowered], 0] = stow[0]
        index = np.flatnonzero(mode == Mode.EMERGENCY)
        way = stow[1] - self.hold_rad[index, 1]
        target[index, 1] += np.clip(way, -settings.emergency_drop_rad, settings.emergency_drop_rad)
        index = np.flatnonzero(mode == Mode.APPROACH)
        unreachable[index] = ~np.isfinite(aim_axis_rad[index]).all(axis=1)
        index = index[~unreachable[index]]
        target[index, 0] = aim_axis_rad[index, 0]
        turned = index[np.abs(self.axis_rad[index, 0] - aim_axis_rad[index, 0]) <= settings.arrived_rad]
        target[turned, 1] = aim_axis_rad[turned, 1]
        return target, unreachable

    def aims_enu_m(self) -> FloatArray:
        """Where the beams shall go (heliostat, xyz) [m]; NaN where it does not matter."""
        if self._aims is None:
            self._aims = read_only(self._find_aims())
        return self._aims

    def _find_aims(self) -> FloatArray:
        mode = self.mode
        aim = np.where(_ON_RECEIVER[mode][:, None], self._aim_enu_m, np.nan)
        aside = mode == Mode.DEFOCUS
        aim[aside] += self.settings.defocus_offset_m * self._right_enu[aside]
        if self._calibration_enu_m is not None:
            index = np.flatnonzero(_ON_CALIBRATION[mode])
            step_m = self._cells[self.cell[index]] * self.settings.search_step_m
            aim[index] = self._calibration_enu_m + step_m[:, :1] * self._right_enu[index]
            aim[index, 2] += step_m[:, 1]
        return aim

    def forget_derived(self) -> None:
        """Forget what is derived from the state, since that was replaced."""
        self._aims = None
