"""Inputs that a fuzzer found to do harm, made as small as they can be; `scripts/fuzz` looks for more."""

import json
import shutil
import struct
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

import rfpose as rf
from rfpose.errors import InvalidInputError, RecordingError
from rfpose.feedback.series import Quantity, read_series_csv
from rfpose.foreign import read_arrays
from rfpose.heaps import check_heaps
from rfpose.pipeline.inspect import inspect_file

ROOT = Path(__file__).resolve().parents[2]
WIND = Quantity(name="speed", units={"mps": 1.0}, unit="m/s", most=100.0, beyond="any wind")


def test_two_lines_do_not_ask_for_gigabytes(tmp_path):
    path = tmp_path / "wind.csv"
    path.write_text("time,speed_mps\n2025-06-21T08:00:00Z,1\n2026-06-21T08:00:00Z,2\n")
    with pytest.raises(InvalidInputError, match=r"wind.csv: spans 365 days and tells of 0 of them.* more than 10 s"):
        read_series_csv(path, WIND, interval_s=1.0, longest_gap_s=10.0)
    # as long, and told of throughout
    _, speed = read_series_csv(path, WIND, interval_s=5.0, longest_gap_s=1e9)
    assert len(speed) == 365 * 86400 // 5 + 1


def test_what_a_library_quotes_of_a_damaged_archive_is_cut(tmp_path):
    path = tmp_path / "rays.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("x" * 5000 + ".npy", b"")
        archive.writestr("a.npy", b"")
    content = path.read_bytes()
    at = content.rindex(b"x" * 5000)  # in the directory, whose names must be those before the members
    path.write_bytes(content[:at] + b"a.npy" + b"y" * 4995 + content[at + 5000 :])
    name = "a.npy" + "y" * 4995
    with pytest.raises(RecordingError, match=r"rays\.npz: no sound archive") as caught:
        read_arrays(path, [name.removesuffix(".npy")])
    assert len(str(caught.value)) < 500 + len(name)


def test_what_info_tells_of_mounts_is_ready_for_json(tmp_path):
    path = tmp_path / "mounts.toml"
    path.write_text('format = "rfpose-mount"\nversion = 1\n[heliostat.H1]\npivot_enu_m = [1.0, 2.0, 3.0]\n')
    found = inspect_file(path)
    assert found["heliostats"]["H1"]["noise_mrad"] is None  # never calibrated
    json.dumps(found, allow_nan=False)
    assert np.isfinite(found["heliostats"]["H1"]["pivot_enu_m"]).all()


@pytest.mark.parametrize("kind", ["recording", "antenna"])
def test_free_space_of_no_length_in_a_heap_of_texts_is_refused(tmp_path, kind):
    """The HDF5 library would stand still there, which no signal to Python ends: so it is tried in another process."""
    path = tmp_path / f"{kind}.h5"
    if kind == "recording":
        site = rf.load_scenario(rf.shipped_scenario("table2.toml"))
        rf.simulate(site.changed(radio={"frame_samples": 40_000}, simulation={"frame_count": 1})).save(path)
    else:
        shutil.copy(ROOT / "data" / "antenna_front_433MHz.h5", path)
    stored = bytearray(path.read_bytes())
    at = heap = stored.index(b"GCOL\1\0\0\0")
    at += 16
    while stored[at] or stored[at + 1]:  # an object's index; that of free space is zero
        at += 16 + (int.from_bytes(stored[at + 8 : at + 16], "little") + 7) // 8 * 8
    assert at < heap + int.from_bytes(stored[heap + 8 : heap + 16], "little") - 16
    stored[at + 8 : at + 16] = bytes(8)
    path.write_bytes(stored)
    done = subprocess.run(
        [sys.executable, "-c", "import rfpose.cli; rfpose.cli.main()", "info", path],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 3
    assert f"{path}: the HDF5 file is damaged" in done.stderr
    assert "copy it again" in done.stderr
    with pytest.raises(OSError, match=f"heap of texts at byte {heap} is damaged at byte {at}"):
        check_heaps(path, everywhere=True)


@pytest.mark.parametrize(
    ("at", "everywhere", "seen"),
    [(100, False, True), (2**20 - 3, True, True), (2**20 - 3, False, False), (2**22 - 20_000, False, True)],
)
@pytest.mark.parametrize("free", [0, 7, 2**17 - 16 - 24])
def test_heaps_are_found_where_they_may_lie(tmp_path, at, everywhere, seen, free):
    """One of 128 KiB: an object of five bytes, and free space to the end."""
    length = 2**17 if at == 100 else 4096 + 8192
    free = min(free, length - 16 - 24)
    heap = b"GCOL\1\0\0\0" + struct.pack("<QHHIQ5s3xHHIQ", length, 1, 1, 0, 5, b"texts", 0, 0, 0, free)
    path = tmp_path / "a.h5"
    path.write_bytes(bytes(at) + heap.ljust(length, b"\0") + bytes(2**22 - at - length))
    if free >= 16 or not seen:
        check_heaps(path, everywhere=everywhere)
    else:
        with pytest.raises(OSError, match=f"texts at byte {at} is damaged at byte {at + 40}"):
            check_heaps(path, everywhere=everywhere)
