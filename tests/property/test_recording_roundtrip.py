"""Whatever pattern of blocks is written, the same samples and the same gaps come back."""

import itertools
import tempfile
from fractions import Fraction
from pathlib import Path

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from rfpose.recording import RecordingWriter, frame_starts, open_recording, recorded_runs

PIECES = st.lists(st.tuples(st.one_of(st.just(0), st.integers(1, 50)), st.integers(1, 400)), max_size=8)
"""[(samples lost before, samples written)]"""


def lay_out(start, pieces):
    """Return the writes [(start, count)] and the set of recorded indices."""
    writes, recorded = [], set()
    for lost, count in pieces:
        start += lost
        writes.append((start, count))
        recorded.update(range(start, start + count))
        start += count
    return writes, recorded


def sample_at(index, salt):
    """Two int16 that depend on the absolute index alone, so that every sample is known where it lies."""
    index = np.asarray(index, np.int64)
    return np.stack([(index * 31 + salt) % 30_000, (index * 17 + salt) % 20_000], axis=-1).astype(np.int16)


def runs_of(indices):
    """Return [start, count] of the maximal runs in a set of integers."""
    runs = []
    for index in sorted(indices):
        if runs and index == sum(runs[-1]):
            runs[-1][1] += 1
        else:
            runs.append([index, 1])
    return runs


def best_offset(blocks, at, count, frame_samples):
    """The first place for the grid at which the receivers have most whole frames, by trying them all."""

    def n_whole(offset):
        grid = range(at + offset, at + count - frame_samples + 1, frame_samples)
        return sum(b <= start and start + frame_samples <= b + n for b, n in blocks for start in grid)

    return max(range(frame_samples), key=lambda offset: (n_whole(offset), -offset))


def own_frame(blocks, frame, frame_samples):
    """The nearest place within a quarter of a frame at which a whole frame was recorded, by trying them all."""
    slack = frame_samples // 4
    near = sorted(range(frame - slack, frame + slack + 1), key=lambda k: (abs(k - frame), k))
    return next((k for k in near if any(b <= k and k + frame_samples <= b + n for b, n in blocks)), None)


@settings(max_examples=40, deadline=None)
@given(
    start=st.integers(0, 2**57),
    first=PIECES,
    second=PIECES,
    shift=st.integers(0, 300),
    frame_samples=st.integers(1, 300),
    cut=st.integers(1, 500),
)
def test_any_block_pattern_round_trips(start, first, second, shift, frame_samples, cut):
    layout = {"a": lay_out(start, first), "b": lay_out(start + shift, second)}
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory) / "r.h5"
        with RecordingWriter(
            path, scenario=None, receiver_ids=["a", "b"], sample_rate=Fraction(10**6), centre_frequency_hz=0.0,
            sample_format="int16", full_scale=32767, provenance={},
        ) as writer:  # fmt: skip
            for salt, (name, (writes, _)) in enumerate(layout.items()):
                for at, count in writes:
                    writer.write(name, at, sample_at(np.arange(at, at + count), salt))
        with open_recording(path) as recording:
            for salt, (name, (_, recorded)) in enumerate(layout.items()):
                assert recording.blocks(name).tolist() == runs_of(recorded)
                for at, count in recording.blocks(name).tolist():
                    whole = recording.read(name, at, count)
                    assert np.array_equal(whole, sample_at(np.arange(at, at + count), salt))
                    # streaming equals one shot
                    parts = [recording.read(name, k, min(cut, at + count - k)) for k in range(at, at + count, cut)]
                    assert np.array_equal(np.concatenate(parts), whole)
                for at in range(start - 2, start + 40, 7):
                    assert recording.covers(name, at, 5) == (set(range(at, at + 5)) <= recorded)
            union = runs_of(layout["a"][1] | layout["b"][1])
            assert recorded_runs(recording).tolist() == union
            blocks = [block for name in layout for block in recording.blocks(name).tolist()]
            expected = []
            for at, count in union:
                offset = best_offset(blocks, at, count, frame_samples)
                expected += range(at + offset, at + count - frame_samples + 1, frame_samples)
            assert frame_starts(recording, frame_samples).tolist() == expected
            for name in layout:
                for frame in expected:
                    own = recording.frame_at(name, frame, frame_samples)
                    assert own == own_frame(recording.blocks(name).tolist(), frame, frame_samples)


@settings(max_examples=15, deadline=None)
@given(cuts=st.lists(st.integers(0, 30_000), max_size=6))
def test_bytes_do_not_depend_on_how_the_samples_were_handed_over(cuts):
    x = sample_at(np.arange(30_000), 5)
    edges = [0, *sorted(cuts), 30_000]
    with tempfile.TemporaryDirectory() as directory:
        contents = []
        for name, pieces in (("one", [(0, 30_000)]), ("many", list(itertools.pairwise(edges)))):
            path = Path(directory) / name
            with RecordingWriter(
                path, scenario=None, receiver_ids=["a"], sample_rate=Fraction(1), centre_frequency_hz=0.0,
                sample_format="int16", full_scale=32767, provenance={},
            ) as writer:  # fmt: skip
                for begin, end in pieces:
                    writer.write("a", 1000 + begin, x[begin:end])
            contents.append(path.read_bytes())
    assert contents[0] == contents[1]
