"""The JSON Schema of scenario files, for editors that complete and check while one writes."""

from __future__ import annotations

import ast
import inspect
import itertools
import json
import textwrap
from typing import Any

from pydantic import BaseModel
from pydantic.json_schema import models_json_schema

from rfpose.scenario._scenario import Scenario
from rfpose.scenario.field_table import HeliostatTable
from rfpose.scenario.records import Mirror, Record

__all__ = ["scenario_schema", "scenario_schema_text"]

_URI = "https://json-schema.org/draft/2020-12/schema"


def scenario_schema() -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of a scenario file, as its reader takes it.

    Descriptions are those of the records' attributes.
    """
    _, whole = models_json_schema(
        [(model, "validation") for model in (Scenario, Mirror, HeliostatTable)],
        ref_template="#/$defs/{model}",
    )
    definitions: dict[str, Any] = whole["$defs"]
    for model in _records(Record):
        if model.__name__ in definitions:
            _describe(definitions[model.__name__], model)
    for definition in definitions.values():  # a table's default is all of its keys' defaults
        for key in definition.get("properties", {}).values():
            if "$ref" in key or isinstance(key.get("default"), dict):
                key.pop("default", None)
    top = definitions.pop("Scenario")
    top["properties"] |= {
        "scale": {"type": "number", "exclusiveMinimum": 0, "default": 1.0, "description": "Multiplies every length."},
        "mirror": {"$ref": "#/$defs/Mirror"},
        "heliostats": {"$ref": "#/$defs/HeliostatTable"},
    }
    _as_written(definitions)
    top |= {"title": "rfpose scenario", "description": "A site for rfpose; see docs/scenario.md."}
    return {"$schema": _URI, **top, "$defs": dict(sorted(definitions.items()))}


def scenario_schema_text() -> str:
    """Return `scenario_schema` as text that ends with a line."""
    return json.dumps(scenario_schema(), indent=1, ensure_ascii=False) + "\n"


def _as_written(definitions: dict[str, Any]) -> None:
    """Say what files may hold that is filled in, or taken for something else, before it is checked."""
    definitions["Heliostat"]["required"] = ["id"]  # its place may stand in a table, its receivers in [mirror]
    plate = definitions["StructurePlate"]
    plate["required"] = ["id", "pivot_enu_m"]
    definitions["Structures"]["properties"] |= {
        **{key: plate["properties"][key] for key in ("width_m", "height_m", "arm_m")},
        "csv": {"type": "string", "description": "Plan of the mirrors without receivers."},
    }
    definitions["Simulation"]["properties"]["start"] = {
        "type": "string",
        "description": "Date and time of the first sample, with time zone; instead of start_unix_s.",
    }


def _records(base: type[BaseModel]) -> list[type[BaseModel]]:
    return [one for each in base.__subclasses__() for one in (each, *_records(each))]


def _describe(definition: dict[str, Any], model: type[BaseModel]) -> None:
    """Take the texts below the attributes of a record into its properties, its bases' too."""
    for one in reversed(model.__mro__):
        if one is not Record and issubclass(one, Record):
            for key, text in _attribute_texts(one).items():
                if key in definition.get("properties", {}):
                    definition["properties"][key]["description"] = text


def _attribute_texts(model: type[BaseModel]) -> dict[str, str]:
    tree = ast.parse(textwrap.dedent(inspect.getsource(model))).body[0]
    assert isinstance(tree, ast.ClassDef)
    out = {}
    for attribute, after in itertools.pairwise(tree.body):
        text = _text_of(after)
        if isinstance(attribute, ast.AnnAssign) and isinstance(attribute.target, ast.Name) and text is not None:
            out[attribute.target.id] = " ".join(text.split())
    return out


def _text_of(node: ast.stmt) -> str | None:
    constant = node.value if isinstance(node, ast.Expr) else None
    return constant.value if isinstance(constant, ast.Constant) and isinstance(constant.value, str) else None
