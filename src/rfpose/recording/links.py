"""Recordings come from elsewhere: what they name outside their own folder is not read unless the user says so."""

from __future__ import annotations

import os
from pathlib import Path

from rfpose.errors import RecordingError

__all__ = ["FOLLOW", "refuse_outside", "refuse_tree_outside"]

FOLLOW = "if you trust where it comes from, add `follow_links=True`"
"""What to do about it, for messages."""


def refuse_outside(folder: Path, path: Path, *, named_by: Path) -> None:
    """Raise unless ``path``, with every link followed, lies in ``folder``.

    Parameters
    ----------
    folder
        The recording's folder.
    path
        What is to be read.
    named_by
        The file or folder that names it, for the message.

    Raises
    ------
    RecordingError
        It lies elsewhere; the message names where and the remedy.
    """
    target = path.resolve()
    if not target.is_relative_to(folder.resolve()):
        raise RecordingError(
            f"{named_by}: names `{target}`, which lies outside the recording's folder and is not read; {FOLLOW}"
        )


def refuse_tree_outside(folder: Path) -> None:
    """Raise unless every link below ``folder`` leads to a place in ``folder``; see `refuse_outside`."""
    for directory, folders, files in os.walk(folder):
        for name in (*folders, *files):
            path = Path(directory) / name
            if path.is_symlink():
                refuse_outside(folder, path, named_by=path)
