"""Pictures and reports without a screen, the command, and what it says where the viewer cannot start."""

from __future__ import annotations

import html
import json
import os
import re
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from PySide6.QtGui import QImage

from rfpose.cli import _app, plot
from rfpose.cli import view as command
from rfpose.errors import RecordingError, RfposeError, install_remedy
from rfpose.multilat import PoseStatus
from rfpose.pipeline.pictures.catalogue import FIGURES
from rfpose.pipeline.pictures.results import COLOURS
from rfpose.recording import open_recording
from rfpose.recording.conversion import convert
from rfpose.recording.native import NativeRecording
from rfpose.viewer import app, export


def run(*arguments: object) -> object:
    return CliRunner().invoke(_app.app, ["view", *map(str, arguments)])


def test_names_of_views_are_one() -> None:
    from rfpose.viewer.window import VIEWS

    assert command.VIEW_NAMES == export.VIEW_NAMES == tuple(kind.name for kind in VIEWS)


def test_names_of_figures_are_one() -> None:
    assert set(plot.FIGURE_NAMES) == {name for known in FIGURES.values() for name in known}
    assert set(plot.COLOUR_NAMES) == set(COLOURS)
    for kind, known in command._FIGURES.items():
        for view, name in known.items():
            assert name in FIGURES["recording" if view == "recording" else kind]


@pytest.mark.parametrize("what", list(FIGURES["result"]))
def test_every_figure_of_a_result_is_drawn(files: dict[str, Path], tmp_path: Path, what: str) -> None:
    out = tmp_path / "figure.pdf"
    done = CliRunner().invoke(_app.app, ["plot", str(files["result"]), "--what", what, "-o", str(out)])
    assert done.exit_code == 0, done.output
    assert out.read_bytes().startswith(b"%PDF")


def test_figure_refuses_what_says_nothing_of_it(files: dict[str, Path], tmp_path: Path) -> None:
    out = tmp_path / "figure.png"
    done = CliRunner().invoke(
        _app.app, ["plot", str(files["result"]), "--what", "links", "--frame", "1", "-o", str(out)]
    )
    assert done.exit_code == 3
    assert "`--frame` says nothing of figure links" in done.stderr
    done = CliRunner().invoke(_app.app, ["plot", str(files["result"]), "--what", "course", "-o", str(out)])
    assert done.exit_code == 3
    assert "`--what` must be one of map, errors" in done.stderr
    assert not out.exists()


@pytest.mark.parametrize(
    ("kind", "view"), [("recording", "recording"), ("result", "field"), ("scenario", "layout"), ("result", "recording")]
)
def test_each_view_becomes_a_picture(files: dict[str, Path], tmp_path: Path, kind: str, view: str) -> None:
    out = tmp_path / "out.png"
    done = run(files[kind], "--view", view, "--save", out, "--json")
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout) == {"file": str(files[kind]), "saved": str(out), "view": view}
    picture = QImage(str(out))
    assert picture.width() > 800
    colours = {picture.pixel(x, y) for x in range(0, picture.width(), 3) for y in range(0, picture.height(), 3)}
    assert len(colours) > 20


def test_shown_bounds_are_those_of_the_commands(qapp, files: dict[str, Path]) -> None:
    """One posture and one estimator for a scenario's figures, wherever they are shown."""
    found = CliRunner().invoke(_app.app, ["layout", "map", str(files["scenario"]), "--json"])
    mapped = json.loads(found.stdout)["normal_mrad"]
    for kind in ("scenario", "result"):
        _, window = export.open_window(files[kind])
        view = window.views["layout"]
        for name in ("scenario", "independent", "carrier"):
            assert window.session.layout is not None
            window.session.layout.choose(estimator=name)
            export.settle(qapp, window)
            assert view.map.rms_mrad == pytest.approx(mapped[name]["rms"], rel=1e-12)
            assert f"rms <b>{mapped[name]['rms']:.4g}</b> mrad" in view.figures.text()
        window.session.layout.choose(estimator="scenario")
        export.settle(qapp, window)
        said = view.figures.text()
        assert "a clock a receiver, with the carrier; posture: reflecting the simulated sun" in said
        window.close()
    _, window = export.open_window(files["scenario"])
    shown = window.session.document.field.normal_enu[0]
    np.testing.assert_allclose(shown, open_recording(files["recording"]).truth.normal_enu[0], atol=1e-12)
    window.close()


def json_of(*arguments: object) -> dict[str, Any]:
    done = CliRunner().invoke(_app.app, [*map(str, arguments), "--json"])
    assert done.exit_code == 0, done.output
    return json.loads(done.stdout)


def told_figures(page: str) -> list[tuple[str, str, str]]:
    """(key, form, what is written) of every figure on a page."""
    found = re.findall(r'data-figure="([^"]+)" data-form="([^"]+)">([^<]*)<', page)
    return [tuple(html.unescape(part) for part in each) for each in found]


def look_up(tree: Any, key: str) -> Any:
    for part in key.split("."):
        tree = tree[int(part)] if isinstance(tree, list) else tree[part]
    return tree


def test_figures_of_a_report_are_those_of_the_commands(files: dict[str, Path], tmp_path: Path) -> None:
    """Each says which command prints it, and under which key."""
    report = tmp_path / "report.html"
    assert run(files["result"], "--save", report).exit_code == 0
    printed = {
        "evaluate": json_of("evaluate", files["result"]),
        "process": json_of("process", files["recording"], "-o", tmp_path / "again.h5"),
    }
    told = told_figures(report.read_text())
    assert len(told) > 25
    for key, form, text in told:
        command, _, place = key.partition(":")
        value = look_up(printed[command], place)
        assert text == ("–" if value is None else format(value, form)), key
    first = [key for key, _, _ in told[:5]]
    assert first[:2] == ["process:poses.solved", "evaluate:normal_error_mrad.rms"]
    # the bound of the layout: of the first frame, the same solver
    mapped = json_of("layout", "map", files["scenario"], "--estimator", "scenario")["normal_mrad"]["scenario"]["rms"]
    assert mapped == pytest.approx(printed["evaluate"]["bound_mrad"]["rms"], rel=0.1)


def cells(table: Any) -> list[list[str]]:
    return [[table.item(i, j).text() for j in range(table.columnCount())] for i in range(table.rowCount())]


def test_levels_of_the_recording_view_are_those_of_the_command(qapp, files: dict[str, Path]) -> None:
    told = json_of("info", files["recording"])
    _, window = export.open_window(files["recording"])
    export.settle(qapp, window)
    shown = cells(window.views["recording"].receiver_table)
    assert [row[0] for row in shown] == list(told["receivers"])
    for name, level, clipped, _, lost, blocks in shown:
        receiver = told["receivers"][name]
        assert level == f"{receiver['rms_dbfs']:.1f}"
        assert clipped == f"{100.0 * receiver['clipped_fraction']:.3g} %"
        assert lost == str(receiver["lost_samples"])
        assert blocks == str(receiver["blocks"])
    window.close()


def test_mirrors_of_the_field_view_have_the_numbers_of_the_commands(
    qapp, files: dict[str, Path], tmp_path: Path
) -> None:
    evaluated = json_of("evaluate", files["result"])
    processed = json_of("process", files["recording"], "-o", tmp_path / "again.h5")
    _, window = export.open_window(files["result"])
    view, field = window.views["field"], window.session.document.field
    excluded: dict[str, int] = {}
    for k, told in enumerate(evaluated["heliostats"]):
        sigma = []
        for frame in range(field.n_frame):
            window.session.select(heliostat=k, frame=frame)
            export.settle(qapp, window)
            headline = view.headline.text()
            assert headline.startswith(f"<b>{told['id']}</b>")
            sigma.append(float(re.search(r"sigma (\S+) mrad", headline)[1]))
        assert np.isfinite(sigma).sum() == told["solved"]
        assert np.sqrt(np.nanmean(np.square(sigma))) == pytest.approx(told["sigma_mrad"]["rms"], rel=2e-3)
        across, up = (1e3 * curve.getData()[1] for curve in view.offset_curves)
        assert np.sqrt(np.mean(across**2 + up**2)) == pytest.approx(told["normal_error_mrad"]["rms"], rel=1e-6)
        for transmitter, reason, count in cells(view.excluded):
            if reason in str(processed["integrity"]["excluded"]):
                excluded[transmitter] = excluded.get(transmitter, 0) + int(count.split()[0])
    assert (field.status == PoseStatus.OK).sum() == processed["poses"]["solved"] == evaluated["solved"]
    assert excluded == {k: sum(v.values()) for k, v in processed["integrity"]["excluded"].items()}
    window.close()


def test_svg_holds_text_that_can_be_read(files: dict[str, Path], tmp_path: Path) -> None:
    out = tmp_path / "out.svg"
    assert run(files["result"], "--heliostat", "H02", "--frame", 1, "--save", out).exit_code == 0
    texts = "".join(ET.parse(out).getroot().itertext())
    for word in ("T10", "north [m]", "H02", "frame 2 of 3", "error of the mirror normal ["):
        assert word in texts


def test_other_formats_are_drawn_alike(files: dict[str, Path], tmp_path: Path) -> None:
    pictures = {}
    for format in ("rfpose-iq", "digital-rf", "sigmf"):
        path = tmp_path / format
        with open_recording(files["recording"]) as recording:
            convert(recording, path, format=format)
        done = run(path, "--save", tmp_path / f"{format}.png")
        assert done.exit_code == 0, done.output
        pictures[format] = (tmp_path / f"{format}.png").read_bytes()
    assert pictures["digital-rf"] == pictures["rfpose-iq"] == pictures["sigmf"]


def test_damage_found_while_drawing_is_an_error_and_no_picture(
    files: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object) -> None:
        raise RecordingError("rec.h5: cannot read sample 5; check the disk")

    monkeypatch.setattr(NativeRecording, "_read_segment", broken)
    done = run(files["recording"], "--save", tmp_path / "a.png")
    assert done.exit_code == 3
    assert "cannot read sample 5" in done.stderr
    assert not (tmp_path / "a.png").exists()


def test_report_is_one_file_with_what_was_asked_then_pictures_then_tables(
    files: dict[str, Path], tmp_path: Path
) -> None:
    out = tmp_path / "report.html"
    chosen = ("--frame", 0, "--frame", 2, "--heliostat", "H01", "--heliostat", "H02")
    done = run(files["result"], "--save", out, *chosen)
    assert done.exit_code == 0, done.output
    page = out.read_text()
    # the map, two of its frames, errors, links, budget, two mirrors
    assert page.count("<figure>") == 8
    assert not re.search(r'(src|href)="(?!#|data:)', page)
    ids = re.findall(r'\bid="([^"]+)"', page)
    assert len(ids) == len(set(ids)) > 20
    order = [page.index(each) for each in ("How good", "<h2>Pictures", "<h2>By heliostat", '<section class="page">')]
    assert order == sorted(order)
    for word in ("carrier not found above the noise", "estimator", "hilbert", "numpy", "Heliostat H02", "frame 3 of 3"):
        assert word in page
    assert "[[transmitter]]" in page
    # ink and paper are the page's, which are light on paper
    assert "currentColor" in page
    assert "@media screen and (prefers-color-scheme: dark)" in page


def test_report_escapes_what_the_file_says(files: dict[str, Path], tmp_path: Path) -> None:
    path = tmp_path / "a<b>.toml"
    path.write_text(files["scenario"].read_text().replace('name = "', 'name = "<script>', 1))
    out = tmp_path / "report.html"
    assert run(path, "--save", out).exit_code == 0
    assert "<script>" not in out.read_text()
    assert "a&lt;b&gt;.toml" in out.read_text()


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["{scenario}", "--save", "{tmp}/a.gif"], 3, "must end in .png, .svg, .pdf, .html"),
        (["{scenario}", "--save", "{tmp}/a.png", "--view", "recording"], 3, "`recording` has no figure of a scenario"),
        (["{result}", "--save", "{tmp}/a.png", "--frame", "9"], 3, "`frame` must lie between 0 and 2, got 9"),
        (["{result}", "--save", "{tmp}/a.png", "--frame", "1", "--frame", "2"], 2, "a report (.html) takes several"),
        (["{result}", "--save", "{tmp}/a.png", "--size", "900", "600"], 2, "--size is of the window"),
        (
            ["{result}", "--save", "{tmp}/a.png", "--heliostat", "H99"],
            3,
            "no heliostat `H99`; choose one of H01, H02",
        ),
        (["{tmp}/none.h5", "--save", "{tmp}/a.png"], 3, "no such file"),
        (["{scenario}", "--save", "{scenario}"], 3, "must end in .png, .svg, .pdf, .html"),
        (["{scenario}", "--save", "{tmp}/old.svg"], 3, "exists already"),
        (["{scenario}", "--save", "{tmp}/no/where/a.png"], 3, "its directory does not exist"),
        (["--save", "{tmp}/a.png"], 2, "--save needs a FILE"),
    ],
)
def test_what_cannot_be_drawn_is_one_line(
    files: dict[str, Path], tmp_path: Path, arguments: list[str], code: int, message: str
) -> None:
    (tmp_path / "old.svg").write_text("old")
    done = run(*(part.format(tmp=tmp_path, scenario=files["scenario"], result=files["result"]) for part in arguments))
    assert done.exit_code == code
    assert message in done.stderr
    assert (tmp_path / "old.svg").read_text() == "old"
    assert not (tmp_path / "a.png").exists()


# -- what is missing -----------------------------------------------------------------------------------------


def rfpose_view(code: str, **environment: str | None) -> subprocess.CompletedProcess[str]:
    """Run `rfpose view` in a program of its own, after ``code``."""
    env = {k: v for k, v in (os.environ | environment).items() if v is not None}
    text = f"import sys\n{code}\nsys.argv = ['rfpose', 'view']\nfrom rfpose.cli import main\nmain()"
    return subprocess.run(
        [sys.executable, "-c", text], capture_output=True, text=True, env=env, timeout=60, check=False
    )


def test_without_the_extra(tmp_path: Path) -> None:
    hide = (
        "import importlib.util as u; find = u.find_spec\n"
        "u.find_spec = lambda name, *a: None if name.split('.')[0] in ('PySide6', 'pyqtgraph') else find(name, *a)"
    )
    done = rfpose_view(hide)
    assert done.returncode == 3
    assert done.stderr.splitlines() == [
        f"rfpose: the viewer needs PySide6 and pyqtgraph; install them, {install_remedy('gui')}"
    ]


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="X and Wayland are Linux's")
def test_without_a_screen() -> None:
    done = rfpose_view("", DISPLAY=None, WAYLAND_DISPLAY=None, QT_QPA_PLATFORM=None)
    assert done.returncode == 3
    assert done.stderr.startswith("rfpose: no screen")
    assert "--save" in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="X is Linux's")
def test_screen_that_does_not_answer_or_lacks_its_libraries() -> None:
    done = rfpose_view("", DISPLAY=":987", WAYLAND_DISPLAY=None, QT_QPA_PLATFORM=None)
    assert done.returncode == 3
    assert re.search("does not answer|apt install libxcb", done.stderr)
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("libEGL.so.1: cannot open shared object file: No such file", "apt install libegl1"),
        ("libsomething.so.3: cannot open shared object file", "the system package that holds libsomething.so"),
        ("undefined symbol: x", "pip install --force-reinstall"),
    ],
)
def test_missing_library_is_named_with_its_package(text: str, message: str) -> None:
    assert message in app._missing_library(text)


def test_binding_that_kills_an_older_interpreter_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    import PySide6

    monkeypatch.setattr(PySide6, "__version__", "6.12.0")
    monkeypatch.setattr(sys, "version_info", (3, 11, 2))
    with pytest.raises(RfposeError, match=r"PySide6-Essentials<6\.12"):
        app.check_installed()


def test_font_is_brought_where_the_system_has_none(qapp, monkeypatch: pytest.MonkeyPatch) -> None:
    from PySide6.QtGui import QFontDatabase

    from rfpose.viewer.theme import ensure_font

    before = qapp.font()
    monkeypatch.setattr(QFontDatabase, "families", staticmethod(lambda: []))
    ensure_font(qapp)
    assert qapp.font().family() == "DejaVu Sans"
    qapp.setFont(before)
