"""Files of one writer are known by their bytes to be laid out alike, and read without HDF5."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt
import pytest

from rfpose.errors import RecordingError
from rfpose.recording import RecordingWriter, open_recording
from rfpose.recording.alike import AlikeRecording, Layout
from rfpose.recording.native import NativeRecording
from rfpose.recording.segments import open_growing
from rfpose.scenario import load_scenario
from rfpose.truth import Truth

EPOCH = 71_600_000_000_000_000
SCENARIO = load_scenario(Path(__file__).resolve().parents[2] / "data" / "table2_100m.toml")
LONG = 600_000  # more than two of HDF5's chunks


def _counts(n: int, seed: int) -> npt.NDArray[np.int16]:
    return np.random.default_rng(seed).integers(-32767, 32768, size=(n, 2), dtype=np.int16)


def _write(path: Path, at: int, seed: int, *, lost: int = 0, before_loss: int = 300, **changes: Any) -> Path:
    """Write two receivers, the second with a stretch lost, and a truth."""
    settings = {
        "scenario": SCENARIO,
        "receiver_ids": ["b", "a"],
        "sample_rate": Fraction(40_000_000),
        "centre_frequency_hz": 100e6,
        "sample_format": "int16",
        "full_scale": 32767,
        "provenance": {"operator": "somebody"},
    }
    with RecordingWriter(path, **(settings | changes)) as writer:
        writer.write("b", at, _counts(LONG, seed))
        writer.write("a", at, _counts(before_loss, seed + 1))
        writer.write("a", at + before_loss + lost, _counts(1000 - before_loss, seed + 2))
        writer.write_truth(
            Truth(
                heliostat_ids=("H",),
                receiver_ids=("a", "b"),
                transmitter_ids=("T",),
                normal_enu=np.full((1, 1, 3), float(seed)),
                receiver_enu_m=np.full((1, 2, 3), float(seed)),
                frame_start_index=np.array([at]),
                transmitter_phase_rad=np.full((1, 1, 1), float(seed)),
                clock_ppm=np.zeros(2),
            )
        )
    return path


@pytest.fixture
def layout(tmp_path: Path) -> Layout:
    with NativeRecording(_write(tmp_path / "first.h5", EPOCH, 1, lost=50)) as first:
        found = first.layout()
    assert found is not None
    return found


def test_a_file_like_another_holds_what_hdf5_finds_in_it(layout: Layout, tmp_path: Path) -> None:
    path = _write(tmp_path / "second.h5", EPOCH + 10**6, 5, lost=80)
    found = AlikeRecording.opened(path, layout)
    assert found is not None
    with found, h5py.File(path) as file, open_recording(path) as wanted:
        assert found.receiver_ids == wanted.receiver_ids
        assert (found.sample_rate, found.full_scale, found.provenance) == (
            wanted.sample_rate, wanted.full_scale, wanted.provenance,
        )  # fmt: skip
        for name in found.receiver_ids:
            np.testing.assert_array_equal(found.blocks(name), wanted.blocks(name))
            stored = file[f"receivers/{name}/iq"][:]
            for (start, count), offset in zip(found.blocks(name), (0, 300), strict=False):
                iq = np.stack([stored[part][offset : offset + count] for part in ("r", "i")], axis=1)
                for recording in (found, wanted):
                    np.testing.assert_array_equal(recording.read(name, int(start), int(count)), iq)
                np.testing.assert_array_equal(found.read(name, int(start) + 7, int(count) - 9), iq[7:-2])


def _shift_offset(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file["receivers/a/blocks"][1, 2] = 299


def _overlap(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file["receivers/a/blocks"][1, 0] = int(file["receivers/a/blocks"][0, 0]) + 1


def _before_time(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file["receivers/b/blocks"][0, 0] = -1


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-1])


@pytest.mark.parametrize(
    "changes",
    [
        {"provenance": {"operator": "somebodY"}},
        {"sample_rate": Fraction(40_000_001)},
        {"receiver_ids": ["a", "b"]},
        {"before_loss": 301},
        {"lost": 0},
    ],
    ids=str,
)
def test_whatever_else_differs_is_not_taken_for_alike(layout: Layout, tmp_path: Path, changes: dict[str, Any]) -> None:
    path = _write(tmp_path / "other.h5", EPOCH, 1, **({"lost": 50} | changes))
    assert AlikeRecording.opened(path, layout) is None


@pytest.mark.parametrize("damage", [_shift_offset, _overlap, _before_time, _cut])
def test_a_damaged_one_is_left_to_who_names_the_damage(
    layout: Layout, tmp_path: Path, damage: Callable[[Path], None]
) -> None:
    path = _write(tmp_path / "damaged.h5", EPOCH, 1, lost=50)
    assert AlikeRecording.opened(path, layout) is not None
    damage(path)
    assert AlikeRecording.opened(path, layout) is None


def test_nothing_is_read_of_a_file_that_was_closed_or_cut(layout: Layout, tmp_path: Path) -> None:
    path = _write(tmp_path / "second.h5", EPOCH, 5, lost=50)
    alike = AlikeRecording.opened(path, layout)
    assert alike is not None
    for recording in (alike, NativeRecording(path)):
        recording.read("b", EPOCH, 10)
        recording.close()
        others = [path.open("rb") for _ in range(8)]  # one gets the number that the closed file had
        with pytest.raises(RecordingError, match=r"second\.h5"):
            recording.read("b", EPOCH, 10)
        for other in others:
            other.close()
    opened = AlikeRecording.opened(path, layout)
    assert opened is not None
    with opened, path.open("r+b") as file:
        file.truncate(1000)
        with pytest.raises(RecordingError, match="the file ends at"):
            opened.read("b", EPOCH, LONG)


def test_compressed_samples_are_left_to_hdf5(tmp_path: Path) -> None:
    pytest.importorskip("hdf5plugin", reason="needs the extra `compressed`")
    with NativeRecording(_write(tmp_path / "small.h5", EPOCH, 1, compress="bitshuffle-zstd")) as first:
        assert first.layout() is None
        np.testing.assert_array_equal(first.read("b", EPOCH, LONG), _counts(LONG, 1))


def test_a_directory_that_grows_opens_one_file_and_knows_the_rest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "night"
    folder.mkdir()
    _write(folder / "frame-0.h5", EPOCH, 1)
    growing = open_growing(folder)
    assert growing is not None
    growing.refresh()
    monkeypatch.setattr("rfpose.recording.segments._opened", None)  # by which a file is opened in full
    for k in range(1, 4):
        _write(folder / f"frame-{k}.h5", EPOCH + k * 10**6, 10 * k)
        growing.refresh()
        growing.forget(EPOCH + k * 10**6)
        np.testing.assert_array_equal(growing.read("b", EPOCH + k * 10**6, LONG), _counts(LONG, 10 * k))
        assert growing.reached() == {"b": EPOCH + k * 10**6 + LONG, "a": EPOCH + k * 10**6 + 1000}
    growing.close()
