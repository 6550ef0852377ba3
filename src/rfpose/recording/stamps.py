"""What the time stamps of one receiver's captures say: where its samples lie, which are missing, how its clock runs."""

from __future__ import annotations

import math
import re
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from fractions import Fraction
from itertools import pairwise
from typing import Final

from rfpose.errors import InvalidInputError
from rfpose.scenario import MAX_SAMPLE_INDEX

__all__ = ["LARGEST_INDEX", "Capture", "Stamp", "Timing", "parse_stamp", "place_captures", "stamp_text"]

_DATETIME: Final = re.compile(r"(\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d)(?:\.(\d{1,30}))?Z", re.ASCII)
_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)
LARGEST_INDEX: Final = MAX_SAMPLE_INDEX
_CLOCK: Final = Fraction(1, 1000)
"""No receiver's clock is off by more; a larger step between two stamps is lost samples."""
_ON_GRID: Final = Fraction(1, 100)
"""Of a sample. A stamp closer to the grid than this, or than its last digit, lies on it."""
_SIGMAS: Final = 6
"""A stamp this many standard deviations of all stamps beside their line is no scatter."""
_WORST_S: Final = Fraction(1, 10)
"""Stamps that scatter by more [s], and by more than their last digit, are no stamps."""
_SIGMA_OF_MAD: Final = Fraction(14826, 10000)
_FEWEST_STEPS: Final = 3
"""Fewer cannot tell a clock, which moves all stamps, from lost samples, which move those after them."""


@dataclass(frozen=True, slots=True)
class Stamp:
    """A time stamp: samples since the epoch at the nominal rate, and how many samples its last digit is."""

    samples: Fraction
    resolution: Fraction


@dataclass(frozen=True, slots=True)
class Capture:
    """A stretch of a receiver's file: the sample with which it begins, and what is said of its time, None: nothing."""

    first_sample: int
    stamp: Stamp | None = None
    global_index: int | None = None


@dataclass(frozen=True, slots=True)
class Timing:
    """Where the captures of a receiver lie.

    Attributes
    ----------
    start_index : (capture,)
        First sample of each, counted from the Unix epoch.
    doubts
        What the stamps say that does not fit, one line each.
    """

    start_index: list[int]
    doubts: list[str]


def parse_stamp(text: object, rate: Fraction) -> Stamp:
    """Return a SigMF ``core:datetime``.

    Raises
    ------
    InvalidInputError
        Not of the form ``2026-09-21T14:00:00.123Z``, no such day or time, a leap second, or before 1970.
    """
    match = _DATETIME.fullmatch(text) if isinstance(text, str) and len(text) <= 64 else None
    if match is None:
        raise InvalidInputError(f"`core:datetime` is {text!r:.60}; it must look like 2026-09-21T14:00:00.123Z")
    try:
        whole = datetime.fromisoformat(match[1]).replace(tzinfo=UTC) - _EPOCH
    except ValueError as error:
        why = "; a leap second has no Unix time" if match[1].endswith(":60") else f": {error}"
        raise InvalidInputError(f"`core:datetime` is {text!r}, no time of Unix{why}; correct it") from error
    if whole.days < 0:
        raise InvalidInputError(f"`core:datetime` is {text!r}, before 1970; correct it")
    digits = match[2] or ""
    resolution = Fraction(1, 10 ** len(digits))
    seconds = whole.days * 86400 + whole.seconds + int(digits or "0") * resolution
    return Stamp(samples=seconds * rate, resolution=resolution * rate)


def stamp_text(index: int, rate: Fraction) -> str:
    """Return the time of a sample in UTC, to the picosecond, as SigMF and ISO 8601 write it.

    Raises
    ------
    InvalidInputError
        The sample lies beyond the year 9999.
    """
    picoseconds = round(index / rate * 10**12)
    try:
        whole = _EPOCH + timedelta(seconds=picoseconds // 10**12)
    except OverflowError as error:
        raise InvalidInputError(f"sample {index} at {float(rate):g} a second lies beyond the year 9999") from error
    return f"{whole:%Y-%m-%dT%H:%M:%S}.{picoseconds % 10**12:012d}Z"


def place_captures(captures: Sequence[Capture], rate: Fraction) -> Timing:
    """Find where the captures of one receiver lie in time.

    The first lies at its stamp; where its ``core:global_index`` agrees with that to a second, or there is no stamp, at
    the index, which is exact. Later ones continue by their index where they have one. Else a step between stamps that
    is more than the stamps' own scatter is lost samples, unless all steps together are the line of a clock that runs
    fast or slow: such a receiver still counts its samples by the nominal rate, and its clock is told as a doubt.

    Parameters
    ----------
    captures : (capture,)
        In the order of the file.
    rate
        Nominal sample rate [1/s].

    Raises
    ------
    InvalidInputError
        A capture starts before the one before it ends, and no clock explains it.
    """
    first, doubts = captures[0], []
    stamp, index = first.stamp, first.global_index
    by_index = index is not None and (stamp is None or abs(index - stamp.samples) <= rate)
    start = index if by_index and index is not None else 0 if stamp is None else round(stamp.samples)
    if stamp is not None and not _agree(stamp.samples - start, stamp):
        beside = _in_words(stamp.samples - start, rate)
        if by_index:
            doubts.append(f"`core:datetime` lies {beside} beside `core:global_index`, which is taken")
        else:
            doubts.append(f"its time stamps lie {beside} beside the sample grid, and its samples are taken as on it")
    position = _positions(captures, doubts)
    doubts += _clock(captures, position, rate)
    return Timing([start + k for k in position], doubts)


def _positions(captures: Sequence[Capture], doubts: list[str]) -> list[int]:
    """Return how many samples after the first capture each begins."""
    late = _lateness(captures)
    slope, scatter = _line(captures, late)
    elapsed = [c.first_sample - captures[0].first_sample for c in captures]
    first_index = captures[0].global_index
    position = [0]
    for i, capture in enumerate(captures[1:], start=1):
        reached = position[-1] + elapsed[i] - elapsed[i - 1]
        begin = reached
        if first_index is not None and capture.global_index is not None:
            begin = capture.global_index - first_index
            if begin < reached:
                raise _too_early(i, reached - begin)
        elif capture.stamp is not None and late[i] is not None:
            lost = position[-1] - elapsed[i - 1]
            # a gap moves the later stamps as well; a stamp that is late alone is no gap
            following = [
                x - slope * n - lost for x, n in zip(late[i : i + 3], elapsed[i : i + 3], strict=True) if x is not None
            ]
            limit = max(Fraction(math.ceil(capture.stamp.resolution)), _SIGMAS * scatter)
            room = _CLOCK * elapsed[i]
            if min(following[0], statistics.median_low(following)) > limit:
                step = following[0] if scatter == 0 else statistics.median_low(following)
                begin = reached + round(step)
                if slope == 0 and step <= room:
                    doubts.append(
                        f"capture {i} begins {round(step)} samples later than the one before it ends: lost, or a slow "
                        "clock; so few time stamps cannot tell"
                    )
            elif following[0] > limit + room:
                doubts.append(f"the time stamp of capture {i} lies {round(following[0])} samples too late, alone")
            elif following[0] < -(limit + room):
                if statistics.median_low(following) < -(limit + room):
                    raise _too_early(i, round(-following[0]))
                doubts.append(f"the time stamp of capture {i} lies {round(-following[0])} samples too early, alone")
        position.append(begin)
    return position


def _too_early(i: int, by: int) -> InvalidInputError:
    return InvalidInputError(
        f"capture {i} starts {by} samples before capture {i - 1} ends; correct its time stamp or its index"
    )


def _lateness(captures: Sequence[Capture]) -> list[Fraction | None]:
    """Return (capture,) how many samples later each stamp is than the first one and the samples between say."""
    first = captures[0].stamp
    if first is None:
        return [None] * len(captures)
    return [
        None if c.stamp is None else c.stamp.samples - first.samples - (c.first_sample - captures[0].first_sample)
        for c in captures
    ]


def _line(captures: Sequence[Capture], late: Sequence[Fraction | None]) -> tuple[Fraction, Fraction]:
    """Return how many samples a sample the stamps run away, by the median step, and the steps' scatter [sample].

    Both are zero where the stamps are too few to tell, or an index counts the samples.
    """
    if captures[0].global_index is not None:
        return Fraction(0), Fraction(0)
    stamped = [(c.first_sample, x, c.stamp) for c, x in zip(captures, late, strict=True) if x is not None]
    steps = []
    for (n, x, _), (n_next, x_next, stamp) in pairwise(stamped):
        coarse = stamp.resolution if stamp is not None else 0
        if n_next > n and abs(x_next - x) <= _CLOCK * (n_next - n) + coarse:
            steps.append((x_next - x, n_next - n))
    if len(steps) < _FEWEST_STEPS:
        return Fraction(0), Fraction(0)
    slope = statistics.median(step / elapsed for step, elapsed in steps)
    return slope, _SIGMA_OF_MAD * statistics.median(abs(step - slope * elapsed) for step, elapsed in steps)


def _clock(captures: Sequence[Capture], position: Sequence[int], rate: Fraction) -> list[str]:
    """Return what the stamps of samples whose positions are known say of the receiver's clock."""
    seen = [(k, c.stamp) for k, c in zip(position, captures, strict=True) if c.stamp is not None]
    if len(seen) < 2:
        return []
    (first, anchor), (last, _) = seen[0], seen[-1]
    away = [(k - first, stamp.samples - anchor.samples - (k - first)) for k, stamp in seen[1:]]
    slope = statistics.median(step / elapsed for elapsed, step in away if elapsed) if last > first else Fraction(0)
    scatter = _SIGMA_OF_MAD * statistics.median(abs(step - slope * elapsed) for elapsed, step in away)
    coarse = max([Fraction(1), *(stamp.resolution for _, stamp in seen)])
    drift = abs(slope) * (last - first)
    doubts = []
    if drift > coarse and drift > _SIGMAS * scatter / math.isqrt(len(away)):
        doubts.append(
            f"its time stamps say that its clock runs {float(abs(slope)) * 1e6:.3g} ppm "
            f"{'slow' if slope > 0 else 'fast'}: counted by the nominal rate, sample times are wrong by up to "
            f"{_in_words(drift, rate)}"
        )
    if scatter > coarse and scatter > _WORST_S * rate:
        raise InvalidInputError(
            f"its time stamps scatter by {_in_words(scatter, rate)} about its samples' times: they tell no time; "
            "correct or remove them"
        )
    if scatter > coarse:
        doubts.append(f"its time stamps scatter by {_in_words(scatter, rate)} about its samples' times")
    return doubts


def _agree(beside: Fraction, stamp: Stamp) -> bool:
    return abs(beside) <= max(stamp.resolution, _ON_GRID)


def _in_words(samples: Fraction, rate: Fraction) -> str:
    number = f"{float(abs(samples)):.3g}"
    return f"{number} sample{'' if number == '1' else 's'} ({float(abs(samples) / rate) * 1e6:.3g} µs)"
