"""Digital RF and SigMF, written by their own libraries, and conversion between all formats."""

import hashlib
import json
import math
import subprocess
import sys
import tempfile
import warnings
from fractions import Fraction
from pathlib import Path

import h5py
import numpy as np
import pytest

from rfpose.errors import InvalidInputError, RecordingError
from rfpose.recording import GapError, Recording, RecordingWriter, convert, count_fill, describe, open_recording
from rfpose.recording.hdf5 import FROM_SAMPLES
from rfpose.scenario import load_scenario

drf = pytest.importorskip("digital_rf", reason="the digital_rf library is not installed")
sigmf = pytest.importorskip("sigmf", reason="the sigmf library is not installed")

EPOCH = 1_790_000_000 * 10**6
SCENARIO = load_scenario(Path(__file__).resolve().parents[2] / "data" / "table2_100m.toml")


def counts(n, seed=0):
    return np.random.default_rng(seed).integers(-32767, 32768, size=(n, 2), dtype=np.int16)


def write_drf(top, channel, pieces, *, dtype="<i2", rate=(10**6, 1), subchannels=1, continuous=False, **settings):
    """Write pieces [(start after EPOCH, samples)] as one channel, in files of 10 ms."""
    (top / channel).mkdir(parents=True)
    writer = drf.DigitalRFWriter(
        str(top / channel), dtype, 3600, 10, EPOCH, *rate, uuid_str="test", is_continuous=continuous,
        num_subchannels=subchannels, marching_periods=False, **settings,
    )  # fmt: skip
    for start, samples in pieces:
        writer.rf_write(samples, start)
    writer.close()


def write_sigmf(directory, name, samples, captures, *, datatype="ci16_le", rate=1e6, **extra):
    directory.mkdir(exist_ok=True)
    (directory / f"{name}.sigmf-data").write_bytes(samples.tobytes())
    meta = {
        "global": {"core:datatype": datatype, "core:sample_rate": rate, "core:version": "1.2.0"} | extra,
        "captures": captures,
        "annotations": [],
    }
    (directory / f"{name}.sigmf-meta").write_text(json.dumps(meta))
    return directory


# -- Digital RF ----------------------------------------------------------------------------------------------


def test_drf_with_gaps_across_files(tmp_path):
    x = counts(60_000)
    write_drf(tmp_path / "d", "r1", [(0, x[:25_000]), (26_000, x[26_000:26_010]), (40_000, x[40_000:])])
    write_drf(tmp_path / "d", "r0", [(100, x[100:])])
    with open_recording(tmp_path / "d") as r:
        assert r.format == "digital-rf"
        assert r.receiver_ids == ("r0", "r1")
        assert r.sample_rate == 10**6
        assert r.centre_frequency_hz is None
        assert r.blocks("r1").tolist() == [[EPOCH, 25_000], [EPOCH + 26_000, 10], [EPOCH + 40_000, 20_000]]
        assert r.blocks("r0").tolist() == [[EPOCH + 100, 59_900]]
        for start, count in r.blocks("r1").tolist():
            assert np.array_equal(r.read("r1", start, count), x[start - EPOCH : start - EPOCH + count])
        assert np.array_equal(r.read("r1", EPOCH + 9_990, 30), x[9_990:10_020])
        with pytest.raises(GapError, match=f"did not record sample {EPOCH + 25_000}"):
            r.read("r1", EPOCH + 24_000, 2_010)


def test_drf_that_fills_holes_shows_the_fill_value(tmp_path):
    x = counts(30_000)
    write_drf(tmp_path / "d", "r0", [(0, x[:12_000]), (15_000, x[15_000:])], continuous=True)
    with open_recording(tmp_path / "d") as r:
        ((start, count),) = r.blocks("r0").tolist()
        got = r.read("r0", start, count)
        assert count_fill(got[:30_000]) == 3_000
        assert np.all(got[12_000:15_000] == r.fill_value)
        assert "3000 of 30000 samples looked at hold the fill value" in " ".join(describe(r)["problems"])


def test_drf_floats(tmp_path):
    z = np.random.default_rng(0).normal(size=(20_000, 2)).astype(np.float32)
    write_drf(tmp_path / "d", "r0", [(0, z)], dtype="<c8")
    with open_recording(tmp_path / "d") as r:
        assert r.sample_format == "complex64"
        assert r.full_scale == math.inf
        assert r.read("r0", EPOCH, 20_000).tobytes() == z.tobytes()


def test_drf_big_endian_and_odd_rate(tmp_path):
    x = counts(5_000)
    write_drf(tmp_path / "d", "r0", [(0, x.astype(">i2"))], dtype=">i2", rate=(10**8, 3))
    with open_recording(tmp_path / "d") as r:
        assert r.sample_rate == Fraction(10**8, 3)
        assert np.array_equal(r.read("r0", EPOCH, 5_000), x)


def test_drf_subchannels_are_receivers(tmp_path):
    x = counts(15_000).reshape(-1, 4)  # two subchannels, interleaved
    write_drf(tmp_path / "d", "H01", [(0, x)], subchannels=2)
    with open_recording(tmp_path / "d") as r:
        assert r.receiver_ids == ("H01_r0", "H01_r1")
        assert np.array_equal(r.read("H01_r0", EPOCH, 7_500), x[:, :2])
        assert np.array_equal(r.read("H01_r1", EPOCH, 7_500), x[:, 2:])


def test_drf_compressed_reads_the_same(tmp_path):
    x = counts(30_000)
    write_drf(tmp_path / "d", "r0", [(0, x)], compression_level=1, checksum=True)
    with open_recording(tmp_path / "d") as r:
        assert np.array_equal(r.read("r0", EPOCH + 5, 29_000), x[5:29_005])


def test_drf_takes_a_scenario_beside_the_channels(tmp_path):
    write_drf(tmp_path / "d", "r0", [(0, counts(10))])
    (tmp_path / "d" / "scenario.toml").write_text(SCENARIO.to_toml())
    with open_recording(tmp_path / "d") as r:
        assert r.scenario is not None
        assert r.scenario.name == SCENARIO.name


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"dtype": "<i1"}, "channel `r0` holds complex samples of 8 bits"),
        ({"dtype": "<f8"}, "channel `r0` holds complex samples of 64 bits"),
        ({"is_complex": False, "subchannels": 2}, "channel `r0` holds real samples of 16 bits"),
    ],
)
def test_drf_of_another_type(tmp_path, settings, words):
    dtype = np.dtype(settings.get("dtype", "<i2"))
    write_drf(tmp_path / "d", "r0", [(0, np.ones((100, 2), dtype))], **settings)
    with pytest.raises(RecordingError, match=words):
        open_recording(tmp_path / "d")


def test_drf_channels_that_differ(tmp_path):
    write_drf(tmp_path / "d", "r0", [(0, counts(10))])
    write_drf(tmp_path / "d", "r1", [(0, counts(10))], rate=(2 * 10**6, 1))
    with pytest.raises(RecordingError, match=r"`r1` \(2000000 Hz\) and channel `r0` \(int16 at 1000000 Hz\) differ"):
        open_recording(tmp_path / "d")


def test_drf_subchannel_and_channel_of_one_name(tmp_path):
    write_drf(tmp_path / "d", "H", [(0, counts(20).reshape(-1, 4))], subchannels=2)
    write_drf(tmp_path / "d", "H_r1", [(0, counts(10))])
    with pytest.raises(RecordingError, match="rename one of the directories"):
        open_recording(tmp_path / "d")


def test_drf_given_too_deep(tmp_path):
    write_drf(tmp_path / "d", "r0", [(0, counts(10))])
    with pytest.raises(RecordingError, match=r"one channel of a Digital RF recording; give `.*/d` instead"):
        open_recording(tmp_path / "d" / "r0")
    with pytest.raises(RecordingError, match="one file of a Digital RF recording"):
        open_recording(next((tmp_path / "d" / "r0").rglob("rf@*.h5")))


def test_drf_damaged_file(tmp_path, capsys):
    write_drf(tmp_path / "d", "r0", [(0, counts(30_000))])
    middle = sorted((tmp_path / "d" / "r0").rglob("rf@*.h5"))[1]
    middle.write_bytes(middle.read_bytes()[:3000])
    with open_recording(tmp_path / "d") as r:
        assert r.blocks("r0").tolist() == [[EPOCH, 10_000], [EPOCH + 20_000, 10_000]]
        assert np.array_equal(r.read("r0", EPOCH + 20_000, 10_000), counts(30_000)[20_000:])
        (told,) = [problem for problem in describe(r)["problems"] if "damaged" in problem]
    assert told.startswith(f"r0: its file `{middle.name}` is damaged (")
    assert "truncated" in told
    assert told.endswith("its samples are left out; copy it again")
    assert capsys.readouterr().out == ""


def test_drf_file_without_samples_is_told(tmp_path, capsys):
    """A command that promises JSON alone on standard output prints nothing else."""
    write_drf(tmp_path / "d", "r0", [(0, counts(30_000))])
    last = max((tmp_path / "d" / "r0").rglob("rf@*.h5"))
    with h5py.File(last, "w"):
        pass
    with open_recording(tmp_path / "d") as r:
        assert r.blocks("r0").tolist() == [[EPOCH, 20_000]]
        assert f"r0: its file `{last.name}` is corrupt: it holds no samples" in describe(r)["problems"]
    assert capsys.readouterr().out == ""


def test_drf_that_loses_a_file_while_open(tmp_path):
    write_drf(tmp_path / "d", "r0", [(0, counts(30_000))])
    with open_recording(tmp_path / "d") as r:
        r.blocks("r0")
        sorted((tmp_path / "d" / "r0").rglob("rf@*.h5"))[0].unlink()
        with pytest.raises(RecordingError, match="channel `r0` lost samples after"):
            r.read("r0", EPOCH + 5_000, 15_000)


@pytest.mark.parametrize(("module", "extra"), [("digital_rf", "digital-rf"), ("sigmf", "sigmf")])
def test_missing_library_names_the_extra(tmp_path, monkeypatch, module, extra):
    write_drf(tmp_path / "digital_rf", "r0", [(0, counts(10))])
    write_sigmf(tmp_path / "sigmf", "r0", counts(10), [])
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(RecordingError, match=rf"pip install '{extra}>="):
        open_recording(tmp_path / module)


# -- SigMF ---------------------------------------------------------------------------------------------------


def test_sigmf_directory_and_single_file(tmp_path):
    x, y = counts(1000), counts(1000, seed=1)
    stamp = {"core:sample_start": 0, "core:datetime": "2026-09-21T14:13:20.000001Z", "core:frequency": 1e8}
    write_sigmf(tmp_path / "s", "r1", y, [stamp])
    write_sigmf(tmp_path / "s", "r0", x, [stamp])
    with open_recording(tmp_path / "s") as r:
        assert r.format == "sigmf"
        assert r.receiver_ids == ("r0", "r1")
        assert r.centre_frequency_hz == 1e8
        assert r.blocks("r1").tolist() == [[EPOCH + 1, 1000]]
        assert np.array_equal(r.read("r1", EPOCH + 11, 500), y[10:510])
    for suffix in ("meta", "data"):
        with open_recording(tmp_path / "s" / f"r0.sigmf-{suffix}") as r:
            assert r.receiver_ids == ("r0",)
            assert np.array_equal(r.read("r0", EPOCH + 1, 1000), x)


def test_sigmf_big_endian_and_float(tmp_path):
    x, z = counts(100), np.random.default_rng(0).normal(size=(100, 2)).astype(np.float32)
    write_sigmf(tmp_path / "i", "r", x.astype(">i2"), [], datatype="ci16_be")
    write_sigmf(tmp_path / "f", "r", z, [], datatype="cf32_le")
    with open_recording(tmp_path / "i") as r:
        assert np.array_equal(r.read("r", 0, 100), x)
    with open_recording(tmp_path / "f") as r:
        assert r.sample_format == "complex64"
        assert r.read("r", 0, 100).tobytes() == z.tobytes()


DAY = "2026-09-21T14:13:20"


@pytest.mark.parametrize(
    ("captures", "blocks"),
    [
        ([], [[0, 1000]]),
        ([{"core:global_index": 77}], [[77, 1000]]),
        ([{"core:datetime": f"{DAY}Z"}], [[EPOCH, 1000]]),
        # the stamp has no fraction, the index agrees to the second: the index is exact
        ([{"core:datetime": f"{DAY}Z", "core:global_index": EPOCH + 123_456}], [[EPOCH + 123_456, 1000]]),
        # the index counts from something else: the stamp holds, the index tells gaps
        (
            [{"core:datetime": f"{DAY}.5Z", "core:global_index": 10}, {"core:global_index": 600}],
            [[EPOCH + 500_000, 400], [EPOCH + 500_590, 600]],
        ),
        # stamps alone, fine enough to tell a gap of 100 samples
        (
            [{"core:datetime": f"{DAY}.000000Z"}, {"core:datetime": f"{DAY}.000500Z"}],
            [[EPOCH, 400], [EPOCH + 500, 600]],
        ),
        # stamps too coarse to tell: no gap is invented
        ([{"core:datetime": f"{DAY}.000Z"}, {"core:datetime": f"{DAY}.001Z"}], [[EPOCH, 1000]]),
        ([{"core:datetime": f"{DAY}Z"}, {}], [[EPOCH, 1000]]),
    ],
)
def test_sigmf_time(tmp_path, captures, blocks):
    for capture, start in zip(captures, (0, 400), strict=False):
        capture["core:sample_start"] = start
    x = counts(1000)
    write_sigmf(tmp_path / "s", "r", x, captures)
    with open_recording(tmp_path / "s") as r:
        assert r.blocks("r").tolist() == blocks
        got = [r.read("r", start, count) for start, count in blocks]
        assert np.array_equal(np.concatenate(got), x)


def test_sigmf_without_time_is_not_sound(tmp_path):
    write_sigmf(tmp_path / "s", "r0", counts(1000) // 2, [{"core:sample_start": 0}])
    write_sigmf(tmp_path / "s", "r1", counts(1000) // 2, [{"core:sample_start": 0, "core:global_index": 77}])
    with open_recording(tmp_path / "s") as r:
        summary = describe(r)
    assert summary["start_unix_s"] is None
    assert summary["start_utc"] is None
    assert [problem.split(":")[0] for problem in summary["problems"]] == ["r0", "r1"]
    assert all("when it was recorded is not known" in problem for problem in summary["problems"])


def test_sigmf_stamps_beside_the_grid_are_told(tmp_path):
    for name, stamp in (("r0", f"{DAY}.000000000Z"), ("r1", f"{DAY}.000000400Z")):
        capture = {"core:sample_start": 0, "core:datetime": stamp}
        write_sigmf(tmp_path / "s", name, counts(1000) // 2, [capture])
    with open_recording(tmp_path / "s") as r:
        (problem,) = describe(r)["problems"]
    assert problem.startswith("r1: its time stamps lie 0.4 samples (0.4 µs) beside the sample grid")


def test_sigmf_annotations_and_undeclared_extensions_are_no_faults(tmp_path):
    directory = write_sigmf(tmp_path / "s", "r", counts(1000), [], **{"mine:gain": 3})
    meta = directory / "r.sigmf-meta"
    content = json.loads(meta.read_text())
    content["annotations"] = [{"core:sample_start": 10, "core:sample_count": 10**9}]
    meta.write_text(json.dumps(content))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with open_recording(directory) as r:
            assert r.blocks("r").tolist() == [[0, 1000]]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"rate": math.nan}, "`global.core:sample_rate` is nan"),
        ({"rate": 1e-9}, "`core:sample_rate` must be a rate from"),
        ({"rate": 1e13}, "`global.core:sample_rate`: 10000000000000.0 is greater than the maximum"),
        ({"core:dataset": 5}, "`core:dataset` must be a file name, got 5"),
        ({"captures": [{"core:sample_start": 0, "core:datetime": "2026-02-30T12:00:00Z"}]}, "no time of Unix"),
        (
            {"captures": [{"core:sample_start": 0, "core:global_index": 2**63 - 1}]},
            "must be a whole number below 9223[0-9]{15}",
        ),
        ({"datatype": "ri16_le"}, "`core:datatype` is ri16_le; .* must be one of ci8, cu8, ci16_le"),
        ({"datatype": "cf64_le"}, "`core:datatype` is cf64_le; .* must be one of ci8, cu8, ci16_le"),
        (
            {"core:offset": 100, "captures": [{"core:sample_start": 0}]},
            "capture 0 has a `core:sample_start` before `core:offset`, 100",
        ),
        ({"captures": [{"core:sample_start": 5000}]}, "capture 0 starts at sample 5000 of 1000.*truncated"),
        (
            {"captures": [{"core:sample_start": 0, "core:global_index": 50},
                          {"core:sample_start": 400, "core:global_index": 60}]},
            "capture 1 starts 390 samples before capture 0 ends",
        ),
        (
            {"captures": [{"core:sample_start": 0, "core:frequency": 1e8},
                          {"core:sample_start": 400, "core:frequency": 2e8}]},
            "different `core:frequency`",
        ),
        ({"captures": [{"core:sample_start": 0, "core:datetime": "2026-09-21T14:13:20+01:00"}]}, "must look like"),
    ],
)  # fmt: skip
def test_sigmf_that_cannot_be_read(tmp_path, change, words):
    captures = change.pop("captures", [])
    write_sigmf(tmp_path / "s", "r", counts(1000), captures, **change)
    with pytest.raises(RecordingError, match=words) as caught:
        open_recording(tmp_path / "s")
    assert "r.sigmf-meta" in str(caught.value)


def test_sigmf_broken_pairs(tmp_path):
    directory = write_sigmf(tmp_path / "s", "r", counts(1000), [])
    meta, data = directory / "r.sigmf-meta", directory / "r.sigmf-data"
    text = meta.read_text()
    data.write_bytes(data.read_bytes()[:-3])
    with pytest.raises(RecordingError, match="integer number of samples"):
        open_recording(directory)
    data.unlink()
    with pytest.raises(RecordingError, match="file of samples beside it is missing"):
        open_recording(directory)
    meta.write_text(text[:50])
    with pytest.raises(RecordingError, match="not valid JSON"):
        open_recording(directory)
    meta.write_text('{"global": {}}')
    with pytest.raises(RecordingError, match="cannot read"):
        open_recording(directory)


def test_sigmf_receivers_that_differ(tmp_path):
    write_sigmf(tmp_path / "s", "r0", counts(10), [])
    write_sigmf(tmp_path / "s", "r1", counts(10), [], rate=2e6)
    with pytest.raises(RecordingError, match="`r1` and `r0` differ in rate: 2000000 and 1000000"):
        open_recording(tmp_path / "s")


STORED = {
    "ci8": ("i1", 0, "int16"), "cu8": ("u1", 128, "int16"), "ci16_le": ("<i2", 0, "int16"),
    "ci16_be": (">i2", 0, "int16"), "ci32_le": ("<i4", 0, "complex64"), "ci32_be": (">i4", 0, "complex64"),
    "cf32_le": ("<f4", 0, "complex64"), "cf32_be": (">f4", 0, "complex64"),
}  # fmt: skip


@pytest.mark.parametrize("datatype", STORED)
@pytest.mark.parametrize("channels", [1, 3])
def test_sigmf_types_channels_headers_and_trailer(tmp_path, datatype, channels):
    """A non-conforming dataset of every type; the values are small enough to be exact in all."""
    dtype, zero, sample_format = STORED[datatype]
    values = np.random.default_rng(5).integers(-100, 100, size=(700, channels, 2))
    stored = (values + zero).astype(dtype)
    tmp_path.joinpath("x.bin").write_bytes(
        b"head" + stored[:300].tobytes() + b"pause" + stored[300:].tobytes() + b"tail!"
    )
    meta = {
        "global": {
            "core:datatype": datatype, "core:sample_rate": 1e6, "core:version": "1.2.0", "core:num_channels": channels,
            "core:dataset": "x.bin", "core:trailing_bytes": 5, "core:offset": 50,
        },
        "captures": [
            {"core:sample_start": 50, "core:global_index": EPOCH, "core:header_bytes": 4},
            {"core:sample_start": 350, "core:global_index": EPOCH + 1000, "core:header_bytes": 5},
        ],
        "annotations": [],
    }  # fmt: skip
    tmp_path.joinpath("x.sigmf-meta").write_text(json.dumps(meta))
    with open_recording(tmp_path / "x.sigmf-meta") as r:
        assert r.receiver_ids == (("x",) if channels == 1 else tuple(f"x_r{k}" for k in range(channels)))
        assert r.sample_format == sample_format
        for k, name in enumerate(r.receiver_ids):
            assert r.blocks(name).tolist() == [[EPOCH, 300], [EPOCH + 1000, 400]]
            assert np.array_equal(r.read(name, EPOCH, 300), values[:300, k])
            assert np.array_equal(r.read(name, EPOCH + 1007, 200), values[307:507, k])
    with (tmp_path / "x.bin").open("ab") as file:
        file.write(b"x")
    with pytest.raises(RecordingError, match="integer number of samples"):
        open_recording(tmp_path / "x.sigmf-meta")


def test_sigmf_archive_and_collection_of_the_library(tmp_path, monkeypatch):
    x = {name: counts(1000, seed) for seed, name in enumerate(("r0", "r1"))}
    stamp = {"core:sample_start": 0, "core:global_index": EPOCH}
    for name, samples in x.items():
        write_sigmf(tmp_path, name, samples, [stamp])
    monkeypatch.chdir(tmp_path)
    sigmf.SigMFCollection(["r0.sigmf-meta", "r1.sigmf-meta"]).tofile("both")
    sigmf.fromfile("r0.sigmf-meta").archive("packed")
    with open_recording(tmp_path / "packed.sigmf") as r:
        assert r.receiver_ids == ("r0",) or r.receiver_ids == ("packed",)
        assert np.array_equal(r.read(r.receiver_ids[0], EPOCH + 5, 900), x["r0"][5:905])
        assert tmp_path / "packed.sigmf" in r.files()
    with open_recording(tmp_path / "both.sigmf-collection") as r:
        assert r.receiver_ids == ("r0", "r1")
        assert np.array_equal(r.read("r1", EPOCH, 1000), x["r1"])
        assert r.notes == []
    meta = tmp_path / "r0.sigmf-meta"
    meta.write_text(meta.read_text().replace("1.2.0", "1.2.1"))
    (tmp_path / "r1.sigmf-meta").unlink()
    with open_recording(tmp_path / "both.sigmf-collection") as r:
        assert r.receiver_ids == ("r0",)
        assert "`r0.sigmf-meta` was changed since `both.sigmf-collection` was written" in r.notes[0]
        assert "names `r1.sigmf-meta`, which is missing" in r.notes[1]


@pytest.mark.parametrize("packed", ["gz", "xz", "zip"])
def test_compressed_sigmf_archives_of_the_library(tmp_path, monkeypatch, packed):
    x = counts(1000, 3)
    write_sigmf(tmp_path, "r0", x, [{"core:sample_start": 0, "core:global_index": EPOCH}])
    monkeypatch.chdir(tmp_path)
    sigmf.fromfile("r0.sigmf-meta").archive(f"packed.sigmf.{packed}", compression=packed)
    path, room = tmp_path / f"packed.sigmf.{packed}", tmp_path / "room"
    room.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(room))
    with open_recording(path) as r:
        (name,) = r.receiver_ids
        assert np.array_equal(r.read(name, EPOCH + 5, 900), x[5:905])
        assert set(r.files()) == {path}
        assert sum(file.stat().st_size for file in room.rglob("*") if file.is_file()) == x.nbytes
    assert not list(room.iterdir())
    (tmp_path / "set").mkdir()
    path.rename(tmp_path / "set" / path.name)
    with open_recording(tmp_path / "set") as r:
        assert r.receiver_ids == (name,)
    path = tmp_path / "set" / path.name
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(RecordingError, match=rf"packed.sigmf.{packed}: .*archive"):
        open_recording(path)
    monkeypatch.setattr("rfpose.recording.sigmf_files._UNPACKED_BYTES", 3999 - FROM_SAMPLES * len(content))
    path.write_bytes(content)
    with pytest.raises(RecordingError, match="would unpack to more than 1100 times its size"):
        open_recording(path)
    assert not list(room.iterdir())


@pytest.mark.parametrize("name", ["a.sigmf", "a.sigmf.gz", "a.sigmf.xz", "a.sigmf.zip"])
def test_sigmf_archive_that_is_none(tmp_path, name):
    (tmp_path / name).write_bytes(b"x")
    with pytest.raises(RecordingError, match=rf"{name}: (no sound (un)?compressed archive|cannot read)"):
        open_recording(tmp_path / name)


# -- conversion ----------------------------------------------------------------------------------------------


@pytest.fixture(params=["int16", "complex64"])
def native(request, tmp_path):
    """A native recording with gaps, at a rate that is no whole number, with a late block in another hour."""
    x = counts(9000) if request.param == "int16" else counts(9000).astype(np.float32) / 32768
    path = tmp_path / "native.h5"
    with RecordingWriter(
        path, scenario=SCENARIO, receiver_ids=["H01_r1", "H01_r0"], sample_rate=Fraction(10**7, 3),
        centre_frequency_hz=100e6, sample_format=request.param, full_scale=32767 if request.param == "int16" else 1.0,
        provenance={},
    ) as writer:  # fmt: skip
        writer.write("H01_r0", EPOCH, x[:5000])
        writer.write("H01_r0", EPOCH + 6000, x[5000:6000])
        writer.write("H01_r1", EPOCH + 17, x)
        writer.write("H01_r1", EPOCH + 4 * 10**9, x[:100])
    with open_recording(path) as recording:
        yield recording


@pytest.mark.parametrize("format", ["rfpose-iq", "digital-rf", "sigmf"])
def test_conversion_keeps_samples_times_and_gaps(native, tmp_path, format):
    progress = []
    convert(native, tmp_path / "out", format=format, on_progress=lambda done, total: progress.append((done, total)))
    convert_back = tmp_path / "back.h5"
    with open_recording(tmp_path / "out") as middle:
        convert(middle, convert_back, format="rfpose-iq")
    for path in (tmp_path / "out", convert_back):
        with open_recording(path) as got:
            assert set(got.receiver_ids) == set(native.receiver_ids)
            assert got.sample_rate == native.sample_rate
            assert got.centre_frequency_hz == native.centre_frequency_hz
            assert got.sample_format == native.sample_format
            assert got.scenario is not None
            assert got.scenario.to_toml() == SCENARIO.to_toml()
            for name in native.receiver_ids:
                assert np.array_equal(got.blocks(name), native.blocks(name))
                for start, count in native.blocks(name).tolist():
                    assert got.read(name, start, count).tobytes() == native.read(name, start, count).tobytes()
    assert progress[-1] == (15_100, 15_100)
    assert progress == sorted(progress)


@pytest.mark.parametrize("format", ["rfpose-iq", "digital-rf", "sigmf"])
def test_conversion_refuses_and_replaces(native, tmp_path, format):
    out = tmp_path / "out"
    convert(native, out, format=format)
    with pytest.raises(RecordingError, match=r"exists already.*`force=True`"):
        convert(native, out, format=format)
    convert(native, out, format=format, overwrite=True)
    with open_recording(out) as got:
        assert got.covers("H01_r1", EPOCH + 17, 9000)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["native.h5", "out"]


def test_conversion_never_replaces_a_directory_that_is_no_recording(native, tmp_path):
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter1.txt").write_text("years of work")
    for format in ("digital-rf", "sigmf"):
        with pytest.raises(RecordingError, match="not a recording is never replaced"):
            convert(native, tmp_path / "thesis", format=format, overwrite=True)
    with pytest.raises(RecordingError, match="is a directory"):
        convert(native, tmp_path / "thesis", format="rfpose-iq", overwrite=True)
    assert (tmp_path / "thesis" / "chapter1.txt").read_text() == "years of work"


def test_conversion_arguments(native, tmp_path):
    with pytest.raises(InvalidInputError, match="`format` must be one of"):
        convert(native, tmp_path / "out", format="wav")
    with pytest.raises(RecordingError, match="source and target are the same"):
        convert(native, native.path, format="rfpose-iq", overwrite=True)
    with pytest.raises(RecordingError, match="does not exist; make it first"):
        convert(native, tmp_path / "no" / "out", format="sigmf")


def test_interrupted_conversion_leaves_nothing(native, tmp_path):
    def stop(done, total):
        raise KeyboardInterrupt

    for format in ("rfpose-iq", "digital-rf", "sigmf"):
        with pytest.raises(KeyboardInterrupt):
            convert(native, tmp_path / "out", format=format, on_progress=stop)
    assert [p.name for p in tmp_path.iterdir()] == ["native.h5"]


@pytest.mark.parametrize("format", ["rfpose-iq", "digital-rf", "sigmf"])
def test_conversion_is_checksummed_and_read_back(native, tmp_path, format, monkeypatch):
    wanted = {
        name: hashlib.sha256(
            b"".join(native.read(name, start, count).tobytes() for start, count in native.blocks(name).tolist())
        ).hexdigest()
        for name in native.receiver_ids
    }
    assert convert(native, tmp_path / "out", format=format) == wanted
    if format == "sigmf":
        for meta in (tmp_path / "out").glob("*.sigmf-meta"):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                sigmf.fromfile(meta, skip_checksum=False)  # raises where the checksum is wrong
            assert "core:sha512" in json.loads(meta.read_text())["global"]
    # a disk that gives back something else
    plain = Recording.read

    def read(self, receiver_id, start, count, out=None):
        found = plain(self, receiver_id, start, count, out)
        if self is not native:
            found[-1] += 1
        return found

    monkeypatch.setattr(Recording, "read", read)
    with pytest.raises(RecordingError, match=r"out2: what was written of receiver .* reads back as something else"):
        convert(native, tmp_path / "out2", format=format)
    assert not (tmp_path / "out2").exists()
    with pytest.raises(InvalidInputError, match="`compress` is for rfpose-iq"):
        convert(native, tmp_path / "out3", format="sigmf", compress="blosc2")


def test_reading_digital_rf_leaves_the_programs_logging_alone() -> None:
    """The library sets up the root logger when it is imported."""
    code = (
        "import logging; from rfpose.recording.drf import import_digital_rf as go; go(); print(logging.root.handlers)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
