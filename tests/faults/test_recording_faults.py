"""Damaged recordings, full disks and killed writers: a clear error, and nothing half written."""

import os
import resource
import signal
import subprocess
import sys
import textwrap
from fractions import Fraction
from pathlib import Path

import h5py
import numpy as np
import pytest

from rfpose.errors import RecordingError, ScenarioError
from rfpose.recording import RecordingWriter, describe, open_recording
from rfpose.scenario import load_scenario
from rfpose.truth import Truth

SCENARIO = load_scenario(Path(__file__).resolve().parents[2] / "data" / "table2_100m.toml")


@pytest.fixture
def sound(tmp_path):
    path = tmp_path / "r.h5"
    with RecordingWriter(
        path, scenario=SCENARIO, receiver_ids=["a", "b"], sample_rate=Fraction(40_000_000), centre_frequency_hz=1e8,
        sample_format="int16", full_scale=32767, provenance={"x": "y"},
    ) as writer:  # fmt: skip
        for name in ("a", "b"):
            writer.write(name, 1000, np.ones((50_000, 2), np.int16))
            writer.write(name, 90_000, np.ones((50_000, 2), np.int16))
        writer.write_truth(
            Truth(
                heliostat_ids=("H",),
                receiver_ids=("a", "b"),
                transmitter_ids=("T",),
                normal_enu=np.ones((1, 1, 3)),
                receiver_enu_m=np.ones((1, 2, 3)),
            )
        )
    return path


# -- not a recording -----------------------------------------------------------------------------------------


def test_missing_path(tmp_path):
    with pytest.raises(RecordingError, match="no such file or directory; check the path"):
        open_recording(tmp_path / "nothing.h5")


@pytest.mark.parametrize(("content", "words"), [(b"", "is empty"), (b"time,i,q\n0,1,2\n" * 100, "not an HDF5 file")])
def test_not_hdf5(tmp_path, content, words):
    (tmp_path / "r.h5").write_bytes(content)
    with pytest.raises(RecordingError, match=rf"r\.h5: .*{words}"):
        open_recording(tmp_path / "r.h5")


def test_directory_of_something_else(tmp_path):
    with pytest.raises(RecordingError, match=r"neither Digital RF channels .* nor SigMF"):
        open_recording(tmp_path)


@pytest.mark.parametrize("keep", [0.02, 0.3, 0.9, 0.9999])
def test_truncated(sound, keep):
    content = sound.read_bytes()
    sound.write_bytes(content[: int(len(content) * keep)])
    with pytest.raises(RecordingError, match=r"r\.h5: the HDF5 file is truncated .*copy it again"):
        open_recording(sound)


def test_other_hdf5(tmp_path):
    with h5py.File(tmp_path / "x.h5", "w") as file:
        file["temperature"] = np.arange(5.0)
    with pytest.raises(RecordingError, match=r"an HDF5 file of another format .*must be 'rfpose-iq', is None"):
        open_recording(tmp_path / "x.h5")


def test_result_file_is_called_one(tmp_path):
    with h5py.File(tmp_path / "x.h5", "w") as file:
        file.attrs["format"] = "rfpose-result"
    with pytest.raises(RecordingError, match="no recording, but a result of `rfpose process`, which `rfpose evaluate`"):
        open_recording(tmp_path / "x.h5")


# -- spoilt inside -------------------------------------------------------------------------------------------


def replace(file, place, data):
    del file[place]
    file[place] = data


def set_attribute(name, value):
    return lambda file: file.attrs.__setitem__(name, value)


def delete_attribute(name):
    return lambda file: file.attrs.__delitem__(name)


BLOCKS = "receivers/a/blocks"
SPOILERS = [
    (set_attribute("format_version", 2), "version 2; this program reads version 1: install a newer rfpose"),
    (set_attribute("format_version", "one"), "attribute `format_version` of `/` must be an integer, is 'one'"),
    (delete_attribute("sample_rate_numerator"), "attribute `sample_rate_numerator` of `/` is missing"),
    (set_attribute("sample_rate_denominator", 0), "attribute `sample_rate_numerator` gives a rate of 40000000/0"),
    (set_attribute("sample_format", "int12"), "attribute `sample_format` must be int16 or complex64, is 'int12'"),
    (set_attribute("sample_format", 16), "attribute `sample_format` of `/` must be text"),
    (set_attribute("full_scale", "big"), "attribute `full_scale` of `/` must be a number"),
    (set_attribute("full_scale", [1.0, 2.0]), "attribute `full_scale` of `/` must be a number"),
    (set_attribute("centre_frequency_hz", np.nan), "attribute `centre_frequency_hz` of `/` must be a number"),
    (delete_attribute("created_by"), "attribute `created_by` of `/` is missing"),
    (lambda f: f.__delitem__("receivers"), "`/receivers` must be a group and is missing"),
    (lambda f: replace(f, "receivers", np.ones(3)), "`/receivers` must be a group and is missing or something else"),
    (lambda f: [f.__delitem__(f"receivers/{name}") for name in "ab"], "`/receivers` holds no receiver"),
    (lambda f: f.__delitem__("receivers/b/iq"), "`/receivers/b/iq` must be a dataset of samples and is missing"),
    (lambda f: replace(f, "receivers/b/iq", np.ones(9, "<f8")), "`/receivers/b/iq` must be one-dimensional of type"),
    (lambda f: replace(f, "receivers/b/iq", np.ones((9, 2), "<i2")), "is 2-dimensional of type int16"),
    (lambda f: replace(f, "scenario", np.arange(3)), "`/scenario` must be a text"),
    (lambda f: f.__delitem__("truth/receiver_enu_m"), "`/truth/receiver_enu_m` must be a dataset of float64"),
    (lambda f: replace(f, "truth/normal_enu", np.ones(3)), "`/truth/normal_enu` must be float64 of 3 dimensions"),
    (lambda f: replace(f, "truth/receiver_ids", np.ones(3)), "`/truth/receiver_ids` must be a list of texts"),
    (lambda f: f.__delitem__(BLOCKS), "`/receivers/a/blocks` must be a table of int64 and is missing"),
    (lambda f: replace(f, BLOCKS, np.ones((2, 3))), "`/receivers/a/blocks` must be int64 of shape"),
    (lambda f: replace(f, BLOCKS, np.ones((2, 2), np.int64)), "`/receivers/a/blocks` must be int64 of shape"),
    (lambda f: replace(f, BLOCKS, np.array([[0, 100_001, 0]])), "row 0 .* does not lie within the 100000 samples"),
    (lambda f: replace(f, BLOCKS, np.array([[0, 2**63 - 1, 5]])), "row 0 .* does not lie within the 100000 samples"),
    (lambda f: replace(f, BLOCKS, np.array([[0, 10, 0], [-5, 10, 10]])), "row 1 .* does not lie within"),
    (lambda f: replace(f, BLOCKS, np.array([[0, 10, 0], [9, 10, 10]])), "row 1 starts before row 0 ends"),
]


@pytest.mark.parametrize(("spoil", "words"), SPOILERS, ids=[words[:50] for _, words in SPOILERS])
def test_spoilt_inside(sound, spoil, words):
    with h5py.File(sound, "r+") as file:
        spoil(file)
    with pytest.raises(RecordingError, match=words) as caught, open_recording(sound) as recording:
        recording.blocks("a")
    assert str(caught.value).startswith(str(sound))
    assert "\n" not in str(caught.value)


def test_embedded_scenario_that_is_none(sound):
    with h5py.File(sound, "r+") as file:
        replace(file, "scenario", "name = 3")
    with pytest.raises(ScenarioError, match=r"r\.h5:/scenario: "):
        open_recording(sound)


def test_describe_reports_a_spoilt_receiver_and_goes_on(sound):
    with h5py.File(sound, "r+") as file:
        replace(file, BLOCKS, np.ones((2, 3)))
    with open_recording(sound) as recording:
        summary = describe(recording)
    assert summary["sound"] is False
    assert summary["receivers"]["a"] == {"readable": False}
    assert summary["receivers"]["b"]["samples"] == 100_000


# -- full disk, killed process -------------------------------------------------------------------------------

WRITE_FOREVER = """
    import sys
    from fractions import Fraction
    import numpy as np
    from rfpose.errors import RecordingError
    from rfpose.recording import RecordingWriter
    x = np.ones((100_000, 2), np.int16)
    n = int(sys.argv[2])
    try:
        with RecordingWriter(
            sys.argv[1], scenario=None, receiver_ids=["a", "b"], sample_rate=Fraction(10**6), centre_frequency_hz=0.0,
            sample_format="int16", full_scale=32767, provenance={}, overwrite=True,
        ) as writer:
            for k in range(n):
                writer.write("a", k * 100_000, x)
                writer.write("b", k * 100_000, x)
                print(k, flush=True)
    except RecordingError as error:
        print("caught:", error)
"""


def start_writer(path, n, **settings):
    return subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(WRITE_FOREVER), str(path), str(n)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **settings,
    )  # fmt: skip


@pytest.mark.skipif(not hasattr(resource, "RLIMIT_FSIZE"), reason="no limit on file sizes here")
@pytest.mark.parametrize("room", [1_000, 500_000, 5_000_000, 8_030_000], ids=["header", "first", "middle", "last"])
def test_full_disk(tmp_path, room):
    """A limit on the size of a file stands for the full disk; HDF5 reports it anywhere, or crashes at exit."""
    target = tmp_path / "r.h5"
    target.write_text("old")
    process = start_writer(target, 10, preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (room, room)))
    out, err = process.communicate(timeout=60)
    assert out.splitlines()[-1].startswith(f"caught: {target}: cannot write: File too large; free space on the disk")
    assert err == ""
    assert process.returncode == 0
    assert [p.name for p in tmp_path.iterdir()] == ["r.h5"]
    assert target.read_text() == "old"


@pytest.mark.parametrize("existing", [False, True])
def test_killed_writer_leaves_the_target_alone(tmp_path, existing):
    target = tmp_path / "r.h5"
    if existing:
        target.write_text("old")
    with start_writer(target, 10**6) as process:
        for line in process.stdout:
            if line.strip() == "3":
                os.kill(process.pid, signal.SIGKILL)
                break
    assert process.returncode == -signal.SIGKILL
    assert target.exists() == existing
    if existing:
        assert target.read_text() == "old"
    left = sorted(p.name for p in tmp_path.iterdir() if p != target)
    assert left == [".r.h5.lock", ".r.h5.part"]
    with pytest.raises(RecordingError):
        open_recording(tmp_path / ".r.h5.part")
    # the next one takes them over
    assert start_writer(target, 1).communicate(timeout=60) == ("0\n", "")
    assert [p.name for p in tmp_path.iterdir()] == ["r.h5"]
    open_recording(target).close()


def test_no_such_directory(tmp_path):
    with pytest.raises(RecordingError, match=r"its directory does not exist; make it first: .*no$"), \
            RecordingWriter(
                tmp_path / "no" / "r.h5", scenario=None, receiver_ids=["a"], sample_rate=Fraction(1),
                centre_frequency_hz=0.0, sample_format="int16", full_scale=1, provenance={},
            ):  # fmt: skip
        pass
