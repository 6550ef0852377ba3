"""A file's report: one HTML page with pictures, tables, settings and versions, that needs nothing else."""

from __future__ import annotations

import base64
import html
import platform
from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

from rfpose import __version__
from rfpose.drawing import png_of
from rfpose.errors import RfposeError
from rfpose.pipeline.evaluate import evaluate
from rfpose.pipeline.formats.result import Result
from rfpose.pipeline.formats.result_summary import summarise
from rfpose.pipeline.formats.track_file import Track
from rfpose.pipeline.pictures.track_view import MODES, ON_RECEIVER, TrackPicture, clock
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
_COMPARED = (
    "Errors of the normal, of mirrors on the receiver. Caught: part of a perfect tracker's light, while on the "
    "receiver. Available: light caught over light offered in all modes. Off the receiver: hours of a mirror, all days."
)


def report_html(app: QApplication, window: MainWindow) -> str:
    """Return the report of the document that a window shows."""
    document = window.session.document
    assert document is not None
    parts = [f"<h1>{_text(document.path.name)}</h1>", f'<p class="m">{_text(document.kind)}; rfpose {__version__}</p>']
    parts += [f"<p>{_text(note)}</p>" for note in document.notes]
    if document.result is not None:
        parts += _result_tables(document.result)
    elif document.track is not None:
        parts += _track_tables(document.track)
        window.session.playback.scrub(window.session.playback.frame or document.track.n_instant // 2)
    elif document.recording is not None:
        parts += ["<h2>Recording</h2>", _facts(describe(document.recording))]
    parts += _pictures(app, window)
    settings = document.result.settings if document.result is not None else None
    if document.track is not None:
        settings = document.track.track.settings
    if settings is not None:
        parts += ["<h2>Settings</h2>", _facts(settings)]
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
        for name, part in ((key, summary[key]) for key in ("poses", "fixes", "transmitters", "tones"))
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


def _track_tables(picture: TrackPicture) -> list[str]:
    track = picture.track
    facts = {"heliostats": len(track.heliostat_ids), "days": track.dates, "instants": picture.n_instant}
    parts = ["<h2>What was tracked</h2>", _facts(facts), "<h2>How the methods compare</h2>"]
    header = ("method", "error rms [mrad]", "95 %", "worst", "light caught", "available", "kWh/m²", "off the receiver")
    rows = []
    for name in track.ranking():
        summary = track.methods[name].summary
        normal, modes = summary["normal_mrad"], summary["modes"]
        away = sum(mode["hours"] for key, mode in modes.items() if MODES.index(key) not in ON_RECEIVER)
        rows.append(
            [
                name,
                *(_number(normal[key], ".3g") for key in ("rms", "p95", "worst")),
                *(_number(summary[key], ".2%") for key in ("intercept", "availability")),
                _number(summary["energy_kwh_per_m2"], ".3f"),
                f"{away:.2f} h",
            ]
        )
    parts += [_table(header, rows), f'<p class="m">{_text(_COMPARED)}</p>']
    if picture.under_field_control:
        parts += ["<h2>What happened</h2>", _words(("day", "solar time", "what", "methods"), _story(picture))]
        parts += ["<h2>Time and light by mode</h2>", _table(*_by_mode(track))]
    return [*parts, "<h2>The first day</h2>", _drawn(track)]


def _number(value: float | None, form: str) -> str:
    return "–" if value is None else format(value, form).replace("%", " %")


def _story(picture: TrackPicture) -> list[list[str]]:
    """Return rows of what happened, the same thing once for all methods that met it."""
    methods: dict[tuple[int, str, str], list[str]] = {}
    order = {}
    for name in picture.track.ranking():
        for each in picture.happened[name]:
            key = (each.day, clock(each.hour), each.text)
            methods.setdefault(key, []).append(name)
            order[key] = (each.day, not key[1], each.hour if key[1] else 0.0)
    rows = []
    for key in sorted(methods, key=lambda key: order[key])[:_MAX_ROWS]:
        names = methods[key]
        met = "all" if len(names) == len(picture.methods) else ", ".join(names)
        rows.append([picture.track.dates[key[0]], key[1], key[2], met])
    if len(methods) > _MAX_ROWS:
        rows.append(["", "", f"and {len(methods) - _MAX_ROWS} things more", ""])
    return rows


def _by_mode(track: Track) -> tuple[list[str], list[list[str]]]:
    """Return minutes of a mirror in each mode and the light that is lost there, by method."""
    known = [key for key in MODES if any(key in method.summary["modes"] for method in track.methods.values())]
    rows = []
    for name in track.ranking():
        modes = track.methods[name].summary["modes"]
        cells = [modes.get(key) for key in known]
        rows.append([f"{name} [min]", *("–" if cell is None else f"{60.0 * cell['hours']:.1f}" for cell in cells)])
        lost = ("–" if cell is None else f"{cell['lost_kwh_per_m2']:.3f}" for cell in cells)
        rows.append([f"{name}, lost [kWh/m²]", *lost])
    return ["a mirror, all days", *(key.replace("_", " ") for key in known)], rows


def _drawn(track: Track) -> str:
    return f'<img alt="" src="data:image/png;base64,{base64.b64encode(png_of(track.plot())).decode()}">'


def _words(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table of text, where nothing is set to the right."""
    return _table(header, rows).replace("<td class=n>", "<td>")


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
