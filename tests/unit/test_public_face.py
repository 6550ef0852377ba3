"""The public face: verbs take objects or paths and give objects that show, save, draw and label themselves."""

from __future__ import annotations

import ast
import doctest
import importlib
import inspect
import re
import subprocess
import sys
from pathlib import Path

import click
import h5py
import numpy as np
import pytest

import rfpose as rf
from rfpose.cli._support import in_options
from rfpose.errors import InvalidInputError, RecordingError, ScenarioError
from rfpose.pipeline.formats.result import Result
from rfpose.pipeline.formats.track_file import Track
from rfpose.pipeline.simulate import SimulatedRecording
from rfpose.recording import Recording
from rfpose.scenario import Scenario

SITE = rf.shipped_scenario("table2_100m.toml")


@pytest.fixture(scope="module")
def site() -> Scenario:
    """Three mirrors of the shipped field, short frames, one of them with a gap."""
    base = rf.load_scenario(SITE)
    lost = {"receiver": "H02_r1", "frame": 1, "first_sample": 500, "sample_count": 900}
    return base.changed(
        heliostat=base.heliostat[:3],
        radio={"frame_samples": 140_000},
        simulation={"frame_count": 3, "frame_interval_s": 1.0, "dropped": [lost]},
    )


@pytest.fixture(scope="module")
def recording(site: Scenario) -> SimulatedRecording:
    return rf.simulate(site, seed=3)


@pytest.fixture(scope="module")
def result(recording: Recording) -> Result:
    return rf.process(recording)


@pytest.fixture(scope="module")
def day() -> Track:
    field = rf.load_scenario(rf.shipped_scenario("tracking_100m.toml"))
    short = field.changed(tracking={"first_hour": 11.0, "last_hour": 12.0})
    return rf.track(short, methods=["open-loop", "encoder"], heliostats=3)


# -- names ---------------------------------------------------------------------------------------------------


def test_names_are_there_without_loading_them() -> None:
    code = "import sys, rfpose; assert set(rfpose.__all__) <= set(dir(rfpose)); assert 'numpy' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
    for name in rf.__all__:
        assert getattr(rf, name).__name__ == name
    with pytest.raises(AttributeError, match="no attribute 'measure'"):
        _ = rf.measure


def test_type_checkers_see_every_name() -> None:
    """What is imported for them alone is what `__getattr__` finds."""
    seen = [line.split(" import ")[1] for line in inspect.getsource(rf).splitlines() if line.startswith("    from rf")]
    assert sorted(name for names in seen for name in names.split(", ")) == sorted(rf.__all__)


@pytest.mark.parametrize("name", [*rf.__all__, "Scenario"])
def test_examples_in_docstrings(name: str) -> None:
    found = Scenario if name == "Scenario" else getattr(rf, name)
    module = importlib.import_module(found.__module__)
    tests = doctest.DocTestFinder(recurse=True).find(found, name, module=module, globs={})
    runner = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE)
    for test in tests:
        runner.run(test)
    # a pattern wants recordings of ten postures: tests/integration/test_learn_pattern.py
    assert any(test.examples for test in tests) or name in ("shipped_scenario", "learn_pattern")
    assert runner.summarize(verbose=False).failed == 0


@pytest.mark.parametrize(("module", "name"), [
    ("rfpose.multilat.ambiguity.least_squares", "integer_least_squares"), ("rfpose.feedback.energy", "dish_capture"),
])  # fmt: skip
def test_examples_of_what_only_docs_offer(module: str, name: str) -> None:
    home = importlib.import_module(module)
    (test,) = doctest.DocTestFinder(recurse=False).find(getattr(home, name), name, module=home, globs={})
    assert test.examples
    assert doctest.DocTestRunner().run(test).failed == 0


# -- scenarios -----------------------------------------------------------------------------------------------


def test_changed_tables_go_into_each_other(site: Scenario) -> None:
    other = site.changed(
        simulation={"tone_snr_db": 12.0, "dropped": None}, tracking={"mount_errors": {"tilt_sigma_mrad": 0.0}}
    )
    assert other.simulation.tone_snr_db == 12.0
    assert other.simulation.frame_count == 3  # stays
    assert other.simulation.dropped == ()
    errors = site.tracking.mount_errors
    assert other.tracking.mount_errors == errors.model_copy(update={"tilt_sigma_mrad": 0.0})
    assert site.simulation.dropped  # the old one is as it was
    assert site.changed() == site
    assert np.array_equal(site.changed(transmitter=site.transmitter[:6]).transmitter_enu_m, site.transmitter_enu_m[:6])


def test_changed_scenario_is_checked_in_the_words_for_a_file(site: Scenario) -> None:
    with pytest.raises(ScenarioError, match=r"unknown key `simulation\.snr`; remove it or correct its spelling"):
        site.changed(simulation={"snr": 3.0})
    with pytest.raises(ScenarioError, match=r"transmitter `T1` appears twice"):
        site.changed(transmitter=site.transmitter[:1] * 5)


def test_field_from_places_and_from_a_table(site: Scenario, tmp_path: Path) -> None:
    table = tmp_path / "field.csv"
    table.write_text("id,east_m,north_m,up_m\na,10,20,2\nb,-5,30,2\n")
    assert site.with_field(table).heliostat_ids == ("a", "b")
    assert site.with_field([[10, 20, 2], [-5, 30, 2]], ids=["a", "b"]) == site.with_field(table)
    assert site.with_field(table).simulation.dropped == ()  # it named a receiver that is gone
    table.write_text("id,east_m,north_m\na b,10,20\n")
    with pytest.raises(ScenarioError, match=r"field of .*field\.csv: `heliostat\[0\]\.id`"):
        site.with_field(table)


def test_transmitters_from_records_and_places(site: Scenario) -> None:
    blocked = site.changed(simulation={"blocked": [{"transmitter": "T9"}, {"transmitter": "T2"}]})
    assert [b.transmitter for b in blocked.with_transmitters(site.transmitter[:5]).simulation.blocked] == ["T2"]
    more = site.with_transmitters(np.vstack([site.transmitter_enu_m, [[3.0, 4.0, 30.0]]]))
    assert more.transmitter_ids[-1] == "T11"
    assert len(set(more.carrier_hz)) == 11


# -- verbs ---------------------------------------------------------------------------------------------------


def test_recording_from_memory_is_that_of_the_file(recording: SimulatedRecording, tmp_path: Path) -> None:
    recording.save(tmp_path / "rec.h5")
    with rf.open_recording(tmp_path / "rec.h5") as stored:
        assert stored.receiver_ids == recording.receiver_ids
        assert stored.scenario == recording.scenario
        for name in stored.receiver_ids:
            assert np.array_equal(stored.blocks(name), recording.blocks(name))
            for start, count in stored.blocks(name):
                # odd places, so that reads begin and end within what is made at once
                first, n = int(start) + 77, int(count) - 200
                if n > 0:
                    assert np.array_equal(stored.read(name, first, n), recording.read(name, first, n))
        assert np.array_equal(stored.truth.tone_snr, recording.truth.tone_snr)


def test_objects_and_paths_give_the_same(
    site: Scenario, recording: SimulatedRecording, result: Result, tmp_path: Path
) -> None:
    site.save(tmp_path / "site.toml")
    rf.simulate(tmp_path / "site.toml", seed=3).save(tmp_path / "rec.h5")
    stored = rf.process(tmp_path / "rec.h5", tmp_path / "r.h5", scenario=tmp_path / "site.toml")
    for one, other in ((stored, result), (rf.open_result(tmp_path / "r.h5"), result)):
        assert np.array_equal(one.poses.normal_enu, other.poses.normal_enu, equal_nan=True)
        assert np.array_equal(one.tones.phase_rad, other.tones.phase_rad, equal_nan=True)
    assert rf.evaluate(tmp_path / "r.h5", tmp_path / "rec.h5").as_dict() == rf.evaluate(result).as_dict()
    by_object, by_path = (rf.layout_map(s, estimators=["rigid"]) for s in (site, tmp_path / "site.toml"))
    assert by_object.as_dict() == by_path.as_dict()
    assert rf.process(recording, scenario=site).settings["scenario_from"] == "caller"


def test_saving_replaces_nothing_unasked(result: Result, recording: Recording, day: Track, tmp_path: Path) -> None:
    placed = rf.layout_map(SITE, estimators=["rigid"])
    for name, thing in {"r.h5": result, "rec.h5": recording, "day.h5": day, "m.csv": placed}.items():
        (tmp_path / name).write_text("mine")
        with pytest.raises(RecordingError, match=rf"{name}: exists already; .*`force=True`"):
            thing.save(tmp_path / name)
        assert (tmp_path / name).read_text() == "mine"
        thing.save(tmp_path / name, force=True)
        assert (tmp_path / name).read_bytes() != b"mine"


def test_a_recording_does_not_replace_its_scenario(site: Scenario, tmp_path: Path) -> None:
    site.save(tmp_path / "site.toml")
    with pytest.raises(RecordingError, match="source and target are the same"):
        rf.simulate(tmp_path / "site.toml").save(tmp_path / "site.toml", force=True)


def test_faults_of_a_scenario_name_its_file_if_it_has_one(site: Scenario, tmp_path: Path) -> None:
    flat = site.with_transmitters(site.transmitter_enu_m * [1.0, 1.0, 0.0] + [0.0, 0.0, 20.0])
    flat.save(tmp_path / "flat.toml")
    with pytest.raises(ScenarioError, match=r"flat\.toml: "):
        rf.layout_map(tmp_path / "flat.toml")
    with pytest.raises(ScenarioError, match=r"^[^:]*plane"):
        rf.layout_map(flat)


# -- for people ----------------------------------------------------------------------------------------------


def test_everything_shows_itself_in_a_line_and_a_table(
    site: Scenario, recording: Recording, result: Result, day: Track
) -> None:
    shown = [site, recording, result, day, rf.evaluate(result), rf.layout_map(site), rf.budget(site, n_draw=0)]
    shown.append(rf.optimise(SITE, starts=1))
    for thing in shown:
        assert len(repr(thing)) < 160, repr(thing)
        assert "\n" not in repr(thing)
        table = thing._repr_html_()
        assert table.startswith("<table>")
        assert table.count("<tr>") == table.count("</tr>") > 1
        assert "nan" not in table


def test_everything_draws_what_its_command_draws(recording: Recording, result: Result, day: Track) -> None:
    words = {
        "measured by radio": result.plot(),
        "Receiver H01_r0": recording.plot(),
        "3 mirrors": day.plot(),
        "RMS": rf.layout_map(SITE, estimators=["rigid"]).plot(),
        "error budget": rf.budget(SITE, n_draw=0).plot(),
        "ratio of error to bound": rf.evaluate(result).plot(),
        "transmitters placed for pdop": rf.optimise(SITE, starts=1).plot(),
    }
    for word, figure in words.items():
        texts = [axes.get_title() for axes in figure.axes] + [figure.get_suptitle()]
        assert any(word in text for text in texts), texts


def test_pandas(result: Result, day: Track) -> None:
    poses, fixes = result.to_pandas(), result.to_pandas("fixes")
    assert len(poses) == 3 * 3
    assert np.array_equal(
        poses[["normal_east", "normal_north", "normal_up"]], result.poses.normal_enu.reshape(-1, 3), equal_nan=True
    )
    assert str(poses["time_utc"].dtype).startswith("datetime64")
    assert np.array_equal(fixes["east_m"], result.fixes.position_enu_m[..., 0].ravel(), equal_nan=True)
    scores = day.to_pandas().set_index(["method", "heliostat"])
    rms = day.methods["encoder"].scores["heliostat_rms_rad"][1]
    assert scores.loc[("encoder", day.heliostat_ids[1]), "normal_rms_mrad"] == 1e3 * rms
    with pytest.raises(InvalidInputError, match="`what` must be one of poses, fixes"):
        result.to_pandas("tones")  # type: ignore[arg-type]


# -- labelled ------------------------------------------------------------------------------------------------


def test_dataset_has_names_units_and_flags(result: Result) -> None:
    whole = result.to_xarray()
    normal = whole["poses_normal_enu"]
    assert normal.dims == ("frame", "heliostat", "xyz")
    assert np.array_equal(normal.sel(heliostat="H02", xyz="up"), result.poses.normal_enu[:, 1, 2], equal_nan=True)
    assert normal.attrs == {"units": "1", "long_name": "mirror normal, unit length, east, north, up"}
    assert whole["poses_cov_enu"].sel(xyz="east", xyz_other="up").dims == ("frame", "heliostat")
    assert whole["tones_phase_rad"].sel(transmitter="T3", tone=750e3).dims == ("frame", "receiver")
    first = np.datetime64(int(int(result.frame_start_index[0]) * 1_000_000 / result.sample_rate), "us")
    assert whole["frame"].values[0] == first
    status = whole["tones_status"]
    meanings = dict(zip(status.attrs["flag_values"], status.attrs["flag_meanings"].split(), strict=True))
    gap = status.sel(receiver="H02_r1").isel(frame=1)
    assert {meanings[int(code)] for code in gap} == {"gap"}
    with pytest.raises(InvalidInputError, match="`group` must be one of"):
        result.to_xarray("normals")


def test_result_file_opens_with_its_dimensions_named(result: Result, tmp_path: Path) -> None:
    xr = pytest.importorskip("xarray")
    result.save(tmp_path / "r.h5")
    made = result.to_xarray("poses")
    with xr.open_dataset(tmp_path / "r.h5", engine="h5netcdf", group="poses") as stored:
        assert set(stored) == set(made)
        assert dict(stored.sizes) == dict(made.sizes)
        assert stored["normal_enu"].dims == made["normal_enu"].dims
        assert np.array_equal(stored["normal_enu"], made["normal_enu"], equal_nan=True)
    with xr.open_datatree(tmp_path / "r.h5", engine="h5netcdf") as tree:
        for group in ("poses", "tones", "integrity"):
            labelled = tree[group].to_dataset().load()
            wanted = result.to_xarray(group)
            for name in wanted:
                xr.testing.assert_equal(labelled[name], wanted[name])
                assert labelled[name].attrs.get("units") == wanted[name].attrs.get("units")


def test_track_file_opens_with_its_dimensions_named(day: Track, tmp_path: Path) -> None:
    xr = pytest.importorskip("xarray")
    day.save(tmp_path / "day.h5")
    day.save(tmp_path / "again.h5")
    assert (tmp_path / "day.h5").read_bytes() == (tmp_path / "again.h5").read_bytes()
    made = day.to_xarray("encoder")
    assert made["error_rad"].dims == ("time", "stored")
    assert made["time"].values[0] == np.datetime64(round(day.unix_s[0]), "s")
    assert np.array_equal(made["score_heliostat_rms_rad"].sel(heliostat=day.heliostat_ids[2]),
                          day.methods["encoder"].scores["heliostat_rms_rad"][2])  # fmt: skip
    for group, names in {"method/encoder": ("rms_rad", "mode_count", "normal_enu"), "time": ("sun_enu",)}.items():
        with xr.open_dataset(tmp_path / "day.h5", engine="h5netcdf", group=group) as stored:
            for name in names:
                assert stored[name].dims == made[name].dims
                assert np.array_equal(stored[name], made[name], equal_nan=True)


def test_files_without_named_dimensions_still_open(result: Result, day: Track, tmp_path: Path) -> None:
    """As files were before dimensions had names."""
    result.save(tmp_path / "r.h5")
    day.save(tmp_path / "day.h5")
    for name in ("r.h5", "day.h5"):
        with h5py.File(tmp_path / name, "r+") as file:
            places: list[str] = []
            file.visit(places.append)
            datasets = [at for at in places if isinstance(file[at], h5py.Dataset)]
            for at in datasets:
                for dim in file[at].dims if not file[at].is_scale else ():
                    for scale in list(dim.values()):
                        dim.detach_scale(scale)
            kept = ("heliostat/stored", "heliostat/id", "day/date", "mode/name")
            for at in [at for at in datasets if file[at].is_scale and at not in kept]:
                del file[at]
    assert np.array_equal(rf.open_result(tmp_path / "r.h5").tones.status, result.tones.status)
    assert rf.open_track(tmp_path / "day.h5").ranking() == day.ranking()


def test_missing_library_says_how_to_install_it(result: Result, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("xarray", "pandas"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(InvalidInputError, match=r"needs xarray; install it, `pip install .*xarray>="):
        result.to_xarray()
    with pytest.raises(InvalidInputError, match=r"needs pandas; install it"):
        result.to_pandas()


# -- words ---------------------------------------------------------------------------------------------------


def test_commands_say_options_where_the_library_says_arguments() -> None:
    params = [
        click.Option(["--force"], is_flag=True), click.Option(["--filter/--no-filter", "filtered"]),
        click.Option(["--snr", "tone_snr_db"]), click.Option(["-n", "--tones", "n_tone"]), click.Argument(["scenario"]),
    ]  # fmt: skip
    options = {str(p.name): p for p in params}
    said = {
        "a.h5: exists already, `force=True` replaces it": "a.h5: exists already, --force replaces it",
        "leave it off (`filtered=False`)": "leave it off (--no-filter)",
        "`tone_snr_db` must be a number": "`--snr` must be a number",
        "take fewer, `n_tone=3`": "take fewer, --tones 3",
        "set `simulation.tone_snr_db` and `force`": "set `simulation.tone_snr_db` and `force`",
        "give `scenario=FILE`": "give `scenario=FILE`",
    }
    assert {text: in_options(text, options) for text in said} == said


def test_the_library_names_no_options() -> None:
    """Who reads its messages called a function; only settings that repeat the command that made a file have options."""
    named = []
    for path in sorted(Path(rf.__file__).parent.rglob("*.py")):
        if {"cli", "viewer"} & set(path.parts):
            continue
        tree = ast.parse(path.read_text())
        described = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
        for node in ast.walk(tree):
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in described:
                styles = node.value.lstrip().startswith(":root")  # CSS names its variables so
                named += (
                    [f"{path.name}: {node.value}"] if re.search(r"(^|\W)--[a-z]", node.value) and not styles else []
                )
    assert [each for each in named if not each.startswith("process.py:  --")] == []
