"""docs/scenario.md names every key of a scenario, with its default; the schema for editors is what the reader takes."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from rfpose.scenario.schema import scenario_schema, scenario_schema_text

DOCS = Path(__file__).resolve().parents[2] / "docs"
SCHEMA = scenario_schema()
TABLE = re.compile(r"`\[\[?([\w.]+)\]\]?`")
KEY = re.compile(r"`(\w+)`(?: \[((?:[^\[\]]|\[[^\[\]]*\])*(?:\[[^\[\]]*\][^\[\]]*)*)\])?")


def _resolved(key: dict[str, Any]) -> tuple[str | None, bool]:
    """Name of the record that a key's value is, and whether it is a list of them."""
    for one in (key, *key.get("anyOf", [])):
        if "$ref" in one:
            return one["$ref"].rpartition("/")[2], False
        if "$ref" in one.get("items", {}):
            return one["items"]["$ref"].rpartition("/")[2], True
    return None, False


def _tables() -> dict[str, dict[str, dict[str, Any]]]:
    """Keys of each table of a scenario file, by the table's name."""
    out: dict[str, dict[str, dict[str, Any]]] = {}

    def walk(name: str, properties: dict[str, Any]) -> None:
        mine = out.setdefault(name, {})
        for key, value in properties.items():
            record, _ = _resolved(value)
            if record is None:
                mine[key] = value
            else:
                walk(f"{name}.{key}".lstrip("."), SCHEMA["$defs"][record]["properties"])

    walk("", SCHEMA["properties"])
    return out


def _documented() -> dict[str, dict[str, str | None]]:
    """Keys of each table by docs/scenario.md, with the default that stands behind them in brackets."""
    out: dict[str, dict[str, str | None]] = {}
    where = ""
    for line in (DOCS / "scenario.md").read_text().splitlines():
        heading = re.fullmatch(r"## `\[(\w+)\]`", line)
        if heading:
            where = heading[1]
        if not line.startswith("| ") or line.startswith(("| table", "| key", "|--")):
            continue
        cells = [cell.strip() for cell in line.strip("|").split(" | ")]
        if cells[0].startswith("(top)"):
            where = ""
        elif TABLE.match(cells[0]):
            where = TABLE.match(cells[0])[1]
        keys = cells[0] if heading is None and not TABLE.match(cells[0]) and cells[0].startswith("`") else cells[1]
        for name, default in KEY.findall(keys):
            out.setdefault(where, {})[name] = default or None
    return out


TABLES, DOCUMENTED = _tables(), _documented()


@pytest.mark.parametrize("table", [name for name, keys in TABLES.items() if keys])
def test_every_key_is_documented_and_exists(table: str) -> None:
    known, told = set(TABLES[table]), set(DOCUMENTED.get(table, {}))
    if table == "heliostat":
        known -= set(TABLES["mirror"]) - {"receiver_mirror_m"}  # "any key of [mirror]"
        told -= {"mirror"}
    assert told == known


@pytest.mark.parametrize("table", TABLES)
def test_defaults_are_those_that_count(table: str) -> None:
    for key, told in DOCUMENTED.get(table, {}).items():
        default = TABLES[table].get(key, {}).get("default")
        if default is None or default in ([], {}):
            assert told is None or not re.match(r"-?\d", told), f"{key} has no default"
            continue
        assert told is not None, f"{key}: {default}"
        assert _value(told) == (pytest.approx(default) if isinstance(default, int | float) else default), key


def _value(text: str) -> Any:
    plain = re.sub(r"(?<=\d) (?=\d)", "", text).replace("−", "-")
    try:
        return json.loads(plain)
    except ValueError:
        pass
    try:
        return json.loads(f"[{plain}]")
    except ValueError:
        return plain


def test_published_schema_is_up_to_date() -> None:
    """Write it anew with `rfpose init site.toml --schema docs/scenario.schema.json --force`."""
    assert (DOCS / "scenario.schema.json").read_text() == scenario_schema_text()
