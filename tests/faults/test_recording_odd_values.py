"""Whatever stands in a recording: it is read, or one line names the file and the place. Nothing else is raised.

Values and shapes are changed through h5py and in the JSON, files are cut short and taken away, at random but seeded.
Bits of HDF5's own structure are not flipped: on those its C library may hang or crash, which no program around it can
prevent.
"""

import contextlib
import json
import shutil
import warnings
from fractions import Fraction
from pathlib import Path

import h5py
import numpy as np
import pytest

from rfpose.errors import RfposeError
from rfpose.recording import RecordingWriter, convert, describe, open_recording
from rfpose.scenario import load_scenario
from rfpose.truth import Truth

pytest.importorskip("digital_rf", reason="the digital_rf library is not installed")
pytest.importorskip("sigmf", reason="the sigmf library is not installed")

SCENARIO = load_scenario(Path(__file__).resolve().parents[2] / "data" / "table2_100m.toml")
START = 1_790_000_000 * 40_000_000
RUNS = 120
"""A format; about three seconds."""


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    """A sound recording in every format, made once."""
    top = tmp_path_factory.mktemp("sound")
    native = top / "rfpose-iq" / "r.h5"
    native.parent.mkdir()
    with RecordingWriter(
        native, scenario=SCENARIO, receiver_ids=["H01_r0", "H01_r1"], sample_rate=Fraction(40_000_000),
        centre_frequency_hz=1e8, sample_format="int16", full_scale=32767, provenance={"x": "y"},
    ) as writer:  # fmt: skip
        samples = np.random.default_rng(0).integers(-900, 900, (4000, 2)).astype(np.int16)
        for name in ("H01_r0", "H01_r1"):
            writer.write(name, START, samples)
            writer.write(name, START + 9000, samples)
        writer.write_truth(
            Truth(
                heliostat_ids=("H01",),
                receiver_ids=("H01_r0", "H01_r1"),
                transmitter_ids=("T1",),
                normal_enu=np.ones((2, 1, 3)),
                receiver_enu_m=np.ones((2, 2, 3)),
                frame_start_index=np.array([START, START + 9000]),
                tone_snr=np.ones((2, 2, 1, 1)),
            )
        )
    with open_recording(native) as recording:
        for format in ("digital-rf", "sigmf"):
            (top / format).mkdir()
            convert(recording, top / format / "r", format=format)
    return top


NO_NUMBERS = [float("nan"), float("inf"), -float("inf")]
ODD_NUMBERS = [0, -1, 1, 2**31, 2**62, 2**63 - 1, -(2**63), 1e-300, 1e300, 0.5, *NO_NUMBERS]
ODD_TEXTS = ["", "NaN", "int16", "x" * 5000, "\x00", "ü\n", "../../etc/passwd", "1e999999999", "2016-12-31T23:59:60Z"]
ODD_JSON = [*ODD_NUMBERS, *ODD_TEXTS, None, True, [], {}, [1, 2], {"a": 1}, 10**400]
ODD_HDF5 = [
    *ODD_NUMBERS[:7], *(np.float64(x) for x in ODD_NUMBERS[7:]), *ODD_TEXTS[:4], *ODD_TEXTS[5:],
    np.bytes_(b"\xff\xfe"), np.uint64(2**64 - 1), np.float32(np.nan), np.complex128(1j), np.longdouble(1), np.True_,
    h5py.Empty("f8"), np.zeros(0), np.zeros((2, 3)), np.arange(7), np.array([b"\xff"]), np.full((2, 3), 2**63 - 1),
    np.full((2, 2), 2**64 - 1, np.uint64), np.full((3, 3), -1), np.zeros(4000, [("r", "<u2"), ("i", "<u2")]),
    np.full((2, 1, 3), np.nan), np.zeros(5, [("a", "<i4")]), np.array([["a", "b"]], dtype=h5py.string_dtype()),
]  # fmt: skip


def spoil_hdf5(path, rng):
    """Change one attribute or dataset, take one away, or cut the file."""
    if rng.random() < 0.1:
        content = path.read_bytes()
        path.write_bytes(content[: int(rng.integers(0, len(content)))])
        return "cut"
    with h5py.File(path, "r+") as file:
        places = []
        file.visititems(lambda name, item: places.append(name))
        holders = [file, *(file[name] for name in places)]
        attributes = [(holder, name) for holder in holders for name in holder.attrs]
        odd = ODD_HDF5[rng.integers(len(ODD_HDF5))]
        if attributes and (not places or rng.random() < 0.4):
            holder, name = attributes[rng.integers(len(attributes))]
            if rng.random() < 0.1:
                del holder.attrs[name]
                return f"attribute {name} gone"
            holder.attrs[name] = odd
            return f"attribute {name} = {odd!r:.60}"
        if not places:
            return "nothing"
        name = places[rng.integers(len(places))]
        del file[name]
        if rng.random() < 0.1:
            return f"{name} gone"
        file.create_dataset(name, data=odd)
        return f"{name} = {odd!r:.60}"


def spoil_json(path, rng):
    """Change one value, take one away, or cut the file."""
    text = path.read_bytes()
    if rng.random() < 0.1:
        path.write_bytes(text[: int(rng.integers(0, len(text)))] + (b"\xff" if rng.random() < 0.5 else b""))
        return "cut"
    content = json.loads(text)
    places = []

    def walk(value):
        for key in value if isinstance(value, dict) else range(len(value)):
            places.append((value, key))
            if isinstance(value[key], dict | list):
                walk(value[key])

    more = {"core:dataset": path.name.replace("meta", "data"), "core:num_channels": 1, "core:recorder": "x"}
    content["global"] |= more
    walk(content)
    holder, key = places[rng.integers(len(places))]
    if rng.random() < 0.1:
        del holder[key]
    else:
        holder[key] = ODD_JSON[rng.integers(len(ODD_JSON))]
    path.write_text(json.dumps(content))
    return f"{key} changed to {json.dumps(content)[:2000]}"


def spoil(path, rng):
    """Spoil one file of a recording."""
    if path.is_file():
        return spoil_hdf5(path, rng)
    files = [file for file in sorted(path.rglob("*")) if file.is_file() and file.name != "scenario.toml"]
    file = files[rng.integers(len(files))]
    if rng.random() < 0.05:
        file.unlink()
        return f"{file.name} gone"
    if file.suffix == ".sigmf-data":
        file.write_bytes(file.read_bytes()[: int(rng.integers(0, 16_000))])
        return f"{file.name} cut"
    return f"{file.name}: " + (spoil_hdf5 if file.suffix == ".h5" else spoil_json)(file, rng)


def look_at(path):
    """Do with a recording what `rfpose info` does, and read all of it."""
    with open_recording(path) as recording:
        json.dumps(describe(recording), allow_nan=False).encode()
        for name in recording.receiver_ids:
            with contextlib.suppress(RfposeError):  # `describe` has told
                for start, count in recording.blocks(name).tolist():
                    recording.read(name, start, count)


@pytest.mark.parametrize("format", ["rfpose-iq", "digital-rf", "sigmf"])
@pytest.mark.parametrize("seed", range(3))
def test_odd_values_are_read_or_named(sound, tmp_path, format, seed):
    rng = np.random.default_rng(seed)
    original = sound / format
    refused = 0
    for run in range(RUNS // 3):
        folder = tmp_path / str(run)
        shutil.copytree(original, folder)
        path = next(folder.iterdir())
        what = spoil(path, rng)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            try:
                look_at(path)
                continue
            except RfposeError as error:
                text = str(error)
            except Exception as error:
                raise AssertionError(f"seed {seed}, run {run}: {what}: {type(error).__name__}: {error}") from error
        refused += 1
        assert str(folder) in text, what
        assert len(text.encode()) < 1000, what
    # most of what is changed matters, and not all
    assert RUNS // 3 // 4 < refused < RUNS // 3
