"""Pictures of the viewer and of a report, drawn without a screen: viewer_*.png and report.png of docs/images.

    .venv/bin/python scripts/screenshots.py [--output DIRECTORY]

Each view at 1280 × 800 in the light theme, two in the dark one, and one at a scaling of 200 %.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

os.environ["QT_QPA_PLATFORM"] = "offscreen"

import numpy as np

from rfpose.layout.fields import radial_staggered
from rfpose.pipeline.demo import shipped_scenario
from rfpose.pipeline.follow import Follow
from rfpose.pipeline.formats.result import Result
from rfpose.pipeline.process import process
from rfpose.pipeline.report import report_html
from rfpose.pipeline.simulate import simulate
from rfpose.pipeline.track import TrackChanges, track
from rfpose.scenario import load_scenario
from rfpose.viewer.export import open_window, png_of, settle
from rfpose.viewer.views.live import LiveView
from rfpose.viewer.views.tracking import TrackingView

SCALED = "viewer_field_200_percent.png"
EVENTS = (
    {"hour": 9.5, "what": "counts-lost", "heliostats": ("H05",)},
    {"hour": 10.0, "what": "calibrate", "heliostats": ("H04",)},
    {"hour": 10.2, "what": "zero-counts", "heliostats": ("H05",)},
    {"hour": 10.5, "what": "calibrate", "heliostats": ("H05",)},
    {"hour": 11.5, "what": "emergency"},
    {"hour": 12.0, "what": "release"},
    {"hour": 14.0, "what": "approach"},
)
"""Of the tracking run: one mirror loses its counts, one is calibrated, the field stows, a useless order is refused."""


def site(folder: Path) -> Path:
    """Table 2's field with ten frames, a transmitter that two mirrors do not see, and a lost stretch."""
    path = folder / "site.toml"
    simulation = {
        "frame_count": 10,
        "tone_snr_db": 30.0,
        "blocked": [{"transmitter": "T4", "receivers": ["H05", "H09"]}],
        "dropped": [{"receiver": "H02_r0", "frame": 4, "first_sample": 500, "sample_count": 20_000}],
    }
    load_scenario(shipped_scenario("table2_100m.toml")).changed(
        radio={"frame_samples": 100_000}, site={"latitude_deg": 37.1, "longitude_deg": -2.4}, simulation=simulation
    ).save(path)
    return path


def large_site(folder: Path) -> Path:
    """Two thousand mirrors to lay transmitters out for."""
    path = folder / "field.toml"
    places = radial_staggered(2000, first_radius_m=12.0, diagonal_m=3.4, height_m=2.0)
    load_scenario(shipped_scenario("table2_100m.toml")).with_field(places).save(path)
    return path


def shoot(path: Path, output: Path, *, view: str, theme: str = "light", frame: int = 0, **chosen: int) -> None:
    """Write a picture of the whole window."""
    app, window = open_window(path, theme=theme)
    window.go_to(view)
    window.session.select(frame=frame, **chosen)
    window.session.playback.scrub(frame)
    if path.name == "field.toml":
        window.session.layout.choose(posture="sun")
    settle(app, window)
    output.write_bytes(png_of(window))
    window.close()
    app.processEvents()
    print(output)


def tracking(path: Path, output: Path) -> None:
    """Write a picture of a run while one mirror is on the calibration target and another in fault."""
    app, window = open_window(path)
    window.go_to("tracking")
    view = window.views["tracking"]
    assert isinstance(view, TrackingView)
    assert window.session.document is not None
    picture = window.session.document.track
    assert picture is not None
    calibration = next(each for each in picture.happened["radio"] if each.text == "calibrate: H04")
    window.session.playback.scrub(int(np.searchsorted(picture.hours, picture.place_h(calibration))) + 1)
    view.pick(picture.ids.index("H04"))
    view.tables.setCurrentWidget(view.story)
    settle(app, window)
    output.write_bytes(png_of(window))
    window.close()
    app.processEvents()
    print(output)


def live(path: Path, output: Path) -> None:
    """Write a picture of a live field in which a transmitter is off the air and a mirror's motors stand."""
    app, window = open_window(path)
    window.go_to("live")
    settle(app, window)
    view = window.views["live"]
    assert isinstance(view, LiveView)
    for what, name, n_step in (("kill_transmitter", "T10", 75), ("stop_motor", "H05", 45), ("gust", "", 5)):
        view.disturb(what, name)
        view.toggle()  # halted, so that the picture does not depend on how fast the computer is
        settle(app, window)
        view.advance(n_step)
        settle(app, window)
    output.write_bytes(png_of(window))
    window.close()
    app.processEvents()
    print(output)


class _EnoughError(Exception):
    """So many frames are shown."""


def following(path: Path, output: Path) -> None:
    """Write a picture of a result that is being made: seven frames of ten are solved, the last one is shown."""
    frames: list[Result] = []

    def on_frame(result: Result) -> None:
        frames.append(result)
        if len(frames) == 7:
            raise _EnoughError

    simulate(path, seed=1).record("night", pace=None)
    with contextlib.suppress(_EnoughError):
        process(Follow("night", on_frame=on_frame), "night_poses.h5")
    app, window = open_window(path)
    window.follow_path(Path("night_poses.h5"))
    settle(app, window)
    window.session.select(frame=len(frames) - 1, heliostat=2)
    window.go_to("field")
    settle(app, window)
    output.write_bytes(png_of(window))
    window.close()
    app.processEvents()
    print(output)


def welcome(output: Path, path: Path) -> None:
    """Write a picture of the first page."""
    app, window = open_window(path)
    window.welcome.show_recent(("recording.h5", "result.h5", "day.h5", "site.toml"))
    window.session.show(None)
    settle(app, window)
    output.write_bytes(png_of(window))
    window.close()
    app.processEvents()
    print(output)


def report(path: Path, output: Path) -> None:
    """Write a picture of the report as a browser without a network shows it."""
    browser = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if browser is None:
        print(f"{output}: not drawn, since no Chromium is here")
        return
    page = Path("report.html").resolve()
    page.write_text(report_html(path))
    # a host that does not resolve: whatever the page would fetch is not there
    command = [browser, "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"]
    command += ["--host-resolver-rules=MAP * ~NOTFOUND", "--window-size=1280,800"]
    subprocess.run([*command, f"--screenshot={output}", page.as_uri()], check=True, capture_output=True)
    print(output)


def main() -> None:
    """Make files to show, then the pictures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, default=Path(__file__).resolve().parents[1] / "docs" / "images")
    parser.add_argument("--scaled", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    out: Path = options.output
    if options.scaled is not None:
        shoot(options.scaled, out / SCALED, view="field", frame=5, heliostat=4)
        return
    out.mkdir(parents=True, exist_ok=True)
    out, before = out.resolve(), Path.cwd()
    with tempfile.TemporaryDirectory() as name:
        os.chdir(name)  # so that the pictures show names and no places
        folder = Path()
        scenario, recording, result, day = (Path(n) for n in ("site.toml", "recording.h5", "result.h5", "day.h5"))
        site(folder)
        simulate(scenario, seed=1).save(recording)
        process(recording, result)
        track(shipped_scenario("tracking_100m.toml"), day, changes=TrackChanges(events=EVENTS))
        welcome(out / "viewer_welcome.png", scenario)
        shoot(recording, out / "viewer_recording.png", view="recording", frame=3, transmitter=2)
        shoot(recording, out / "viewer_recording_dark.png", view="recording", frame=3, transmitter=2, theme="dark")
        shoot(result, out / "viewer_field.png", view="field", frame=5, heliostat=4)
        shoot(large_site(folder), out / "viewer_layout.png", view="layout")
        shoot(scenario, out / "viewer_layout_dark.png", view="layout", theme="dark")
        report(result, out / "report.png")
        tracking(day, out / "viewer_tracking.png")
        tracked = Path("tracking_100m.toml")
        tracked.write_text(shipped_scenario(tracked.name).read_text())
        live(tracked, out / "viewer_live.png")
        following(scenario, out / "viewer_following.png")
        subprocess.run(
            [sys.executable, str(Path(__file__).resolve()), "--output", str(out), "--scaled", str(result)],
            env=os.environ | {"QT_SCALE_FACTOR": "2"},
            check=True,
        )
        os.chdir(before)


if __name__ == "__main__":
    main()
