"""A file's report: one HTML page with pictures, tables, settings and versions, that needs nothing else."""

from __future__ import annotations

import html
import platform
from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

from rfpose import __version__
from rfpose.errors import RfposeError
from rfpose.pipeline.evaluate import evaluate
from rfpose.pipeline.result import Result
from rfpose.pipeline.result_summary import summarise
from rfpose.recording import describe
from rfpose.viewer.export import picture_tag
from rfpose.viewer.views.field import COLOURS, FieldView

if TYPE_CHECKING:
    from PySide6.QtWidgets import QApplication

    from rfpose.viewer.window import MainWindow

__all__ = ["report_html"]

_STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; max-width: 1300px; margin: 2em auto; padding: 0 1em; color: #1b1f24; }
h1 { margin-bottom: 0; } h2 { margin-top: 2em; border-bottom: 1px solid #c9ced4; }
table { border-collapse: collapse; margin: .8em 0; } td, th { padding: .2em .8em; border-bottom: 1px solid #e3e6ea; }
th { text-align: left; background: #f3f4f6; } td.n { text-align: right; font-variant-numeric: tabular-nums; }
img { max-width: 100%; border: 1px solid #c9ced4; } pre { background: #f3f4f6; padding: 1em; overflow: auto; }
p.m { color: #5d6670; }
"""
_PACKAGES = ("numpy", "scipy", "numba", "h5py", "pyqtgraph", "PySide6-Essentials")
_MAX_ROWS = 500


def report_html(app: QApplication, window: MainWindow) -> str:
    """Return the report of the document that a window shows."""
    document = window.session.document
    assert document is not None
    parts = [f"<h1>{_text(document.path.name)}</h1>", f'<p class="m">{_text(document.kind)}; rfpose {__version__}</p>']
    parts += [f"<p>{_text(note)}</p>" for note in document.notes]
    if document.result is not None:
        parts += _result_tables(document.result)
    elif document.recording is not None:
        parts += ["<h2>Recording</h2>", _facts(describe(document.recording))]
    parts += _pictures(app, window)
    if document.result is not None:
        parts += ["<h2>Settings</h2>", _facts(document.result.settings)]
    parts += ["<h2>Versions</h2>", _facts(_versions())]
    if document.scenario is not None:
        text = _text(document.scenario.to_toml())
        parts += ["<h2>Scenario</h2>", f"<details><summary>as TOML</summary><pre>{text}</pre></details>"]
    title = _text(f"rfpose: {document.path.name}")
    head = f'<meta charset="utf-8"><title>{title}</title><style>{_STYLE}</style>'
    return f'<!DOCTYPE html>\n<html lang="en"><head>{head}</head><body>{"".join(parts)}</body></html>\n'


def _text(value: object) -> str:
    return html.escape(str(value))


def _pictures(app: QApplication, window: MainWindow) -> list[str]:
    out = []
    for name, view in window.views.items():
        if not view.applies():
            continue
        out.append(f"<h2>{_text(view.title)}</h2>")
        if not isinstance(view, FieldView) or view.colour.count() == 0:
            out.append(picture_tag(app, window, view, lambda name=name: window.go_to(name)))  # type: ignore[misc]
            continue
        for key in (view.colour.itemData(i) for i in range(view.colour.count())):

            def prepare(key: str = key, view: FieldView = view, name: str = name) -> None:
                window.go_to(name)
                view.choose_colour(key)

            out.append(f"<p>Coloured by {_text(COLOURS[key])}.</p>")
            out.append(picture_tag(app, window, view, prepare))
    return out


def _result_tables(result: Result) -> list[str]:
    summary = summarise(result)
    rows = [
        [name, str(part["solved"]), str(part["failed"]), "; ".join(f"{n} × {r}" for r, n in part["reasons"].items())]
        for name, part in ((key, summary[key]) for key in ("poses", "fixes", "tones"))
    ]
    counts = {key: summary[key] for key in ("frames", "heliostats", "receivers", "estimator", "pose")}
    parts = ["<h2>What was measured</h2>", _facts(counts), _table(("", "solved", "failed", "reasons"), rows)]
    try:
        evaluation = evaluate(result)
    except RfposeError as error:
        return [*parts, f'<p class="m">No comparison with a truth: {_text(error)}</p>']
    normal, place = evaluation.normal_error_mrad.as_dict(), evaluation.position_error_m.as_dict()
    parts += [
        "<h2>Error against the truth</h2>",
        _table(
            ("", "rms", "median", "95 %", "worst", "bound, rms"),
            [
                ["mirror normal [mrad]", *(f"{v:.4g}" for v in normal.values()), f"{evaluation.bound_mrad:.4g}"],
                ["receiver position [m]", *(f"{v:.4g}" for v in place.values()), f"{evaluation.bound_m:.4g}"],
            ],
        ),
        _table(
            ("heliostat", "solved", "failed", "error rms [mrad]", "worst [mrad]", "sigma [mrad]", "bound [mrad]"),
            [
                [
                    row.id,
                    str(row.solved),
                    str(row.failed),
                    f"{row.normal_error_mrad.rms:.4g}",
                    f"{row.normal_error_mrad.max:.4g}",
                    f"{row.sigma_mrad:.4g}",
                    f"{row.bound_mrad:.4g}",
                ]
                for row in evaluation.heliostats[:_MAX_ROWS]
            ],
        ),
    ]
    if len(evaluation.heliostats) > _MAX_ROWS:
        parts.append(f'<p class="m">and {len(evaluation.heliostats) - _MAX_ROWS} heliostats more.</p>')
    return parts


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    head = "".join(f"<th>{_text(cell)}</th>" for cell in header)
    body = "".join(
        "<tr>" + "".join(f"<td{' class=n' if j else ''}>{_text(cell)}</td>" for j, cell in enumerate(row)) + "</tr>"
        for row in rows
    )
    return f"<table><tr>{head}</tr>{body}</table>"


def _facts(data: Mapping[str, Any]) -> str:
    rows = []
    for key, value in data.items():
        if isinstance(value, Mapping) and len(value) > 20:
            text = f"{len(value)}: {', '.join(map(str, list(value)[:12]))}, …"
        elif isinstance(value, Mapping):
            text = "; ".join(f"{k}: {v}" for k, v in value.items())
        elif isinstance(value, list | tuple):
            text = "; ".join(map(str, value)) or "none"
        else:
            text = str(value)
        rows.append(f"<tr><th>{_text(key.replace('_', ' '))}</th><td>{_text(text)}</td></tr>")
    return f"<table>{''.join(rows)}</table>"


def _versions() -> dict[str, str]:
    found = {"rfpose": __version__, "Python": platform.python_version(), "system": platform.platform()}
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found
