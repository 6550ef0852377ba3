"""What the plant is told of one mirror in one frame, as JSON."""

from __future__ import annotations

import math
from collections.abc import Iterator
from datetime import datetime
from time import sleep
from typing import TYPE_CHECKING, Any

import numpy as np

from rfpose.interruption import check
from rfpose.multilat import PoseStatus
from rfpose.multilat.integrity import IntegrityStatus
from rfpose.pipeline.formats.result import frame_time

if TYPE_CHECKING:
    from rfpose.pipeline.formats.live_result import ResultFollower
    from rfpose.pipeline.formats.result import Result

__all__ = ["LOOK_S", "QUANTITIES", "SCHEMA", "SCHEMA_NAME", "VOUCHED", "messages", "messages_as_they_come"]

LOOK_S = 0.05
"""Between two looks at a result that is followed."""

SCHEMA_NAME = "rfpose-pose/1"
QUANTITIES: dict[str, tuple[str, str]] = {
    "normal_enu": ("1", "unit vector out of the mirror's front: east, north, up"),
    "azimuth_deg": ("deg", "of the normal, from north, clockwise"),
    "elevation_deg": ("deg", "of the normal above the horizon"),
    "sigma_mrad": ("mrad", "RMS angle of the normal's error, both axes together"),
    "protection_level_mrad": ("mrad", "the normal is off by more, without a warning, no more often than agreed"),
}
"""What is told of a pose: unit and meaning by key."""
VOUCHED = (IntegrityStatus.OK.reason, IntegrityStatus.EXCLUDED.reason)
"""What tests of the residuals say of a normal that they stand by."""
_VECTOR = {"type": ["array", "null"], "items": {"type": "number"}, "minItems": 3, "maxItems": 3}
_NUMBER = {"type": ["number", "null"]}
SCHEMA: dict[str, Any] = {
    "$schema": "https://json-schema.org/draft/2020-12/schema",
    "$id": SCHEMA_NAME,
    "title": "Where one heliostat's mirror points",
    "type": "object",
    "properties": {
        "schema": {"const": SCHEMA_NAME},
        "heliostat": {"type": "string"},
        "frame": {"type": "integer", "minimum": 0},
        "time_utc": {"type": "string", "format": "date-time", "description": "first sample of the frame"},
        "status": {"type": "string", "description": "of the pose, in words; `solved` is the good one"},
        "integrity": {"type": ["string", "null"], "description": "what tests of the residuals found, in words"},
        **{
            key: {**(_VECTOR if key == "normal_enu" else _NUMBER), "unit": unit, "description": text}
            for key, (unit, text) in QUANTITIES.items()
        },
        "why_null": {
            "type": "object",
            "additionalProperties": {"type": "string"},
            "description": "for each key that is null: the reason",
        },
    },
    "required": [
        "schema",
        "heliostat",
        "frame",
        "time_utc",
        "status",
        "integrity",
        *QUANTITIES,
        "why_null",
    ],
    "additionalProperties": False,
}
"""JSON Schema of a message; ``unit`` says what a number is in."""


def messages(result: Result, first_frame: int = 0, *, number_from: int = 0) -> Iterator[dict[str, Any]]:
    """Yield what is told of each mirror, frame by frame; a number that is not known is None, and ``why_null`` says why.

    Parameters
    ----------
    result
        Of `rfpose.process`.
    first_frame
        Where to begin.
    number_from
        Number of the result's first frame, which may be one of those that follow others.
    """
    poses, tested = result.poses, result.integrity
    for i_frame in range(first_frame, len(result.frame_start_index)):
        time = frame_time(int(result.frame_start_index[i_frame]), result.sample_rate)
        for i, name in enumerate(result.scenario.heliostat_ids):
            k = (i_frame, i)
            status = PoseStatus(int(poses.status[k])).reason
            integrity = None if tested is None else IntegrityStatus(int(tested.status[k])).reason
            level_mrad = np.nan if tested is None else 1e3 * float(tested.protection_level_rad[k])
            values: dict[str, Any] = {
                "normal_enu": [float(x) for x in poses.normal_enu[k]],
                "azimuth_deg": math.degrees(poses.azimuth_rad[k]),
                "elevation_deg": math.degrees(poses.elevation_rad[k]),
                "sigma_mrad": 1e3 * float(poses.sigma_rad[k]),
                "protection_level_mrad": level_mrad,
            }
            why = {key: status for key, value in values.items() if not np.all(np.isfinite(value))}
            if integrity is None:
                why["integrity"] = why["protection_level_mrad"] = "not tested"
            elif "protection_level_mrad" in why and "sigma_mrad" not in why:
                why["protection_level_mrad"] = "nothing protects the pose" if np.isposinf(level_mrad) else integrity
            yield {
                "schema": SCHEMA_NAME,
                "heliostat": name,
                "frame": number_from + i_frame,
                "time_utc": _iso(time),
                "status": status,
                "integrity": integrity,
                **{key: None if key in why else value for key, value in values.items()},
                "why_null": why,
            }


def messages_as_they_come(follower: ResultFollower) -> Iterator[dict[str, Any]]:
    """Yield what `messages` does of each frame that comes, until the result is complete.

    Parameters
    ----------
    follower
        Says which frames are new.

    Raises
    ------
    RecordingError
        The result is damaged, or another one stands in its place.
    """
    while True:
        found = follower.news()
        if found is not None:
            yield from messages(found, number_from=follower.n_seen - len(found.frame_start_index))
        elif follower.complete:
            return
        else:
            check()
            sleep(LOOK_S)


def _iso(time: datetime) -> str:
    return time.isoformat(timespec="microseconds").replace("+00:00", "Z")
