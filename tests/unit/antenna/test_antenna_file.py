"""Files of antenna patterns: what was written comes back, and whatever is in one is taken or refused in our words."""

import h5py
import numpy as np
import pytest

from damage import copied, damage_bytes, damage_hdf5
from rfpose.antenna import AntennaPattern, dipole_pattern
from rfpose.errors import RecordingError, RfposeError
from rfpose.pipeline.formats.antenna_file import read_pattern, write_pattern
from rfpose.pipeline.inspect import inspect_file

PLACES = [[1.0, 0.0, 0.1], [-0.5, 0.8, 0.1], [-0.5, -0.8, 0.1]]


@pytest.fixture
def pattern():
    rng = np.random.default_rng(3)
    shape = (2, 3, 13, 24)
    response = rng.standard_normal((*shape, 2)) + 1j * rng.standard_normal((*shape, 2))
    response[:, 0, 10:] = np.nan
    return AntennaPattern(
        frequency_hz=[430e6, 440e6],
        receiver_mirror_m=PLACES,
        axis_mirror=np.tile([0.6, 0.0, -0.8], (3, 1)),
        response=response,
        sigma=rng.uniform(0.0, 0.1, shape),
    )


@pytest.fixture
def path(pattern, tmp_path):
    write_pattern(tmp_path / "plate.h5", pattern, settings={"cells": "26"})
    return tmp_path / "plate.h5"


def test_what_was_written_comes_back(pattern, path):
    found = read_pattern(path)
    for name in ("frequency_hz", "receiver_mirror_m", "axis_mirror"):
        np.testing.assert_array_equal(getattr(found.pattern, name), getattr(pattern, name))
    np.testing.assert_array_equal(found.pattern.response, pattern.response.astype(np.complex64))
    np.testing.assert_array_equal(found.pattern.sigma, pattern.sigma.astype(np.float32))
    assert found.made_by["cells"] == "26"


def test_h5py_alone_reads_it(pattern, path):
    with h5py.File(path) as file:
        theta = np.rad2deg(file["polar_rad"][()])
        assert (theta[0], theta[-1], len(theta)) == (0.0, 180.0, 13)
        np.testing.assert_allclose(file["response"][1, 2, 3, 4, 0], pattern.response[1, 2, 3, 4, 0], rtol=1e-6)
        assert file["response"].attrs["units"] == "1"
        assert [scale[0].name for scale in file["response"].dims] == [
            "/frequency", "/receiver", "/polar", "/azimuth", "/component",
        ]  # fmt: skip
        assert file.attrs["sign"].startswith("exp(+j omega t)")


def test_an_existing_file_is_replaced_only_by_force(pattern, path):
    with pytest.raises(RecordingError, match="exists already"):
        write_pattern(path, pattern)
    write_pattern(path, pattern, force=True)


def test_info_tells_of_gaps(path):
    found = inspect_file(path)
    assert (found["kind"], found["receivers"], found["sound"]) == ("antenna", 3, False)
    assert "directions are unknown" in found["problems"][0]


def _set_attribute(file, name, value):
    file.attrs[name] = value


def _replace(file, name, values):
    del file[name]
    file[name] = values


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda file: _set_attribute(file, "sign", "exp(-j omega t)"), "`sign` must be"),
        (lambda file: _set_attribute(file, "version", 2), "version 2"),
        (lambda file: _set_attribute(file, "format", "rfpose-result"), "no antenna pattern, but a result"),
        (lambda file: _replace(file, "polar_rad", np.linspace(0, 3, 13)), "evenly spaced"),
        (lambda file: _replace(file, "azimuth_rad", np.linspace(0, 2 * np.pi, 24)), "evenly spaced"),
        (lambda file: _replace(file, "frequency_hz", [440e6, 430e6]), "rising"),
        (lambda file: _replace(file, "sigma", np.full((2, 3, 13, 24), -1, np.float32)), "sigma"),
        (lambda file: _replace(file, "response", np.zeros((2, 3, 13, 24, 2))), "holds float64"),
        (lambda file: _replace(file, "response", np.zeros((2, 3, 12, 24, 2), np.complex64)), "has shape"),
        (lambda file: _replace(file, "axis_mirror", h5py.ExternalLink("/etc/passwd", "/x")), "stands in another file"),
        (lambda file: file.__delitem__("made_by"), "made_by"),
    ],
)
def test_what_is_no_pattern_is_refused(path, change, said):
    with h5py.File(path, "r+") as file:
        change(file)
    with pytest.raises(RecordingError, match=said) as caught:
        read_pattern(path)
    assert "plate.h5" in str(caught.value)


def test_more_than_is_stored_may_not_be_declared(path):
    with h5py.File(path, "r+") as file:
        del file["response"]
        file.create_dataset("response", shape=(2, 3, 13, 24, 2_000_000), dtype="c8", chunks=True, compression="gzip")
    with pytest.raises(RecordingError, match=r"declares|shape"):
        read_pattern(path)
    with h5py.File(path, "r+") as file:
        for name, shape in (("response", (2, 3, 40_000, 40_000, 2)), ("sigma", (2, 3, 40_000, 40_000))):
            del file[name]
            file.create_dataset(name, shape=shape, dtype="c8" if name == "response" else "f4", chunks=True)
        _replace(file, "polar_rad", np.linspace(0, np.pi, 40_000))
        _replace(file, "azimuth_rad", np.arange(40_000) * (2 * np.pi / 40_000))
    with pytest.raises(RecordingError, match="declares"):
        read_pattern(path)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # damaged numbers overflow
@pytest.mark.parametrize("seed", range(5))
def test_damaged_files_are_taken_or_refused_in_our_words(path, tmp_path, seed):
    rng = np.random.default_rng(seed)
    (tmp_path / "damaged").mkdir()
    for k in range(30):
        broken = copied(path, tmp_path / "damaged")
        how = damage_bytes(broken, rng) if k % 5 == 0 else damage_hdf5(broken, rng)
        try:
            pattern = read_pattern(broken).pattern
            pattern.table(float(pattern.frequency_hz[0])).vector([[0, 0, 1.0]], 0)
            inspect_file(broken)
            message = broken.name
        except RfposeError as error:
            message = str(error)
        except Exception as error:
            raise AssertionError(f"seed {seed}, {k}, {how}: {error!r}") from error
        assert broken.name in message, how


def test_text_comes_back(pattern, tmp_path):
    path = tmp_path / "plate.toml"
    write_pattern(path, pattern, settings={"chamber": "north"})
    found = read_pattern(path)
    np.testing.assert_allclose(found.pattern.response, pattern.response, rtol=1e-7)  # NaN where NaN
    np.testing.assert_allclose(found.pattern.sigma, pattern.sigma, rtol=1e-7)
    np.testing.assert_array_equal(found.pattern.frequency_hz, pattern.frequency_hz)
    assert found.made_by["chamber"] == "north"
    assert inspect_file(path)["kind"] == "antenna"


SMALL = """format = "rfpose-antenna"
version = 1
step_deg = 45
[[receiver]]
place_mirror_m = [0.0, 0.0, 0.1]
axis_mirror = [0.0, 1.0, 0.0]
rows = [  # Hz, polar, azimuth, theta and its phase, phi and its phase, sigma
  [433e6, 45, 90, 0.5, 90, 0.25, 180, 0.01],
]
"""


def test_a_table_written_by_hand(tmp_path):
    path = tmp_path / "plate.toml"
    path.write_text(SMALL)
    pattern = read_pattern(path).pattern
    np.testing.assert_allclose(pattern.response[0, 0, 1, 2], [0.5j, -0.25], atol=1e-12)
    assert pattern.sigma[0, 0, 1, 2] == 0.01
    assert np.isnan(pattern.response).any(axis=-1).sum() == 5 * 8 - 1


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("version = 1", "version = 2", "version 2"),
        ("step_deg = 45", "step_deg = 50", "divide 180"),
        ("step_deg = 45", "step_deg = 1e-300", "divide 180"),
        ("step_deg = 45", "step_deg = 0.25", "one in a hundred"),
        ("step_deg = 45", "", "step_deg"),
        ("433e6, 45,", "433e6, 44,", "row 0: polar 44"),
        ("45, 90", "45, 360", "azimuth 360"),
        ("45, 90", "-45, 90", "polar -45"),
        (" 0.01]", "]", "shape"),
        (" 0.01]", " -1.0]", "sigma"),
        ("0.5, 90", "nan, 90", "finite"),
        ("axis_mirror", "axes", "no key is called"),
        ("[0.0, 1.0, 0.0]", '"y"', "axis_mirror"),
        ("[[receiver]]", "[[antenna]]", "no key is called"),
        ("433e6", "0.0", "frequency_hz"),
    ],
)
def test_text_that_is_no_pattern_is_refused(tmp_path, old, new, said):
    path = tmp_path / "plate.toml"
    path.write_text(SMALL.replace(old, new))
    with pytest.raises(RecordingError, match=said) as caught:
        read_pattern(path)
    assert "plate.toml" in str(caught.value)


def test_damaged_text_is_taken_or_refused_in_our_words(tmp_path):
    rng = np.random.default_rng(8)
    for k in range(60):
        path = tmp_path / f"plate{k}.toml"
        path.write_text(SMALL)
        how = damage_bytes(path, rng)
        try:
            read_pattern(path).pattern.table(433e6)
            message = path.name
        except RfposeError as error:
            message = str(error)
        except Exception as error:
            raise AssertionError(f"{k}, {how}: {error!r}") from error
        assert path.name in message or "MHz is asked for" in message, how


def test_another_kind_of_file_is_told(tmp_path):
    (tmp_path / "site.toml").write_text("[radio]\n")
    with pytest.raises(RecordingError, match="no antenna pattern, but a scenario"):
        read_pattern(tmp_path / "site.toml")
    with pytest.raises(RecordingError, match="no such file"):
        read_pattern(tmp_path / "missing.h5")
    write_pattern(tmp_path / "one.h5", dipole_pattern(PLACES, [0, 1, 0], 1e8))
    assert inspect_file(tmp_path / "one.h5")["sound"]
