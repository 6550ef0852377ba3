"""Digital RF recordings, read through the digital_rf library: every channel is a receiver."""

from __future__ import annotations

import contextlib
import io
import logging
import math
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from rfpose.errors import RecordingError
from rfpose.recording.base import IndexArray, IqArray, Recording, SampleFormat
from rfpose.recording.sidecar import load_sidecar_scenario
from rfpose.scenario import Scenario

__all__ = ["CENTRE_FREQUENCIES", "DigitalRfRecording", "import_digital_rf"]

_log = logging.getLogger(__name__)

CENTRE_FREQUENCIES = "center_frequencies"
"""Field of a channel's Digital Metadata under which its own recorder, thor, notes the tuning, one a subchannel."""

_CACHE_BYTES = 2**28
"""Over all channels. A compressed file is inflated chunk by chunk, and a chunk may hold many frames."""
# H5Tget_class, bytes a component
_SAMPLE_FORMATS: dict[tuple[int, int], SampleFormat] = {(0, 2): "int16", (1, 4): "complex64"}


def import_digital_rf() -> Any:
    """Return the digital_rf module, or say how to get it."""
    try:
        import digital_rf
    except ImportError as error:
        raise RecordingError(
            f"Digital RF needs the digital_rf library ({error}); install it with `pip install 'rfpose[digital-rf]'`"
        ) from error
    return digital_rf


class DigitalRfRecording(Recording):
    """A Digital RF directory. Open it through `open_recording`.

    A channel of several subchannels gives one receiver a subchannel: ``CHANNEL_r0``, ``CHANNEL_r1`` and so on.
    """

    def __init__(self, path: Path, *, scenario: Scenario | None = None) -> None:
        library = import_digital_rf()
        self._path = path
        with self._library_errors("drf_properties.h5"):
            n_channel = sum(1 for _ in path.glob("*/drf_properties.h5"))
            self._reader = library.DigitalRFReader(str(path), rdcc_nbytes=_CACHE_BYTES // n_channel)
            properties = {name: self._reader.get_properties(name) for name in self._reader.get_channels()}
        first = next(iter(properties))
        sample_format = self._checked_format(first, properties[first])
        for name, found in properties.items():
            if self._checked_format(name, found) != sample_format or _rate(found) != _rate(properties[first]):
                raise RecordingError(
                    f"{path}: channel `{name}` ({_rate(found)} Hz) and channel `{first}` ({sample_format} at "
                    f"{_rate(properties[first])} Hz) differ in rate or type; put them into separate directories"
                )
        self._place: dict[str, tuple[str, int]] = {}
        for name, found in properties.items():
            n_subchannel = int(found["num_subchannels"])
            for k in range(n_subchannel):
                receiver_id = name if n_subchannel == 1 else f"{name}_r{k}"
                if receiver_id in self._place:
                    raise RecordingError(
                        f"{path}: a channel `{receiver_id}` stands beside subchannel {k} of `{name}`, which is read "
                        "under the same name; rename one of the directories"
                    )
                self._place[receiver_id] = (name, k)
        super().__init__(
            path,
            format="digital-rf",
            receiver_ids=tuple(self._place),
            sample_rate=_rate(properties[first]),
            centre_frequency_hz=self._centre_frequency(first),
            sample_format=sample_format,
            full_scale=32767.0 if sample_format == "int16" else math.inf,
            scenario=scenario if scenario is not None else load_sidecar_scenario(path),
            provenance={
                "digital_rf_version": str(properties[first].get("digital_rf_version", "")),
                "channels": ", ".join(properties),
            },
        )

    def close(self) -> None:
        """Release the library's open file."""
        self._reader.close()

    def _checked_format(self, channel: str, found: dict[str, Any]) -> SampleFormat:
        kind, size, is_complex = int(found["H5Tget_class"]), int(found["H5Tget_size"]), bool(found["is_complex"])
        sample_format = _SAMPLE_FORMATS.get((kind, size))
        if sample_format is None or not is_complex:
            raise RecordingError(
                f"{self._path}: channel `{channel}` holds {'complex' if is_complex else 'real'} samples of {8 * size} "
                f"bits ({ {0: 'integer', 1: 'float'}.get(kind, 'other') }); rfpose reads complex int16 and complex "
                "float32: record or convert it to one of them"
            )
        return sample_format

    def _centre_frequency(self, channel: str) -> float | None:
        try:
            latest = self._reader.get_digital_metadata(channel).read_latest(CENTRE_FREQUENCIES)
            value = float(np.ravel(next(iter(latest.values())))[0])
        except (OSError, KeyError, ValueError, StopIteration, IndexError, TypeError) as error:
            _log.debug("%s: no tuning in the metadata of channel %s: %s", self._path, channel, error)
            return None
        return value if math.isfinite(value) else None

    def _load_segments(self, receiver_id: str) -> IndexArray:
        channel, _ = self._place[receiver_id]
        with self._library_errors(channel):
            first, last = self._reader.get_bounds(channel)
            if first is None or last is None:
                return np.empty((0, 2), np.int64)
            blocks = self._reader.get_continuous_blocks(first, last, channel)
        return np.array(list(blocks.items()), np.int64).reshape(-1, 2)

    def _read_segment(self, receiver_id: str, i_segment: int, skip: int, out: IqArray) -> None:
        channel, k = self._place[receiver_id]
        first = int(self._segments[receiver_id][i_segment, 0]) + skip
        with self._library_errors(channel):
            pieces = self._reader.read(first, first + len(out) - 1, channel, sub_channel=k)
        if sum(len(piece) for piece in pieces.values()) != len(out):
            raise RecordingError(
                f"{self.path}: channel `{channel}` lost samples after {first} since it was opened; open it again when "
                "nothing writes to it"
            )
        done = 0
        for piece in pieces.values():
            component = piece.dtype["r"] if piece.dtype.names else piece.real.dtype
            out[done : done + len(piece)] = piece.view(component).reshape(-1, 2)
            done += len(piece)

    @contextlib.contextmanager
    def _library_errors(self, place: str) -> Iterator[None]:
        """Turn the library's errors into ours, and what it prints into log messages."""
        printed = io.StringIO()
        try:
            with contextlib.redirect_stdout(printed):
                yield
        except (OSError, KeyError, ValueError, RuntimeError, AttributeError, IndexError) as error:
            raise RecordingError(
                f"{self._path}: cannot read `{place}`: {error}; copy the recording again, or remove the damaged file"
            ) from error
        finally:
            for line in printed.getvalue().splitlines():
                _log.warning("%s: %s", self._path, line)


def _rate(properties: dict[str, Any]) -> Fraction:
    return Fraction(int(properties["sample_rate_numerator"]), int(properties["sample_rate_denominator"]))
