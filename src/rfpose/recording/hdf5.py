"""What an HDF5 file from elsewhere holds: found without leaving the file, and no larger than what is stored of it."""

from __future__ import annotations

import contextlib
import importlib
import math
import os
from collections import deque
from typing import Any, Final

import h5py

from rfpose.errors import RecordingError
from rfpose.recording.links import FOLLOW

__all__ = ["FROM_SAMPLES", "FROM_TABLE", "find_dataset", "find_item", "printable"]

FROM_SAMPLES: Final = 1100
"""As many bytes as one stored byte may stand for in samples, which are read piece by piece: what deflate reaches."""
FROM_TABLE: Final = 64
"""The same for a table, which is read as a whole."""
_UNSTORED_BYTES: Final = 2**24
"""So much may be declared beyond that: fill values for which nothing is stored yet."""
_FILTERED_CHUNK_BYTES: Final = 2**28
"""A compressed chunk is inflated as a whole, however little of it is read."""
_SOFT_LINKS: Final = 16
_FILTERS: Final = {
    4: "szip", 305: "LZO", 307: "bzip2", 32000: "LZF", 32001: "Blosc", 32004: "LZ4", 32008: "bitshuffle", 32013: "ZFP",
    32015: "Zstandard", 32017: "SZ", 32026: "Blosc2",
}  # fmt: skip


def printable(text: str) -> str:
    """Return a text whose bytes were no UTF-8 in a form that can be written anywhere."""
    return text.encode("utf-8", "backslashreplace").decode()


def find_item(
    file: h5py.File, place: str, *, follow_links: bool, within: h5py.Group | None = None
) -> h5py.Group | h5py.Dataset | None:
    """Return what stands at an absolute place of a file, or None.

    ``within``, the group that holds it, spares the way there.

    Raises
    ------
    RecordingError
        The way there leads into another file and ``follow_links`` is not set, or in a circle.
    """
    with contextlib.suppress(_NotPlainError):
        if within is not None:
            return _plain_item(within.id, [place.rpartition("/")[2]])
        return _plain_item(h5py.h5g.open(file.id, b"/"), [part for part in place.split("/") if part])
    group, parts, n_soft = file["/"], deque(part for part in place.split("/") if part), 0
    while parts:
        name = parts.popleft()
        link = group.get(name, getlink=True) if isinstance(group, h5py.Group) else None
        if link is None:
            return None
        if isinstance(link, h5py.SoftLink):
            n_soft += 1
            if n_soft > _SOFT_LINKS:
                raise RecordingError(f"{file.filename}: the soft links at `{place}` lead in a circle; remove them")
            if link.path.startswith("/"):
                group = file["/"]
            parts.extendleft(part for part in reversed(link.path.split("/")) if part and part != ".")
            continue
        if not isinstance(link, h5py.HardLink) and not follow_links:
            where = f" in `{link.filename}`" if isinstance(link, h5py.ExternalLink) else ""
            raise RecordingError(
                f"{file.filename}: `{place}` stands in another file{printable(where)}, which is not read; {FOLLOW}"
            )
        group = group[name]
    return group


class _NotPlainError(Exception):
    """A link on the way is not there, or none of the hard ones that files are made with."""


def _plain_item(group: h5py.h5g.GroupID, parts: list[str]) -> h5py.Group | h5py.Dataset | None:
    """Return what `find_item` does where all links are hard: many times as fast, for files of many receivers."""
    found: Any = group
    for name in parts:
        if not isinstance(found, h5py.h5g.GroupID):
            return None
        encoded = name.encode()
        try:
            link = found.links.get_info(encoded).type
        except (KeyError, RuntimeError) as error:  # there is none, or it cannot be read
            raise _NotPlainError from error
        if link != h5py.h5l.TYPE_HARD:
            raise _NotPlainError
        found = h5py.h5o.open(found, encoded)
    if isinstance(found, h5py.h5d.DatasetID):
        return h5py.Dataset(found, readonly=True)  # so that it asks for its shape once
    return h5py.Group(found) if isinstance(found, h5py.h5g.GroupID) else None


def find_dataset(
    file: h5py.File, place: str, *, follow_links: bool, per_stored: int, within: h5py.Group | None = None
) -> h5py.Dataset | None:
    """Return a dataset whose samples lie in its file and can be read, or None if there is none at ``place``.

    Parameters
    ----------
    file
        An open file.
    place
        Absolute.
    follow_links
        Whether it may stand, or have its values, in another file.
    per_stored
        `FROM_SAMPLES` or `FROM_TABLE`.
    within
        The group that holds it, which spares the way there.

    Raises
    ------
    RecordingError
        The values stand in another file; many more are declared than stored; or a filter is missing, which is named.
    """
    item = find_item(file, place, follow_links=follow_links, within=within)
    if not isinstance(item, h5py.Dataset):
        return None
    shape, item_bytes = item.shape, item.id.get_type().get_size()
    declared = 0 if shape is None else math.prod(shape) * item_bytes
    if declared <= _UNSTORED_BYTES and item.id.get_offset() is not None:
        return item  # it lies in this file in one piece, without filters
    settings = item.id.get_create_plist()
    layout, n_filter = settings.get_layout(), settings.get_nfilters()
    elsewhere = layout == h5py.h5d.VIRTUAL or bool(settings.get_external_count())
    if elsewhere and not follow_links:
        raise RecordingError(f"{file.filename}: `{place}` has its values in another file, which is not read; {FOLLOW}")
    if n_filter:
        _check_filters(f"{file.filename}: `{place}`", settings, item_bytes)
    if not elsewhere and declared > _UNSTORED_BYTES:
        # of what was never written HDF5 counts as stored what it would take
        stored = min(item.id.get_storage_size(), os.stat(file.filename).st_size)
        if declared > _UNSTORED_BYTES + per_stored * stored:
            raise RecordingError(
                f"{file.filename}: `{place}` declares {declared / 1e9:.3g} GB, of which {stored / 1e9:.3g} GB are "
                "stored; the file is damaged or was not completed: make it again"
            )
    return item


def _check_filters(where: str, settings: h5py.h5p.PropDCID, item_bytes: int) -> None:
    for i in range(settings.get_nfilters()):
        _check_filter(where, *settings.get_filter(i)[::3])
    chunk = math.prod(settings.get_chunk()) * item_bytes
    if chunk > _FILTERED_CHUNK_BYTES:
        raise RecordingError(
            f"{where} is compressed in chunks of {chunk / 1e9:.3g} GB, each of which must be inflated as a whole; "
            "write it again in chunks of about 1 MB"
        )


def _check_filter(where: str, code: int, name: bytes) -> None:
    if h5py.h5z.filter_avail(code):
        return
    with contextlib.suppress(ImportError):
        importlib.import_module("hdf5plugin")  # registers its filters
    if not h5py.h5z.filter_avail(code):
        called = _FILTERS.get(code) or name.decode("ascii", "replace") or "unknown"
        raise RecordingError(
            f"{where} is compressed by the HDF5 filter {code} ({called:.40}), which is not installed; install it with "
            "`pip install hdf5plugin`, or write the file again without it (`h5repack -f NONE`)"
        )
