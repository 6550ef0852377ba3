"""The result file: what goes in comes out, equal results are equal bytes, and damage is named."""

from __future__ import annotations

import csv
import math
import re
from dataclasses import replace
from datetime import UTC, datetime
from fractions import Fraction
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from rfpose.dsp import TonePhases
from rfpose.errors import RecordingError
from rfpose.multilat.integrity import IntegrityStatus, TransmitterStatus
from rfpose.pipeline.choice import choose
from rfpose.pipeline.formats import result_file
from rfpose.pipeline.formats.result import IntegrityTable, Result, frame_time
from rfpose.pipeline.formats.result_file import KEYS, is_result, open_result, write_result
from rfpose.pipeline.formats.result_summary import CSV_COLUMNS, pose_table, summarise, write_poses_csv
from rfpose.pipeline.solve import solve
from rfpose.scenario import load_scenario
from rfpose.tables import write_parquet
from rfpose.truth import Truth

SHIPPED = Path(__file__).resolve().parents[2] / "data" / "table2_100m.toml"
DOCS = Path(__file__).resolve().parents[2] / "docs"
START = 1_782_043_200 * 40_000_000
SETTINGS = {"estimator": "hilbert", "version": "0"}


def make_result(*, n_frame: int = 2, seed: int = 5) -> Result:
    """Return a result whose tone phases are exact up to a little noise; one receiver is lost in frame 0."""
    shipped = load_scenario(SHIPPED)
    scenario = shipped.changed(heliostat=shipped.heliostat[:2])
    rng = np.random.default_rng(seed)
    normal = np.broadcast_to([0.0, -math.sqrt(0.5), math.sqrt(0.5)], (n_frame, 2, 3))
    place = np.empty((n_frame, 7, 3))
    for i, heliostat in enumerate(scenario.heliostat):
        triangle = np.array(heliostat.receiver_mirror_m)
        across, up = np.array([1.0, 0.0, 0.0]), np.array([0.0, math.sqrt(0.5), math.sqrt(0.5)])
        place[:, 3 * i : 3 * i + 3] = heliostat.pivot_enu_m + triangle[:, :1] * across + triangle[:, 1:2] * up
    place[:, 6:] = scenario.calibration_enu_m
    distance = np.linalg.norm(place[:, :, None] - scenario.transmitter_enu_m, axis=-1)
    tones = TonePhases.empty(
        receiver_ids=scenario.receiver_ids,
        transmitter_ids=scenario.transmitter_ids,
        tone_hz=scenario.tone_hz,
        frame_start_index=START + 40_000_000 * np.arange(n_frame),
    )
    sigma = 1e-5
    tones.phase_rad[..., 0] = -2.0 * np.pi * distance / scenario.wavelength_m[0] + sigma * rng.normal(
        size=distance.shape
    )
    tones.sigma_rad[...] = sigma
    tones.status[...] = 0
    tones.phase_rad[0, 1] = tones.sigma_rad[0, 1] = np.nan
    tones.status[0, 1] = 7
    truth = Truth(
        heliostat_ids=scenario.heliostat_ids,
        receiver_ids=scenario.receiver_ids,
        transmitter_ids=scenario.transmitter_ids,
        normal_enu=normal,
        receiver_enu_m=place,
        frame_start_index=tones.frame_start_index,
    )
    choice = choose(scenario, pose="independent")
    return solve(tones, scenario, choice, sample_rate=Fraction(40_000_000), settings=SETTINGS, truth=truth)


@pytest.fixture(scope="module")
def result() -> Result:
    return make_result()


@pytest.fixture
def path(result: Result, tmp_path: Path) -> Path:
    write_result(result, tmp_path / "result.h5")
    return tmp_path / "result.h5"


def _assert_equal(a: Any, b: Any) -> None:
    for name in a.__dataclass_fields__:
        x, y = getattr(a, name), getattr(b, name)
        if hasattr(x, "__dataclass_fields__"):
            _assert_equal(x, y)
        elif isinstance(x, np.ndarray):
            np.testing.assert_array_equal(x, y, err_msg=name)
        else:
            assert x == y, name


def test_round_trip(result: Result, path: Path) -> None:
    assert result.poses.status.tolist() == [[1, 0], [0, 0]]
    _assert_equal(result, open_result(path))


def test_read_arrays_are_read_only(path: Path) -> None:
    with pytest.raises(ValueError, match="read-only"):
        open_result(path).poses.normal_enu[0, 0, 0] = 1.0


def test_round_trip_without_truth(result: Result, tmp_path: Path) -> None:
    write_result(replace(result, truth=None), tmp_path / "r.h5")
    assert open_result(tmp_path / "r.h5").truth is None


def test_equal_results_are_equal_bytes(path: Path, tmp_path: Path) -> None:
    write_result(make_result(), tmp_path / "again.h5")
    assert path.read_bytes() == (tmp_path / "again.h5").read_bytes()


def test_every_dataset_says_dimensions_unit_and_meaning(path: Path) -> None:
    with h5py.File(path) as file:
        for name, key in KEYS.items():
            if name in file:
                assert file[name].attrs["long_name"] == key.meaning
                assert file[name].attrs.get("units") == (None if key.codes else key.unit)
                assert [dim[0].name for dim in file[name].dims] == [f"/{dim}" for dim in key.dims]
        assert file["poses/status"].attrs["codes"].startswith("0 solved; 1 fewer than three")
        assert file["poses/status"].attrs["flag_meanings"].split()[0] == "ok"


def test_documentation_names_every_key() -> None:
    text = (DOCS / "result-format.md").read_text()
    named = set(re.findall(r"^\| `/?([a-z_]+/[a-z0-9_]+)`", text, re.MULTILINE))
    assert named >= set(KEYS)


# -- what is refused -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("kept", [0.0, 0.01, 0.3, 0.9, 0.999])
def test_truncated(path: Path, kept: float) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: int(kept * len(content))])
    with pytest.raises(RecordingError, match=r"result\.h5: no result, but truncated.*run `rfpose process` again"):
        open_result(path)
    assert not is_result(path)


def test_not_hdf5(tmp_path: Path) -> None:
    (tmp_path / "a.h5").write_text("a letter")
    with pytest.raises(RecordingError, match=r"a\.h5: no result, but.* another kind of file"):
        open_result(tmp_path / "a.h5")


def test_absent(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"a\.h5: no such file"):
        open_result(tmp_path / "a.h5")


def test_hdf5_of_another_kind(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["x"] = 1
    with pytest.raises(RecordingError, match=r"a\.h5: no result, but.* another kind of file"):
        open_result(tmp_path / "a.h5")
    assert not is_result(tmp_path / "a.h5")


def test_version_of_the_future(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file.attrs["version"] = 2
    with pytest.raises(RecordingError, match="version 2"):
        open_result(path)


@pytest.mark.parametrize("name", ["scenario", "settings", "poses/normal_enu", "tones/phase_rad", "truth/normal_enu"])
def test_missing(path: Path, name: str) -> None:
    with h5py.File(path, "r+") as file:
        del file[name]
    with pytest.raises(RecordingError, match=f"result.h5: `/{name}` is missing"):
        open_result(path)


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (np.zeros((2, 2, 3), "S4"), "holds .S4, not float64"),
        (np.zeros((2, 3, 3)), r"has shape \(2, 3, 3\), not \(frame, heliostat, xyz\)"),
        (np.zeros((3, 2, 3)), r"has shape \(3, 2, 3\)"),
        (np.zeros((2, 2)), r"has shape \(2, 2\)"),
        (np.zeros((2, 2, 4)), r"has shape \(2, 2, 4\)"),
    ],
)
def test_mistyped(path: Path, value: np.ndarray, message: str) -> None:
    with h5py.File(path, "r+") as file:
        del file["poses/normal_enu"]
        file["poses/normal_enu"] = value
    with pytest.raises(RecordingError, match=r"result\.h5: `/poses/normal_enu` " + message):
        open_result(path)


def test_a_code_too_large_for_its_type_does_not_become_another(path: Path) -> None:
    """256 in a byte is 0: solved."""
    with h5py.File(path, "r+") as file:
        codes = file["poses/status"][()].astype(np.int64) + 256
        del file["poses/status"]
        file["poses/status"] = codes
    with pytest.raises(RecordingError, match=r"`/poses/status` holds 2[56]\d, which means nothing"):
        open_result(path)


def test_broken_scenario(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        del file["scenario"]
        file["scenario"] = "name = "
    with pytest.raises(RecordingError, match=r"result\.h5:/scenario: not valid TOML"):
        open_result(path)


def test_failed_write_leaves_the_old_file(path: Path, result: Result, monkeypatch: pytest.MonkeyPatch) -> None:
    before = path.read_bytes()
    monkeypatch.setitem(result_file.KEYS, "poses/absent", KEYS["poses/status"])
    with pytest.raises(AttributeError, match="absent"):
        write_result(result, path)
    assert path.read_bytes() == before
    assert list(path.parent.iterdir()) == [path]


# -- for people ----------------------------------------------------------------------------------------------


def test_frame_time_is_exact_to_the_microsecond() -> None:
    assert frame_time(START + 40, Fraction(40_000_000)) == datetime(2026, 6, 21, 12, 0, 0, 1, tzinfo=UTC)
    # a rate that no float holds exactly
    assert frame_time(10**15, Fraction(10_000_000, 3)).microsecond == 0


def test_csv(result: Result, tmp_path: Path) -> None:
    write_poses_csv(result, tmp_path / "poses.csv")
    rows = list(csv.DictReader((tmp_path / "poses.csv").read_text().splitlines()))
    assert list(rows[0]) == list(CSV_COLUMNS)
    assert [row["heliostat"] for row in rows] == ["H01", "H02"] * 2
    lost, solved = rows[0], rows[2]
    assert lost["status"] == "fewer than three receivers of the mirror were located"
    assert lost["azimuth_deg"] == lost["normal_up"] == lost["normal_sigma_mrad"] == ""
    assert solved["status"] == "solved"
    assert solved["time_utc"] == "2026-06-21T12:00:01.000000Z"
    # 1e-5 rad of phase is 0.64 mm of range: some milliradians on a mirror of 1.7 m
    assert float(solved["azimuth_deg"]) == pytest.approx(180.0, abs=0.5)
    assert float(solved["elevation_deg"]) == pytest.approx(45.0, abs=0.5)
    assert float(solved["normal_sigma_mrad"]) == pytest.approx(1e3 * result.poses.sigma_rad[1, 0], abs=1e-6)
    place = [float(solved[f"centre_{axis}_m"]) for axis in ("east", "north", "up")]
    assert place == pytest.approx(result.poses.centre_enu_m[1, 0], abs=1e-6)
    assert solved["receivers"] == "3"
    assert solved["integrity"] == solved["transmitters_left_out"] == solved["protection_level_mrad"] == ""


def test_table_tells_what_was_left_out_and_how_far_a_pose_is_protected(result: Result) -> None:
    columns = IntegrityTable.unsolved(result.scenario, 2)
    columns["status"][1] = IntegrityStatus.EXCLUDED, IntegrityStatus.OK
    columns["transmitter_status"][1, :, [3, 7]] = TransmitterStatus.COMMON_ERROR
    columns["transmitter_status"][1, 0, 1] = TransmitterStatus.NOT_RECEIVED
    columns["protection_level_rad"][1] = 2e-3, np.inf
    table = replace(result, integrity=IntegrityTable(**columns))
    header, rows = pose_table(table)
    told = [dict(zip(header, row, strict=True)) for row in rows]
    # names mean nothing where leaving them out explains nothing; what was not received was not left out
    assert [row["transmitters_left_out"] for row in told] == ["", "", "T4 T8", ""]
    assert told[2]["protection_level_mrad"] == pytest.approx(2.0)
    assert told[2]["integrity"] == IntegrityStatus.EXCLUDED.reason
    assert told[3]["protection_level_mrad"] == np.inf


def test_parquet_holds_the_table_with_all_its_digits(result: Result, tmp_path: Path) -> None:
    pandas = pytest.importorskip("pandas")
    pytest.importorskip("pyarrow")
    write_parquet(tmp_path / "poses.parquet", *pose_table(result))
    found = pandas.read_parquet(tmp_path / "poses.parquet")
    assert list(found) == list(CSV_COLUMNS)
    np.testing.assert_array_equal(found["normal_up"], result.poses.normal_enu[..., 2].ravel())
    assert found["time_utc"][2] == datetime(2026, 6, 21, 12, 0, 1, tzinfo=UTC)


def test_summary_counts_mirrors_only(result: Result) -> None:
    summary = summarise(result)
    assert summary["fixes"]["solved"] + summary["fixes"]["failed"] == 2 * 6
    assert summary["poses"] == {
        "solved": 3,
        "failed": 1,
        "reasons": {"fewer than three receivers of the mirror were located": 1},
    }
    assert summary["tones"]["failed"] == 10
    assert result_file.FORMAT == "rfpose-result"
