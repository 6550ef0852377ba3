"""Digital RF written by its own library: to what receivers were tuned, and what its recorder left behind."""

import numpy as np
import pytest

from rfpose.errors import RecordingError
from rfpose.recording import describe, open_recording

drf = pytest.importorskip("digital_rf", reason="the digital_rf library is not installed")

RATE = 10**6
EPOCH = 1_790_000_000 * RATE


def write(top, channel, *, subchannels=1, dtype="<i2", n=30_000):
    (top / channel).mkdir(parents=True)
    writer = drf.DigitalRFWriter(
        str(top / channel), dtype, 3600, 10, EPOCH, RATE, 1, uuid_str="test", is_continuous=False,
        num_subchannels=subchannels, marching_periods=False,
    )  # fmt: skip
    x = np.random.default_rng(0).integers(0, 1000, (n, 2 * subchannels)).astype(dtype)
    writer.rf_write(x, 0)
    writer.close()


def tune(top, channel, entries, *, cadence=1):
    """Note tunings [(sample after EPOCH, frequencies of the subchannels)], all in one file by a long ``cadence``."""
    metadata = top / channel / "metadata"
    metadata.mkdir()
    writer = drf.DigitalMetadataWriter(str(metadata), 3600, cadence, RATE, 1, "metadata")
    for at, frequencies in entries:
        writer.write(EPOCH + at, {"center_frequencies": np.array([frequencies])})


def test_the_tuning_in_force_is_that_noted_last_before(tmp_path):
    """A file that holds later entries too is no reason to take one of them; the library's own forward fill does."""
    write(tmp_path / "d", "a")
    tune(tmp_path / "d", "a", [(-5_000, [90e6]), (-10, [100e6]), (30_000, [110e6])], cadence=3600)
    with open_recording(tmp_path / "d") as r:
        assert r.centre_frequency_hz == 100e6
        assert describe(r)["problems"] == []


def test_one_frequency_is_that_of_all_subchannels(tmp_path):
    write(tmp_path / "d", "a", subchannels=2)
    tune(tmp_path / "d", "a", [(0, [100e6])])
    write(tmp_path / "d", "b")
    tune(tmp_path / "d", "b", [(0, [100e6]), (20_000, [100e6])])
    with open_recording(tmp_path / "d") as r:
        assert r.centre_frequency_hz == 100e6
        assert describe(r)["sound"] is True


@pytest.mark.parametrize(
    ("channels", "words"),
    [
        ({"a": [(0, [1e8]), (15_000, [2e8])]}, "a/metadata: `a` is tuned to 100000000 Hz and to 200000000 Hz .*split"),
        ({"a": [(0, [1e8])], "b": [(0, [2e8])]}, "b/metadata: `b` is tuned to 200000000 Hz, but `a` to 100000000 Hz"),
        (
            {"a": [(0, [1e8, 2e8])]},
            "`a_r1` is tuned to 200000000 Hz, but `a_r0` to 100000000 Hz; put them into separate",
        ),
        ({"a": [(0, [1e8, 1e8, 1e8])]}, "`center_frequencies` must be 1 frequencies, one a subchannel, is .*3"),
    ],
)
def test_tunings_that_are_not_one(tmp_path, channels, words):
    for name, entries in channels.items():
        write(tmp_path / "d", name, subchannels=2 if len(entries[0][1]) == 2 else 1)
        tune(tmp_path / "d", name, entries)
    with pytest.raises(RecordingError, match=words):
        open_recording(tmp_path / "d")


def test_a_tuning_that_only_some_note_is_told(tmp_path):
    for name in "abc":
        write(tmp_path / "d", name)
    tune(tmp_path / "d", "b", [(10, [1e8])])
    tune(tmp_path / "d", "c", [(0, [np.nan])])
    with open_recording(tmp_path / "d") as r:
        assert r.centre_frequency_hz == 1e8
        assert describe(r)["problems"] == [
            "2 receivers (`a`, `c`): its metadata does not say to what it was tuned, `b`'s does",
            "b: its metadata says to what it was tuned only from a later sample on",
        ]


def test_a_damaged_file_of_metadata_is_named_and_left_alone(tmp_path):
    """The library's reader deletes a file that it cannot open."""
    write(tmp_path / "d", "a")
    tune(tmp_path / "d", "a", [(0, [1e8])])
    (path,) = (tmp_path / "d" / "a" / "metadata").rglob("metadata@*.h5")
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(RecordingError, match=rf"{path.name}: cannot read `a`: .*; copy the recording again"):
        open_recording(tmp_path / "d")
    assert path.exists()


def test_unsigned_samples_are_refused(tmp_path):
    write(tmp_path / "d", "a", dtype="<u2")
    with pytest.raises(RecordingError, match="`a` holds complex uint16 samples"):
        open_recording(tmp_path / "d")


def test_what_a_killed_recorder_left_is_told(tmp_path):
    write(tmp_path / "d", "a", subchannels=2)
    last = max((tmp_path / "d" / "a").rglob("rf@*.h5"))
    last.rename(last.with_name(f"tmp.{last.name}"))
    with open_recording(tmp_path / "d") as r:
        assert r.blocks("a_r0").tolist() == [[EPOCH, 20_000]]
        (problem,) = describe(r)["problems"]
    assert problem.startswith(f"2 receivers (`a_r0`, `a_r1`): `a/{last.parent.name}/tmp.{last.name}` was not completed")


def test_files_that_overlap_are_named(tmp_path):
    write(tmp_path / "d", "a")
    first, second, _ = sorted((tmp_path / "d" / "a").rglob("rf@*.h5"))
    second.write_bytes(first.read_bytes())
    with (
        open_recording(tmp_path / "d") as r,
        pytest.raises(RecordingError, match=rf"{second.name}: starts with sample"),
    ):
        r.blocks("a")
