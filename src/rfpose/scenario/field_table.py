"""Heliostats from a table: the ``[heliostats]`` table of a scenario."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from pydantic import Field, ValidationError, model_validator

from rfpose.checks import FloatArray
from rfpose.errors import RecordingError, ScenarioError
from rfpose.foreign import beside
from rfpose.paint import read_plan
from rfpose.scenario._words import in_words
from rfpose.scenario.positions import PositionForm, read_positions

__all__ = ["HeliostatTable", "add_listed"]

Place = Annotated[str, Field(min_length=1, max_length=4096)]


class HeliostatTable(PositionForm):
    """Where the heliostats' places are written down: beside the scenario's file, else from where the command is run."""

    csv: Place | None = None
    """Table of positions."""
    paint: Place | None = None
    """Directory of a plant in PAINT's layout instead."""

    @model_validator(mode="after")
    def _one_of_two(self) -> Self:
        if (self.csv is None) == (self.paint is None):
            raise ValueError("give exactly one of `csv` (a table) and `paint` (a directory in PAINT's layout)")
        if self.paint is not None and (self.columns.model_fields_set or self.unit is not None):
            raise ValueError("`columns` and `unit` are about `csv`; PAINT's files have neither: leave them out")
        return self

    def read(self, folder: Path | None) -> tuple[tuple[str, ...], FloatArray]:
        """Return names and pivots (heliostat, xyz) [m].

        Raises
        ------
        ScenarioError
            The file or directory cannot be used.
        """
        if self.csv is not None:
            return read_positions(beside(self.csv, folder), self)
        assert self.paint is not None
        try:
            plan = read_plan(beside(self.paint, folder))
        except RecordingError as error:
            raise ScenarioError(str(error)) from error
        return plan.ids, plan.pivot_enu_m + np.array([0.0, 0.0, self.pivot_height_m or 0.0])


def add_listed(data: dict[str, Any], folder: Path | None) -> None:
    """Take ``[heliostats]`` out of a file's tables and put what it lists among ``heliostat``.

    A heliostat that stands in both is one: what the file says of it goes before the table.

    Raises
    ------
    ScenarioError
        The table cannot be used.
    """
    table = data.pop("heliostats", None)
    if table is None:
        return
    try:
        ids, pivot = HeliostatTable.model_validate(table).read(folder)
    except ValidationError as error:
        raise ScenarioError(in_words(error, "heliostats")) from error
    own = data.get("heliostat", [])
    if not isinstance(own, list):
        return
    said = {one["id"]: one for one in own if isinstance(one, dict) and isinstance(one.get("id"), str)}
    places: list[list[float]] = pivot.tolist()
    listed = [{"id": name, "pivot_enu_m": place, **said.get(name, {})} for name, place in zip(ids, places, strict=True)]
    known = set(ids)
    data["heliostat"] = listed + [one for one in own if not (isinstance(one, dict) and one.get("id") in known)]
