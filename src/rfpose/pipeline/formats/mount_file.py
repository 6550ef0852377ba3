"""Mounts in files: format ``rfpose-mount``, JSON or TOML, for mounts as planned and as calibrated alike.

A planned mount has a pivot and, where they are not plain, axes and actuators. A calibrated one adds its parameters, how
well they are known and how far its normals scatter about the model, so that what is read back commands and forecasts as
well as what was fitted.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from rfpose import __version__
from rfpose.checks import FloatArray, as_float_array, read_only
from rfpose.errors import InvalidInputError, RecordingError
from rfpose.feedback.calibrated import KnownMount, ParameterChoice, resolve_free
from rfpose.feedback.mount import Actuator, Mount
from rfpose.files import claim
from rfpose.foreign import load_json, load_toml
from rfpose.kinds import told_kind
from rfpose.sun import Location, site_from_degrees

__all__ = ["MODEL_FORMAT", "MODEL_VERSION", "MountFile", "StoredMount", "read_models", "write_model_file"]

MODEL_FORMAT = "rfpose-mount"
MODEL_VERSION = 1
_LARGEST_BYTES = 2**28  # ten thousand calibrated heliostats are 100 MB


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredMount:
    """A mount out of a file, and what is known of it.

    Attributes
    ----------
    mount
        With its parameters.
    free
        Parameters that were fitted; none: a mount as planned.
    covariance, ambiguity : (free, free)
        As in `rfpose.feedback.calibration.FieldCalibration`.
    column_length : (free,)
        Likewise.
    noise_rad
        Scatter of one normal, one component, about the model [rad]; NaN if unknown.
    noise_assumed
        It rests on the measurements' stated sigma, for want of redundant ones.
    choice
        How its parameters were chosen; None where they were given.
    undetermined
        Groups of parameters that the data could not tell apart.
    """

    mount: Mount
    free: tuple[str, ...] = ()
    covariance: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    ambiguity: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    column_length: FloatArray = field(default_factory=lambda: np.zeros(0))
    noise_rad: float = float("nan")
    noise_assumed: bool = False
    choice: ParameterChoice | None = None
    undetermined: tuple[tuple[str, ...], ...] = ()

    @property
    def calibrated(self) -> bool:
        """Whether it was fitted to measurements."""
        return bool(self.free)


@dataclass(frozen=True, slots=True, kw_only=True)
class MountFile:
    """What a file of mounts holds.

    Attributes
    ----------
    heliostats
        By name.
    site
        Where the site frame's origin lies; None if the file does not say.
    made_by
        Version and settings that it was written with.
    """

    heliostats: Mapping[str, StoredMount]
    site: Location | None = None
    made_by: Mapping[str, Any] = field(default_factory=dict)


def write_model_file(
    path: str | Path,
    heliostats: Mapping[str, KnownMount],
    *,
    site: Location | None = None,
    settings: Mapping[str, Any] | None = None,
    undetermined: Mapping[str, tuple[tuple[str, ...], ...]] | None = None,
    force: bool = False,
) -> None:
    """Write mounts as JSON or TOML, by the file's ending.

    Parameters
    ----------
    path
        Ends in .json or .toml.
    heliostats
        By name.
    site
        So that commands for a time can be made from the file alone.
    settings
        What the mounts were fitted with.
    undetermined
        Groups by name, where there are some.
    force
        Overwrite.

    Raises
    ------
    RecordingError
        Another ending, the file exists and ``force`` is not set, or it cannot be written.
    """
    path = Path(path)
    if path.suffix not in (".json", ".toml"):
        raise RecordingError(f"{path}: a model is written as .json or .toml; change the name's ending")
    groups = undetermined or {}
    content: dict[str, Any] = {
        "format": MODEL_FORMAT,
        "version": MODEL_VERSION,
        "made_by": {"rfpose": __version__, **(settings or {})},
    }
    if site is not None:
        content["site"] = {
            "latitude_deg": float(np.degrees(site.latitude_rad)),
            "longitude_deg": float(np.degrees(site.longitude_rad)),
            "altitude_m": site.altitude_m,
        }
    content["heliostat"] = {name: _as_table(known, groups.get(name, ())) for name, known in heliostats.items()}
    text = tomli_w.dumps(content) if path.suffix == ".toml" else json.dumps(content, indent=1, allow_nan=False) + "\n"
    with claim(path, force=force) as job:
        job.write(path, text.encode())


def _as_table(known: KnownMount, undetermined: tuple[tuple[str, ...], ...]) -> dict[str, Any]:
    mount = known.mount
    table: dict[str, Any] = {
        "pivot_enu_m": mount.pivot_enu_m.tolist(),
        "rot_enu_from_mount": mount.rot_enu_from_mount.tolist(),
        "actuators": [_actuator_table(actuator) for actuator in mount.actuators],
        "parameters": {name: value for name, value in mount.parameters.items() if value != 0.0},
    }
    if known.free and np.isfinite(known.covariance).all():
        sigma = np.sqrt(np.diag(known.covariance))
        table |= {
            "free": list(known.free),
            "sigma": dict(zip(known.free, sigma.tolist(), strict=True)),
            "covariance": known.covariance.tolist(),
            "ambiguity": known.ambiguity.tolist(),
            "column_length": known.column_length.tolist(),
            "noise_rad": known.noise_rad,
            "noise_assumed": known.noise_assumed,
            "undetermined": [list(group) for group in undetermined],
        }
        if known.choice is not None:
            table["choice"] = {
                "chosen": known.choice.chosen,
                "reason": known.choice.reason,
                "held_out_rad": dict(known.choice.held_out_rad),
                "held_out_sigma": known.choice.held_out_sigma,
            }
        for group in undetermined:
            for name in group:
                table["sigma"].pop(name, None)
    return table


def _actuator_table(actuator: Actuator) -> dict[str, Any]:
    """Actuator as a table; a limit that is none is left out, since JSON knows no infinity."""
    table = asdict(actuator)
    low, high = table.pop("limits_count")
    if np.isfinite(low) and np.isfinite(high):
        table["limits_count"] = [low, high]
    return table


def read_models(path: str | Path) -> MountFile:
    """Read mounts from a JSON or TOML file.

    Raises
    ------
    RecordingError
        Missing, not of this format or of a newer version, or something in it is not as it must be: the place is named.
    """
    path = Path(path)
    if instead := told_kind(path, wanted="model"):
        raise RecordingError(f"{path}: no {MODEL_FORMAT} file, but {instead}; give what `rfpose calibrate -o` wrote")
    content = _load(path)
    if content.get("format") != MODEL_FORMAT:
        raise RecordingError(f"{path}: is no {MODEL_FORMAT} file; give what `rfpose calibrate -o` wrote")
    version = content.get("version")
    if version != MODEL_VERSION:
        raise RecordingError(f"{path}: has version {version!r:.40}, this rfpose reads {MODEL_VERSION}; update rfpose")
    tables = content.get("heliostat")
    if not isinstance(tables, Mapping) or not tables:
        raise RecordingError(f"{path}: names no heliostat; add a table [heliostat.NAME] with pivot_enu_m")
    made_by = content.get("made_by", {})
    if not isinstance(made_by, Mapping):
        raise RecordingError(f"{path}: made_by must be a table, got {made_by!r:.40}")
    heliostats = {}
    for name, table in tables.items():
        if not isinstance(table, Mapping):
            raise RecordingError(f"{path}: heliostat {name}: must be a table with pivot_enu_m, got {table!r:.40}")
        try:
            heliostats[str(name)] = _from_table(table)
        except (InvalidInputError, TypeError, ValueError, KeyError, AttributeError) as error:
            text = f"{error} is missing" if isinstance(error, KeyError) else str(error)
            raise RecordingError(f"{path}: heliostat {name}: {text}") from error
    return MountFile(heliostats=heliostats, site=_site(path, content.get("site")), made_by=made_by)


def _load(path: Path) -> dict[str, Any]:
    load = load_toml if path.suffix == ".toml" else load_json
    content = load(path, limit=_LARGEST_BYTES, remedy="give what `rfpose calibrate -o` wrote, .json or .toml")
    if not isinstance(content, dict):
        raise RecordingError(f"{path}: must hold one object, got a {type(content).__name__}")
    return content


def _from_table(table: Mapping[str, Any]) -> StoredMount:
    known = {"pivot_enu_m", "rot_enu_from_mount", "actuators", "parameters"}
    fitted = {"free", "sigma", "covariance", "ambiguity", "column_length", "noise_rad", "undetermined"}
    fitted |= {"noise_assumed", "choice"}
    unknown = [key for key in table if key not in known | fitted]
    if unknown:
        raise InvalidInputError(f"no key is called {unknown[0]!r}; known are {', '.join(sorted(known | fitted))}")
    actuators = tuple(
        Actuator(**{**item, **({"limits_count": tuple(item["limits_count"])} if "limits_count" in item else {})})
        for item in table.get("actuators", ({}, {}))
    )
    if len(actuators) != 2:
        raise InvalidInputError(f"`actuators` must be two, axis 1 and axis 2, got {len(actuators)}")
    mount = Mount(
        pivot_enu_m=np.array(table["pivot_enu_m"], np.float64),
        rot_enu_from_mount=np.array(table.get("rot_enu_from_mount", np.eye(3)), np.float64),
        actuators=(actuators[0], actuators[1]),
        parameters=table.get("parameters", {}),
    )
    if not table.get("free"):
        return StoredMount(mount=mount)
    free = resolve_free(table["free"])
    n = len(free)
    covariance = as_float_array("covariance", table["covariance"], (n, n))
    ambiguity = as_float_array("ambiguity", table["ambiguity"], (n, n))
    length = as_float_array("column_length", table["column_length"], (n,))
    for name, square in (("covariance", covariance), ("ambiguity", ambiguity)):
        if not _could_be_covariance(square):
            raise InvalidInputError(f"`{name}` must be symmetric, without a negative variance; calibrate again")
    if np.any(length < 0.0):
        raise InvalidInputError(f"`column_length` must be zero or greater, got {length.min()}")
    assumed = table.get("noise_assumed", False)
    if not isinstance(assumed, bool):
        raise InvalidInputError(f"`noise_assumed` must be true or false, got {assumed!r:.40}")
    return StoredMount(
        mount=mount,
        free=free,
        covariance=read_only(covariance),
        ambiguity=read_only(ambiguity),
        column_length=read_only(length),
        noise_rad=_not_negative("noise_rad", table["noise_rad"]),
        noise_assumed=assumed,
        choice=_stored_choice(table.get("choice"), free),
        undetermined=tuple(tuple(group) for group in table.get("undetermined", ())),
    )


def _could_be_covariance(square: FloatArray) -> bool:
    """Whether a matrix is symmetric and has no negative variance, in units in which its diagonal is one."""
    diagonal = np.diag(square)
    if np.any(diagonal < 0.0):
        return False
    unit = np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    scaled = square / unit[:, None] / unit
    return bool(np.allclose(scaled, scaled.T, atol=1e-6) and np.abs(scaled).max() < 1.0 + 1e-6)


def _not_negative(name: str, value: Any) -> float:
    number = float(as_float_array(name, value, ()))
    if number < 0.0:
        raise InvalidInputError(f"`{name}` must be zero or greater, got {number}")
    return number


def _stored_choice(table: Any, free: tuple[str, ...]) -> ParameterChoice | None:
    if table is None:
        return None
    if not isinstance(table, Mapping) or not isinstance(table.get("held_out_rad"), Mapping):
        raise InvalidInputError(f"`choice` must be a table with chosen, reason, held_out_rad, got {table!r:.40}")
    return ParameterChoice(
        chosen=str(table["chosen"]),
        free=free,
        held_out_rad={str(k): _not_negative(f"held_out_rad.{k}", v) for k, v in table["held_out_rad"].items()},
        held_out_sigma=_not_negative("held_out_sigma", table["held_out_sigma"]),
        reason=str(table["reason"]),
    )


def _site(path: Path, table: Any) -> Location | None:
    if table is None:
        return None
    try:
        return site_from_degrees(table["latitude_deg"], table["longitude_deg"], table.get("altitude_m", 0.0))
    except InvalidInputError as error:
        raise RecordingError(f"{path}: [site]: {error}") from error
    except (KeyError, TypeError, AttributeError) as error:
        raise RecordingError(f"{path}: [site] needs latitude_deg and longitude_deg, as numbers ({error})") from error
