"""A tracking run under field control: modes, flux, what happened; in the window, in the report, as a picture."""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from PySide6.QtCore import QPointF, Qt

from rfpose.cli import _app
from rfpose.drawing import save_figure
from rfpose.feedback.fieldcontrol.modes import Mode
from rfpose.pipeline.demo import shipped_scenario
from rfpose.pipeline.formats.track_file import Track, open_track
from rfpose.pipeline.pictures.track_view import (
    MODES,
    clock,
    groups,
    instant_at,
    local_hour,
    picture_of_track,
    what_happened,
)
from rfpose.pipeline.track import TrackChanges, track
from rfpose.scenario import Scenario, load_scenario
from rfpose.viewer.export import open_window
from rfpose.viewer.views.tracking import TrackingView
from rfpose.viewer.window import MainWindow

Wait = Callable[..., None]
EVENTS = (
    {"hour": 10.9, "what": "power-fails", "heliostats": ("H02",)},
    {"hour": 11.1, "what": "power-returns", "heliostats": ("H02",)},
    {"hour": 11.5, "what": "emergency"},
    {"hour": 12.0, "what": "release"},
    {"hour": 12.3, "what": "approach"},
    {"hour": 12.6, "what": "calibrate", "heliostats": ("H01",)},
)


def short_day() -> Scenario:
    """From stow to stow in four hours about noon."""
    site = load_scenario(shipped_scenario("tracking_100m.toml"))
    return site.changed(tracking={"min_sun_elevation_deg": 50.0})


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The same mirrors with field control, and for two days without."""
    folder = tmp_path_factory.mktemp("track")
    site = folder / "site.toml"
    site.write_text(short_day().to_toml())
    paths = {"control": folder / "control.h5", "without": folder / "without.h5"}
    methods = ["open-loop", "camera-model"]
    track(site, paths["control"], methods=methods, heliostats=4, changes=TrackChanges(events=EVENTS))
    track(
        site, paths["without"], methods=methods, heliostats=4, changes=TrackChanges(days=2, without_field_control=True)
    )
    return paths


@pytest.fixture(scope="module")
def controlled(runs: dict[str, Path]) -> Track:
    return open_track(runs["control"])


def view_of(window: MainWindow, path: Path, wait: Wait) -> TrackingView:
    window.open_path(path)
    wait(window, lambda: window.session.document is not None)
    view = window.views["tracking"]
    assert isinstance(view, TrackingView)
    return view


def instant_of(run: Track, hour: float) -> int:
    return int(np.argmin(np.abs(local_hour(run) - hour)))


# -- what happened, in words --------------------------------------------------------------------------------


def test_events_alarms_calibrations_and_messages_are_told_in_order(controlled: Track) -> None:
    told = what_happened(controlled, "camera-model")
    assert [each.kind for each in told] == ["event"] * 3 + ["alarm"] + ["event"] * 3 + ["calibration", "messages"]
    text = [each.text for each in told]
    assert text[0] == "power fails: H02"
    assert text[2] == "emergency"
    assert re.fullmatch(r"alarm, emergency: flux below a tenth after \d+ s, .*, all stowed after \d+ s", text[3])
    assert text[5] == "approach; refused: 4 × it points at its aim already"
    assert text[7].startswith("H01 calibrated: ")
    assert re.match(r"messages missed: \d+\.\d % of sun angles", text[8])
    assert [each.trouble for each in told] == [False] * 5 + [True] + [False] * 3


def test_an_alarm_that_the_field_does_not_answer_is_trouble(controlled: Track) -> None:
    method = controlled.methods["open-loop"]
    alarm = method.happened[0]["alarms"][0] | {"stowed_s": None}
    changed = dataclasses.replace(method, happened=(method.happened[0] | {"alarms": [alarm]},))
    told = what_happened(dataclasses.replace(controlled, methods={"open-loop": changed}), "open-loop")[3]
    assert told.trouble
    assert told.text.endswith("all stowed: not within half an hour")


def test_two_events_of_one_hour_keep_their_own_names(controlled: Track) -> None:
    plan = controlled.scenario.tracking
    twice = [plan.event[0], plan.event[0].model_copy(update={"heliostats": ("H03",)})]
    scenario = controlled.scenario.model_copy(update={"tracking": plan.model_copy(update={"event": tuple(twice)})})
    method = controlled.methods["open-loop"]
    entry = method.happened[0]["events"][0]
    changed = dataclasses.replace(method, happened=(method.happened[0] | {"events": [entry, entry]},))
    run = dataclasses.replace(controlled, scenario=scenario, methods={"open-loop": changed})
    told = [each.text for each in what_happened(run, "open-loop") if each.kind == "event"]
    assert told == ["power fails: H02", "power fails: H03"]


def test_happenings_lie_where_their_time_is(controlled: Track) -> None:
    picture = picture_of_track(controlled)
    emergency = picture.happened["open-loop"][2]
    place = int(np.searchsorted(picture.hours, picture.place_h(emergency)))
    assert clock(float(local_hour(controlled)[place])) == clock(emergency.hour) == "11:30"
    assert picture.track.methods["open-loop"].series["flux"][place - 1] > 0.3
    assert picture.track.methods["open-loop"].series["flux"][place + 1] == 0.0
    assert np.isnan(picture.place_h(picture.happened["open-loop"][-1]))


def test_near_places_come_together() -> None:
    assert groups([0.0, 0.4, 0.9, 1.1, 5.0], 1.0) == [[0, 1, 2], [3], [4]]
    assert groups([], 1.0) == []


def test_beams_of_stowed_mirrors_lead_nowhere() -> None:
    normal, sun = np.array([[0.0, 0.6, 0.8]] * 3), np.array([0.0, 0.0, 1.0])
    pivot = np.zeros((3, 3))
    target = np.array([[0.0, 0.96, 0.28]] * 2 + [[0.0, 0.28, 0.96]]) * 100.0
    mode = np.array([Mode.TRACK, Mode.STOW, Mode.FAULT])
    now = instant_at(normal, np.array([0.0, np.nan, np.nan]), sun, pivot, target, mode=mode)
    np.testing.assert_allclose(now.spot_m[0], 0.0, atol=1e-9)
    assert np.isnan(now.beam_end_enu_m[1:]).all()  # the last passes the target by far
    assert now.on_receiver.tolist() == [True, False, False]


# -- in the window ------------------------------------------------------------------------------------------


def test_modes_are_counted_and_marked(window: MainWindow, runs: dict[str, Path], controlled: Track, wait: Wait) -> None:
    view = view_of(window, runs["control"], wait)
    window.session.playback.scrub(instant_of(controlled, 11.0))
    assert "power loss 1" in view.legend_of_modes.texts
    assert "point 3, coloured by error" in view.legend_of_modes.texts
    assert view.away.getData()[0].tolist() == [controlled.pivot_enu_m[1, 0]]
    window.session.playback.scrub(instant_of(controlled, 11.8))
    assert "stow 4" in view.legend_of_modes.texts
    assert len(view.away.getData()[0]) == 4
    assert not len(view.beams.getData()[0])
    window.session.playback.scrub(instant_of(controlled, 12.25))
    assert len(view.beams.getData()[0]) == 8
    assert not len(view.away.getData()[0])


def test_a_clicked_mirror_says_what_it_does(
    window: MainWindow, runs: dict[str, Path], controlled: Track, qtbot, wait: Wait
) -> None:
    view = view_of(window, runs["control"], wait)
    window.session.playback.scrub(instant_of(controlled, 11.0))
    assert view.mirror_text.text().startswith("Click a mirror")
    wait(window)
    place = view.plan_plot.vb.mapViewToScene(QPointF(*controlled.pivot_enu_m[1, :2]))
    qtbot.mouseClick(view.map.viewport(), Qt.MouseButton.LeftButton, pos=view.map.mapFromScene(place))
    assert view.mirror_text.text() == "H02: power loss since 10:54, not on the receiver"
    assert window.session.selection.heliostat == 1
    window.session.playback.scrub(instant_of(controlled, 12.25))
    assert re.fullmatch(r"H02: point since 12:0\d, error [\d.]+ mrad of the normal", view.mirror_text.text())
    window.session.select(heliostat=0)
    assert view.mirror_text.text().startswith("H01: ")


def test_curves_and_table_tell_of_light(
    window: MainWindow, runs: dict[str, Path], controlled: Track, wait: Wait
) -> None:
    view = view_of(window, runs["control"], wait)
    curves = view.flux_plot.listDataItems()
    assert len(curves) == 2
    np.testing.assert_allclose(curves[0].getData()[1], controlled.methods["open-loop"].series["flux"])
    window.session.playback.scrub(instant_of(controlled, 11.8))
    best = controlled.ranking()[0]
    summary = controlled.methods[best].summary
    row = [view.table.item(0, j).text() for j in range(view.table.columnCount())]
    assert row[:2] == [best, "–"]  # nobody is on the receiver
    assert row[5:] == [f"{100 * summary['intercept']:.2f} %", f"{100 * summary['availability']:.2f} %"]
    assert summary["availability"] < summary["intercept"] - 0.05


def test_what_happened_is_listed_and_marked(
    window: MainWindow, runs: dict[str, Path], controlled: Track, wait: Wait
) -> None:
    view = view_of(window, runs["control"], wait)
    assert view.tables.isTabVisible(1)
    told = [[view.story.item(i, j).text() for j in range(3)] for i in range(view.story.rowCount())]
    assert [row[:2] for row in told[:5]] == [
        ["1", "10:54"], ["2", "11:06"], ["3", "11:30"], ["3", "11:30"], ["4", "12:00"],
    ]  # fmt: skip
    assert told[-1][:2] == ["", ""]
    lines = [item for plot, item in view._marks if plot is view.flux_plot]
    assert [line.label.format for line in lines] == ["1", "2", "3", "4", "5", "6"]
    assert "11:30 emergency\n11:30 alarm, emergency: flux below" in lines[2].toolTip()
    warned, calm = view.story.item(5, 2).foreground().color().name(), view.story.item(4, 2).foreground().color().name()
    assert warned == view.theme.warning != calm
    view.story.selectRow(3)
    assert window.session.playback.frame == pytest.approx(instant_of(controlled, 11.5), abs=1)
    view.choose_method("open-loop")
    assert len([item for plot, item in view._marks if plot is view.flux_plot]) == 6


def test_a_run_without_field_control_has_no_modes_to_show(
    window: MainWindow, runs: dict[str, Path], wait: Wait
) -> None:
    view = view_of(window, runs["without"], wait)
    assert not view.tables.isTabVisible(1)
    assert not view.legend_of_modes.key.isVisible()
    assert not view._marks
    hours, flux = view.flux_plot.listDataItems()[0].getOriginalDataset()
    assert np.isnan(hours).sum() == np.isnan(flux).sum() == 1  # the night
    view_of(window, runs["control"], wait)
    assert view.tables.isTabVisible(1)
    assert view.legend_of_modes.key.isVisible()
    assert len(view.flux_plot.listDataItems()) == 2


# -- report and picture -------------------------------------------------------------------------------------


def test_report_of_a_run_tells_what_happened(runs: dict[str, Path], controlled: Track, tmp_path: Path) -> None:
    out = tmp_path / "report.html"
    done = CliRunner().invoke(_app.app, ["view", str(runs["control"]), "--save", str(out)])
    assert done.exit_code == 0, done.output
    page = out.read_text()
    plain = re.sub("</?span[^>]*>", "", page)
    cells = [re.findall(r"<td[^>]*>([^<]*)</td>", row) for row in plain.split("</tr>")]
    assert ["2026-03-20", "11:30", "emergency", "all"] in cells
    assert ["2026-03-20", "12:18", "approach; refused: 4 × it points at its aim already", "all"] in cells
    for method in controlled.methods.values():
        row = next(row for row in cells if row[:1] == [method.name])
        assert row[5] == f"{100 * method.summary['availability']:.2f} %"
    assert "power loss</th>" in page
    assert page.count("<figure>") == 3  # methods, the first day, an instant
    assert "after emergency" in page or "after power" in page
    assert "<th>seed</th><td>0</td>" in page


def test_report_of_a_run_without_field_control(runs: dict[str, Path], tmp_path: Path) -> None:
    out = tmp_path / "report.html"
    done = CliRunner().invoke(_app.app, ["view", str(runs["without"]), "--save", str(out)])
    assert done.exit_code == 0, done.output
    assert "How the methods compare" in out.read_text()
    assert "What happened" not in out.read_text()


@pytest.mark.parametrize("name", ["control", "without"])
def test_picture_shows_flux_and_modes_where_there_are_any(runs: dict[str, Path], tmp_path: Path, name: str) -> None:
    save_figure(open_track(runs[name]).plot(), tmp_path / "day.svg")
    text = (tmp_path / "day.svg").read_text()
    written = re.findall(r"<text [^>]*>(.*?)</text>", text)
    assert any("flux" in each for each in written)
    wanted = {"emergency", "power fails H02", "release", "power loss", "stow"}
    assert wanted & set(written) == (wanted if name == "control" else set())


def test_picture_of_nobody_on_the_receiver(controlled: Track, tmp_path: Path) -> None:
    nothing = {}
    for name, method in controlled.methods.items():
        dark = np.full(len(controlled.unix_s), np.nan)
        count = np.zeros((len(dark), len(MODES)), np.int32)
        count[:, Mode.STOW] = 4
        series = dict(method.series) | {"rms_rad": dark, "flux": dark, "mode_count": count}
        scores = dict(method.scores) | {"heliostat_rms_rad": np.full(4, np.nan)}
        nothing[name] = dataclasses.replace(method, series=series, scores=scores)
    save_figure(dataclasses.replace(controlled, methods=nothing).plot(), tmp_path / "day.png")
    assert (tmp_path / "day.png").stat().st_size > 10_000


def test_methods_in_the_window_have_the_numbers_of_the_command(qapp, runs: dict[str, Path]) -> None:
    told = json.loads(CliRunner().invoke(_app.app, ["info", str(runs["control"]), "--json"]).stdout)["methods"]
    _, window = open_window(runs["control"])
    table = window.views["tracking"].table
    rows = [[table.item(i, j).text() for j in range(table.columnCount())] for i in range(table.rowCount())]
    assert [row[0] for row in rows] == list(told)
    for name, _, rms, _, worst, caught, _ in rows:
        assert rms == f"{told[name]['rms_mrad']:.3g}"
        assert worst == f"{told[name]['worst_mrad']:.3g}"
        assert caught == f"{100.0 * told[name]['intercept']:.2f} %"
    window.close()
