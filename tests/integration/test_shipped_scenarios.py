"""Every scenario that comes with rfpose goes through every command that takes one."""

import json
from pathlib import Path

import pytest
from click.testing import CliRunner

from rfpose.cli._app import app
from rfpose.recording import open_recording
from rfpose.scenario import load_scenario

SHIPPED = sorted((Path(__file__).resolve().parents[2] / "data").glob("*.toml"))
FRAME_SAMPLES = 24_000


def run(*arguments: object) -> dict:
    done = CliRunner().invoke(app, [*map(str, arguments), "--json"])
    assert done.exit_code == 0, f"{arguments}: {done.output}"
    return json.loads(done.stdout)


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_shipped_scenario(path: Path, tmp_path: Path) -> None:
    """Rates, times, carriers and tones as shipped; frames shorter, mirrors without a posture level."""
    shipped = load_scenario(path)
    heliostat = shipped.heliostat[:3]
    if shipped.simulation.sun_azimuth_deg is None:
        heliostat = [h.changed(normal_enu=h.normal_enu or (0.0, 0.0, 1.0)) for h in heliostat]
    site, recording, result = tmp_path / "site.toml", tmp_path / "recording.h5", tmp_path / "result.h5"
    short = {"radio": {"frame_samples": FRAME_SAMPLES}, "simulation": {"frame_count": 2}}
    small = shipped.changed(heliostat=heliostat, **short)
    small.save(site)
    assert run("info", path)["sound"]
    run("simulate", site, "-o", recording)
    told = run("info", recording)
    assert told["sound"], told["problems"]
    with open_recording(recording) as opened:
        assert opened.truth is not None
        starts = [int(opened.blocks(name)[0, 0]) for name in opened.receiver_ids]
        assert starts == [small.simulation.start_unix_s * opened.sample_rate] * len(starts)
    reflects = ["--reflection", "estimate"] if small.simulation.ground else []
    done = run("process", recording, "-o", result, "--estimator", "correlator", *reflects)
    n_line = 2 * len(opened.receiver_ids) * len(small.transmitter)
    assert done["transmitters"]["solved"] + done["transmitters"]["failed"] == n_line
    assert done["tones"]["solved"] + done["tones"]["failed"] == n_line * len(small.tone)
    assert done["poses"]["solved"] == 2 * len(small.heliostat)
    assert run("evaluate", result)["ratio_to_bound"] < 2.0
    assert run("info", result)["first_frame_utc"].startswith("2026-06-21T12:00:00")
    mapped = run("layout", "map", site)
    assert mapped["normal_mrad"]["scenario"]["undetermined"] == 0.0
    for file in (site, result):
        run("view", file, "--save", tmp_path / f"{file.stem}.png")
