"""What a report says of a tracking run."""

from __future__ import annotations

from rfpose.pipeline.formats.track_file import Track
from rfpose.pipeline.pictures.track_view import MODES, ON_RECEIVER, TrackPicture, clock
from rfpose.pipeline.report.page import MAX_ROWS, answers, shown, table, text, words
from rfpose.shown import counted

__all__ = ["track_parts"]

_COMPARED = (
    "Errors of the normal, of mirrors on the receiver. Caught: part of a perfect tracker's light, while on the "
    "receiver. Available: light caught over light offered in all modes. Off the receiver: hours of a mirror, all days."
)


def track_parts(picture: TrackPicture) -> tuple[str, list[str]]:
    """Return what was asked of a run with the answers, and its tables, in HTML."""
    track = picture.track
    names = track.ranking()
    best = names[0]
    found = track.methods[best].summary
    mirrors = counted(len(track.heliostat_ids), "mirror")
    kept = f", courses kept of {len(track.stored)}" if len(track.stored) < len(track.heliostat_ids) else ""
    days = ", ".join(track.dates[:3]) + (f", … ({len(track.dates)} days)" if len(track.dates) > 3 else "")
    rows = [
        ("What was tracked", f"<b>{mirrors}</b>{kept}, {text(days)}, by {counted(len(names), 'method')}"),
        (
            "Which is best",
            f"<b>{text(best)}</b>: {shown(f'track:methods.{best}.normal_mrad.rms', found['normal_mrad']['rms'])} mrad "
            f"RMS of the normal, {shown(f'track:methods.{best}.intercept', found['intercept'], '.2%')} of a perfect "
            "tracker's light",
        ),
    ]
    if len(names) > 1:
        last = names[-1]
        other = track.methods[last].summary
        rows.append(
            (
                "And the last",
                f"{text(last)}: {shown(f'track:methods.{last}.normal_mrad.rms', other['normal_mrad']['rms'])} mrad, "
                f"{shown(f'track:methods.{last}.intercept', other['intercept'], '.2%')}",
            )
        )
    trouble = [each for each in picture.happened[best] if each.trouble or each.kind == "alarm"]
    said = "<br>".join(text(f"{track.dates[e.day]} {clock(e.hour)}: {e.text}") for e in trouble[:6])
    if picture.under_field_control:
        rows.append(("Alarms and trouble", said or "nothing"))
    tables = ["<h2>How the methods compare</h2>", _comparison(track), f'<p class="m">{text(_COMPARED)}</p>']
    if picture.under_field_control:
        tables += ["<h2>What happened</h2>", words(("day", "solar time", "what", "methods"), _story(picture))]
        tables += ["<h2>Time and light by mode</h2>", _by_mode(track)]
    return answers(rows), tables


def _comparison(track: Track) -> str:
    header = ("method", "error rms [mrad]", "95 %", "worst", "light caught", "available", "kWh/m²", "off the receiver")
    rows = []
    for name in track.ranking():
        summary, key = track.methods[name].summary, f"track:methods.{name}"
        normal, modes = summary["normal_mrad"], summary["modes"]
        away = sum(mode["hours"] for mode_name, mode in modes.items() if MODES.index(mode_name) not in ON_RECEIVER)
        rows.append(
            [
                text(name),
                *(shown(f"{key}.normal_mrad.{k}", normal[k], ".3g") for k in ("rms", "p95", "worst")),
                *(shown(f"{key}.{k}", summary[k], ".2%") for k in ("intercept", "availability")),
                shown(f"{key}.energy_kwh_per_m2", summary["energy_kwh_per_m2"], ".3f"),
                f"{away:.2f} h",
            ]
        )
    return table(header, rows)


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
    for key in sorted(methods, key=lambda key: order[key])[:MAX_ROWS]:
        names = methods[key]
        met = "all" if len(names) == len(picture.methods) else ", ".join(names)
        rows.append([picture.track.dates[key[0]], key[1], key[2], met])
    if len(methods) > MAX_ROWS:
        rows.append(["", "", f"and {len(methods) - MAX_ROWS} things more", ""])
    return rows


def _by_mode(track: Track) -> str:
    """Return minutes of a mirror in each mode and the light that is lost there, by method."""
    known = [key for key in MODES if any(key in method.summary["modes"] for method in track.methods.values())]
    rows = []
    for name in track.ranking():
        modes = track.methods[name].summary["modes"]
        cells = [modes.get(key) for key in known]
        minutes = ("–" if cell is None else f"{60.0 * cell['hours']:.1f}" for cell in cells)
        lost = ("–" if cell is None else f"{cell['lost_kwh_per_m2']:.3f}" for cell in cells)
        rows.append([text(f"{name} [min]"), *minutes])
        rows.append([text(f"{name}, lost [kWh/m²]"), *lost])
    return table(["a mirror, all days", *(key.replace("_", " ") for key in known)], rows)
