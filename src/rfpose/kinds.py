"""Which kind of ours a file is: for those who were given another than they read, and for who takes anything."""

from __future__ import annotations

import json
import re
from pathlib import Path

from rfpose.errors import RecordingError
from rfpose.heaps import open_hdf5

__all__ = [
    "COMPRESSED_SIGMF",
    "FORMAT_KINDS",
    "JOURNAL_KEY",
    "LIVE_SCENARIO",
    "SIGMF_ENDINGS",
    "check_kind",
    "head_of",
    "is_hdf5",
    "is_live",
    "kind_of",
    "read_key",
    "told_kind",
]

FORMAT_KINDS = {
    "rfpose-iq": "recording",
    "rfpose-recording": "recording",
    "rfpose-result": "result",
    "rfpose-tracking": "track",
    "rfpose-mount": "model",
    "rfpose-antenna": "antenna",
    "rfpose-survey": "survey",
}
"""Kinds by the format that files give themselves."""

_WORDS = {
    "recording": "a recording, which `rfpose process`, `rfpose convert`, `rfpose info` and `rfpose view` take",
    "result": "a result of `rfpose process`, which `rfpose evaluate`, `rfpose info` and `rfpose view` take",
    "track": "a run of `rfpose track`, which `rfpose info` and `rfpose view` take",
    "model": "a file of mounts, which `rfpose aim`, `rfpose calibrate` and `rfpose info` take",
    "antenna": "an antenna pattern, which `rfpose info` takes",
    "survey": "a survey, which `rfpose process` takes beside a recording",
    "scenario": "a scenario, which `rfpose simulate`, `rfpose layout`, `rfpose track` and `rfpose info` take",
    "truth": "a truth, which `rfpose evaluate` takes beside a result",
}
_MADE = {
    "result": ("result", "`rfpose process`"),
    "track": ("tracking run", "`rfpose track`"),
    "antenna": ("antenna pattern", "`scripts/antenna_pattern.py`"),
    "survey": ("survey", "`rfpose survey`"),
}
COMPRESSED_SIGMF = (".sigmf.gz", ".sigmf.xz", ".sigmf.zip")
"""Endings of SigMF's archives that are compressed."""
SIGMF_ENDINGS = (".sigmf", ".sigmf-meta", ".sigmf-data", ".sigmf-collection", *COMPRESSED_SIGMF)
JOURNAL_KEY = "key.json"
"""File of a directory of unfinished work: what that depends on."""
LIVE_SCENARIO = "scenario"
"""What that names where the work is a result that can be read meanwhile."""
_HDF5 = b"\x89HDF\r\n\x1a\n"
_HEAD_BYTES = 2**16


def head_of(path: Path, n_byte: int) -> bytes:
    """Return how a file begins; nothing where it cannot be read, or is none: a pipe would be waited for."""
    try:
        if not path.is_file():
            return b""
        with path.open("rb") as file:
            return file.read(n_byte)
    except (OSError, ValueError):
        return b""


def kind_of(path: str | Path) -> str | None:
    """Return the kind: one of those of `FORMAT_KINDS`, ``scenario`` or ``truth``; None: unknown.

    By what a file says of itself at its beginning; whether it is sound is for its reader to say.
    """
    path = Path(path)
    if path.name.endswith(SIGMF_ENDINGS):
        return "recording"
    head = head_of(path, _HEAD_BYTES)
    if not head:
        return "result" if is_live(path) else None
    if head[:4] in (b"RIFF", b"RF64", b"BW64") and head[8:12] == b"WAVE":
        return "recording"
    if head.startswith(_HDF5):
        return _kind_of_hdf5(path)
    text = head.decode("utf-8-sig", errors="replace")
    named = re.search(r"""^[\s{]*"?format"?\s*[:=]\s*["']([a-z-]+)["']""", text, re.MULTILINE)
    if named is not None and named[1] in FORMAT_KINDS:
        return FORMAT_KINDS[named[1]]
    if re.match(r"\s*\{", text):
        return "truth" if '"heliostats"' in text else None
    return "scenario" if re.search(r"^\s*\[\[?(radio|transmitter|heliostat|tone)\]", text, re.MULTILINE) else None


def is_hdf5(path: str | Path) -> bool:
    """Whether a file begins as HDF5 does; false where it cannot be read."""
    try:
        with open(path, "rb") as file:
            return file.read(len(_HDF5)) == _HDF5
    except (OSError, ValueError):
        return False


def is_live(path: str | Path) -> bool:
    """Tell whether a directory holds a result that is, or was, being made frame by frame."""
    return LIVE_SCENARIO in (read_key(path) or {})


def read_key(directory: str | Path) -> dict[str, str] | None:
    """Return what the unfinished work in a directory depends on; None: there is none."""
    try:
        found = json.loads((Path(directory) / JOURNAL_KEY).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) else None


def _kind_of_hdf5(path: Path) -> str | None:
    try:
        with open_hdf5(path) as file:
            found = file.attrs.get("format")
    except (OSError, RuntimeError, KeyError, ValueError, TypeError):
        return None
    return FORMAT_KINDS.get(found) if isinstance(found, str) else None


def check_kind(path: str | Path, *, wanted: str) -> None:
    """Refuse what is no ``result``, ``track``, ``antenna`` or ``survey`` by its beginning, before its reader is loaded.

    Raises
    ------
    RecordingError
        Missing, another kind of file, or none that is known.
    """
    path = Path(path)
    name, maker = _MADE[wanted]
    if not path.exists():
        raise RecordingError(f"{path}: no such file; make it with {maker}")
    kind = kind_of(path)
    if kind is None:
        raise RecordingError(f"{path}: no {name}, but truncated or another kind of file; run {maker} again")
    if kind != wanted:
        raise RecordingError(f"{path}: no {name}, but {_WORDS[kind]}; give what {maker} wrote")


def told_kind(path: str | Path, *, wanted: str) -> str:
    """Return what a file is instead of what is wanted, and which commands take it; empty where nothing is known."""
    kind = kind_of(path)
    return "" if kind is None or kind == wanted else _WORDS[kind]
