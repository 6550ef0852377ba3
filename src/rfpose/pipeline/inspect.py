"""What a file holds, whatever of ours it is."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from rfpose.errors import GeometryError, RecordingError, ScenarioError
from rfpose.kinds import kind_of
from rfpose.recording import Declared, RecordingSource, describe, open_recording
from rfpose.scenario import Scenario, load_scenario
from rfpose.shown import plain

# each kind loads its reader when one of it is there: a reader of results or runs takes longer to load than to read

__all__ = ["inspect_file"]


def inspect_file(
    path: RecordingSource, *, declared: Declared | None = None, follow_links: bool = False
) -> dict[str, Any]:
    """Describe a recording, a result, a tracking run, a scenario, mounts or an antenna pattern, ready for JSON.

    Parameters
    ----------
    path
        The file, or a recording's directory; several are the parts of one recording.
    declared, follow_links
        As for `rfpose.recording.open_recording`.

    Returns
    -------
    dict
        ``kind`` is ``"recording"``, ``"result"``, ``"track"`` (a tracking run), ``"scenario"``, ``"model"`` (mounts) or
        ``"antenna"`` (a pattern); ``sound`` tells whether ``problems`` is empty. What is not known is None.

    Raises
    ------
    RecordingError, ScenarioError
        The file is missing, damaged or none of these.
    """
    if declared is not None or not isinstance(path, str | Path):
        return _recording(path, declared=declared, follow_links=follow_links)
    path = Path(path)
    kind = kind_of(path)
    readers = {"antenna": _antenna, "model": _models, "result": _result, "survey": _survey, "track": _track}
    if kind in readers:
        return {"kind": kind, "path": str(path), **plain(readers[kind](path))}
    if kind == "truth":
        raise RecordingError(f"{path}: a truth, which `rfpose evaluate` takes; give it there beside its result")
    if kind == "scenario" or (kind is None and path.suffix == ".toml"):
        return {"kind": "scenario", "path": str(path), **_scenario(load_scenario(path))}
    return _recording(path, declared=None, follow_links=follow_links)


def _recording(path: RecordingSource, *, declared: Declared | None, follow_links: bool) -> dict[str, Any]:
    with open_recording(path, declared=declared, follow_links=follow_links) as recording:
        return {"kind": "recording", **describe(recording)}


def _scenario(scenario: Scenario) -> dict[str, Any]:
    from rfpose.pipeline.choice import POSES
    from rfpose.pipeline.solvable import check_solvable

    problems = []
    try:
        check_solvable(scenario, pose=POSES[0])
    except (ScenarioError, GeometryError) as error:
        problems.append(str(error))
    if scenario.impossible_sun:
        problems.append(scenario.impossible_sun)
    radio = scenario.radio
    return {
        "name": scenario.name,
        "transmitters": len(scenario.transmitter),
        "heliostats": len(scenario.heliostat),
        "receivers": len(scenario.receiver_ids),
        "calibration_receivers": len(scenario.calibration_receiver),
        "tone_hz": scenario.tone_hz.tolist(),
        "wavelength_m": scenario.wavelength_m.tolist(),
        "sample_rate_hz": radio.sample_rate_hz,
        "centre_frequency_hz": radio.centre_frequency_hz,
        "frame_samples": radio.frame_samples,
        "reflection": scenario.reflection.model,
        "integrity": "on" if scenario.integrity.enabled else "off",
        "frame_s": radio.frame_samples / radio.sample_rate_hz,
        "problems": problems,
        "sound": not problems,
    }


def _result(path: Path) -> dict[str, Any]:
    from rfpose.pipeline.formats.result import frame_time
    from rfpose.pipeline.formats.result_file import open_result
    from rfpose.pipeline.formats.result_summary import summarise

    result = open_result(path)
    starts = result.frame_start_index
    times = [frame_time(int(starts[i]), result.sample_rate).isoformat() for i in (0, -1)] if len(starts) else [None] * 2
    summary = summarise(result)
    problems = [f"{count} poses: {reason}" for reason, count in summary["poses"]["reasons"].items()]
    for name, count in summary.get("integrity", {}).get("priors_rejected", {}).items():
        problems.append(f"{count} poses: {name} of the scenario contradicts the data and was left out")
    return {
        "scenario": result.scenario.name,
        "settings": dict(result.settings),
        "first_frame_utc": times[0],
        "last_frame_utc": times[1],
        **{key: value for key, value in summary.items() if key not in ("estimator", "pose")},
        "has_truth": result.truth is not None,
        "problems": problems,
        "sound": not problems,
    }


def _track(path: Path) -> dict[str, Any]:
    from rfpose.pipeline.formats.track_file import open_track

    track = open_track(path)
    times = [datetime.fromtimestamp(float(t), UTC).isoformat() for t in track.unix_s[:: max(len(track.unix_s) - 1, 1)]]
    unscored = [name for name, method in track.methods.items() if method.summary["normal_mrad"]["rms"] is None]
    problems = [f"{name}: no error was scored; its mirrors were never on the receiver" for name in unscored]
    return {
        "scenario": track.scenario.name,
        "settings": dict(track.settings),
        "heliostats": len(track.heliostat_ids),
        "heliostats_with_courses": [track.heliostat_ids[i] for i in track.stored],
        "days": list(track.dates),
        "first_instant_utc": times[0] if times else None,
        "last_instant_utc": times[-1] if times else None,
        "instants": len(track.unix_s),
        "field_control": "on" if any(m.happened for m in track.methods.values()) else "off",
        "methods": {
            name: {
                "rms_mrad": m.summary["normal_mrad"]["rms"],
                "worst_mrad": m.summary["normal_mrad"]["worst"],
                "intercept": m.summary["intercept"],
                "energy_kwh_per_m2": m.summary["energy_kwh_per_m2"],
            }
            for name, m in ((name, track.methods[name]) for name in track.ranking())
        },
        "problems": problems,
        "sound": not problems,
    }


def _survey(path: Path) -> dict[str, Any]:
    from rfpose.pipeline.formats.survey_file import read_survey

    return {"sound": True, "problems": [], **read_survey(path).as_dict()}


def _antenna(path: Path) -> dict[str, Any]:
    import numpy as np

    from rfpose.pipeline.formats.antenna_file import read_pattern

    found = read_pattern(path)
    pattern = found.pattern
    n_polar = pattern.response.shape[2]
    unknown = float(np.isnan(pattern.response).any(axis=-1).mean())
    problems = [f"{unknown:.1%} of the directions are unknown"] if unknown else []
    return {
        "made_by": dict(found.made_by),
        "receivers": pattern.n_receiver,
        "frequency_hz": pattern.frequency_hz.tolist(),
        "step_deg": 180.0 / (n_polar - 1),
        "largest_sigma": float(pattern.sigma.max()),
        "problems": problems,
        "sound": not problems,
    }


def _models(path: Path) -> dict[str, Any]:
    from rfpose.pipeline.formats.mount_file import read_models

    content = read_models(path)
    site = content.site
    problems = [
        f"{name}: {', '.join(group)} were not told apart"
        for name, stored in content.heliostats.items()
        for group in stored.undetermined
    ]
    return {
        "made_by": dict(content.made_by),
        "site_deg": None if site is None else [math.degrees(site.latitude_rad), math.degrees(site.longitude_rad)],
        "heliostats": {
            name: {
                "pivot_enu_m": stored.mount.pivot_enu_m.tolist(),
                "actuators": [actuator.kind for actuator in stored.mount.actuators],
                "calibrated": stored.calibrated,
                "parameters": sum(value != 0.0 for value in stored.mount.parameters.values()),
                "free": len(stored.free),
                "noise_mrad": 1e3 * stored.noise_rad,
            }
            for name, stored in content.heliostats.items()
        },
        "problems": problems,
        "sound": not problems,
    }
