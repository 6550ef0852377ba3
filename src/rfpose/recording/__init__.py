"""IQ on disk: rfpose-iq (HDF5), Digital RF, SigMF, WAV, raw samples, and recordings of many such parts.

`open_recording` reads any of them, `RecordingWriter` writes the first, `convert` goes between them.
"""

from typing import TYPE_CHECKING, Any

from rfpose.recording.base import GapError, Recording, count_fill, frame_starts, recorded_runs
from rfpose.recording.declared import Declared
from rfpose.recording.opening import RecordingSource, files_of, open_recording
from rfpose.recording.summary import check_against, describe, note_doubts
from rfpose.recording.writer import RecordingWriter

if TYPE_CHECKING:
    from rfpose.recording.conversion import convert

__all__ = [
    "Declared",
    "GapError",
    "Recording",
    "RecordingSource",
    "RecordingWriter",
    "check_against",
    "convert",
    "count_fill",
    "describe",
    "files_of",
    "frame_starts",
    "note_doubts",
    "open_recording",
    "recorded_runs",
]


def __getattr__(name: str) -> Any:
    if name != "convert":  # the writers of all formats, which no reader needs
        raise AttributeError(f"module 'rfpose.recording' has no attribute {name!r}")
    from rfpose.recording.conversion import convert

    return convert
