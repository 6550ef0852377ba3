"""``recording.toml``: which files make a recording, whose receivers they are, how their clocks stand."""

from __future__ import annotations

import glob
import re
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, Final

from rfpose.errors import InvalidInputError, RecordingError
from rfpose.foreign import exact_number, load_toml
from rfpose.kinds import kind_of
from rfpose.recording.declared import Declared, declared_from, seconds_of
from rfpose.recording.links import refuse_outside
from rfpose.scenario import ID_PATTERN, MAX_ID_LENGTH

__all__ = ["MANIFEST_FILE", "Entry", "Manifest", "is_manifest", "read_manifest"]

MANIFEST_FILE: Final = "recording.toml"
_FORMAT: Final = "rfpose-recording"
_KEYS: Final = {"format", "scenario", "part"}
_PART_KEYS: Final = {"files", "receivers", "offset_s", "start"}
_MOST_FILES: Final = 100_000
_LARGEST_OFFSET_S: Final = 10**9
_RECEIVER_ID: Final = re.compile(ID_PATTERN)


@dataclass(frozen=True, slots=True, kw_only=True)
class Entry:
    """One file of a manifest.

    Attributes
    ----------
    path
        The file or directory.
    receivers
        Names in the whole, by the file's own names or in the file's order; None: as they are.
    offset_s
        To be added to its time [s]; None: to be found, see `rfpose.pipeline.clocks`.
    start_s
        When it begins [s since 1970 UTC], for a file that does not say.
    declared
        What a file of samples does not say of itself.
    """

    path: Path
    receivers: Mapping[str, str] | tuple[str, ...] | None
    offset_s: Fraction | None
    start_s: Fraction | None
    declared: Declared | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Manifest:
    """What a manifest says: the scenario's file, or None; its files; and which of those that it names are missing."""

    scenario: Path | None
    entries: list[Entry]
    notes: list[str]


def is_manifest(path: Path) -> bool:
    """Whether a file is a manifest, by what it says of itself."""
    return path.suffix == ".toml" and path.is_file() and kind_of(path) == "recording"


def read_manifest(path: Path, *, follow_links: bool = False) -> Manifest:
    """Read a manifest; files are sought beside it.

    Parameters
    ----------
    path
    follow_links
        Take files outside its folder, too.

    Raises
    ------
    RecordingError
        Malformed, an unknown key, or a file outside its folder.
    """
    content = load_toml(path)
    try:
        if content.get("format") != _FORMAT:
            raise InvalidInputError(f"`format` must be {_FORMAT!r}, got {content.get('format')!r:.60}")
        _refuse_unknown(content, _KEYS, "")
        parts = content.get("part")
        if not isinstance(parts, list) or not parts or not all(isinstance(part, dict) for part in parts):
            raise InvalidInputError("`part` must be one or more tables, [[part]]")
        notes: list[str] = []
        entries: list[Entry] = []
        for i, part in enumerate(parts):
            entries += _entries(path, part, f"part[{i}]", notes, follow_links=follow_links)
        scenario = content.get("scenario")
        if scenario is not None and (not isinstance(scenario, str) or not scenario or "\0" in scenario):
            raise InvalidInputError(f"`scenario` must be the name of a file, got {scenario!r:.60}")
    except InvalidInputError as error:
        raise RecordingError(f"{path}: {error}; correct it") from error
    site = None if scenario is None else path.parent / scenario
    if site is not None and not follow_links:
        refuse_outside(path.parent, site, named_by=path)
    return Manifest(scenario=site, entries=entries, notes=notes)


def _refuse_unknown(data: Mapping[str, Any], known: set[str], place: str) -> None:
    unknown = sorted(set(data) - known)
    if unknown:
        where = f" in {place}" if place else ""
        raise InvalidInputError(f"unknown key `{unknown[0]:.60}`{where}; known: {', '.join(sorted(known))}")


def _entries(path: Path, part: dict[str, Any], place: str, notes: list[str], *, follow_links: bool) -> list[Entry]:
    declared, rest = declared_from(part, place)
    _refuse_unknown(rest, _PART_KEYS, place)
    patterns = rest.get("files")
    patterns = [patterns] if isinstance(patterns, str) else patterns
    if not isinstance(patterns, list) or not patterns or not all(isinstance(name, str) and name for name in patterns):
        raise InvalidInputError(f"{place}: `files` must be names or patterns of files, got {patterns!r:.60}")
    receivers = _receivers(rest.get("receivers"), place)
    offset = rest.get("offset_s", 0)
    offset_s = None if offset == "find" else _seconds(f"{place}: `offset_s", offset)
    start_s = None if "start" not in rest else seconds_of(rest["start"], f"{place}: `start`")
    found: list[Entry] = []
    for pattern in patterns:
        if "\0" in pattern:
            raise InvalidInputError(f"{place}: `files` holds {pattern!r:.60}, no name of a file")
        names = sorted(glob.glob(pattern, root_dir=path.parent, recursive=True))
        if not names:
            notes.append(f"`{pattern:.100}` of {path.name} is missing: there is no such file")
        if len(names) > _MOST_FILES:
            raise InvalidInputError(f"{place}: {pattern!r:.60} stands for {len(names)} files, more than {_MOST_FILES}")
        for name in names:
            file = path.parent / name
            if not follow_links:
                refuse_outside(path.parent, file, named_by=path)
            found.append(Entry(path=file, receivers=receivers, offset_s=offset_s, start_s=start_s, declared=declared))
    return found


def _seconds(name: str, value: Any) -> Fraction:
    found = exact_number(name.replace("`", ""), value)
    if abs(found) > _LARGEST_OFFSET_S:
        raise InvalidInputError(f"{name}` must lie within {_LARGEST_OFFSET_S} s, got {float(found):g}")
    # as written in decimals, not as the nearest binary number
    return Fraction(repr(value)) if isinstance(value, float) else found


def _receivers(value: Any, place: str) -> Mapping[str, str] | tuple[str, ...] | None:
    if value is None:
        return None
    named = list(value.values()) if isinstance(value, dict) else value
    if not isinstance(named, list) or not named:
        raise InvalidInputError(
            f"{place}: `receivers` must be a list of names, or a table of them by the file's own, got {value!r:.60}"
        )
    for name in named:
        if not isinstance(name, str) or not _RECEIVER_ID.fullmatch(name) or len(name) > MAX_ID_LENGTH:
            raise InvalidInputError(
                f"{place}: `receivers` may hold letters, digits, `_`, `-` and `.`, {MAX_ID_LENGTH} at most, got "
                f"{name!r:.60}"
            )
    if len(set(named)) != len(named):
        raise InvalidInputError(f"{place}: `receivers` names one twice")
    return value if isinstance(value, dict) else tuple(named)
