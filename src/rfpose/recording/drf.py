"""Digital RF recordings: every channel is a receiver.

The digital_rf library says which files belong to a channel; they are read here. Its own readers trust what the files
declare, leave out files that they cannot open, and the reader of metadata deletes such files.
"""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime, timedelta
from fractions import Fraction
from pathlib import Path
from typing import Any, Final, NamedTuple

import h5py
import numpy as np

from rfpose.errors import InvalidInputError, RecordingError, install_remedy
from rfpose.foreign import exact_number, exact_rate
from rfpose.heaps import open_hdf5
from rfpose.recording.base import IndexArray, IqArray, Recording, SampleFormat
from rfpose.recording.hdf5 import FROM_SAMPLES, FROM_TABLE, find_dataset, find_item, printable
from rfpose.recording.links import refuse_tree_outside
from rfpose.recording.sidecar import load_sidecar_scenario
from rfpose.recording.stamps import LARGEST_INDEX
from rfpose.scenario import Scenario

__all__ = ["CENTRE_FREQUENCIES", "DigitalRfRecording", "import_digital_rf"]

_log = logging.getLogger(__name__)

CENTRE_FREQUENCIES = "center_frequencies"
"""Field of a channel's Digital Metadata under which its own recorder, thor, notes the tuning, one a subchannel."""

_PROPERTIES: Final = "drf_properties.h5"
_CACHE_BYTES = 2**28
"""Over all channels. A compressed file is inflated chunk by chunk, and a chunk may hold many frames."""
_MOST_SUBCHANNELS = 1024
_REMEMBERED_FILES: Final = 8
"""Of a channel that grows: files of one time, which are listed again with new ones."""
# H5Tget_class, bytes a component
_SAMPLE_FORMATS: dict[tuple[int, int], SampleFormat] = {(0, 2): "int16", (1, 4): "complex64"}
_NOT_TO_BE_HAD: Final = (RecordingError, FileNotFoundError, PermissionError, BlockingIOError)
"""What is no damage of the file."""
_HDF5_ERRORS: Final = (OSError, RuntimeError, KeyError, ValueError, TypeError, OverflowError, IndexError)
"""What h5py raises at what it cannot read or has no type for."""


def import_digital_rf() -> Any:
    """Return the digital_rf module, or say how to get it."""
    root = logging.getLogger()
    level, handlers = root.level, list(root.handlers)
    try:
        import digital_rf
    except ImportError as error:
        raise RecordingError(
            f"Digital RF needs the digital_rf library ({error}); install it, {install_remedy('digital-rf')}"
        ) from error
    finally:  # it sets up the program's logging, and every note would be told twice
        root.setLevel(level)
        root.handlers[:] = handlers
    return digital_rf


class _Channel(NamedTuple):
    """What a channel's properties say, and its files in order of time."""

    directory: Path
    rate: Fraction
    sample_format: SampleFormat
    n_subchannel: int
    files: list[Path]
    version: str


class _Piece(NamedTuple):
    """A stretch without a gap within one file."""

    start: int
    length: int
    offset: int
    file: Path


class DigitalRfRecording(Recording):
    """A Digital RF directory. Open it through `open_recording`.

    A channel of several subchannels gives one receiver a subchannel: ``CHANNEL_r0``, ``CHANNEL_r1`` and so on.
    """

    grows = True

    def __init__(self, path: Path, *, scenario: Scenario | None = None, follow_links: bool = False) -> None:
        library = import_digital_rf()
        if not follow_links:
            refuse_tree_outside(path)
        self._follow_links = follow_links
        self._channels = {
            properties.parent.name: _channel(library, properties, follow_links=follow_links)
            for properties in sorted(path.glob(f"*/{_PROPERTIES}"))
        }
        first_name, first = next(iter(self._channels.items()))
        for name, channel in self._channels.items():
            if (channel.sample_format, channel.rate) != (first.sample_format, first.rate):
                raise RecordingError(
                    f"{path}: channel `{name}` ({channel.rate} Hz) and channel `{first_name}` ({first.sample_format} "
                    f"at {first.rate} Hz) differ in rate or type; put them into separate directories"
                )
        self._place = _receivers(path, self._channels)
        self._pieces: dict[str, list[_Piece]] = {}
        self._opened: dict[str, tuple[Path, h5py.File, h5py.Dataset]] = {}
        self._told: dict[str, list[str]] = {name: [] for name in self._place}
        for channel_name, channel in self._channels.items():
            for doubt in _unfinished(channel.directory):
                self._tell(channel_name, doubt)
            if channel.files:  # its properties do not say whether integers have a sign
                self._pieces_in(channel_name, channel.files[0])
        super().__init__(
            path,
            format="digital-rf",
            receiver_ids=tuple(self._place),
            sample_rate=first.rate,
            centre_frequency_hz=self._centre_frequency(library),
            sample_format=first.sample_format,
            full_scale=32767.0 if first.sample_format == "int16" else math.inf,
            scenario=scenario if scenario is not None else load_sidecar_scenario(path, follow_links=follow_links),
            provenance={"digital_rf_version": first.version, "channels": ", ".join(self._channels)},
        )
        self.doubts = self._told

    def close(self) -> None:
        """Close the files that are open."""
        for _, file, _ in self._opened.values():
            file.close()
        self._opened.clear()

    # -- growing -----------------------------------------------------------------------------------------

    def refresh(self) -> None:
        """Take in files that were completed since; one that cannot be read, or goes back in time, is left out."""
        library = import_digital_rf()
        for name, channel in self._channels.items():
            known = set(channel.files[-_REMEMBERED_FILES:])
            since = _time_of(channel.files[-1]) if channel.files else None
            new = [path for path in _files(library, channel.directory, since) if path not in known]
            if not new:
                continue
            channel.files.extend(new)
            for receiver_id, (own, _) in self._place.items():
                if own == name:
                    self._segments.pop(receiver_id, None)
                    self._blocks.pop(receiver_id, None)
            for path in new if name in self._pieces else ():
                self._take_in(name, path)

    def _take_in(self, channel: str, path: Path) -> None:
        pieces = self._pieces[channel]
        try:
            found = self._pieces_in(channel, path)
            if found and pieces and found[0].start < pieces[-1].start + pieces[-1].length:
                raise RecordingError(f"{path}: goes back in time: starts before `{pieces[-1].file.name}` ends")
        except RecordingError as error:
            _log.warning("%s; it is left out", error)
            self._tell(channel, f"its file `{path.name}` is left out: {error}")
        else:
            pieces += found

    def forget(self, before_index: int) -> None:
        """Let go of files that end before a sample; a channel's last one is kept, by which new ones are known."""
        for name, channel in self._channels.items():
            if name in self._pieces:
                pieces = self._pieces[name]
                n_old = sum(piece.start + piece.length <= before_index for piece in pieces[:-1])
                del pieces[:n_old]
                first = pieces[0].file if pieces else None
                n_old = channel.files.index(first) if first in channel.files else 0
            else:
                begins = [
                    int(_time_of(path) / timedelta(milliseconds=1)) * channel.rate / 1000 for path in channel.files
                ]
                n_old = max(0, sum(begin <= before_index for begin in begins) - 1)
            del channel.files[:n_old]
            if n_old:
                for receiver_id, (own, _) in self._place.items():
                    if own == name:
                        self._segments.pop(receiver_id, None)
                        self._blocks.pop(receiver_id, None)

    # -- samples -----------------------------------------------------------------------------------------

    def _load_segments(self, receiver_id: str) -> IndexArray:
        channel = self._place[receiver_id][0]
        if channel not in self._pieces:
            pieces: list[_Piece] = []
            for path in self._channels[channel].files:
                found = self._pieces_in(channel, path)
                if found and pieces and found[0].start < pieces[-1].start + pieces[-1].length:
                    raise RecordingError(
                        f"{path}: starts with sample {found[0].start}, before `{pieces[-1].file.name}` ends; remove "
                        "one of the two"
                    )
                pieces += found
            self._pieces[channel] = pieces
        return np.array([(piece.start, piece.length) for piece in self._pieces[channel]], np.int64).reshape(-1, 2)

    def _pieces_in(self, channel: str, path: Path) -> list[_Piece]:
        """Return the stretches in one file; one that is damaged, or to which nothing was written, has none."""
        try:
            with open_hdf5(path) as file:
                if file.get("rf_data", getlink=True) is None or file.get("rf_data_index", getlink=True) is None:
                    self._tell(channel, f"its file `{path.name}` is corrupt: it holds no samples")
                    return []
                n_sample = len(_samples(file, self._channels[channel], self._follow_links))
                table = _index(file, n_sample, self._follow_links)
        except _NOT_TO_BE_HAD as error:
            raise _unreadable(path, channel, error) from error
        except _HDF5_ERRORS as error:  # costs what is in it, and nothing of the others
            self._tell(channel, f"its file `{path.name}` is damaged ({error}): its samples are left out; copy it again")
            return []
        ends = np.append(table[1:, 1], n_sample)
        return [
            _Piece(start, end - offset, offset, path)
            for (start, offset), end in zip(table.tolist(), ends.tolist(), strict=True)
            if end > offset
        ]

    def _read_segment(self, receiver_id: str, i_segment: int, skip: int, out: IqArray) -> None:
        channel, k = self._place[receiver_id]
        piece = self._pieces[channel][i_segment]
        first = piece.offset + skip
        try:
            samples = self._data(channel, piece.file)[first : first + len(out), k]
        except FileNotFoundError as error:
            raise RecordingError(
                f"{self.path}: channel `{channel}` lost samples after {piece.start} since it was opened "
                f"(`{piece.file.name}` is gone); open it again when nothing writes to it"
            ) from error
        except _HDF5_ERRORS as error:
            raise _unreadable(piece.file, channel, error) from error
        if len(samples) != len(out):
            raise RecordingError(f"{piece.file}: became shorter since it was opened; open the recording again")
        component = samples.dtype["r"] if samples.dtype.names else samples.real.dtype
        out[:] = np.ascontiguousarray(samples).view(component).reshape(-1, 2)

    def _data(self, channel: str, path: Path) -> h5py.Dataset:
        """Return a file's samples; one file a channel stays open."""
        if channel not in self._opened or self._opened[channel][0] != path:
            if channel in self._opened:
                self._opened.pop(channel)[1].close()
            file = open_hdf5(path, rdcc_nbytes=_CACHE_BYTES // len(self._channels))
            try:
                self._opened[channel] = path, file, _samples(file, self._channels[channel], self._follow_links)
            except BaseException:
                file.close()
                raise
        return self._opened[channel][2]

    def _tell(self, channel: str, doubt: str) -> None:
        _log.info("%s: channel %s: %s", self._channels[channel].directory, channel, doubt)
        for name, (own, _) in self._place.items():
            if own == channel and doubt not in self._told[name]:
                self._told[name].append(doubt)

    # -- tuning ------------------------------------------------------------------------------------------

    def _centre_frequency(self, library: Any) -> float | None:
        """Return the one tuning of all receivers at all times, None if no channel notes any."""
        tuned: dict[str, float] = {}
        for channel_name, channel in self._channels.items():
            entries = _tunings(library, channel, follow_links=self._follow_links)
            if not entries:
                continue
            first, last = self._bounds(channel_name)
            past = [at for at in entries if at <= first]
            in_force = [entries[at] for at in (*past[-1:], *(at for at in entries if first < at <= last))]
            changes = [at for at in entries if first < at <= last]
            for name, (own, k) in self._place.items():
                if own != channel_name:
                    continue
                values = [value for row in in_force if (value := row[k]) is not None]
                for value in values:
                    if value != values[0]:
                        raise RecordingError(
                            f"{channel.directory / 'metadata'}: `{name}` is tuned to {values[0]:.12g} Hz and to "
                            f"{value:.12g} Hz while it records (entries at samples "
                            f"{', '.join(str(at) for at in changes[:4])}); split the recording where the tuning changes"
                        )
                if values:
                    tuned[name] = values[0]
                if values and not past:
                    self._told[name].append("its metadata says to what it was tuned only from a later sample on")
        if not tuned:
            return None
        reference, wanted = next(iter(tuned.items()))
        for name, value in tuned.items():
            if value != wanted:
                raise RecordingError(
                    f"{self._channels[self._place[name][0]].directory / 'metadata'}: `{name}` is tuned to {value:.12g} "
                    f"Hz, but `{reference}` to {wanted:.12g} Hz; put them into separate directories"
                )
        for name in self._place:
            if name not in tuned:
                self._told[name].append(f"its metadata does not say to what it was tuned, `{reference}`'s does")
        return wanted

    def _bounds(self, channel: str) -> tuple[int, int]:
        """Return the first and last sample of a channel, without opening all of its files."""
        files = self._channels[channel].files
        first = next((pieces[0] for path in files if (pieces := self._pieces_in(channel, path))), None)
        last = next((pieces[-1] for path in reversed(files) if (pieces := self._pieces_in(channel, path))), None)
        if first is None or last is None:
            return 0, 0
        return first.start, last.start + last.length - 1


def _channel(library: Any, properties: Path, *, follow_links: bool) -> _Channel:
    """Read a channel's properties and list its files."""
    try:
        with open_hdf5(properties) as file:
            found = {name: _scalar(value) for name, value in file.attrs.items()}
    except _HDF5_ERRORS as error:
        raise _unreadable(properties, properties.parent.name, error) from error
    directory = properties.parent
    if not directory.name.isprintable():
        raise RecordingError(f"{properties}: {directory.name!a} is no name for a receiver; rename the directory")
    try:
        rate = _rate(found)
        n_subchannel = _whole(found, "num_subchannels")
        kind, size = _whole(found, "H5Tget_class"), _whole(found, "H5Tget_size")
        is_complex = bool(_whole(found, "is_complex"))
        if not 1 <= n_subchannel <= _MOST_SUBCHANNELS:
            raise InvalidInputError(f"`num_subchannels` must be 1 to {_MOST_SUBCHANNELS}, is {n_subchannel}")
    except InvalidInputError as error:
        raise RecordingError(f"{properties}: {error}; copy the file again") from error
    sample_format = _SAMPLE_FORMATS.get((kind, size))
    if sample_format is None or not is_complex:
        raise RecordingError(
            f"{directory.parent}: channel `{directory.name}` holds {'complex' if is_complex else 'real'} samples of "
            f"{8 * size} bits ({ {0: 'integer', 1: 'float'}.get(kind, 'other') }); rfpose reads complex int16 "
            "and complex float32: record or convert it to one of them"
        )
    return _Channel(
        directory=directory,
        rate=rate,
        sample_format=sample_format,
        n_subchannel=n_subchannel,
        files=_files(library, directory),
        version=printable(str(found.get("digital_rf_version", ""))),
    )


def _files(library: Any, directory: Path, since: timedelta | None = None) -> list[Path]:
    """List a channel's files in order of time, those that begin at a time (since the epoch) or after it."""
    found = library.ilsdrf(
        str(directory),
        recursive=False,
        include_drf=True,
        include_dmd=False,
        include_drf_properties=False,
        starttime=None if since is None else datetime(1970, 1, 1, tzinfo=UTC) + since,
    )
    return [Path(name) for name in found]


def _time_of(path: Path) -> timedelta:
    """Return the time since the epoch that a file is named by."""
    found = re.search(r"@(\d+)\.(\d{3})\.h5$", path.name)
    return timedelta() if found is None else timedelta(seconds=int(found[1]), milliseconds=int(found[2]))


def _scalar(value: Any) -> Any:
    """Return an attribute's one value: some versions write arrays of one."""
    return value.item() if isinstance(value, np.ndarray | np.generic) and value.size == 1 else value


def _whole(properties: Mapping[str, Any], name: str) -> int:
    if name not in properties:
        raise InvalidInputError(f"attribute `{name}` is missing")
    value = exact_number(name, properties[name])
    if value.denominator != 1:
        raise InvalidInputError(f"`{name}` must be a whole number, is {float(value):g}")
    return int(value)


def _rate(properties: Mapping[str, Any]) -> Fraction:
    if "sample_rate_numerator" not in properties and "samples_per_second" in properties:  # before version 2.3
        return exact_rate("samples_per_second", properties["samples_per_second"])
    numerator, denominator = (_whole(properties, f"sample_rate_{part}") for part in ("numerator", "denominator"))
    if denominator == 0:
        raise InvalidInputError("`sample_rate_denominator` must not be zero")
    return exact_rate("sample_rate_numerator", Fraction(numerator, denominator))


def _receivers(path: Path, channels: Mapping[str, _Channel]) -> dict[str, tuple[str, int]]:
    """Return the channel and subchannel of each receiver."""
    place: dict[str, tuple[str, int]] = {}
    for name, channel in channels.items():
        for k in range(channel.n_subchannel):
            receiver_id = name if channel.n_subchannel == 1 else f"{name}_r{k}"
            if receiver_id in place or (receiver_id != name and receiver_id in channels):
                raise RecordingError(
                    f"{path}: a channel `{receiver_id}` stands beside subchannel {k} of `{name}`, which is read under "
                    "the same name; rename one of the directories"
                )
            place[receiver_id] = (name, k)
    return place


def _unfinished(directory: Path) -> list[str]:
    """Tell of files that a recorder had begun: it gives them their names when they are complete."""
    found = sorted(directory.glob("*/tmp.*.h5"))
    if not found:
        return []
    more = f" and {len(found) - 1} more" if len(found) > 1 else ""
    return [
        f"`{found[0].relative_to(directory.parent)}`{more} was not completed: its recorder still writes or was "
        "stopped, and its samples are not read"
    ]


def _samples(file: h5py.File, channel: _Channel, follow_links: bool) -> h5py.Dataset:
    """Return a file's samples (sample, subchannel), of exactly the promised type."""
    found = find_dataset(file, "/rf_data", follow_links=follow_links, per_stored=FROM_SAMPLES)
    if found is None or found.ndim != 2 or found.shape[1] != channel.n_subchannel:
        shape = None if found is None else found.shape
        raise RecordingError(
            f"{file.filename}: `/rf_data` must be of shape (sample, {channel.n_subchannel}), is {shape}; "
            "remove the file"
        )
    dtype = found.dtype
    parts = [dtype[name] for name in dtype.names] if dtype.names else [np.dtype(f"f{dtype.itemsize // 2}")]
    wanted = "i2" if channel.sample_format == "int16" else "f4"
    is_complex = dtype.kind == "c" or (dtype.names is not None and len(dtype.names) == 2)
    if not is_complex or any(part.newbyteorder("=") != np.dtype(wanted) for part in parts):
        kind = f"complex {parts[0].newbyteorder('=').name}" if is_complex else str(dtype)
        raise RecordingError(
            f"{file.filename}: channel `{channel.directory.name}` holds {kind} samples; rfpose reads complex int16 and "
            "complex float32: record or convert it to one of them"
        )
    return found


def _index(file: h5py.File, n_sample: int, follow_links: bool) -> IndexArray:
    """Return (stretch, 2) rows [first sample since the epoch, its place in the file], checked."""
    found = find_dataset(file, "/rf_data_index", follow_links=follow_links, per_stored=FROM_TABLE)
    if found is None or found.ndim != 2 or found.shape[1] != 2 or found.dtype.kind not in "iu" or not len(found):
        raise RecordingError(
            f"{file.filename}: `/rf_data_index` must be integers of shape (stretch, 2); remove the file"
        )
    rows = found[()]
    # before they become signed: numbers from a damaged file must not overflow into plausible ones
    fits = (rows[:, 0] < LARGEST_INDEX) & (rows[:, 1] <= n_sample) & (rows >= 0).all(axis=1)
    if fits.all():
        start, offset = rows.astype(np.int64).T
        count = np.diff(np.append(offset, n_sample))
        fits = count >= 0
        fits[:-1] &= start[1:] >= start[:-1] + count[:-1]
    if not fits.all():
        i = int(np.flatnonzero(~fits)[0])
        raise RecordingError(
            f"{file.filename}: `/rf_data_index` row {i} is {rows[i].tolist()}, which does not fit the {n_sample} "
            "samples stored or the row after; copy the file again or remove it"
        )
    table: IndexArray = rows.astype(np.int64)
    return table


def _tunings(library: Any, channel: _Channel, *, follow_links: bool) -> dict[int, Sequence[float | None]]:
    """Return the noted tunings of all subchannels by the sample from which they hold, in order; None: not known."""
    directory = channel.directory / "metadata"
    if not directory.is_dir():
        return {}
    scale = Fraction(1)
    entries: dict[int, Sequence[float | None]] = {}
    files = [
        Path(name)
        for name in library.ilsdrf(
            str(directory), recursive=False, include_drf=False, include_dmd=True, include_dmd_properties=False
        )
    ]
    path = directory / "dmd_properties.h5"
    try:
        if path.is_file():
            with open_hdf5(path) as file:
                scale = channel.rate / _rate({name: _scalar(value) for name, value in file.attrs.items()})
        for path in files:
            with open_hdf5(path) as file:
                for index in file:
                    place = f"/{index}/{CENTRE_FREQUENCIES}"
                    if not (index.isascii() and index.isdigit() and len(index) < 20):
                        continue
                    if find_item(file, place, follow_links=follow_links) is None:
                        continue
                    found = find_dataset(file, place, follow_links=follow_links, per_stored=FROM_TABLE)
                    entries[round(int(index) * scale)] = _frequencies(found, channel.n_subchannel)
    except InvalidInputError as error:
        raise RecordingError(f"{path}: {error}; copy the file again") from error
    except _HDF5_ERRORS as error:
        raise _unreadable(path, channel.directory.name, error) from error
    return dict(sorted(entries.items()))


def _frequencies(found: h5py.Dataset | None, n_subchannel: int) -> Sequence[float | None]:
    """Return one frequency a subchannel; a single one is that of all."""
    if found is None or found.dtype.kind not in "fiu" or found.size not in (1, n_subchannel):
        shape = "nothing" if found is None else f"{found.dtype} of shape {found.shape}"
        raise InvalidInputError(
            f"`{CENTRE_FREQUENCIES}` must be {n_subchannel} frequencies, one a subchannel, is {shape}"
        )
    values = np.broadcast_to(np.ravel(found[()]).astype(np.float64), n_subchannel).tolist()
    return [value if math.isfinite(value) else None for value in values]


def _unreadable(path: Path, channel: str, error: Exception) -> RecordingError:
    if isinstance(error, RecordingError):
        return error
    return RecordingError(
        f"{path}: cannot read `{channel}`: {error}; copy the recording again, or remove the damaged file"
    )
