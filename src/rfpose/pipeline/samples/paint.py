"""A small directory in PAINT's layout, made from mounts that are known. No record in it was measured."""

from __future__ import annotations

import json
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from rfpose import geometry
from rfpose.checks import FloatArray
from rfpose.feedback.mount import Mount, command
from rfpose.feedback.paint import read_heliostat
from rfpose.geometry import enu_from_wgs84

__all__ = ["ERRORS", "FIRST_S", "ORIGIN", "TARGET", "properties", "tower", "wgs84", "write_json", "write_paint"]

ORIGIN = (50.9, 6.4, 90.0)
TARGET = "tower_target"
FIRST_S = 1_700_000_000.0
ERRORS = {"axis_1_zero_rad": 4e-3, "axis_2_zero_rad": -6e-3, "canting_right_rad": 5e-3}
_APART_M = np.array([0.04, 0.0, 0.02])
_METRE_DEG = np.array([1.0 / 111_260.0, 1.0 / 70_300.0, 1.0])


def wgs84(enu_m: Any) -> list[float]:
    """Return latitude, longitude, height of a place in the site's frame."""
    place = np.array(ORIGIN)
    for _ in range(6):
        place = place + (np.asarray(enu_m) - enu_from_wgs84(place, ORIGIN))[[1, 0, 2]] * _METRE_DEG
    return [float(x) for x in place]


def _actuator(clockwise: int, angle: float) -> dict[str, Any]:
    return {
        "type_axis": "linear", "min_increment": 0, "max_increment": 76112, "increment": 154166.6667,
        "initial_stroke_length": 0.0766, "offset": 0.338, "pivot_radius": 0.33, "initial_angle": angle,
        "clockwise_axis_movement": clockwise, "offset_shift": 0, "radius_shift": 0,
    }  # fmt: skip


def properties(position_enu_m: Any) -> dict[str, Any]:
    """Return what PAINT says of a heliostat."""
    return {
        "heliostat_position": wgs84(position_enu_m),
        "initial_orientation": [0.0, -1.0, 0.0],
        "kinematics_properties": {
            "actuators": [_actuator(0, 0.028), _actuator(1, 0.931)],
            **{f"joint_translation_{axis}_{joint}": 0.0 for joint in (1, 2) for axis in "enu"},
            "concentrator_translation_e": 0.0, "concentrator_translation_n": 0.175, "concentrator_translation_u": 0.0,
        },
    }  # fmt: skip


def tower() -> dict[str, Any]:
    """Return what PAINT says of the tower: one target that faces north."""
    corners = {"upper_left": (4.0, 3.5), "upper_right": (-4.0, 3.5), "lower_left": (4.0, -3.5), "lower_right": (-4, -3)}
    places = {name: wgs84([east, 0.0, 36.0 + up]) for name, (east, up) in corners.items()}
    return {
        "power_plant_properties": {"ID": "synthetic", "coordinates": list(ORIGIN)},
        TARGET: {
            "type": "planar", "normal_vector": [0, 1, 0],
            "coordinates": {"center": wgs84([0.0, 0.0, 36.0]), **places},
        },
    }  # fmt: skip


def write_json(path: Path, content: Any) -> None:
    """Write JSON, folders made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))


def write_paint(
    folder: Path,
    names: Mapping[str, tuple[float, float, float]],
    *,
    n_record: int = 12,
    creep_rad_per_day: float = 0.0,
    every_days: float = 11.0,
    sigma_rad: float = 3e-4,
    seed: int = 0,
) -> Path:
    """Write heliostats (place by name) whose mounts err by `ERRORS` and, if wanted, creep; return the folder."""
    write_json(folder / "tower" / "tower_measurements.json", tower())
    times = {}
    for h, (name, place) in enumerate(names.items()):
        write_json(folder / name / f"{name}_properties.json", properties(place))
        records = folder / name / "calibration"
        write_json(
            records / "1_calibration_properties.json", _record([0, 0], (170.0, 40.0), np.array([0.0, 0.0, 36.0]))
        )
        planned = read_heliostat(folder, name).mount
        (records / "1_calibration_properties.json").unlink()
        rng = np.random.default_rng(seed + h)
        for i in range(n_record):
            day = every_days * i
            mount = planned.replace(**ERRORS | {"axis_1_zero_rad": ERRORS["axis_1_zero_rad"] + creep_rad_per_day * day})
            number = 1000 * (h + 1) + i
            write_json(records / f"{number}_calibration_properties.json", _drive(mount, rng, sigma_rad))
            times[f"{name}_{number}"] = datetime.fromtimestamp(FIRST_S + 86400.0 * day, UTC).isoformat()
    write_json(folder / "timestamps.json", times)
    return folder


def _drive(mount: Mount, rng: np.random.Generator, sigma_rad: float) -> dict[str, Any]:
    """Record of a mount that is sent somewhere near the target's middle and errs by the noise."""
    sun_deg = (float(rng.uniform(110.0, 250.0)), float(rng.uniform(20.0, 60.0)))
    sun = geometry.enu_from_azimuth_elevation(*np.radians(sun_deg))
    spot = np.array([rng.uniform(-1.5, 1.5), 0.0, 36.0 + rng.uniform(-1.5, 1.5)])
    shaken = geometry.unit(sun + 2.0 * sigma_rad * rng.normal(size=3))
    count = command(mount, sun_enu=shaken, target_enu_m=spot).count
    return _record([int(x) for x in np.rint(np.ravel(count))], sun_deg, spot)


def _record(count: list[int], sun_deg: tuple[float, float], spot_enu_m: FloatArray) -> dict[str, Any]:
    return {
        "motor_position": {"axis_1_motor_position": count[0], "axis_2_motor_position": count[1]},
        "target_name": TARGET,
        "sun_elevation": sun_deg[1],
        "sun_azimuth": 180.0 - sun_deg[0],
        "focal_spot": {"HeliOS": wgs84(spot_enu_m), "UTIS": wgs84(spot_enu_m + _APART_M)},
    }
