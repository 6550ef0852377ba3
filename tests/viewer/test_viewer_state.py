"""What the viewer knows, without Qt."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rfpose.errors import InvalidInputError, RecordingError, RfposeError, ScenarioError
from rfpose.multilat.integrity import TransmitterStatus
from rfpose.pipeline.demo import shipped_scenario
from rfpose.pipeline.formats.result_file import open_result
from rfpose.pipeline.pictures.field_view import history, project
from rfpose.scenario import load_scenario, parse_scenario
from rfpose.viewer.state.document import open_document
from rfpose.viewer.state.layout_edit import LayoutEdit
from rfpose.viewer.state.observed import Signal
from rfpose.viewer.state.playback import Playback
from rfpose.viewer.state.session import Session
from rfpose.viewer.state.settings import Settings


def test_state_and_the_package_load_no_qt() -> None:
    code = (
        "import sys, rfpose.viewer.state.session, rfpose.viewer.app, rfpose.viewer.export, rfpose.cli.view\n"
        "print([m for m in ('PySide6', 'pyqtgraph') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_event_reaches_those_who_still_listen() -> None:
    heard: list[str] = []
    event = Signal()
    leave = event.connect(lambda: (heard.append("a"), leave_b()))
    leave_b = event.connect(lambda: heard.append("b"))
    event.emit()
    assert heard == ["a"]  # b left while the event was on its way
    leave()
    event.emit()
    assert heard == ["a"]


# -- layout --------------------------------------------------------------------------------------------------


@pytest.fixture
def edit() -> LayoutEdit:
    return LayoutEdit(load_scenario(shipped_scenario("table2_100m.toml")))


def test_drag_is_one_step_of_undo(edit: LayoutEdit) -> None:
    before = edit.transmitters
    edit.begin_drag()
    for k in range(20):
        edit.move("T1", east=100.0 - k)
    edit.end_drag()
    assert edit.find("T1").position_enu_m == (81.0, 0.0, 20.0)
    edit.undo()
    assert edit.transmitters == before
    assert not edit.can_undo
    edit.redo()
    assert edit.find("T1").position_enu_m[0] == 81.0


def test_new_edit_ends_redo(edit: LayoutEdit) -> None:
    edit.move("T1", up=33.0)
    edit.undo()
    edit.move("T2", up=44.0)
    assert not edit.can_redo


def test_locked_transmitter_neither_moves_nor_goes(edit: LayoutEdit) -> None:
    edit.lock("T3", True)
    before = edit.transmitters
    edit.move("T3", east=0.0)
    assert edit.transmitters == before
    with pytest.raises(InvalidInputError, match=r"`T3` is locked; unlock"):
        edit.remove("T3")
    edit.undo()  # locking, too, can be taken back
    edit.move("T3", east=0.0)
    assert edit.find("T3").position_enu_m[0] == 0.0


def test_what_is_not_finite_does_not_move(edit: LayoutEdit) -> None:
    edit.move("T1", east=float("nan"))
    assert edit.transmitters == edit.scenario.transmitter


def test_added_transmitter_gets_a_carrier_that_the_scenario_allows(edit: LayoutEdit) -> None:
    edit.remove("T4")
    assert edit.add(1.0, 2.0, 3.0) == "T4"  # the name that is free
    assert edit.add(10.0, 20.0, 30.0) == "T11"
    saved = parse_scenario(edit.to_scenario().to_toml())
    assert saved.transmitter_ids[-2:] == ("T4", "T11")
    assert saved.transmitter[-1].position_enu_m == (10.0, 20.0, 30.0)


def test_full_band_is_said() -> None:
    # lines must be 400 kHz apart
    site = load_scenario(shipped_scenario("table2_100m.toml")).changed(radio={"frame_samples": 200})
    edit = LayoutEdit(site)

    def fill() -> None:
        for _ in range(100):
            edit.add(0.0, 0.0, 10.0)

    with pytest.raises(ScenarioError, match="no room for another carrier"):
        fill()
    site.changed(transmitter=[t.changed(position_enu_m=(k, 0.0, 0.0)) for k, t in enumerate(edit.transmitters)])


def test_saving_a_layout_that_contradicts_itself_names_what(edit: LayoutEdit) -> None:
    edit.move("T1", east=50.0, north=86.6, up=30.0)  # onto T2
    with pytest.raises(ScenarioError, match=r"`T1` and `T2` stand at the same place"):
        edit.to_scenario()


def test_saved_layout_with_another_field(edit: LayoutEdit) -> None:
    edit.use_field(np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]))
    saved = edit.to_scenario()
    assert saved.heliostat_ids == ("H1", "H2")
    assert saved.heliostat[1].pivot_enu_m == (4.0, 5.0, 6.0)
    assert saved.heliostat[0].receiver_mirror_m == edit.scenario.heliostat[0].receiver_mirror_m


# -- playback ------------------------------------------------------------------------------------------------


def test_playback_stops_at_the_end_and_begins_anew() -> None:
    play = Playback(5)
    play.play()
    play.tick(0.25)
    assert play.frame == 2
    play.tick(10.0)
    assert (play.frame, play.playing) == (4, False)
    play.toggle()
    assert (play.frame, play.playing) == (0, True)


@pytest.mark.parametrize(("to", "there"), [(-3, 0), (2, 2), (99, 4)])
def test_scrubbing_stays_inside(to: int, there: int) -> None:
    play = Playback(5)
    play.scrub(to)
    assert play.frame == there


@pytest.mark.parametrize("n", [0, 1])
def test_nothing_to_play(n: int) -> None:
    play = Playback(n)
    play.play()
    play.tick(1.0)
    play.step(1)
    assert (play.frame, play.playing) == (0, False)


# -- settings ------------------------------------------------------------------------------------------------


def test_settings_come_back() -> None:
    settings = Settings(theme="dark").opened("/a/b.h5").opened("/a/c.h5").opened("/a/b.h5")
    assert settings.recent == ("/a/b.h5", "/a/c.h5")
    assert Settings.from_dict(settings.as_dict()) == settings


@pytest.mark.parametrize("stored", [{}, {"theme": 3, "recent": 7, "view": None}, {"recent": ["", 5, None]}])
def test_damaged_settings_are_defaults(stored: dict) -> None:
    assert Settings.from_dict(stored) == Settings()


def test_one_recent_file_is_stored_as_text_by_ini() -> None:
    assert Settings.from_dict({"recent": "/a/b.h5"}).recent == ("/a/b.h5",)


def test_recent_files_are_few() -> None:
    settings = Settings()
    for k in range(20):
        settings = settings.opened(f"/a/{k}")
    assert len(settings.recent) == 8
    assert settings.recent[0] == "/a/19"


# -- documents and selection ---------------------------------------------------------------------------------


def test_documents_by_what_they_hold(files: dict[str, Path]) -> None:
    for kind, path in files.items():
        document = open_document(path)
        assert document.kind == kind
        document.close()


def test_result_finds_its_recording_or_says_where_it_looked(files: dict[str, Path], tmp_path: Path) -> None:
    beside = open_document(files["result"])
    assert beside.recording is not None
    beside.close()
    alone = tmp_path / "result.h5"
    alone.write_bytes(files["result"].read_bytes())
    document = open_document(alone)
    assert document.recording is None
    assert "`rec.h5` is not beside result.h5" in document.notes[0]


def test_result_beside_a_damaged_recording_is_still_shown(files: dict[str, Path], tmp_path: Path) -> None:
    (tmp_path / "result.h5").write_bytes(files["result"].read_bytes())
    (tmp_path / "rec.h5").write_bytes(files["recording"].read_bytes()[:4000])
    document = open_document(tmp_path / "result.h5")
    assert document.recording is None
    assert "cannot be shown" in document.notes[0]


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.h5", b"", "empty"),
        ("a.h5", b"\x89PNG and so on", "not an HDF5 file"),
        ("a.txt", b"hello", "not an HDF5 file"),
        ("a.toml", b"name = 3", "`radio` is missing|`name`"),
        ("a.toml", b"name = [", "not valid TOML"),
    ],
)
def test_other_files_are_refused_with_the_place(tmp_path: Path, name: str, content: bytes, message: str) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(RfposeError, match=message) as caught:
        open_document(path)
    assert str(path) in str(caught.value)


def test_invalid_scenario_names_the_key(files: dict[str, Path], tmp_path: Path) -> None:
    path = tmp_path / "site.toml"
    path.write_text(files["scenario"].read_text().replace("frame_samples = 20000", "frame_samples = -5"))
    with pytest.raises(ScenarioError, match=r"site\.toml: `radio\.frame_samples`"):
        open_document(path)


def test_truncated_recording_is_refused(files: dict[str, Path], tmp_path: Path) -> None:
    path = tmp_path / "cut.h5"
    path.write_bytes(files["recording"].read_bytes()[:100_000])
    with pytest.raises(RecordingError, match="truncated"):
        open_document(path)


def test_closed_recording_says_so(files: dict[str, Path]) -> None:
    document = open_document(files["recording"])
    recording = document.recording
    assert recording is not None
    recording.blocks("H01_r0")
    document.close()
    with pytest.raises(RecordingError, match="was closed; open it again"):
        recording.read("H01_r0", int(document.frame_start_index[0]), 64)


def test_selection_stays_inside_the_document(files: dict[str, Path]) -> None:
    session = Session()
    session.select(frame=3)  # nothing is open
    session.show(open_document(files["result"]))
    session.select(frame=99, transmitter=77, heliostat=-1, reference=50, tone=9, receiver="nobody")
    now = session.selection
    assert (now.frame, now.transmitter, now.heliostat, now.reference, now.tone) == (2, None, None, 9, 0)
    assert now.receiver == "H01_r0"
    session.show(None)
    assert session.selection.receiver is None


# -- what the field view is told -----------------------------------------------------------------------------


def test_history_names_what_the_tests_threw_out(files: dict[str, Path]) -> None:
    result = open_result(files["result"])
    assert result.integrity is not None
    status = np.zeros_like(result.integrity.transmitter_status)
    status[1:, 1, 6] = TransmitterStatus.INTERFERENCE
    rejected = np.zeros_like(result.integrity.prior_rejected)
    rejected[0, 1, 0] = True
    tests = replace(result.integrity, transmitter_status=status, prior_rejected=rejected)
    found = {
        (e.transmitter_id, e.count, e.total, e.unit) for e in history(replace(result, integrity=tests), 1).exclusions
    }
    assert {("T7", 2, 3, "frames"), ("pivot", 1, 3, "frames")} <= found
    others = history(replace(result, integrity=tests), 0).exclusions
    assert {e.transmitter_id for e in others} == {"T4"}  # blocked, and so never received


def test_ellipse_holds_the_covariance(files: dict[str, Path]) -> None:
    """Its semi-axes are 2.448 sigmas: the chi-square of two dimensions at 95 %."""
    result = open_result(files["result"])
    found = history(result, 0)
    outline = found.ellipse_mrad - found.offset_mrad[:, None]
    axes = np.linalg.norm(outline, axis=2)
    cov = result.poses.cov_enu[:, 0]
    sizes = np.sqrt(np.linalg.eigvalsh(cov)[:, 1:])  # the smallest lies along the normal
    np.testing.assert_allclose(axes.max(axis=1), 2448.0 * sizes[:, 1], rtol=5e-3)
    np.testing.assert_allclose(axes.min(axis=1), 2448.0 * sizes[:, 0], rtol=5e-3)
    total = np.sqrt(np.trace(cov, axis1=1, axis2=2))
    np.testing.assert_allclose(found.sigma_mrad, 1e3 * total, rtol=1e-6)


@pytest.mark.parametrize(("azimuth", "right"), [(180.0, (1, 0)), (270.0, (0, -1)), (0.0, (-1, 0))])
def test_projection_puts_what_is_to_the_right_to_the_right(azimuth: float, right: tuple[int, int]) -> None:
    """An eye in the south has east to its right; in the west, south."""
    seen = project(np.array([[*right, 0.0], [0.0, 0.0, 1.0]]), np.radians(azimuth), np.radians(20.0))
    np.testing.assert_allclose(seen[0, 0], 1.0, atol=1e-12)
    assert seen[1, 1] > 0.9
