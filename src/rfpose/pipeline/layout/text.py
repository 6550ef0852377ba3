"""A scenario's file with other transmitters: its text as it was, comments, names and all, but for what changes."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import tomlkit

from rfpose.errors import ScenarioError
from rfpose.foreign import read_text
from rfpose.scenario import Scenario, Transmitter, parse_scenario

__all__ = ["edited"]

_LARGEST = 2**26


def edited(source: str | Path, scenario: Scenario, *, folder: Path) -> str | None:
    """Return the text of a scenario's file with the transmitters of ``scenario``, to stand in ``folder``.

    None: it names tables that are not found from there.

    Lengths stand in the file before its ``scale``, and are written so. Blockages of transmitters that are gone go.

    Raises
    ------
    ScenarioError
        The file cannot be read, or is no longer that of the scenario.
    """
    text = read_text(source, limit=_LARGEST, error=ScenarioError, remedy="write it anew")
    document = tomlkit.parse(text)
    scale = float(document.get("scale", 1.0))
    listed = document.get("transmitter")
    if not isinstance(listed, tomlkit.items.AoT) or not len(listed):
        raise ScenarioError(f"{source}: has no [[transmitter]] tables that could be changed")
    for k, wanted in enumerate(scenario.transmitter):
        if k == len(listed):
            listed.append(copy.deepcopy(listed[-1]))
        _set(listed[k], wanted, scale)
    while len(listed) > len(scenario.transmitter):
        del listed[-1]
    _drop_blockages(document, {each.id for each in scenario.transmitter})
    changed = tomlkit.dumps(document)
    try:
        found = parse_scenario(changed, source=f"{source} with other transmitters", folder=folder)
    except ScenarioError:
        parse_scenario(changed, source=f"{source} with other transmitters", folder=Path(source).parent)
        return None
    return changed if found.heliostat_ids == scenario.heliostat_ids else None


def _set(table: Any, wanted: Transmitter, scale: float) -> None:
    """Write what differs, so that numbers that stay keep how they were written."""
    place = [float(f"{value / scale:.9g}") for value in wanted.position_enu_m]
    for key, value in (("id", wanted.id), ("carrier_hz", wanted.carrier_hz), ("amplitude", wanted.amplitude)):
        if key in table and table[key] == value:
            continue
        if key != "amplitude" or key in table or value != 1.0:
            table[key] = value
    if list(map(float, table["position_enu_m"])) != place:
        table["position_enu_m"] = place


def _drop_blockages(document: Any, left: set[str]) -> None:
    blocked = document.get("simulation", {}).get("blocked")
    if blocked is not None:
        for k in reversed(range(len(blocked))):
            if blocked[k].get("transmitter") not in left:
                del blocked[k]
