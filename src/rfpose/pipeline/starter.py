"""A scenario to begin with: a commented file whose every number may be changed."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from rfpose.checks import FloatArray
from rfpose.errors import InvalidInputError
from rfpose.files import claim, write_atomically
from rfpose.geometry import enu_from_azimuth_elevation
from rfpose.paint import read_plan
from rfpose.scenario import PositionForm, parse_scenario
from rfpose.scenario.field_table import HeliostatTable
from rfpose.scenario.schema import scenario_schema_text

__all__ = ["KINDS", "Starter", "starter_of_field", "starter_of_kind", "write_starter"]

KINDS = ("paper", "tower", "dishes")

# Swart et al., Table 2: places of the transmitters in a field of radius one
_TABLE_2 = np.array([
    [1.0, 0.0, 0.2], [0.5, 0.866, 0.3], [-0.5, 0.866, 0.2], [-1.0, 0.0, 0.3], [-0.5, -0.866, 0.2],
    [0.5, -0.866, 0.3], [0.433, 0.25, 0.4], [-0.433, 0.25, 0.4], [0.0, -0.5, 0.4], [0.0, 0.0, 0.5],
])  # fmt: skip
_CALIBRATION = np.array([0.15, -0.2])
_PAPER = np.array([
    [20, 0], [0, 25], [-30, 0], [8, -35], [45, 45], [-45, 50],
    [-55, -40], [50, -50], [85, 10], [10, 90], [-88, 5], [-10, -85],
])  # fmt: skip
_HIGHEST_MAST_M = 60.0
_LEAST_RADIUS_M = 30.0
_WAVELENGTH_RADII = 4.0
"""A tone is unambiguous over half its length; Table 2's is so over its field, four radii long."""
_COARSEST_HZ = 750e3
_SPEED_MPS = 299_792_458.0
_ALMERIA_DEG = (37.09, -2.36)
_SOLSTICE = datetime(2026, 6, 21, 12, tzinfo=UTC)


@dataclass(frozen=True, slots=True, kw_only=True)
class Starter:
    """What a starting scenario is made of.

    Attributes
    ----------
    name
        Of the site.
    pivot_enu_m : (heliostat, xyz)
        Where the mirrors stand [m].
    ids
        Their names.
    table
        The ``[heliostats]`` table that lists them, as TOML; empty: the file lists them itself.
    place_deg
        Latitude, longitude; None: those of Almería, marked as to be changed.
    height_m
        Of the site above the sea.
    aim_enu_m
        None: a height that suits the field, marked as to be changed.
    radius_m
        Of the transmitters' ring about the origin [m]; None: it goes about the mirrors.
    dishes
        Whether they are dishes, which face the sun.
    """

    name: str
    pivot_enu_m: FloatArray
    ids: tuple[str, ...]
    table: str = ""
    place_deg: tuple[float, float] | None = None
    height_m: float = 0.0
    aim_enu_m: tuple[float, float, float] | None = None
    radius_m: float | None = None
    dishes: bool = False


def starter_of_kind(
    kind: str, *, place_deg: tuple[float, float] | None = None, aim_enu_m: tuple[float, float, float] | None = None
) -> Starter:
    """Return one of `KINDS`: the paper's field with the demo's mirrors, a field north of a tower, or four dishes.

    Raises
    ------
    InvalidInputError
        Another kind.
    """
    if kind not in KINDS:
        raise InvalidInputError(f"`kind` must be one of {', '.join(KINDS)}, got {kind!r}")
    if kind == "paper":
        name, pivot = "Table 2, 100 m field", np.column_stack([_PAPER, np.full(len(_PAPER), 2.0)])
    elif kind == "dishes":
        name, pivot = "Four dishes", np.array([[e, n, 5.0] for n in (25.0, -25.0) for e in (-25.0, 25.0)])
    else:
        name, pivot = "Tower field", _north_of_tower()
    ids = tuple(f"{'D' if kind == 'dishes' else 'H'}{k:02d}" for k in range(1, len(pivot) + 1))
    return Starter(
        name=name,
        pivot_enu_m=pivot,
        ids=ids,
        place_deg=place_deg,
        aim_enu_m=aim_enu_m,
        radius_m=100.0 if kind == "paper" else None,
        dishes=kind == "dishes",
    )


def starter_of_field(
    source: str | Path,
    form: PositionForm,
    *,
    folder: Path,
    place_deg: tuple[float, float] | None = None,
    aim_enu_m: tuple[float, float, float] | None = None,
) -> Starter:
    """Return a starter for the heliostats of a table, or of a plant in PAINT's layout.

    Parameters
    ----------
    source
        CSV file, or PAINT directory; that also tells where the plant is.
    form
        How the table is to be read.
    folder
        Where the scenario will lie, which names the source from there.
    place_deg, aim_enu_m
        As in `Starter`.

    Raises
    ------
    ScenarioError, RecordingError
        The source cannot be used.
    """
    source, height_m = Path(source), 0.0
    key = "paint" if source.is_dir() else "csv"
    table = HeliostatTable(**{key: str(source)}, **form.model_dump(exclude_defaults=True))
    ids, pivot = table.read(None)
    if key == "paint":
        latitude, longitude, height_m = read_plan(source).origin_deg_m
        place_deg = place_deg or (latitude, longitude)
    lines = ["[heliostats]", f"{key} = {_text(os.path.relpath(source, folder))}"]
    if form.unit is not None:
        lines.append(f'unit = "{form.unit}"')
    if form.pivot_height_m is not None:
        lines.append(f"pivot_height_m = {form.pivot_height_m:g}   # above the table's heights")
    columns = form.columns.model_dump(exclude_none=True)
    if columns:
        lines.append("columns = { " + ", ".join(f"{name} = {_text(value)}" for name, value in columns.items()) + " }")
    return Starter(
        name=source.resolve().stem,
        pivot_enu_m=pivot,
        ids=ids,
        table="\n".join(lines),
        place_deg=place_deg,
        height_m=height_m,
        aim_enu_m=aim_enu_m,
    )


def write_starter(
    path: str | Path, starter: Starter, *, schema: str | Path | None = None, force: bool = False
) -> dict[str, int]:
    """Write a commented scenario, and beside it the schema by which editors check and complete it.

    Parameters
    ----------
    path
        The scenario.
    starter
        What it describes.
    schema
        The schema; None writes none.
    force
        Overwrite what exists.

    Returns
    -------
    dict
        ``heliostats``, ``transmitters``, ``frames`` and ``bytes`` of the recording that it simulates.

    Raises
    ------
    ScenarioError
        The field cannot be measured as it is, such as two mirrors at one place.
    RecordingError
        A file exists, or cannot be written.
    """
    from rfpose.pipeline.choice import POSES
    from rfpose.pipeline.solvable import check_solvable

    path = Path(path)
    text = _toml(starter)
    site = parse_scenario(text, source=str(path), folder=path.parent)
    check_solvable(site, pose=POSES[0])
    with claim(path, None if schema is None else Path(schema), force=force):
        if schema is not None:
            text = f"#:schema {os.path.relpath(schema, path.parent)}\n{text}"
            write_atomically(schema, scenario_schema_text().encode(), force=True)
        write_atomically(path, text.encode(), force=True)
    frames = site.simulation.frame_count
    return {
        "heliostats": len(site.heliostat),
        "transmitters": len(site.transmitter),
        "frames": frames,
        "bytes": 4 * frames * site.radio.frame_samples * len(site.receivers),
    }


def _north_of_tower() -> FloatArray:
    """Four staggered rows within 50° of north (heliostat, xyz) [m]."""
    rows = []
    for k, radius in enumerate((40.0, 50.0, 60.0, 70.0)):
        azimuth = np.radians(np.linspace(-50.0, 50.0, 6) + (10.0 if k % 2 else 0.0) - 5.0)
        rows.append(radius * enu_from_azimuth_elevation(azimuth, np.zeros(6)) + [0.0, 0.0, 3.0])
    return np.concatenate(rows)


def _toml(starter: Starter) -> str:
    place = np.asarray(starter.pivot_enu_m)
    low, high = place[:, :2].min(axis=0), place[:, :2].max(axis=0)
    centre = np.zeros(2) if starter.radius_m else np.round(0.5 * (low + high))
    reach = 1.1 * float(np.linalg.norm(place[:, :2] - centre, axis=1).max())
    radius = starter.radius_m or float(f"{max(_LEAST_RADIUS_M, reach):.2g}")
    # a field of kilometres has no masts that are half as high
    ground = float(place[:, 2].min())
    mast = np.minimum(_TABLE_2[:, 2] * radius, _HIGHEST_MAST_M * _TABLE_2[:, 2] / _TABLE_2[:, 2].max())
    transmitters = np.column_stack([centre + radius * _TABLE_2[:, :2], ground + mast])
    calibration = [*np.round(centre + radius * _CALIBRATION, 1), round(ground + 0.5, 1)]
    tone_hz = float(f"{min(_COARSEST_HZ, _SPEED_MPS / (_WAVELENGTH_RADII * radius)):.2g}")
    return "\n".join(
        [
            _head(starter),
            _site(starter, radius, ground),
            _radio(tone_hz),
            _transmitters(transmitters),
            _mirror(starter, calibration),
            _simulation(starter.place_deg or _ALMERIA_DEG),
            *(['[tracking]\ncollector = "dish"\n'] if starter.dishes else []),
        ]
    )


def _head(starter: Starter) -> str:
    listed = ""
    if not starter.table:
        rows = [
            f'  {{ id = "{name}", pivot_enu_m = {_numbers(pivot)} }},'
            for name, pivot in zip(starter.ids, starter.pivot_enu_m, strict=True)
        ]
        what = "dish" if starter.dishes else "heliostat"
        listed = "\n".join(["", f"# Each {what}: its name and where it pivots.", "heliostat = [", *rows, "]", ""])
    return f"""\
# A site for rfpose. Lengths are metres, places are east, north and up of the site's origin.
# All keys: docs/scenario.md. Check it with `rfpose info` and this file's name.
name = {_text(starter.name)}
{listed}"""


def _site(starter: Starter, radius_m: float, ground_m: float) -> str:
    latitude, longitude = starter.place_deg or _ALMERIA_DEG
    yours = "" if starter.place_deg else "   # <- yours"
    aim = starter.aim_enu_m or (0.0, 0.0, round(ground_m + min(max(0.5 * radius_m, 20.0), 150.0)))
    lines = ["[site]", f"latitude_deg = {latitude:.6g}{yours}", f"longitude_deg = {longitude:.6g}{yours}"]
    if starter.height_m:
        lines.append(f"height_m = {starter.height_m:g}")
    if not starter.dishes:
        mark = "" if starter.aim_enu_m else " <- yours"
        lines.append(f"aim_enu_m = {_numbers(aim)}   # where the heliostats send the sun:{mark or ' the receiver'}")
    if starter.table:
        lines += ["", "# Where the heliostats pivot.", starter.table]
    return "\n".join([*lines, ""])


def _radio(tone_hz: float) -> str:
    return f"""\
[radio]
sample_rate_hz = 40e6
centre_frequency_hz = 100e6
frame_samples = 100_000          # 2.5 ms; longer frames measure better, as the square root

# The ranging tone that every carrier bears; half its length must span the field.
[[tone]]
frequency_hz = {tone_hz / 1e3:g}e3             # {_SPEED_MPS / tone_hz:.4g} m
modulation_index = 0.8
"""


def _transmitters(place: FloatArray) -> str:
    rows = [
        "# Transmitters; `rfpose layout optimise` finds better places. Carriers are offsets from the centre frequency."
    ]
    for k, (xyz, carrier_mhz) in enumerate(zip(place, range(-18, 20, 4), strict=True), start=1):
        rows += [
            "[[transmitter]]",
            f'id = "T{k}"',
            f"position_enu_m = {_numbers(xyz)}",
            f"carrier_hz = {carrier_mhz}e6",
        ]
    return "\n".join([*rows, ""])


def _mirror(starter: Starter, calibration: Sequence[float]) -> str:
    size = 3.0 if starter.dishes else 1.0
    receivers = [[size * np.cos(a), size * np.sin(a), 0.0] for a in np.radians([0.0, 120.0, 240.0])]
    return f"""\
# A receiver at a surveyed place, from which the transmitters' phases are learned.
[[calibration_receiver]]
id = "cal0"
position_enu_m = {_numbers(calibration)}

# What all mirrors have in common: three or more receivers; x to the right seen from the front, y up, z out of it.
[mirror]
receiver_mirror_m = [{", ".join(map(_numbers, receivers))}]
oscillator = "shared"            # one clock for a mirror's receivers
# pivot_sigma_m = 0.01           # where pivots are surveyed: how well
# receiver_delay_sigma_s = 0.0   # where delays between a mirror's receivers are known: how well
"""


def _simulation(place_deg: tuple[float, float]) -> str:
    # noon by the sun, so that it is up wherever the site is
    noon = _SOLSTICE - timedelta(minutes=round(4.0 * place_deg[1]))
    return f"""\
# Only for `rfpose simulate`; a real recording brings its own.
[simulation]
start = {noon:%Y-%m-%dT%H:%M:%SZ}     # the sun follows from this and [site]
frame_count = 2
frame_interval_s = 60.0
tone_snr_db = 50.0               # per sample, in the recorded band
clock_offset_ppm = 2.0
# ground = {{ coefficient = [-0.3, 0.1] }}
"""


def _numbers(values: Sequence[float] | FloatArray) -> str:
    return "[" + ", ".join(_number(float(x)) for x in values) + "]"


def _number(value: float) -> str:
    return repr(round(value, 4) + 0.0)


def _text(value: str) -> str:
    return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
