"""One recording out of many: receivers in different files, files that follow each other, formats mixed."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import logging
import math
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from rfpose.errors import RecordingError, ScenarioError
from rfpose.recording.base import GapError, IndexArray, IqArray, Recording, count_fill, merge_rows
from rfpose.recording.stamps import stamp_text
from rfpose.scenario import Scenario
from rfpose.truth import Truth

__all__ = ["Part", "PartsRecording", "blocks_by_part", "coverage"]

_log = logging.getLogger(__name__)

_OPEN_PARTS: Final = 64
"""So many parts are held open; a plant's night is more files than a process may open."""
_COMPARED_SAMPLES: Final = 2**16
"""Of an overlap, at its beginning and at its end."""
_SHOWN: Final = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """One part of a recording, and how it lies in the whole.

    Attributes
    ----------
    name
        What messages and tables call it.
    open
        Opens it; a scenario that is given spares reading its own.
    receivers
        Names in the whole by the part's own names; None: as they are, all of them.
    offset_s
        What is to be added to its time [s].
    find_offset
        The offset is to be found besides; see `rfpose.pipeline.clocks`.
    start_s
        When it begins [s since 1970 UTC], for a part that does not say; None: as it says.
    """

    name: str
    open: Callable[[Scenario | None], Recording]
    receivers: Mapping[str, str] | None = None
    offset_s: Fraction = Fraction(0)
    find_offset: bool = False
    start_s: Fraction | None = None


class _Stretch(NamedTuple):
    """A block of one receiver in one part; indices are the whole's."""

    start: int
    n_sample: int
    part: int
    own_id: str

    @property
    def end(self) -> int:
        return self.start + self.n_sample


@dataclass(frozen=True, slots=True)
class _Known:
    """What is kept of a part when it is closed."""

    part: Part
    recording: Recording
    shift: int
    blocks: dict[str, IndexArray] = field(default_factory=dict)
    """By the receiver's name in the whole."""
    own_id: dict[str, str] = field(default_factory=dict)


class PartsRecording(Recording):
    """Many recordings that are read as one. Open it through `open_recording`.

    Parts have one sample rate and one site, or are refused, as is a receiver that is tuned otherwise in one part than
    in another; receivers may be tuned apart. A part that is missing or damaged is left out and named in `notes`. Where
    parts overlap in a receiver they must hold the same samples.

    Parameters
    ----------
    path
        What stands for the whole in messages.
    parts
        In the order in which their receivers are told.
    names
        What was given to open it.
    scenario
        The site; None: the one that the parts bring along.
    notes
        What is known to be wrong already.
    """

    def __init__(
        self,
        path: Path,
        parts: Sequence[Part],
        *,
        names: Sequence[str],
        scenario: Scenario | None = None,
        notes: Sequence[str] = (),
    ) -> None:
        self._opened: OrderedDict[int, Recording] = OrderedDict()
        self._broken: dict[int, str] = {}
        self._known: list[_Known] = []
        self._site = scenario
        self._given, self._given_notes = list(parts), list(notes)
        notes = list(notes)
        try:
            self._look_at(parts, notes)
            if not self._known:
                first = f": {notes[0]}" if notes else ""
                raise RecordingError(f"{path}: none of its {len(parts) or 'no'} parts can be read{first}")
            self._refuse_unlike(path)
            self._site = scenario if scenario is not None else self._one_site(path)
            formats = {known.recording.sample_format for known in self._known}
            first_part = self._known[0].recording
            super().__init__(
                path,
                format="parts",
                receiver_ids=tuple(dict.fromkeys(name for known in self._known for name in known.blocks)),
                sample_rate=first_part.sample_rate,
                centre_frequency_hz=next(
                    (f for known in self._known if (f := known.recording.centre_frequency_hz) is not None), None
                ),
                sample_format=formats.pop() if len(formats) == 1 else "complex64",
                full_scale=max(known.recording.full_scale for known in self._known),
                scenario=self._site,
                truth=_one_truth([known.recording.truth for known in self._known], notes),
                provenance={"parts": ", ".join(known.part.name for known in self._known)},
            )
            self.names = tuple(names)
            self.notes = notes
            self._tell_tunings()
            self._tell_doubts()
            self._stretches = {name: self._laid_out(name) for name in self.receiver_ids}
            self._tell_gaps()
        except BaseException:
            self.close()
            raise

    def files(self) -> list[Path]:
        """Return what its parts are read from."""
        return [file for known in self._known for file in known.recording.files()]

    def close(self) -> None:
        """Close the parts that are open."""
        while self._opened:
            self._opened.popitem()[1].close()

    def moved(self, offset_s: Mapping[str, Fraction], notes: Sequence[str]) -> PartsRecording:
        """Return the same with the clocks of parts, by name, set right; the parts are opened anew.

        Parameters
        ----------
        offset_s
            What is to be added to a part's time besides [s].
        notes
            What is to be told of it.
        """
        parts = [
            dataclasses.replace(part, offset_s=part.offset_s + offset_s.get(part.name, 0), find_offset=False)
            for part in self._given
        ]
        return PartsRecording(
            self.path, parts, names=self.names, scenario=self.scenario, notes=[*self._given_notes, *notes]
        )

    # -- putting together --------------------------------------------------------------------------------

    def _look_at(self, parts: Sequence[Part], notes: list[str]) -> None:
        """Open each part once; keep what is known of it, and tell why one is left out."""
        for part in parts:
            try:
                recording = part.open(self._site)
            except (RecordingError, ScenarioError) as error:
                notes.append(f"left out: {error}")
                continue
            i_part = len(self._known)
            self._keep_open(i_part, recording)
            if not recording.time_known and part.start_s is None:
                notes.append(
                    f"left out: {part.name}: when it was recorded is not known; say so with `start` in a manifest"
                )
                self._opened.pop(i_part).close()
                continue
            shift = round((part.offset_s + (part.start_s or 0)) * recording.sample_rate)
            known = _Known(part, recording, shift)
            for own_id, name in self._renamed(part, recording, notes).items():
                try:
                    blocks = recording.blocks(own_id)
                except RecordingError as error:
                    notes.append(f"receiver `{name}` of {part.name} left out: {error}")
                    continue
                known.blocks[name] = blocks + np.array([shift, 0])
                known.own_id[name] = own_id
            self._known.append(known)

    @staticmethod
    def _renamed(part: Part, recording: Recording, notes: list[str]) -> Mapping[str, str]:
        if part.receivers is None:
            return {name: name for name in recording.receiver_ids}
        for own_id in part.receivers:
            if own_id not in recording.receiver_ids:
                notes.append(f"{part.name} has no receiver `{own_id}`, only {', '.join(recording.receiver_ids[:8])}")
        return {own: name for own, name in part.receivers.items() if own in recording.receiver_ids}

    def _refuse_unlike(self, path: Path) -> None:
        """Raise if parts differ in rate, or in the tuning of a receiver; both numbers are named."""
        first = self._known[0]
        for known in self._known:
            mine, theirs = known.recording.sample_rate, first.recording.sample_rate
            if mine != theirs:
                raise RecordingError(
                    f"{path}: {known.part.name} was recorded at {_number(mine)} samples/s, but {first.part.name} at "
                    f"{_number(theirs)}; process them apart"
                )
        tuned: dict[str, tuple[float, str]] = {}
        for known in self._known:
            frequency = known.recording.centre_frequency_hz
            if frequency is None:
                continue
            for name in known.blocks:
                wanted, where = tuned.setdefault(name, (frequency, known.part.name))
                if frequency != wanted:
                    raise RecordingError(
                        f"{path}: receiver `{name}` is tuned to {frequency:.12g} Hz in {known.part.name}, but to "
                        f"{wanted:.12g} Hz in {where}; process them apart"
                    )

    def _one_site(self, path: Path) -> Scenario | None:
        """Return the site that the parts bring along; two are refused."""
        found: tuple[str, Scenario] | None = None
        for known in self._known:
            scenario = known.recording.scenario
            if scenario is None:
                continue
            if found is None:
                found = known.part.name, scenario
            elif scenario != found[1]:
                raise RecordingError(
                    f"{path}: {found[0]} and {known.part.name} are of two sites: {_difference(found[1], scenario)}; "
                    "give the one that holds as `scenario=FILE`, or process them apart"
                )
        return None if found is None else found[1]

    def _tell_tunings(self) -> None:
        """Keep and tell which receivers are tuned otherwise than the first part that says it."""
        wanted = self.centre_frequency_hz
        for known in self._known:
            frequency = known.recording.centre_frequency_hz
            if frequency is None or wanted is None or frequency == wanted:
                continue
            self.tunings |= dict.fromkeys(known.blocks, frequency)
            self.notes.append(
                f"{known.part.name} is tuned to {frequency:.12g} Hz, other parts to {wanted:.12g} Hz: lines of its "
                "receivers are sought where that puts them"
            )

    def _tell_doubts(self) -> None:
        """Gather what the parts doubt, under the names that receivers have in the whole."""
        for known in self._known:
            self.notes += [f"{known.part.name}: {note}" for note in known.recording.notes]
            for name, own_id in known.own_id.items():
                doubts = [f"{doubt} ({known.part.name})" for doubt in known.recording.doubts.get(own_id, ())]
                if doubts:
                    self.doubts.setdefault(name, []).extend(doubts)
        if self.centre_frequency_hz is not None:
            silent = [known.part.name for known in self._known if known.recording.centre_frequency_hz is None]
            if silent:
                self.notes.append(f"{_some(silent)} does not say to what it was tuned, other parts do")
        scales = {known.recording.full_scale for known in self._known}
        if len(scales) > 1:
            most = max(scales)
            self.notes.append(
                f"parts have full scales from {min(scales):g} to {most:g}; samples that reach {most:g} count as clipped"
                if math.isfinite(most)
                else f"parts have full scales from {min(scales):g} to none; no sample counts as clipped"
            )

    def _laid_out(self, receiver_id: str) -> list[_Stretch]:
        """Return a receiver's stretches in order of time, none over another."""
        rows = [
            _Stretch(start, count, i, known.own_id[receiver_id])
            for i, known in enumerate(self._known)
            if receiver_id in known.blocks
            for start, count in known.blocks[receiver_id].tolist()
        ]
        laid: list[_Stretch] = []
        for row in sorted(rows, key=lambda row: (row.start, row.part)):
            if row.start < 0:
                raise RecordingError(
                    f"{self.path}: {self._known[row.part].part.name} would begin before 1970; correct its offset"
                )
            if laid and row.start < laid[-1].end:
                reached = laid[-1].end
                self._refuse_contradiction(receiver_id, laid[-1], row, min(reached, row.end) - row.start)
                row = row._replace(start=reached, n_sample=row.end - reached)
            if row.n_sample > 0:
                laid.append(row)
        return laid

    def _refuse_contradiction(self, receiver_id: str, one: _Stretch, other: _Stretch, count: int) -> None:
        """Raise unless two parts hold the same samples where they overlap, which are told and kept once."""
        names = [self._known[stretch.part].part.name for stretch in (one, other)]
        take = min(count, _COMPARED_SAMPLES)
        where = f"{count} samples from {other.start} ({self._utc(other.start)}) on"
        for at in {other.start, other.start + count - take}:
            mine, theirs = (self._of_part(stretch, at, take) for stretch in (one, other))
            if not np.array_equal(mine, theirs, equal_nan=mine.dtype.kind == "f"):
                raise RecordingError(
                    f"{self.path}: {names[0]} and {names[1]} both claim to be receiver `{receiver_id}` in {where}, "
                    "with other samples; name receivers apart, correct the offset of one, or leave one out"
                )
        self.doubts.setdefault(receiver_id, []).append(
            f"{names[0]} and {names[1]} both hold {where}; they are the same, and taken once"
        )

    def _tell_gaps(self) -> None:
        """Tell of what a receiver lost between two parts while others recorded."""
        rows = np.array(
            [(s.start, s.n_sample) for stretches in self._stretches.values() for s in stretches], np.int64
        ).reshape(-1, 2)
        runs = merge_rows(rows[np.argsort(rows[:, 0], kind="stable")])
        alone = len(self._stretches) == 1
        for name, stretches in self._stretches.items():
            for one, other in itertools.pairwise(stretches):
                end = one.end
                if one.part == other.part or other.start == end:
                    continue
                i_run = np.searchsorted(runs[:, 0], [end, other.start], side="right") - 1
                if alone or i_run[0] == i_run[1]:
                    lost = other.start - end
                    self.doubts.setdefault(name, []).append(
                        f"{lost} samples ({float(lost / self.sample_rate):.3g} s) are missing between "
                        f"{self._known[one.part].part.name} and {self._known[other.part].part.name}"
                    )

    # -- samples -----------------------------------------------------------------------------------------

    def _load_segments(self, receiver_id: str) -> IndexArray:
        rows = [(stretch.start, stretch.n_sample) for stretch in self._stretches[receiver_id]]
        return np.array(rows, np.int64).reshape(-1, 2)

    def _read_segment(self, receiver_id: str, i_segment: int, skip: int, out: IqArray) -> None:
        stretch = self._stretches[receiver_id][i_segment]
        self._of_part(stretch, stretch.start + skip, len(out), out)

    def _of_part(self, stretch: _Stretch, start: int, count: int, out: IqArray | None = None) -> IqArray:
        """Read samples of a part by the whole's index, as the whole's type."""
        out = np.empty((count, 2), self.component_dtype) if out is None else out
        known = self._known[stretch.part]
        try:
            recording = self._part(stretch.part)
            if recording.component_dtype == out.dtype:
                recording.read(stretch.own_id, start - known.shift, count, out=out)
            else:
                samples = recording.read(stretch.own_id, start - known.shift, count)
                n_fill = count_fill(samples)
                out[:] = samples
                if n_fill:
                    out[(samples == recording.fill_value).all(axis=1)] = self.fill_value
        except RecordingError as error:
            # the rest goes on: what cannot be read counts as not recorded
            if stretch.part not in self._broken:
                self._broken[stretch.part] = str(error)
                self.notes.append(f"{known.part.name} is damaged: {error}")
                _log.warning(
                    "%s: %s is damaged: %s; what cannot be read is left out", self.path, known.part.name, error
                )
            raise GapError(str(error)) from error
        return out

    def _part(self, i_part: int) -> Recording:
        """Return an open part, and close the one that was longest unused if they are too many."""
        if i_part not in self._opened:
            self._keep_open(i_part, self._known[i_part].part.open(self._site))
        self._opened.move_to_end(i_part)
        return self._opened[i_part]

    def _keep_open(self, i_part: int, recording: Recording) -> None:
        self._opened[i_part] = recording
        while len(self._opened) > _OPEN_PARTS:
            self._opened.popitem(last=False)[1].close()

    def _utc(self, index: int) -> str:
        with contextlib.suppress(ValueError):
            return stamp_text(index, self.sample_rate)[:-4] + "Z"
        return "?"

    @property
    def sought(self) -> tuple[str, ...]:
        """Names of parts whose offset in time is to be found."""
        return tuple(known.part.name for known in self._known if known.part.find_offset)

    def parts(self) -> Iterator[tuple[str, Recording, dict[str, IndexArray]]]:
        """Yield each part's name, what was opened for it, and (block, 2) rows by receiver, in the whole's indices."""
        for known in self._known:
            yield known.part.name, known.recording, known.blocks


def _parts(recording: Recording) -> list[tuple[str, Recording, dict[str, IndexArray]]]:
    if isinstance(recording, PartsRecording):
        return list(recording.parts())
    return [(recording.path.name, recording, {name: recording.blocks(name) for name in recording.receiver_ids})]


def blocks_by_part(recording: Recording) -> list[tuple[str, dict[str, IndexArray]]]:
    """Return each part's name and (block, 2) rows by receiver; a recording that is no set has one part."""
    return [(name, blocks) for name, _, blocks in _parts(recording)]


def coverage(recording: Recording) -> dict[str, dict[str, Any]]:
    """Return who covers what, ready for JSON: by part its format, receivers, first and last time, samples.

    A recording that is no set has one part.
    """
    found: dict[str, dict[str, Any]] = {}
    for name, opened, blocks in _parts(recording):
        rows = [row for each in blocks.values() for row in each.tolist()]
        start = min((row[0] for row in rows), default=None)
        end = max((sum(row) for row in rows), default=None)
        found[name] = {
            "format": opened.format,
            "receivers": list(blocks),
            "start_utc": None if start is None else _date(start, recording.sample_rate),
            "end_utc": None if end is None else _date(end, recording.sample_rate),
            "samples": sum(row[1] for row in rows),
            "gaps": sum(max(0, len(each) - 1) for each in blocks.values()),
        }
    return found


def _date(index: int, rate: Fraction) -> str | None:
    with contextlib.suppress(ValueError):
        return stamp_text(index, rate)[:-4] + "Z"
    return None


def _number(rate: Fraction) -> str:
    return str(rate) if rate.denominator == 1 else f"{float(rate):.12g} ({rate})"


def _some(names: Sequence[str]) -> str:
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return ", ".join(names[:_SHOWN]) + more


def _difference(one: Scenario, other: Scenario) -> str:
    """Name the first key in which two scenarios differ."""
    mine, theirs = one.model_dump(), other.model_dump()
    key = next((key for key in mine if mine[key] != theirs.get(key)), "name")
    if key == "name":
        return f"`{one.name}` and `{other.name}`"
    return f"`{one.name}` and `{other.name}` differ in `{key}`"


def _one_truth(truths: Sequence[Truth | None], notes: list[str]) -> Truth | None:
    """Return the truth of the whole: the one that parts share, or those of parts that follow each other, joined."""
    found: list[Truth] = []
    for truth in truths:
        if truth is not None and not any(_equal(truth, other) for other in found):
            found.append(truth)
    if len(found) < 2:
        return found[0] if found else None
    try:
        return _joined(found)
    except ValueError as error:
        notes.append(f"the truths of its parts do not fit together ({error}) and are left out")
        return None


_OF_ALL_FRAMES: Final = ("heliostat_ids", "receiver_ids", "transmitter_ids", "clock_ppm")


def _equal(one: Truth, other: Truth) -> bool:
    return all(_same(getattr(one, each.name), getattr(other, each.name)) for each in dataclasses.fields(Truth))


def _same(one: Any, other: Any) -> bool:
    if one is None or other is None or isinstance(one, tuple):
        return bool(one is other or one == other)
    return one.shape == other.shape and np.array_equal(one, other, equal_nan=True)


def _joined(truths: Sequence[Truth]) -> Truth:
    """Join truths of stretches of time that follow each other; ValueError says what does not fit."""
    if any(truth.frame_start_index is None for truth in truths):
        raise ValueError("one has no times")
    ordered = sorted(truths, key=lambda truth: int(truth.frame_start_index[0]) if len(truth.frame_start_index) else 0)  # type: ignore[index, arg-type]
    first = ordered[0]
    for name in _OF_ALL_FRAMES:
        if not all(_same(getattr(first, name), getattr(other, name)) for other in ordered):
            raise ValueError(f"`{name}` differ")
    values: dict[str, Any] = {}
    for each in dataclasses.fields(Truth):
        parts = [getattr(truth, each.name) for truth in ordered]
        if each.name in _OF_ALL_FRAMES or all(part is None for part in parts):
            values[each.name] = parts[0]
        elif any(part is None for part in parts):
            raise ValueError(f"only some have `{each.name}`")
        else:
            values[each.name] = np.concatenate(parts)
    if not (np.diff(values["frame_start_index"]) > 0).all():
        raise ValueError("they overlap in time")
    return Truth(**values)
