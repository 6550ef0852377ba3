"""A recording from elsewhere reads nothing outside its folder unless asked, and takes no more than it stores."""

import json
import os
import shutil
from fractions import Fraction

import h5py
import numpy as np
import pytest
from click.testing import CliRunner

from rfpose.cli._app import app
from rfpose.errors import RecordingError
from rfpose.recording import RecordingWriter, convert, describe, open_recording

drf = pytest.importorskip("digital_rf", reason="the digital_rf library is not installed")
pytest.importorskip("sigmf", reason="the sigmf library is not installed")

SECRET = b"secret" * 4000
START = 1_790_000_000 * 10**6
NATIVE, DRF, SIGMF = "rfpose-iq", "digital-rf", "sigmf"


@pytest.fixture
def private(tmp_path):
    """A file outside of every recording."""
    (tmp_path / "private").mkdir()
    path = tmp_path / "private" / "key.bin"
    path.write_bytes(SECRET)
    return path


@pytest.fixture
def make(tmp_path):
    """A function that makes a sound recording of receivers a and b in any format, and returns its path."""

    def made(format):
        native = tmp_path / "rec" / "r.h5"
        native.parent.mkdir()
        with RecordingWriter(
            native, scenario=None, receiver_ids=["a", "b"], sample_rate=Fraction(10**6), centre_frequency_hz=1e8,
            sample_format="int16", full_scale=32767, provenance={},
        ) as writer:  # fmt: skip
            for name in "ab":
                writer.write(name, START, np.random.default_rng(0).integers(-900, 900, (6000, 2)).astype(np.int16))
        if format == NATIVE:
            return native
        with open_recording(native) as recording:
            convert(recording, tmp_path / "other", format=format)
        return tmp_path / "other"

    return made


def outside(path, private, how):
    """Let part of a recording stand outside its folder."""
    if how == "core:dataset":
        meta = path / "a.sigmf-meta"
        content = json.loads(meta.read_text())
        content["global"]["core:dataset"] = f"../{private.parent.name}/{private.name}"
        meta.write_text(json.dumps(content))
    elif how == "data link":
        (path / "a.sigmf-data").unlink()
        (path / "a.sigmf-data").symlink_to(private)
    elif how in ("metadata link", "scenario link", "channel link"):
        name = {"metadata link": "a.sigmf-meta", "scenario link": "scenario.toml", "channel link": "a"}[how]
        elsewhere = private.parent / name
        if (path / name).exists():
            shutil.move(path / name, elsewhere)
        else:
            elsewhere.write_text("name = 'private'")
        (path / name).symlink_to(elsewhere)
    elif how == "file link":
        file = next(path.rglob("rf@*.h5"))
        shutil.move(file, private.parent / file.name)
        file.symlink_to(private.parent / file.name)
    else:
        file = path if path.is_file() else next((path / "a").rglob("rf@*.h5"))
        place = "receivers/a/iq" if path.is_file() else "rf_data"
        with h5py.File(file, "r+") as f:
            dtype, n, stored = f[place].dtype, f[place].shape, f[place][()]
            del f[place]
            if how == "external link":
                with h5py.File(private.parent / "x.h5", "w") as other:
                    other.create_dataset("before", data=np.ones(1000))  # so that samples lie elsewhere in it
                    other.create_dataset("iq", data=stored)
                f[place] = h5py.ExternalLink(str(private.parent / "x.h5"), "/iq")
            elif how == "soft link":
                with h5py.File(private.parent / "x.h5", "w") as other:
                    other.create_dataset("iq", n, dtype)
                f["way"] = h5py.ExternalLink(str(private.parent / "x.h5"), "/")
                f[place] = h5py.SoftLink("/way/iq")
            elif how == "external storage":
                f.create_dataset(place, n, dtype, external=[(str(private), 0, int(np.prod(n)) * dtype.itemsize)])
            elif how == "virtual":
                with h5py.File(private.parent / "x.h5", "w") as other:
                    other.create_dataset("iq", n, dtype)
                layout = h5py.VirtualLayout(n, dtype)
                layout[...] = h5py.VirtualSource(str(private.parent / "x.h5"), "iq", n)
                f.create_virtual_dataset(place, layout)


HDF5 = ["external link", "soft link", "external storage", "virtual"]
WAYS = [
    *((SIGMF, how) for how in ("core:dataset", "data link", "metadata link", "scenario link")),
    *((DRF, how) for how in ("channel link", "file link", "scenario link", *HDF5)),
    *((NATIVE, how) for how in HDF5),
]


@pytest.mark.parametrize(("format", "how"), WAYS, ids=[f"{format} {how}" for format, how in WAYS])
def test_nothing_outside_the_recording_is_read_unasked(make, private, format, how):
    path = make(format)

    def read(**settings):
        with open_recording(path, **settings) as recording:
            start, count = recording.blocks("a")[0].tolist()
            return recording.read("a", start, count)

    before = read()
    outside(path, private, how)
    with pytest.raises(RecordingError, match=r"is not read; .*add `follow_links=True`") as caught:
        read()
    assert str(path) in str(caught.value)
    if how == "scenario link":
        return  # which is none, so it cannot be read either way
    found = read(follow_links=True)
    assert len(found) > 0
    if how in ("external link", "channel link", "file link"):
        np.testing.assert_array_equal(found, before)


def test_links_within_the_recording_are_fine(make):
    path = make(SIGMF)
    (path / "samples").mkdir()
    shutil.move(path / "a.sigmf-data", path / "samples" / "a.bin")
    (path / "a.sigmf-data").symlink_to("samples/a.bin")
    with open_recording(path) as recording:
        assert recording.receiver_ids == ("a", "b")
    native = make_soft_links(path.parent / "rec" / "r.h5")
    with open_recording(native) as recording:
        assert recording.covers("a", START, 6000)


def make_soft_links(path):
    with h5py.File(path, "r+") as file:
        file.move("receivers/a/iq", "samples_of_a")
        file["alias"] = h5py.SoftLink("/samples_of_a")
        file["receivers/a/iq"] = h5py.SoftLink("/alias")
    return path


def test_a_circle_of_soft_links_is_refused(make):
    path = make(NATIVE)
    with h5py.File(path, "r+") as file:
        del file["receivers/a/iq"]
        file["receivers/a/iq"] = h5py.SoftLink("/receivers/a/iq")
    with pytest.raises(RecordingError, match="the soft links at `/receivers/a/iq` lead in a circle"):
        open_recording(path)


@pytest.mark.parametrize("arguments", [["info"], ["convert", "-o", "out.h5"], ["process", "-o", "out.h5"]])
def test_the_flag_is_the_same_on_every_command(make, private, tmp_path, arguments):
    path = make(SIGMF)
    outside(path, private, "core:dataset")
    arguments = [str(tmp_path / item) if item == "out.h5" else item for item in arguments]
    refused = CliRunner().invoke(app, [*arguments, str(path)])
    assert refused.exit_code == 3
    assert "add --follow-links" in refused.output
    assert not (tmp_path / "out.h5").exists()
    allowed = CliRunner().invoke(app, [*arguments, str(path), "--follow-links"])
    assert "follow-links" not in allowed.output


@pytest.mark.parametrize("name", ["x" * 5000, "a\0b"], ids=["long", "zero"])
def test_paths_that_are_none(name):
    with pytest.raises(RecordingError, match="check the path"):
        open_recording(name)


@pytest.mark.parametrize("name", ["/dev/zero", "/etc", ".", "..", "", "a\\u0000b", pytest.param("x" * 5000, id="long")])
def test_names_that_are_no_file_of_samples(make, name):
    path = make(SIGMF)
    meta = path / "a.sigmf-meta"
    meta.write_text(meta.read_text().replace('"core:datatype"', f'"core:dataset": "{name}", "core:datatype"'))
    for follow in (False, True):
        with pytest.raises(RecordingError, match=r"a\.sigmf-meta: "):
            open_recording(path, follow_links=follow)


def test_a_pipe_is_no_recording(tmp_path):
    os.mkfifo(tmp_path / "r.h5")
    with pytest.raises(RecordingError, match="not a file"):
        open_recording(tmp_path / "r.h5")


# -- no more than is stored ----------------------------------------------------------------------------------


def replace(file, place, **settings):
    del file[place]
    file.create_dataset(place, **settings)


IQ = np.dtype([("r", "<i2"), ("i", "<i2")])
HOLLOW = [
    ("/receivers/a/iq", {"shape": (10**12,), "dtype": IQ, "chunks": (2**18,)}),
    ("/receivers/a/iq", {"shape": (2**62,), "dtype": IQ, "chunks": (2**18,)}),
    ("/receivers/a/iq", {"shape": (10**9,), "dtype": IQ, "chunks": (2**28,), "compression": 1}),
    ("/receivers/a/blocks", {"shape": (10**9, 3), "dtype": "<i8", "fillvalue": 1, "chunks": (2**16, 3)}),
    ("/scenario", {"shape": (), "dtype": "S1000000000"}),
    ("/truth/normal_enu", {"shape": (10**6, 10**4, 3), "dtype": "<f8", "chunks": (1, 10**4, 3)}),
    ("/truth/receiver_ids", {"shape": (10**10,), "dtype": h5py.string_dtype(), "chunks": (2**16,)}),
]


@pytest.mark.parametrize(("place", "settings"), HOLLOW, ids=[f"{p} {s['shape']}" for p, s in HOLLOW])
def test_a_small_file_that_declares_much_is_refused(make, place, settings):
    path = make(NATIVE)
    with h5py.File(path, "r+") as file:
        for name in ("heliostat_ids", "receiver_ids", "transmitter_ids"):
            file.create_dataset(f"truth/{name}", data=["x"], dtype=h5py.string_dtype())
        for name in ("normal_enu", "receiver_enu_m"):
            file.create_dataset(f"truth/{name}", data=np.ones((1, 1, 3)))
        file["scenario"] = "x"
        replace(file, place, **settings)
        if place != "/scenario":
            del file["scenario"]
    assert path.stat().st_size < 10**7
    with pytest.raises(RecordingError, match=rf"`{place}` (declares|is compressed in chunks of)"), \
            open_recording(path) as recording:  # fmt: skip
        recording.blocks("a")


@pytest.mark.parametrize(
    ("place", "settings"),
    [
        ("/rf_data", {"shape": (10**12, 1), "dtype": IQ, "chunks": (2**18, 1)}),
        ("/rf_data_index", {"shape": (10**9, 2), "dtype": "<u8", "chunks": (2**16, 2)}),
    ],
)
def test_a_small_digital_rf_file_that_declares_much_is_refused(make, place, settings):
    path = make(DRF)
    file = next((path / "a").rglob("rf@*.h5"))
    with h5py.File(file, "r+") as f:
        replace(f, place, **settings)
    with pytest.raises(RecordingError, match=rf"{file.name}: `{place}` declares"):
        open_recording(path)


def test_much_compressed_samples_are_read(make):
    """Zeros shrink a thousand times, which is no reason for mistrust."""
    path = make(NATIVE)
    with h5py.File(path, "r+") as file:
        replace(file, "/receivers/a/iq", data=np.zeros(20_000_000, IQ), chunks=(2**18,), compression=9)
        file["receivers/a/blocks"][0] = (START, 20_000_000, 0)
    with open_recording(path) as recording:
        assert describe(recording)["problems"] == ["a: all samples looked at are zero: is the receiver connected?"]


def test_a_filter_that_is_missing_is_named(make):
    path = make(NATIVE)
    with h5py.File(path, "r+") as file:
        data = file["receivers/a/iq"][()]
        del file["receivers/a/iq"]
        settings = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        settings.set_chunk((4096,))
        settings.set_filter(305, h5py.h5z.FLAG_OPTIONAL)  # LZO, which hdf5plugin does not bring either
        space = h5py.h5s.create_simple(data.shape)
        kind = h5py.h5t.py_create(data.dtype)
        h5py.h5d.create(file["receivers/a"].id, b"iq", kind, space, settings)
    with pytest.raises(RecordingError, match=r"compressed by the HDF5 filter 305 \(LZO\).*pip install hdf5plugin"):
        open_recording(path)


def test_json_that_asks_for_memory_is_refused(make):
    path = make(SIGMF)
    meta = path / "a.sigmf-meta"
    sound = meta.read_text()
    for text in (sound.replace("1000000.0", "1e999999999"), sound.replace("1000000.0", "9" * 400), "[" * 10**6):
        meta.write_text(text)
        with pytest.raises(RecordingError, match=r"a\.sigmf-meta: "):
            open_recording(path)
