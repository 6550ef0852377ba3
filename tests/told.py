"""What docs/json-output.md says of the keys that commands print."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

PAGE = Path(__file__).resolve().parents[1] / "docs" / "json-output.md"
Keys = tuple[str, ...]
ITEM = "[]"


def _rows(section: str) -> Iterator[Keys]:
    for line in section.splitlines():
        if line.startswith("| `"):
            for told in re.findall(r"`([^`]+)`", line.split(" | ")[0]):
                choices = [part.split(",") if k % 2 else [part] for k, part in enumerate(re.split(r"[{}]", told))]
                for one in itertools.product(*choices):
                    parts = "".join(one).replace(ITEM, f".{ITEM}").split(".")
                    yield tuple(parts)


def documented(command: str) -> list[Keys]:
    """Return the keys of a command's table, from the outermost in; ``<…>`` stands for any name."""
    found = re.search(rf"^## `{re.escape(command)}`$(.*?)(?=^## |\Z)", PAGE.read_text(), re.MULTILINE | re.DOTALL)
    assert found, f"docs/json-output.md has no section `{command}`"
    rows = list(_rows(found[1]))
    if command == "demo":
        rows = [*rows, *documented("evaluate")]
        rows += [("independent", *row) for row in documented("evaluate")]
    if command == "info":
        rows += [row for row in documented("survey") if row != ("survey",)]
    return rows


def _printed(tree: Any, above: Keys = ()) -> Iterator[tuple[Keys, Any]]:
    items = (
        [(ITEM, each) for each in tree] if isinstance(tree, list) else tree.items() if isinstance(tree, dict) else []
    )
    for key, value in items:
        if key != ITEM or isinstance(value, dict):
            yield (*above, key), value
            yield from _printed(value, (*above, key))


def _fits(keys: Keys, row: Keys) -> bool:
    return all(told == key or (told[0] == "<" and key != ITEM) for key, told in zip(keys, row, strict=False))


def undocumented(command: str, trees: Iterable[Any]) -> set[str]:
    """Return printed keys that the page does not know."""
    rows = documented(command)
    printed = {keys for tree in trees for keys, _ in _printed(tree)}
    return {".".join(keys) for keys in printed if not any(len(keys) <= len(r) and _fits(keys, r) for r in rows)}


def unseen(command: str, trees: Iterable[Any]) -> set[str]:
    """Return keys of the page that were not printed, though what they stand in was there and not empty."""
    printed = [each for tree in trees for each in _printed(tree)]
    whole = {keys for keys, _ in printed}
    empty = {keys for keys, value in printed if value in ({}, [], None)}

    def seen(row: Keys) -> bool:
        same = any(len(keys) == len(row) and _fits(keys, row) for keys in whole)
        return same or any(len(keys) < len(row) and _fits(keys, row) for keys in empty)

    return {".".join(row) for row in documented(command) if not seen(row)}
