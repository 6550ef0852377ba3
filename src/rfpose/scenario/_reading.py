"""TOML in, a checked scenario out, or one line that names the key and the remedy."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from rfpose.errors import GeometryError, InvalidInputError, ScenarioError
from rfpose.foreign import parse_toml, read_text
from rfpose.kinds import told_kind
from rfpose.scenario._scenario import Scenario
from rfpose.scenario._words import in_words
from rfpose.scenario.field_table import add_listed
from rfpose.scenario.records import Mirror
from rfpose.scenario.site import fill_structures

SCENARIO_BYTES = 2**26
"""Of a scenario's text: a hundred thousand heliostats."""

_REMEDY = "a scenario is TOML in UTF-8, as docs/scenario.md has it: correct it"


def load_scenario(path: str | Path, *, scale: float | None = None) -> Scenario:
    """Read and check a scenario file.

    Parameters
    ----------
    path
        A TOML file as described in ``docs/scenario.md``.
    scale
        Overrides the file's ``scale`` key: every length and tone wavelength is multiplied by it.

    Raises
    ------
    ScenarioError
        The file is missing, is not TOML, has unknown or mistyped keys, or contradicts itself. The message
        names the file, the key and the remedy.

    Examples
    --------
    >>> import rfpose as rf
    >>> rf.load_scenario(rf.shipped_scenario("table2_100m.toml"))
    <Scenario 'Table 2, 100 m field': 10 transmitters, 1 tone, 12 heliostats>
    """
    if instead := told_kind(path, wanted="scenario"):
        raise ScenarioError(f"{path}: no scenario, but {instead}; give a site in TOML, as docs/scenario.md has it")
    text = read_text(path, limit=SCENARIO_BYTES, error=ScenarioError, remedy=_REMEDY)
    return parse_scenario(text, source=str(path), scale=scale, folder=Path(path).parent)


def parse_scenario(
    text: str, *, source: str = "scenario", scale: float | None = None, folder: Path | None = None
) -> Scenario:
    """Check a scenario given as TOML text; see `load_scenario`.

    ``source`` names it in messages; tables that it names lie in ``folder``, or where the program runs.
    """
    data = parse_toml(text, source=source, error=ScenarioError, remedy=_REMEDY)
    try:
        file_scale = data.pop("scale", 1.0)
        if not isinstance(file_scale, int | float) or isinstance(file_scale, bool):
            raise ScenarioError(f"`scale` must be a number, got {file_scale!r}")
        _check_start(data.get("simulation"))
        add_listed(data, folder)
        _fill_heliostats(data)
        fill_structures(data, folder)
        scenario = Scenario.model_validate(data)
    except ValidationError as error:
        raise ScenarioError(f"{source}: {in_words(error)}") from error
    except ScenarioError as error:
        raise ScenarioError(f"{source}: {error}") from error
    factor = float(file_scale if scale is None else scale)
    try:
        return scenario.scaled(factor)
    except ValidationError as error:
        raise ScenarioError(f"{source}: with `scale` {factor:g}: {in_words(error)}") from error
    except ScenarioError as error:
        raise ScenarioError(f"{source}: {error}") from error


def scenario_of(source: Scenario | str | Path) -> Scenario:
    """Return a scenario as it is, or that of a file; see `load_scenario`."""
    return source if isinstance(source, Scenario) else load_scenario(source)


@contextlib.contextmanager
def naming(source: Scenario | str | Path) -> Iterator[None]:
    """Name the scenario's file in what turns out to be wrong with it; a scenario from no file has none to name."""
    try:
        yield
    except (ScenarioError, GeometryError, InvalidInputError) as error:
        place = "" if isinstance(source, Scenario) else f"{source}: "
        raise ScenarioError(f"{place}{error}") from error


def _check_start(simulation: Any) -> None:
    if isinstance(simulation, dict) and {"start", "start_unix_s"} <= simulation.keys():
        raise ScenarioError("[simulation] gives `start` and `start_unix_s`; keep the one that counts")


def _fill_heliostats(data: dict[str, Any]) -> None:
    """Give each heliostat what the ``[mirror]`` table says unless it says so itself, and names its receivers."""
    try:
        mirror = Mirror.model_validate(data.pop("mirror", {})).model_dump(exclude_none=True)
    except ValidationError as error:
        raise ScenarioError(in_words(error, "mirror")) from error
    heliostats = data.get("heliostat", [])
    if not isinstance(heliostats, list):
        return
    for heliostat in heliostats:
        if not isinstance(heliostat, dict):
            continue
        for key, value in mirror.items():
            heliostat.setdefault(key, value)
        places = heliostat.get("receiver_mirror_m")
        if isinstance(places, list | tuple) and "id" in heliostat:
            heliostat.setdefault("receiver_ids", [f"{heliostat['id']}_r{k}" for k in range(len(places))])
