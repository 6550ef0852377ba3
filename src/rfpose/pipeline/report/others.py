"""What a report says of a recording, and of a site to which nothing was measured."""

from __future__ import annotations

from typing import Any

from rfpose.pipeline.report.page import answers, facts, text, words
from rfpose.recording import Recording, describe
from rfpose.scenario import Scenario
from rfpose.shown import counted

__all__ = ["recording_parts", "scenario_parts"]


def recording_parts(recording: Recording) -> tuple[str, list[str]]:
    """Return what was asked of a recording with the answers, and its tables, in HTML."""
    found = describe(recording)
    problems = "<br>".join(text(each) for each in found["problems"])
    rows = [
        ("Is it sound", "<b>yes</b>" if found["sound"] else f"<b>no</b><br>{problems}"),
        (
            "How much",
            f"{counted(len(found['receivers']), 'receiver')}, {text(found.get('recorded_s'))} s recorded from "
            f"{text(found.get('start_utc') or 'an unknown time')}",
        ),
    ]
    plain = {key: value for key, value in found.items() if key not in ("receivers", "problems", "sound", "path")}
    return answers(rows), ["<h2>Recording</h2>", facts(plain), "<h2>Receivers</h2>", _receivers(found["receivers"])]


def _receivers(found: dict[str, dict[str, Any]]) -> str:
    header = [key for key in dict.fromkeys(key for each in found.values() for key in each) if key != "readable"]
    rows = [[name, *(_cell(each.get(key)) for key in header)] for name, each in found.items()]
    return words(["receiver", *(key.replace("_", " ") for key in header)], rows)


def _cell(value: Any) -> str:
    return "–" if value is None else f"{value:.5g}" if isinstance(value, float) else str(value)


def scenario_parts(scenario: Scenario) -> tuple[str, list[str]]:
    """Return what was asked of a site with the answers, and its tables, in HTML."""
    parts = [(len(scenario.transmitter), "transmitter"), (len(scenario.heliostat), "heliostat")]
    parts += [(len(scenario.receiver_ids), "receiver"), (len(scenario.calibration_receiver), "calibration receiver")]
    rows = [("What it is", f"<b>{text(scenario.name)}</b>: {', '.join(counted(n, what) for n, what in parts)}")]
    places = [[each.id, *(f"{x:.3f}" for x in each.position_enu_m)] for each in scenario.transmitter]
    return answers(rows), ["<h2>Transmitters [m]</h2>", words(("", "east", "north", "up"), places)]
