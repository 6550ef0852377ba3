"""The table of modes: each entry, each refusal, and what must hold for the whole."""

import itertools

import numpy as np
import pytest
from scipy.sparse.csgraph import connected_components

from rfpose.feedback.fieldcontrol.diagram import draw_modes
from rfpose.feedback.fieldcontrol.modes import (
    COMMANDS,
    IGNORED,
    REFUSED,
    TABLE,
    TRANSITIONS,
    Mode,
    ModeEvent,
    dot,
    follow,
    refusal,
)

# What each transition is for, written by hand from the requirements and not from the table: mode, event, mode after.
ON_AIM = ("POINT", "TRACK", "CALIBRATE", "SEARCH", "DEFOCUS")
EXPECTED = {
    ("STOW", "STOW"): "STOW",
    ("STOW", "EMERGENCY"): "STOW",
    ("STOW", "APPROACH"): "APPROACH",
    ("STOWING", "STOW"): "STOWING",
    ("STOWING", "EMERGENCY"): "STOWING",
    ("STOWING", "HOLD"): "IDLE",
    ("STOWING", "ARRIVED"): "STOW",
    ("APPROACH", "APPROACH"): "APPROACH",
    ("APPROACH", "ARRIVED"): "POINT",
    ("APPROACH", "STOW"): "STOWING",
    ("APPROACH", "HOLD"): "IDLE",
    ("APPROACH", "EMERGENCY"): "EMERGENCY",
    ("APPROACH", "HEARTBEAT_LOST"): "EMERGENCY",
    **{(a, b): b for a in ("POINT", "TRACK", "CALIBRATE") for b in ("POINT", "TRACK", "CALIBRATE", "DEFOCUS")},
    **{(a, "STOW"): "STOWING" for a in (*ON_AIM, "EMERGENCY", "IDLE")},
    **{(a, "HOLD"): "IDLE" for a in (*ON_AIM, "IDLE")},
    **{(a, "EMERGENCY"): "EMERGENCY" for a in (*ON_AIM, "EMERGENCY", "IDLE")},
    **{(a, "HEARTBEAT_LOST"): "EMERGENCY" for a in (*ON_AIM, "IDLE")},
    ("POINT", "FEEDBACK_BACK"): "TRACK",
    ("TRACK", "FEEDBACK_LOST"): "POINT",
    ("CALIBRATE", "SEARCH"): "SEARCH",
    ("SEARCH", "SEARCH"): "SEARCH",
    ("SEARCH", "CALIBRATE"): "CALIBRATE",
    ("SEARCH", "DEFOCUS"): "DEFOCUS",
    ("SEARCH", "FOUND"): "CALIBRATE",
    ("SEARCH", "NOT_FOUND"): "DEFOCUS",
    ("DEFOCUS", "DEFOCUS"): "DEFOCUS",
    ("DEFOCUS", "REFOCUS"): "POINT",
    ("DEFOCUS", "CALIBRATE"): "CALIBRATE",
    ("EMERGENCY", "REFOCUS"): "POINT",
    ("EMERGENCY", "HOLD_OVER"): "STOWING",
    **{(m.name, "POWER_OFF"): "POWER_LOSS" for m in Mode if m.name != "POWER_LOSS"},
    ("POWER_LOSS", "POWER_ON"): "IDLE",
    ("POWER_LOSS", "COUNTS_LOST"): "FAULT",
    ("FAULT", "ZERO_COUNTS"): "IDLE",
}
PAIRS = list(itertools.product(Mode, ModeEvent))


@pytest.mark.parametrize(("mode", "event"), PAIRS, ids=lambda item: item.name)
def test_every_pair_of_mode_and_event(mode, event):
    after, refused = follow(np.array([mode], np.int8), np.array([event], np.int8))
    expected = EXPECTED.get((mode.name, event.name))
    reason = refusal(mode, event)
    if expected is not None:
        assert Mode(after[0]).name == expected
        assert not refused[0]
        assert reason is None
    else:
        assert after[0] == mode
        assert refused[0] == (event in COMMANDS)
        assert TABLE[mode, event] == (REFUSED if event in COMMANDS else IGNORED)
        assert (reason is not None) == (event in COMMANDS)
        if reason is not None:
            assert reason.startswith(f"{event.name} refused: ")


def test_reasons_name_the_remedy():
    assert refusal(Mode.STOW, ModeEvent.TRACK) == "TRACK refused: it is stowed: order an approach first"
    assert "stow it first" in refusal(Mode.IDLE, ModeEvent.TRACK)
    assert "no power" in refusal(Mode.POWER_LOSS, ModeEvent.ZERO_COUNTS)
    assert "order calibrate first" in refusal(Mode.TRACK, ModeEvent.SEARCH)
    assert "zero them first" in refusal(Mode.FAULT, ModeEvent.STOW)


def test_no_mode_is_a_trap():
    leads = np.zeros((len(Mode), len(Mode)))
    for before, row in TRANSITIONS.items():
        leads[before, list(row.values())] = 1
    assert connected_components(leads, connection="strong")[0] == 1


def test_every_powered_mode_with_valid_counts_can_be_stowed_at_once():
    for mode in set(Mode) - {Mode.POWER_LOSS, Mode.FAULT}:
        assert TRANSITIONS[mode][ModeEvent.STOW] in (Mode.STOW, Mode.STOWING)


def test_without_messages_every_mode_ends_in_stow():
    """Silence, waiting and arriving alone lead from each moving mode to the park position."""
    alone = {ModeEvent.HEARTBEAT_LOST, ModeEvent.HOLD_OVER, ModeEvent.ARRIVED}
    for mode in set(Mode) - {Mode.POWER_LOSS, Mode.FAULT}:
        here = mode
        for _ in range(5):
            row = TRANSITIONS[here]
            here = next((row[event] for event in sorted(alone, reverse=True) if event in row), here)
        assert here == Mode.STOW, mode.name


def test_azimuth_first_modes_are_entered_from_stow_only():
    into = {before for before, row in TRANSITIONS.items() if Mode.APPROACH in row.values()}
    assert into == {Mode.STOW, Mode.APPROACH}


def test_graphviz_text_holds_every_transition():
    text = dot()
    edges = {}
    for line in text.splitlines():
        if "->" in line:
            before, rest = line.strip().split(" -> ")
            after, label = rest.split(" [label=")
            edges[before, after] = label.rstrip("];").strip('"').split("\\n")
    held = {(before, event.upper(), after) for (before, after), names in edges.items() for event in names}
    assert held == {(b.name, e.name, a.name) for b, row in TRANSITIONS.items() for e, a in row.items()}
    assert text.startswith("digraph modes {")


def test_picture_shows_every_mode_and_arrow():
    axes = draw_modes().axes[0]
    texts = [text.get_text() for text in axes.texts]
    for mode in Mode:
        assert mode.name.replace("_", " ") in texts
    words = "\n".join(texts)
    for event in ModeEvent:
        assert event.name.replace("_", " ").lower() in words.lower()
