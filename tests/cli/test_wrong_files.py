"""Each command that is given another kind of file says what it is and which command takes it; info knows them all."""

import json
import re
from pathlib import Path

import pytest
from click.testing import CliRunner

from rfpose.cli._app import app
from rfpose.errors import install_remedy
from rfpose.kinds import kind_of
from rfpose.pipeline.formats.mount_file import MODEL_FORMAT
from rfpose.pipeline.process import process
from rfpose.pipeline.simulate import simulate
from rfpose.pipeline.track import track
from rfpose.scenario import load_scenario

DATA = Path(__file__).resolve().parents[2] / "data"


def run(*arguments: object) -> tuple[int, str, str]:
    done = CliRunner().invoke(app, [str(a) for a in arguments])
    return done.exit_code, done.stdout, done.stderr


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("kinds")
    site = load_scenario(DATA / "table2_100m.toml")
    site = site.changed(
        heliostat=site.heliostat[:2],
        radio={"frame_samples": 8000},
        tone=[{"frequency_hz": 750e3, "modulation_index": 0.4}, {"frequency_hz": 1e6, "modulation_index": 0.3}],
        tracking={"first_hour": 11.0, "last_hour": 11.2, "settle_s": 60.0, "date": "2026-03-20"},
        site={"latitude_deg": -33.9, "longitude_deg": 18.9},
    )
    names = {"recording": "rec.h5", "result": "result.h5", "track": "run.h5", "scenario": "site.toml"}
    paths = {kind: folder / name for kind, name in names.items()}
    site.save(paths["scenario"])
    simulate(paths["scenario"], seed=1).save(paths["recording"])
    process(paths["recording"], paths["result"], estimator="correlator")
    track(paths["scenario"], paths["track"], methods=("open-loop", "encoder"))
    for name, text in (
        ("mounts.toml", f'format = "{MODEL_FORMAT}"\nversion = 1\n[heliostat.H1]\npivot_enu_m = [1.0, 2.0, 3.0]\n'),
        (
            "mounts.json",
            json.dumps({"format": MODEL_FORMAT, "version": 1, "heliostat": {"H1": {"pivot_enu_m": [1, 2, 3]}}}),
        ),
        ("truth.json", json.dumps({"heliostats": [{"id": "H01", "normal_enu": [0, 0, 1], "receivers_enu_m": []}]})),
    ):
        (folder / name).write_text(text)
        paths[name] = folder / name
    return paths


def test_kinds_are_told_apart(files: dict[str, Path], tmp_path: Path) -> None:
    expected = {"mounts.toml": "model", "mounts.json": "model", "truth.json": "truth"}
    assert {name: kind_of(path) for name, path in files.items()} == {name: expected.get(name, name) for name in files}
    other = tmp_path / "other.toml"
    other.write_text("[tool]\nname = 'x'\n")
    assert kind_of(other) is None
    assert kind_of(tmp_path) is None
    assert kind_of(tmp_path / "missing") is None


@pytest.mark.parametrize(
    ("command", "others"),
    [
        (("evaluate", "FILE"), ("scenario", "recording", "track", "mounts.toml")),
        (("simulate", "FILE", "-o", "OUT"), ("recording", "result", "track", "mounts.toml", "truth.json")),
        (("process", "FILE", "-o", "OUT"), ("scenario", "result", "track", "mounts.json")),
        (("layout", "map", "FILE"), ("result", "track", "mounts.toml")),
        (("layout", "budget", "FILE"), ("recording",)),
        (("layout", "tones", "FILE", "--accuracy-mrad", "1"), ("recording",)),
        (("layout", "optimise", "FILE"), ("recording",)),
        (("track", "FILE", "-o", "OUT"), ("result", "mounts.toml")),
        (("convert", "FILE", "-o", "OUT"), ("scenario", "result")),
        (("aim", "FILE", "--dish", "--start", "2026-06-21T06:00Z"), ("scenario", "result", "truth.json")),
    ],
    ids=lambda value: "-".join(value[:2]) if isinstance(value, tuple) else str(value),
)
def test_another_kind_is_named_with_who_takes_it(files, tmp_path, command, others) -> None:
    words = {
        "scenario": "a scenario",
        "recording": "a recording",
        "result": "a result",
        "track": "a run of `rfpose track`",
        "mounts.toml": "a file of mounts",
        "mounts.json": "a file of mounts",
        "truth.json": "a truth",
    }
    for other in others:
        path = files[other]
        arguments = [path if a == "FILE" else tmp_path / "out.h5" if a == "OUT" else a for a in command]
        code, _, error = run(*arguments)
        assert code == 3, (other, error)
        assert str(path) in error
        assert f"but {words[other]}" in error, error
        assert "take" in error
        assert len(error.strip().splitlines()) == 1
        assert not (tmp_path / "out.h5").exists()


def test_info_tells_a_tracking_run(files: dict[str, Path]) -> None:
    code, out, _ = run("info", files["track"], "--json")
    told = json.loads(out)
    assert code == 0
    assert (told["kind"], told["sound"], told["heliostats"], told["days"]) == ("track", True, 2, ["2026-03-20"])
    assert told["first_instant_utc"].startswith("2026-03-20T")
    assert told["first_instant_utc"] < told["last_instant_utc"]
    assert set(told["methods"]) == {"open-loop", "encoder"}
    assert all(method["rms_mrad"] > 0.0 for method in told["methods"].values())
    for name in ("mounts.toml", "mounts.json"):
        assert json.loads(run("info", files[name], "--json")[1])["kind"] == "model"
    code, _, error = run("info", files["truth.json"])
    assert code == 3
    assert "`rfpose evaluate` takes" in error


def test_tones_and_transmitters_are_counted_apart(files: dict[str, Path]) -> None:
    told = json.loads(run("info", files["result"], "--json")[1])
    # 5 frames, 2 mirrors of 3 receivers and one for calibration, 10 transmitters, 2 tones
    assert told["transmitters"]["solved"] + told["transmitters"]["failed"] == 5 * 7 * 10
    assert told["tones"]["solved"] == 5 * 7 * 10 * 2


def test_tones_speak_in_the_unit_that_was_asked_for(files: dict[str, Path]) -> None:
    code, _, error = run("layout", "tones", files["scenario"], "--accuracy-mrad", "0.5")
    assert code == 3
    assert "band too narrow: 0.5 mrad of the normal needs a tone of" in error
    assert "leave it to the carriers" in error
    assert "estimator `scenario` of a layout map" in error
    code, _, error = run("layout", "tones", files["scenario"], "--accuracy-mrad", "0.5", "-n", "1")
    assert "wanted 0.5; allow more tones" in error
    code, _, error = run("layout", "tones", files["scenario"], "--accuracy-mrad", "1e-9")
    assert "carriers" not in error


def test_extras_are_installed_from_a_checkout_too() -> None:
    """The packages themselves: rfpose need not be on any index, nor be a checkout."""
    told = install_remedy("gui")
    assert re.fullmatch(
        r"`pip install 'pyqtgraph>=[\d.]+' 'pyside6-essentials[^']+'`", told.replace("PySide6-E", "pyside6-e")
    )
    assert "6.12.0" in told
    assert "'scikit-image>=" in install_remedy("images")
    for path in (DATA.parent / "src").rglob("*.py"):
        if path.name != "errors.py":
            assert "rfpose[" not in path.read_text(encoding="utf-8"), f"{path}: use install_remedy"


def test_reflections_without_radio_frequencies_are_refused_in_the_users_words(tmp_path: Path) -> None:
    table2 = load_scenario(DATA / "table2_100m.toml")
    site = tmp_path / "site.toml"
    table2.changed(
        heliostat=table2.heliostat[:2],
        radio={"frame_samples": 8000, "centre_frequency_hz": 0.0},
        simulation={"ground": {"coefficient": [-0.3, 0.1]}},
        reflection={"model": "estimate"},
        site={"latitude_deg": -33.9, "longitude_deg": 18.9},
    ).save(site)
    simulate(site, seed=1).save(tmp_path / "rec.h5")
    for command in (
        ("layout", "budget", site),
        ("process", tmp_path / "rec.h5", "-o", tmp_path / "out.h5"),
        ("track", site, "-o", tmp_path / "out.h5", "--methods", "radio"),
    ):
        code, _, error = run(*command)
        assert code == 3
        assert "transmitter `T1` is -1.8e+07 Hz; set `radio.centre_frequency_hz`" in error, error


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (("tones", "--accuracy-mrad", "nan"), 3, "`--accuracy-mrad` must"),
        (("tones", "--accuracy-mrad", "5", "--band", "5", "1"), 3, "`--band` must"),
        (("tones", "--accuracy-mrad", "5", "-n", "9"), 3, "`--tones` must lie between 1 and 6"),
        (("tones", "--accuracy-mrad", "5", "--success", "2"), 3, "`--success` must"),
        (("tones", "--accuracy-mrad", "5", "--snr", "nan"), 3, "`--snr` must"),
        (("map", "--snr", "inf"), 3, "`--snr` must"),
        (("map", "--sun", "10", "-95"), 2, "--sun AZ EL needs an elevation above 0"),
        (("map", "--year", "12000"), 2, "'--year'"),
        (("map", "--day", "0001-01-01"), 2, "--day must lie between"),
        (("optimise", "--height", "5", "1"), 3, "`--height` must"),
        (("optimise", "--separation", "-1"), 3, "`--separation` must"),
        (("optimise", "--radius", "nan"), 3, "`--radius` must"),
    ],
    ids=lambda value: "-".join(value) if isinstance(value, tuple) else None,
)
def test_options_are_refused_by_their_own_names(files, arguments, code, message) -> None:
    command, *options = arguments
    found, _, error = run("layout", command, files["scenario"], *options)
    assert found == code, error
    assert message in error


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("--format raw --sample-type ci16_le", "`--rate` must be given for raw samples"),
        ("--format raw --rate 1000", "`--sample-type` must be given for raw samples"),
        ("--format raw --sample-type ci16_le --rate -3", "`--rate` must be a rate from"),
        ("--format raw --sample-type ci16_le --rate 1e3 --centre x", "`--centre` must be a number"),
        ("--format raw --sample-type ci16_le --rate 1e3 --start tomorrow", "`--start` must be a time such as"),
        ("--format raw --sample-type ci16_le --rate 1e3 --start 2026-06-21", "`--start` must be a time such as"),
        ("--format raw --sample-type ci16_le --rate 1e3 --receiver a:b", "`--receiver` may hold letters"),
        ("--format raw --sample-type ci16_le --rate 1e3 --receiver a --receiver a", "`--receiver` names one twice"),
        ("--rate 1e3", "--rate goes with --format raw or --format wav"),
        ("--follow --until tomorrow", "`--until` must be a time such as"),
    ],
)
def test_what_is_said_wrongly_of_raw_samples_is_told_in_options(tmp_path: Path, options: str, words: str) -> None:
    (tmp_path / "a.iq").write_bytes(bytes(4000))
    code, _, error = run("process", tmp_path / "a.iq", "-o", tmp_path / "r.h5", *options.split())
    assert code == 3
    assert error.startswith(f"rfpose: {words}")


@pytest.mark.parametrize("option", ["--mqtt", "--opcua"])
def test_an_address_of_the_plant_that_makes_no_sense_is_told_in_options(files: dict[str, Path], option: str) -> None:
    anonymous = ["--anonymous"] if option == "--opcua" else []
    code, _, error = run("publish", files["result"], option, "http://broker", *anonymous)
    assert code == 3
    assert error.startswith(f"rfpose: `{option}` must be ")
