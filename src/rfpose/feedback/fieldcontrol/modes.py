"""Modes of a heliostat as a table: from each mode, by each event, to another, or a refusal with its reason.

The table is data. It drives ten thousand heliostats by one indexing, `follow`; it is drawn by ``diagram``; each of its
entries is a test. A library of state machines calls Python for each object and event and was left aside for that.

References
----------
Malan, A heliostat field control system, §5.4.2, §6.5, Appendix D. Edwards, Arrays of paraboloidal collectors, §5.5.
Berenguel et al., §4.6 (wrong pointing).
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np
import numpy.typing as npt

from rfpose.checks import read_only

__all__ = [
    "COMMANDS",
    "IGNORED",
    "REFUSED",
    "TABLE",
    "TRANSITIONS",
    "Mode",
    "ModeEvent",
    "dot",
    "follow",
    "refusal",
]


class Mode(IntEnum):
    """What a heliostat is doing."""

    STOW = 0
    """Parked."""
    STOWING = 1
    """On its way to the park position, elevation before azimuth."""
    APPROACH = 2
    """Leaving the park position, azimuth before elevation."""
    POINT = 3
    """On its aim point by computed axis positions."""
    TRACK = 4
    """On its aim point by measured normals."""
    CALIBRATE = 5
    """On the calibration target."""
    SEARCH = 6
    """In an outward spiral about the calibration target, since no image of it was found there."""
    DEFOCUS = 7
    """Following the sun beside the receiver."""
    EMERGENCY = 8
    """Off the receiver at full speed by elevation alone, without knowing the sun; stows next."""
    IDLE = 9
    """Standing still, listening."""
    POWER_LOSS = 10
    """Dead; step counts are stored."""
    FAULT = 11
    """Alive, but its step counts are not to be trusted: does not move."""


class ModeEvent(IntEnum):
    """What can happen to a heliostat: commands first, then what it notices itself."""

    STOW = 0
    APPROACH = 1
    POINT = 2
    TRACK = 3
    CALIBRATE = 4
    SEARCH = 5
    DEFOCUS = 6
    REFOCUS = 7
    HOLD = 8
    EMERGENCY = 9
    ZERO_COUNTS = 10
    ARRIVED = 11
    FEEDBACK_LOST = 12
    FEEDBACK_BACK = 13
    FOUND = 14
    NOT_FOUND = 15
    HEARTBEAT_LOST = 16
    HOLD_OVER = 17
    POWER_OFF = 18
    POWER_ON = 19
    COUNTS_LOST = 20


COMMANDS = tuple(event for event in ModeEvent if event <= ModeEvent.ZERO_COUNTS)
"""Events that are ordered from outside; refused where they do not fit. The others are ignored there."""

REFUSED = -1
IGNORED = -2

_ON_AIM = {
    ModeEvent.STOW: Mode.STOWING,
    ModeEvent.POINT: Mode.POINT,
    ModeEvent.TRACK: Mode.TRACK,
    ModeEvent.CALIBRATE: Mode.CALIBRATE,
    ModeEvent.DEFOCUS: Mode.DEFOCUS,
    ModeEvent.HOLD: Mode.IDLE,
    ModeEvent.EMERGENCY: Mode.EMERGENCY,
    ModeEvent.HEARTBEAT_LOST: Mode.EMERGENCY,
    ModeEvent.POWER_OFF: Mode.POWER_LOSS,
}

TRANSITIONS: dict[Mode, dict[ModeEvent, Mode]] = {
    Mode.STOW: {
        ModeEvent.STOW: Mode.STOW,
        ModeEvent.EMERGENCY: Mode.STOW,
        ModeEvent.APPROACH: Mode.APPROACH,
        ModeEvent.POWER_OFF: Mode.POWER_LOSS,
    },
    Mode.STOWING: {
        ModeEvent.STOW: Mode.STOWING,
        ModeEvent.EMERGENCY: Mode.STOWING,
        ModeEvent.HOLD: Mode.IDLE,
        ModeEvent.ARRIVED: Mode.STOW,
        ModeEvent.POWER_OFF: Mode.POWER_LOSS,
    },
    Mode.APPROACH: {
        ModeEvent.APPROACH: Mode.APPROACH,
        ModeEvent.STOW: Mode.STOWING,
        ModeEvent.HOLD: Mode.IDLE,
        ModeEvent.EMERGENCY: Mode.EMERGENCY,
        ModeEvent.ARRIVED: Mode.POINT,
        ModeEvent.HEARTBEAT_LOST: Mode.EMERGENCY,
        ModeEvent.POWER_OFF: Mode.POWER_LOSS,
    },
    Mode.POINT: {**_ON_AIM, ModeEvent.FEEDBACK_BACK: Mode.TRACK},
    Mode.TRACK: {**_ON_AIM, ModeEvent.FEEDBACK_LOST: Mode.POINT},
    Mode.CALIBRATE: {**_ON_AIM, ModeEvent.SEARCH: Mode.SEARCH},
    Mode.SEARCH: {
        ModeEvent.STOW: Mode.STOWING,
        ModeEvent.SEARCH: Mode.SEARCH,
        ModeEvent.CALIBRATE: Mode.CALIBRATE,
        ModeEvent.DEFOCUS: Mode.DEFOCUS,
        ModeEvent.HOLD: Mode.IDLE,
        ModeEvent.EMERGENCY: Mode.EMERGENCY,
        ModeEvent.FOUND: Mode.CALIBRATE,
        ModeEvent.NOT_FOUND: Mode.DEFOCUS,
        ModeEvent.HEARTBEAT_LOST: Mode.EMERGENCY,
        ModeEvent.POWER_OFF: Mode.POWER_LOSS,
    },
    Mode.DEFOCUS: {
        ModeEvent.STOW: Mode.STOWING,
        ModeEvent.DEFOCUS: Mode.DEFOCUS,
        ModeEvent.REFOCUS: Mode.POINT,
        ModeEvent.CALIBRATE: Mode.CALIBRATE,
        ModeEvent.HOLD: Mode.IDLE,
        ModeEvent.EMERGENCY: Mode.EMERGENCY,
        ModeEvent.HEARTBEAT_LOST: Mode.EMERGENCY,
        ModeEvent.POWER_OFF: Mode.POWER_LOSS,
    },
    Mode.EMERGENCY: {
        ModeEvent.EMERGENCY: Mode.EMERGENCY,
        ModeEvent.STOW: Mode.STOWING,
        ModeEvent.REFOCUS: Mode.POINT,
        ModeEvent.HOLD_OVER: Mode.STOWING,
        ModeEvent.POWER_OFF: Mode.POWER_LOSS,
    },
    Mode.IDLE: {
        ModeEvent.STOW: Mode.STOWING,
        ModeEvent.HOLD: Mode.IDLE,
        ModeEvent.EMERGENCY: Mode.EMERGENCY,
        ModeEvent.HEARTBEAT_LOST: Mode.EMERGENCY,
        ModeEvent.POWER_OFF: Mode.POWER_LOSS,
    },
    Mode.POWER_LOSS: {ModeEvent.POWER_ON: Mode.IDLE, ModeEvent.COUNTS_LOST: Mode.FAULT},
    Mode.FAULT: {ModeEvent.ZERO_COUNTS: Mode.IDLE, ModeEvent.POWER_OFF: Mode.POWER_LOSS},
}
"""Every transition there is."""

_WHY: dict[Mode, str] = {
    Mode.STOW: "it is stowed: order an approach first",
    Mode.STOWING: "it is on its way to stow and would swing a raised beam about: wait until it is stowed",
    Mode.APPROACH: "its approach is not over",
    Mode.POINT: "it points at its aim already",
    Mode.TRACK: "it tracks its aim already",
    Mode.CALIBRATE: "it is on the calibration target: order point or track first",
    Mode.SEARCH: "it searches the calibration target: let it find it, or defocus or stow it",
    Mode.DEFOCUS: "it is defocused: order refocus first",
    Mode.EMERGENCY: "it is in an emergency: order refocus or stow once the cause is gone",
    Mode.IDLE: "it stands still at a place from which no safe way to the receiver is known: stow it first",
    Mode.POWER_LOSS: "it has no power",
    Mode.FAULT: "its step counts are not valid: home it and zero them first",
}
_WHY_EVENT: dict[ModeEvent, str] = {
    ModeEvent.ZERO_COUNTS: "its step counts are valid and in use",
    ModeEvent.SEARCH: "a search starts on the calibration target: order calibrate first",
    ModeEvent.REFOCUS: "it is not defocused",
}
# where the mode's reason tells more than the event's
_MODE_SAYS_MORE = frozenset(
    {Mode.STOW, Mode.STOWING, Mode.APPROACH, Mode.POWER_LOSS, Mode.FAULT, Mode.EMERGENCY, Mode.IDLE}
)


def refusal(mode: Mode, command: ModeEvent) -> str | None:
    """Return why a command is refused in a mode; None where it is not."""
    if command not in COMMANDS or command in TRANSITIONS[mode]:
        return None
    of_event = mode not in _MODE_SAYS_MORE or (command == ModeEvent.ZERO_COUNTS and mode != Mode.POWER_LOSS)
    why = _WHY_EVENT.get(command, _WHY[mode]) if of_event else _WHY[mode]
    return f"{command.name} refused: {why}"


def _table() -> npt.NDArray[np.int8]:
    table = np.full((len(Mode), len(ModeEvent)), IGNORED, np.int8)
    table[:, list(COMMANDS)] = REFUSED
    for mode, row in TRANSITIONS.items():
        for event, after in row.items():
            table[mode, event] = after
    return read_only(table)


TABLE: npt.NDArray[np.int8] = _table()
"""Next mode by (mode, event); `REFUSED` for a command and `IGNORED` for another event without a transition."""


def follow(
    mode: npt.NDArray[np.int8], event: npt.NDArray[np.int8]
) -> tuple[npt.NDArray[np.int8], npt.NDArray[np.bool_]]:
    """Return the modes after events, and where the event was refused.

    Parameters
    ----------
    mode, event : (heliostat,)
        `Mode` and `ModeEvent` of each.
    """
    after = TABLE[mode, event]
    return np.where(after < 0, mode, after).astype(np.int8), after == REFUSED


def dot() -> str:
    """Return the state machine in graphviz's language; edges with the same ends share one arrow.

    Commands are written in capitals, what the heliostat notices itself in small letters.
    """
    lines = ["digraph modes {", "  rankdir=LR;", "  node [shape=box, style=rounded];"]
    lines += [f"  {mode.name};" for mode in Mode]
    for mode, row in TRANSITIONS.items():
        for after in sorted(set(row.values())):
            events = [event for event in sorted(row) if row[event] == after]
            label = "\\n".join(e.name if e in COMMANDS else e.name.lower() for e in events)
            lines.append(f'  {mode.name} -> {after.name} [label="{label}"];')
    return "\n".join([*lines, "}", ""])
