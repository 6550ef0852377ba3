"""What reports are made of: text, tables, facts, figures that say where they come from, and the page's look."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

__all__ = ["MAX_ROWS", "answers", "facts", "html", "shown", "table", "text", "words"]

MAX_ROWS = 500

_STYLE = """
:root { color-scheme: light dark; --ink: #1b1f24; --paper: #fff; --quiet: #5d6670; --line: #d5dae0; --head: #f3f4f6; }
@media screen and (prefers-color-scheme: dark) {
  :root { --ink: #e6e9ed; --paper: #15181c; --quiet: #9aa4af; --line: #3b434c; --head: #22272d; }
}
html { background: var(--paper); }
body { font: 15px/1.45 system-ui, "DejaVu Sans", sans-serif; max-width: 980px; margin: 2em auto; padding: 0 1em;
  color: var(--ink); background: var(--paper); }
h1 { margin-bottom: 0; } h2 { margin-top: 1.8em; border-bottom: 1px solid var(--line); break-after: avoid; }
table { border-collapse: collapse; margin: .8em 0; }
td, th { padding: .2em .8em; border-bottom: 1px solid var(--line); vertical-align: top; }
th { text-align: left; background: var(--head); } td.n { text-align: right; font-variant-numeric: tabular-nums; }
figure { margin: 1.2em 0; break-inside: avoid; } figure svg { width: 100%; height: auto; }
figcaption, p.m { color: var(--quiet); } pre { background: var(--head); padding: 1em; overflow: auto; }
dl.asked { display: grid; grid-template-columns: max-content 1fr; gap: .4em 1.2em; margin: 1em 0; }
dl.asked dt { font-weight: 600; } dl.asked dd { margin: 0; }
div.wide { overflow-x: auto; }
@page { size: A4; margin: 16mm; }
@media print {
  :root { color-scheme: light; } body { font-size: 10pt; margin: 0; padding: 0; max-width: none; }
  section.page { break-before: page; } tr { break-inside: avoid; } thead { display: table-header-group; }
  table { font-size: 8pt; } td, th { padding: .15em .5em; } pre { white-space: pre-wrap; font-size: 7pt; }
  details { display: none; }
}
"""


def text(value: object) -> str:
    """Return text fit to stand in HTML."""
    return escape(str(value))


def shown(key: str, value: float | None, form: str = ".4g") -> str:
    """Return a figure in HTML that says under which key a command's ``--json`` prints it.

    ``key`` is the command, a colon, and keys with dots between; a dash stands for what is not known.
    """
    known = value is not None and math.isfinite(value)
    said = format(value, form).replace("%", " %") if known and value is not None else "–"
    return f'<span data-figure="{text(key)}" data-form="{text(form)}">{text(said)}</span>'


def html(title: str, parts: Sequence[str]) -> str:
    """Return the page."""
    head = f'<meta charset="utf-8"><title>{text(title)}</title>'
    head += f'<meta name="viewport" content="width=device-width"><style>{_STYLE}</style>'
    return f'<!DOCTYPE html>\n<html lang="en"><head>{head}</head><body>{"".join(parts)}</body></html>\n'


def answers(rows: Sequence[tuple[str, str]]) -> str:
    """Return questions (text) and their answers (HTML)."""
    return f'<dl class="asked">{"".join(f"<dt>{text(q)}</dt><dd>{a}</dd>" for q, a in rows)}</dl>'


def table(header: Sequence[str], rows: Sequence[Sequence[str]], *, numbers: bool = True) -> str:
    """Return a table of cells in HTML, the first column to the left; of many rows the first."""
    head = "".join(f"<th>{text(cell)}</th>" for cell in header)
    mark = " class=n" if numbers else ""
    body = "".join(
        "<tr>" + "".join(f"<td{mark if j else ''}>{cell}</td>" for j, cell in enumerate(row)) + "</tr>"
        for row in rows[:MAX_ROWS]
    )
    more = f'<p class="m">and {len(rows) - MAX_ROWS} more.</p>' if len(rows) > MAX_ROWS else ""
    whole = f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
    return f'<div class="wide">{whole}</div>{more}'


def words(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table of plain text, where nothing is set to the right."""
    return table(header, [[text(cell) for cell in row] for row in rows], numbers=False)


def facts(data: Mapping[str, Any]) -> str:
    """Return names and values as a table."""
    rows = []
    for key, value in data.items():
        if isinstance(value, Mapping) and len(value) > 20:
            said = f"{len(value)}: {', '.join(map(str, list(value)[:12]))}, …"
        elif isinstance(value, Mapping):
            said = "; ".join(f"{k}: {v}" for k, v in value.items())
        elif isinstance(value, list | tuple):
            said = "; ".join(map(str, value)) or "none"
        else:
            said = str(value)
        rows.append(f"<tr><th>{text(key.replace('_', ' '))}</th><td>{text(said)}</td></tr>")
    return f"<table>{''.join(rows)}</table>"
