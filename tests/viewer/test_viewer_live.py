"""The live field: its state without widgets, and the real widgets without a screen."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from rfpose.scenario import Scenario, load_scenario
from rfpose.viewer.models.live_track import LiveTrack
from rfpose.viewer.state.live import LiveRun
from rfpose.viewer.views.live import LiveView
from rfpose.viewer.window import MainWindow

Wait = Callable[..., None]


@pytest.fixture
def scenario(files: dict[str, Path]) -> Scenario:
    return load_scenario(files["scenario"])


@pytest.fixture
def view(window: MainWindow, files: dict[str, Path], wait: Wait) -> LiveView:
    window.open_path(files["scenario"])
    wait(window, lambda: window.session.document is not None)
    window.go_to("live")
    found = window.views["live"]
    assert isinstance(found, LiveView)
    wait(window, lambda: found.live is not None)
    return found


def test_state_owes_steps_by_the_clock_and_notes_what_they_came_to(scenario: Scenario) -> None:
    run = LiveRun(LiveTrack(scenario))
    assert run.due(1.0) == 0
    run.toggle()
    run.factor = 30.0
    assert [run.due(0.1), run.due(0.1), run.due(0.1)] == [0, 1, 1]  # steps of 4 s
    assert run.due(1e6) == 60
    run.take(run.track.advance(5))
    run.take(run.track.advance(2))
    np.testing.assert_allclose(run.seconds, 4.0 * np.arange(1, 8))
    assert len(run.rms_mrad) == 7
    run.disturb("stop_motor", "H02")
    assert run.marks == [(28.0, "stop H02")]
    run.take(run.track.advance(1))
    assert run.picture is not None
    assert run.picture.mode == ("track", "motors stopped")


def test_view_begins_with_mirrors_on_their_target_and_runs_by_the_clock(view: LiveView, qtbot) -> None:
    assert view.live is not None
    assert view.live.now_s == 240.0
    assert view.live.rms_mrad[-1] < 3.0
    assert view.table.rowCount() == 2
    view.run_button.click()
    assert view.run_button.text() == "Halt"
    qtbot.waitUntil(lambda: view.live.now_s > 250.0, timeout=20_000)
    view.run_button.click()
    assert not view.live.running
    assert view.curve.getData()[0].size == len(view.live.seconds)


def test_buttons_disturb_the_field(view: LiveView, window: MainWindow, wait: Wait) -> None:
    live = view.live
    assert live is not None

    def after(steps: int) -> None:
        if live.running:
            view.toggle()
        wait(window)
        view.advance(steps)
        wait(window)

    before = live.picture.sigma_mrad
    view.transmitter.setCurrentText("T7")
    view.kill_button.click()
    after(1)
    assert live.picture.dead == ("T7",)
    assert np.all(live.picture.sigma_mrad > before)
    view.table.selectRow(1)
    view.stop_button.click()
    view.gust_button.click()
    after(3)
    assert live.picture.mode[1] == "motors stopped"
    assert live.picture.wind_mps > 6.0
    view.emergency_button.click()
    after(7)
    assert live.picture.mode == ("emergency", "motors stopped")
    assert not np.linalg.norm(live.picture.instant.spot_m[0]) < 2.0  # NaN: it no longer comes near
    assert np.linalg.norm(live.picture.instant.spot_m[1]) < 2.0
    # one on its way to stow has no error and no beam; one whose motors stand shines on, and drifts off
    now = live.picture.instant
    assert np.isnan([now.error_mrad[0], *now.beam_end_enu_m[0]]).all()
    assert live.rms_mrad[-1] == pytest.approx(now.error_mrad[1])
    view.normal_button.click()
    after(1)
    assert live.picture.dead == ()
    assert set(live.picture.mode) == {"track"}
    assert [text for _, text in live.marks] == ["kill T7", "stop H02", "gust", "emergency", "normal"]


def test_cancelled_work_halts_time_and_it_can_go_on(view: LiveView, window: MainWindow, qtbot) -> None:
    live = view.live
    assert live is not None
    view.factor.setCurrentIndex(view.factor.count() - 1)
    view._set_factor()
    view.run_button.click()
    qtbot.waitUntil(lambda: any(job.name == "Live" for job in window.workers.jobs), timeout=20_000)
    window.cancel()
    qtbot.waitUntil(lambda: not live.running, timeout=20_000)
    halted = live.now_s
    view.run_button.click()
    qtbot.waitUntil(lambda: live.now_s > halted, timeout=20_000)


def test_another_file_ends_it(view: LiveView, window: MainWindow, files: dict[str, Path], wait: Wait) -> None:
    view.run_button.click()
    window.open_path(files["result"])
    wait(window, lambda: window.session.document.kind == "result")
    assert view.live is None
    assert not view.applies()
