"""What a recording whose format has no place for it takes from beside: the scenario, the receiver's name."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Final

from rfpose.recording.links import refuse_outside
from rfpose.scenario import MAX_ID_LENGTH, Scenario, load_scenario

__all__ = ["SCENARIO_FILE", "load_sidecar_scenario", "receiver_name"]

SCENARIO_FILE: Final = "scenario.toml"


def load_sidecar_scenario(directory: Path, *, follow_links: bool) -> Scenario | None:
    """Return the scenario of a Digital RF or SigMF directory, or None if it holds none.

    A link that leads out of the directory is followed only with ``follow_links``.

    Raises
    ------
    RecordingError
        The file lies outside ``directory``.
    ScenarioError
        The file is malformed.
    """
    path = directory / SCENARIO_FILE
    if not path.is_file():
        return None
    if not follow_links:
        refuse_outside(directory, path, named_by=path)
    return load_scenario(path)


def receiver_name(text: str) -> str:
    """Return a receiver's name out of a file's: what no name may hold becomes an underscore."""
    return re.sub(r"[^A-Za-z0-9_.\-]", "_", text)[:MAX_ID_LENGTH] or "receiver"
