"""Files that hold samples and nothing else; what they are is declared."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rfpose.errors import RecordingError
from rfpose.kinds import is_hdf5
from rfpose.recording.declared import Declared
from rfpose.recording.flat import FlatRecording, FlatStream
from rfpose.recording.sidecar import receiver_name
from rfpose.recording.stamps import LARGEST_INDEX
from rfpose.recording.wav import is_wav
from rfpose.scenario import Scenario

__all__ = ["RawRecording"]


class RawRecording(FlatRecording):
    """Interleaved samples of one or several receivers. Open it through `open_recording`."""

    def __init__(self, path: Path, *, declared: Declared, scenario: Scenario | None = None) -> None:
        kind, rate = declared.type, declared.sample_rate
        assert kind is not None
        assert rate is not None
        names = declared.receiver_ids or (receiver_name(path.stem),)
        if not path.is_file():
            raise RecordingError(f"{path}: not a file; give a file of samples")
        n_sample, rest = divmod(path.stat().st_size, kind.sample_bytes * len(names))
        if rest:
            raise RecordingError(
                f"{path}: does not hold an integer number of samples of {kind.name} of {len(names)} receivers: {rest} "
                "bytes are left; check type and receivers, or copy it again"
            )
        start = round((declared.start_s or 0) * rate)
        if start + n_sample > LARGEST_INDEX:
            raise RecordingError(f"{path}: would end at sample {start + n_sample}, more than 64 bits can count")
        segments = np.array([[start, n_sample, 0]] if n_sample else [], np.int64).reshape(-1, 3)
        untimed = [] if declared.start_s is not None else ["nothing says when it was recorded; say so with `start`"]
        other = "HDF5" if is_hdf5(path) else "WAV" if is_wav(path) else None
        foreign = [] if other is None else [f"it begins as a file of {other} does, whose header is taken for samples"]
        streams = {
            name: FlatStream(
                file=path,
                type=kind,
                segments=segments,
                channels=len(names),
                channel=k,
                doubts=foreign + untimed,
                time_known=not untimed,
            )
            for k, name in enumerate(names)
        }
        super().__init__(
            path,
            streams,
            format="raw",
            sample_rate=rate,
            centre_frequency_hz=declared.centre_frequency_hz,
            scenario=scenario,
        )
