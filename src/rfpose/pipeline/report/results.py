"""What a report says of a result."""

from __future__ import annotations

from typing import Any

import numpy as np

from rfpose.multilat import PoseStatus
from rfpose.pipeline.evaluate import Evaluation
from rfpose.pipeline.formats.result import Result, frame_time
from rfpose.pipeline.formats.result_summary import pose_table, summarise
from rfpose.pipeline.pictures.field_view import history
from rfpose.pipeline.report.page import answers, shown, table, text, words
from rfpose.shown import counted

__all__ = ["mirror_table", "result_parts"]


def result_parts(result: Result, evaluation: Evaluation | None) -> tuple[str, list[str]]:
    """Return what was asked of a result with the answers, and its tables, in HTML."""
    summary = summarise(result)
    rows = [
        ("How many", _how_many(result, summary)),
        ("How good", _how_good(result, evaluation)),
        ("What was left out", _left_out(summary)),
        ("How protected", _protected(result, summary, evaluation)),
    ]
    tables = ["<h2>By heliostat</h2>", _by_heliostat(result, evaluation)]
    tables += ["<h2>Counts</h2>", _counts(summary), *_why(summary)]
    return answers(rows), tables


def _how_many(result: Result, summary: dict[str, Any]) -> str:
    poses = summary["poses"]
    starts = result.frame_start_index
    when = ""
    if len(starts):
        first, last = (frame_time(int(starts[k]), result.sample_rate) for k in (0, -1))
        when = f", {first:%Y-%m-%d %H:%M:%S}" + (f" to {last:%H:%M:%S}" if len(starts) > 1 else "") + " UTC"
    solved = shown("process:poses.solved", poses["solved"], "d")
    return (
        f"<b>{solved} of {poses['solved'] + poses['failed']}</b> mirror normals measured: "
        f"{counted(summary['heliostats'], 'heliostat')}, {counted(summary['frames'], 'frame')}{text(when)}"
    )


def _how_good(result: Result, found: Evaluation | None) -> str:
    if found is None:
        good = result.poses.status == PoseStatus.OK
        mrad = 1e3 * result.poses.sigma_rad[good & np.isfinite(result.poses.sigma_rad)]
        if not mrad.size:
            return "no normal was measured"
        rms = float(np.sqrt(np.mean(mrad**2)))
        return (
            f"<b>sigma {rms:.4g} mrad</b> of the normal, RMS, by what the result itself states (median "
            f"{float(np.median(mrad)):.4g}); no truth is known to compare it with"
        )
    error = found.normal_error_mrad
    return (
        f"<b>{shown('evaluate:normal_error_mrad.rms', error.rms)} mrad</b> RMS error of the normal (median "
        f"{shown('evaluate:normal_error_mrad.median', error.median)}, worst "
        f"{shown('evaluate:normal_error_mrad.max', error.max)}); the bound of this estimator is "
        f"{shown('evaluate:bound_mrad.rms', found.bound_mrad)}, ratio "
        f"{shown('evaluate:ratio_to_bound', found.ratio_to_bound, '.3f')} ± "
        f"{shown('evaluate:ratio_to_bound_sigma', found.ratio_sigma, '.2g')}; the result itself states "
        f"{shown('evaluate:sigma_mrad.rms', found.sigma_mrad)} mrad"
    )


def _left_out(summary: dict[str, Any]) -> str:
    said = [f"{n} poses: {text(why)}" for why, n in summary["poses"]["reasons"].items()]
    for name, reasons in summary.get("integrity", {}).get("excluded", {}).items():
        said += [f"transmitter {text(name)} in {counted(n, 'pose')}: {text(why)}" for why, n in reasons.items()]
    for name, n in summary.get("integrity", {}).get("priors_rejected", {}).items():
        said.append(f"{text(name)} of the scenario in {counted(n, 'pose')}: contradicts the phases")
    said += [f"{n} transmitter lines: {text(why)}" for why, n in summary["transmitters"]["reasons"].items()]
    return "<br>".join(said) or "nothing"


def _protected(result: Result, summary: dict[str, Any], found: Evaluation | None) -> str:
    integrity = summary.get("integrity")
    if integrity is None:
        return "not tested: this result was made without integrity"
    if integrity["protection_level_mrad"] is None:
        return "no pose is protected: nothing would show a wrong transmitter"
    missed = result.scenario.integrity.missed_detection
    said = (
        f"<b>{shown('process:integrity.protection_level_mrad', integrity['protection_level_mrad'])} mrad</b>, median "
        f"of {shown('process:integrity.protected', integrity['protected'], 'd')} poses: with one transmitter wrong by "
        f"whatever amount the normal is off by more, unnoticed, in at most {missed:g} of the cases"
    )
    if found is not None and found.protection is not None:
        said += f"; exceeded here in {shown('evaluate:protection.exceeded', found.protection.exceeded, 'd')}"
    return said


def _by_heliostat(result: Result, found: Evaluation | None) -> str:
    if found is not None:
        header = ("heliostat", "solved", "failed", "error rms [mrad]", "worst [mrad]", "bound [mrad]", "sigma [mrad]")
        return table(
            header,
            [
                [
                    text(row.id),
                    shown(f"evaluate:heliostats.{k}.solved", row.solved, "d"),
                    shown(f"evaluate:heliostats.{k}.failed", row.failed, "d"),
                    shown(f"evaluate:heliostats.{k}.normal_error_mrad.rms", row.normal_error_mrad.rms),
                    shown(f"evaluate:heliostats.{k}.normal_error_mrad.max", row.normal_error_mrad.max),
                    shown(f"evaluate:heliostats.{k}.bound_mrad.rms", row.bound_mrad),
                    shown(f"evaluate:heliostats.{k}.sigma_mrad.rms", row.sigma_mrad),
                ]
                for k, row in enumerate(found.heliostats)
            ],
        )
    names, rows = result.figures()
    return table(names, [[text(cell) for cell in row] for row in rows])


def _counts(summary: dict[str, Any]) -> str:
    rows = [
        [
            name,
            shown(f"process:{name}.solved", summary[name]["solved"], "d"),
            shown(f"process:{name}.failed", summary[name]["failed"], "d"),
        ]
        for name in ("poses", "fixes", "transmitters", "tones")
    ]
    return table(("", "solved", "failed"), rows)


def _why(summary: dict[str, Any]) -> list[str]:
    rows = [
        [name, str(n), why]
        for name in ("poses", "fixes", "transmitters", "tones")
        for why, n in summary[name]["reasons"].items()
    ]
    return ["<h2>Why some failed</h2>", words(("", "how many", "reason"), rows)] if rows else []


_OF_POSE = ("time_utc", "azimuth_deg", "elevation_deg", "normal_sigma_mrad", "protection_level_mrad", "status",
            "transmitters_left_out")  # fmt: skip


def mirror_table(result: Result, name: str) -> str:
    """Return the poses of one heliostat, and what had no full part in them, in HTML."""
    header, rows = pose_table(result)
    column = {key: header.index(key) for key in (*_OF_POSE, "heliostat")}
    mine = [row for row in rows if row[column["heliostat"]] == name]
    cells = [[_cell(row[column[key]]) for key in _OF_POSE] for row in mine]
    parts = [words([key.replace("_", " ") for key in _OF_POSE], cells)]
    found = history(result, result.scenario.heliostat_ids.index(name)).exclusions
    if found:
        out = [[each.transmitter_id, each.reason, f"{each.count} of {each.total} {each.unit}"] for each in found]
        parts.append(words(("had no full part", "why", "how often"), out))
    return "".join(parts)


def _cell(value: Any) -> str:
    if hasattr(value, "strftime"):
        return f"{value:%Y-%m-%d %H:%M:%S.%f}"[:-3]
    if isinstance(value, float):
        return "" if np.isnan(value) else f"{value:.6g}"
    return str(value)
