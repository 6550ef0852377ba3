"""The scenario beside a recording whose format has no place for it."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from rfpose.scenario import Scenario, load_scenario

__all__ = ["SCENARIO_FILE", "load_sidecar_scenario"]

SCENARIO_FILE: Final = "scenario.toml"


def load_sidecar_scenario(directory: Path) -> Scenario | None:
    """Return the scenario of a Digital RF or SigMF directory, or None if it holds none.

    Raises
    ------
    ScenarioError
        The file is malformed.
    """
    path = directory / SCENARIO_FILE
    return load_scenario(path) if path.is_file() else None
