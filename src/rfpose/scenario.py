"""A site as data: transmitters, tones, heliostats, receivers, and how to simulate them.

A scenario is a TOML file; `load_scenario` turns it into frozen records and refuses unknown keys and
contradictions. Every length is metres in the site ENU frame unless a name says otherwise.
"""

from __future__ import annotations

import itertools
import math
import tomllib
from collections.abc import Callable
from fractions import Fraction
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, Self

import numpy as np
import tomli_w
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from rfpose import geometry
from rfpose.checks import FloatArray, read_only
from rfpose.errors import ScenarioError

__all__ = [
    "Blockage",
    "CalibrationReceiver",
    "Dropout",
    "Ground",
    "Heliostat",
    "Mirror",
    "Radio",
    "Receiver",
    "Scenario",
    "Simulation",
    "Site",
    "Tone",
    "Transmitter",
    "load_scenario",
    "parse_scenario",
]

SPEED_OF_LIGHT_MPS = 299_792_458.0
MAX_FRAME_SAMPLES = 2**24
MIN_FRAME_SAMPLES = 64

Point = tuple[float, float, float]
Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Identifier = Annotated[str, Field(min_length=1, pattern=r"^[A-Za-z0-9_.\-]+$")]


class _Record(BaseModel):
    """Frozen, refuses unknown keys, NaN and infinity."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Site(_Record):
    """Where the field is. Latitude and longitude place the sun; they are not needed to process radio."""

    latitude_deg: Annotated[float, Field(ge=-90, le=90)] | None = None
    longitude_deg: Annotated[float, Field(ge=-180, le=180)] | None = None
    height_m: float = 0.0
    aim_enu_m: Point | None = None
    """Aim point of the heliostats (the tower's receiver)."""


class Radio(_Record):
    """The recorded band and how it is cut into frames."""

    sample_rate_hz: Positive
    centre_frequency_hz: NonNegative
    frame_samples: Annotated[int, Field(ge=MIN_FRAME_SAMPLES, le=MAX_FRAME_SAMPLES)]
    propagation_speed_mps: Positive = SPEED_OF_LIGHT_MPS
    clock_search_ppm: NonNegative = 50.0
    """Receiver clocks are searched within plus and minus this offset."""

    @property
    def sample_rate(self) -> Fraction:
        """Sample rate as a rational number [1/s]."""
        return Fraction(self.sample_rate_hz).limit_denominator(1_000_000)


class Tone(_Record):
    """One ranging sinusoid, common to all transmitters, given by its frequency or its wavelength."""

    frequency_hz: Positive | None = None
    wavelength_m: Positive | None = None
    modulation_index: Positive = 0.8

    @model_validator(mode="after")
    def _one_of_two(self) -> Self:
        if (self.frequency_hz is None) == (self.wavelength_m is None):
            raise ValueError("give exactly one of `frequency_hz` and `wavelength_m`")
        return self


class Transmitter(_Record):
    """A transmitter at a surveyed place; its carrier is given as the offset from the centre frequency."""

    id: Identifier
    position_enu_m: Point
    carrier_hz: float
    amplitude: Positive = 1.0


class CalibrationReceiver(_Record):
    """A receiver at a surveyed place, from which the transmitters' electronic phases are measured."""

    id: Identifier
    position_enu_m: Point
    survey_sigma_m: NonNegative = 0.0


class Mirror(_Record):
    """What the mirrors have in common; a heliostat may override each entry.

    Receivers are given in the mirror frame (x to the right seen from the front, y up, z along the normal),
    whose origin is the mirror's centre. The centre lies ``arm_m`` from the pivot along the normal.
    """

    receiver_mirror_m: tuple[Point, ...] | None = None
    arm_m: NonNegative = 0.0
    oscillator: Literal["shared", "separate"] = "shared"
    receiver_delay_sigma_s: NonNegative | None = None
    """How well the delays between a mirror's receivers are known; without it they are unknown in every frame."""
    pivot_sigma_m: Positive | None = None
    """How well pivots are surveyed; without it they are not used."""
    carrier_phase: bool = True
    """Whether receivers on one oscillator also compare the carriers' own phases."""
    mount: Literal["free", "azimuth_elevation"] = "free"
    """Whether orientation is held to a two-axis mount, whose mirror keeps its x axis horizontal."""


class Heliostat(_Record):
    """One heliostat: a pivot and three or more receivers fixed to its mirror."""

    id: Identifier
    pivot_enu_m: Point
    receiver_mirror_m: tuple[Point, ...]
    receiver_ids: tuple[Identifier, ...]
    arm_m: NonNegative = 0.0
    oscillator: Literal["shared", "separate"] = "shared"
    receiver_delay_sigma_s: NonNegative | None = None
    pivot_sigma_m: Positive | None = None
    carrier_phase: bool = True
    mount: Literal["free", "azimuth_elevation"] = "free"
    normal_enu: Point | None = None
    """Posture for simulation; without it the mirror reflects the simulated sun onto the aim point."""

    @model_validator(mode="after")
    def _receivers_span_a_plane(self) -> Self:
        n = len(self.receiver_mirror_m)
        if n < 3:
            raise ValueError(f"`receiver_mirror_m` must hold three or more receivers, got {n}")
        if len(self.receiver_ids) != n:
            raise ValueError(f"`receiver_ids` must name all {n} receivers, got {len(self.receiver_ids)}")
        if geometry.is_collinear(self.receiver_mirror_m):
            raise ValueError("`receiver_mirror_m` must not lie on a line: a line fixes no normal; move one aside")
        if self.normal_enu is not None and math.hypot(*self.normal_enu) < 1e-9:
            raise ValueError("`normal_enu` must not be zero")
        return self


class Ground(_Record):
    """A level ground that reflects each transmitter as its mirror image (simulation)."""

    coefficient: tuple[float, float]
    """Complex reflection coefficient at RF: real and imaginary part."""
    height_m: float = 0.0


class Blockage(_Record):
    """One transmitter hidden from some receivers for some frames (simulation)."""

    transmitter: Identifier
    receivers: tuple[Identifier, ...] = ()
    """Receiver or heliostat identifiers; empty means all."""
    first_frame: Annotated[int, Field(ge=0)] = 0
    last_frame: Annotated[int, Field(ge=0)] = 2**31
    attenuation_db: NonNegative = 200.0


class Dropout(_Record):
    """Samples that one receiver lost (simulation): an explicit gap in the recording."""

    receiver: Identifier
    frame: Annotated[int, Field(ge=0)]
    first_sample: Annotated[int, Field(ge=0)]
    sample_count: Annotated[int, Field(gt=0)]


class Simulation(_Record):
    """How `rfpose simulate` makes a recording of this scenario."""

    frame_count: Annotated[int, Field(gt=0)] = 4
    frame_interval_s: NonNegative = 0.0
    """Start to start; zero records frames back to back."""
    start_unix_s: Annotated[int, Field(ge=0)] = 1_782_043_200
    tone_snr_db: float = 40.0
    """First tone of a transmitter of amplitude one at the reference range, against all noise in the recorded
    band, per sample: ``(a m)² / σ²`` with σ² the variance of the complex noise."""
    path_loss: Literal["none", "free_space"] = "none"
    reference_range_m: Positive = 100.0
    sample_format: Literal["int16", "complex64"] = "int16"
    adc_bits: Annotated[int, Field(ge=2, le=16)] = 16
    headroom_db: float = 3.0
    """Full scale above the largest possible signal; negative clips."""
    clock_offset_ppm: NonNegative = 0.0
    """Each oscillator's offset is drawn uniformly from plus and minus this."""
    receiver_delay_s: NonNegative = 0.0
    """Standard deviation of each receiver's hardware delay."""
    receiver_delay_drift_s_per_sqrt_min: NonNegative = 0.0
    transmitter_phase_drift_rad_per_sqrt_h: NonNegative = 0.0
    sun_azimuth_deg: float | tuple[float, float] | None = None
    """One value, or the values at the first and the last frame."""
    sun_elevation_deg: float | tuple[float, float] | None = None
    ground: Ground | None = None
    blocked: tuple[Blockage, ...] = ()
    dropped: tuple[Dropout, ...] = ()


class Receiver(NamedTuple):
    """One row of the receiver axis: where it belongs. Calibration receivers have no heliostat."""

    id: str
    heliostat: int | None
    calibration: int | None
    oscillator: str


class Scenario(_Record):
    """A whole site. Load one with `load_scenario`; array properties are read-only.

    The receiver axis holds every heliostat's receivers in order, then the calibration receivers.
    """

    name: str
    site: Site = Site()
    radio: Radio
    tone: Annotated[tuple[Tone, ...], Field(min_length=1)]
    transmitter: Annotated[tuple[Transmitter, ...], Field(min_length=1)]
    calibration_receiver: tuple[CalibrationReceiver, ...] = ()
    heliostat: tuple[Heliostat, ...] = ()
    simulation: Simulation = Simulation()

    def __eq__(self, other: object) -> bool:
        # not pydantic's own comparison, which trips over the cached arrays
        return isinstance(other, Scenario) and self.model_dump() == other.model_dump()

    def __hash__(self) -> int:
        return hash(self.to_toml())

    # -- arrays ------------------------------------------------------------------------------------------

    @cached_property
    def transmitter_enu_m(self) -> FloatArray:
        """(transmitter, xyz) positions [m]."""
        return read_only(np.array([t.position_enu_m for t in self.transmitter], np.float64))

    @cached_property
    def carrier_hz(self) -> FloatArray:
        """(transmitter,) carrier offsets from the centre frequency [Hz]."""
        return read_only(np.array([t.carrier_hz for t in self.transmitter], np.float64))

    @cached_property
    def tone_hz(self) -> FloatArray:
        """(tone,) tone frequencies [Hz]."""
        speed = self.radio.propagation_speed_mps
        return read_only(np.array([t.frequency_hz or speed / (t.wavelength_m or np.nan) for t in self.tone]))

    @cached_property
    def wavelength_m(self) -> FloatArray:
        """(tone,) tone wavelengths [m]."""
        return read_only(self.radio.propagation_speed_mps / self.tone_hz)

    @cached_property
    def line_hz(self) -> FloatArray:
        """(transmitter, line) spectral lines, offset from the centre frequency [Hz].

        Lines of a transmitter: carrier, then upper and lower sideband of each tone.
        """
        offset = [0.0]
        for tone_hz in self.tone_hz:
            offset += [tone_hz, -tone_hz]
        return read_only(self.carrier_hz[:, None] + np.array(offset)[None, :])

    @cached_property
    def calibration_enu_m(self) -> FloatArray:
        """(calibration receiver, xyz) surveyed positions [m]."""
        return read_only(np.array([r.position_enu_m for r in self.calibration_receiver]).reshape(-1, 3))

    @cached_property
    def pivot_enu_m(self) -> FloatArray:
        """(heliostat, xyz) pivot positions [m]."""
        return read_only(np.array([h.pivot_enu_m for h in self.heliostat]).reshape(-1, 3))

    @cached_property
    def transmitter_ids(self) -> tuple[str, ...]:
        """Transmitter identifiers in file order."""
        return tuple(t.id for t in self.transmitter)

    @cached_property
    def heliostat_ids(self) -> tuple[str, ...]:
        """Heliostat identifiers in file order."""
        return tuple(h.id for h in self.heliostat)

    @cached_property
    def receivers(self) -> tuple[Receiver, ...]:
        """The receiver axis."""
        rows = []
        for i, heliostat in enumerate(self.heliostat):
            for receiver_id in heliostat.receiver_ids:
                shared = heliostat.oscillator == "shared"
                rows.append(Receiver(receiver_id, i, None, heliostat.id if shared else receiver_id))
        for i, calibration in enumerate(self.calibration_receiver):
            rows.append(Receiver(calibration.id, None, i, calibration.id))
        return tuple(rows)

    @cached_property
    def receiver_ids(self) -> tuple[str, ...]:
        """Identifiers along the receiver axis."""
        return tuple(r.id for r in self.receivers)

    # -- derived -----------------------------------------------------------------------------------------

    def receiver_rows(self, i_heliostat: int) -> slice:
        """Rows of the receiver axis that belong to one heliostat."""
        start = sum(len(h.receiver_ids) for h in self.heliostat[:i_heliostat])
        return slice(start, start + len(self.heliostat[i_heliostat].receiver_ids))

    def scaled(self, factor: float) -> Scenario:
        """Return the scenario with every length, and every tone's wavelength, multiplied by ``factor``.

        Swart et al. §4.5: positions and normals scale with it, so one layout serves every field size. Carrier
        frequencies stay as they are.
        """
        if not (math.isfinite(factor) and factor > 0):
            raise ScenarioError(f"`scale` must be a finite number greater than zero, got {factor}")
        if factor == 1.0:
            return self
        data = self.model_dump(exclude_none=True)
        _scale_lengths(data, factor)
        return Scenario.model_validate(data)

    def to_toml(self) -> str:
        """Return the scenario as TOML that `parse_scenario` reads back to an equal record."""
        return tomli_w.dumps(self.model_dump(mode="json", exclude_none=True, exclude_defaults=True))

    # -- contradictions ----------------------------------------------------------------------------------

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        for check in _CONSISTENCY:
            check(self)
        return self


# -- consistency: each raises ValueError in the user's words -------------------------------------------------


def _check_ids(s: Scenario) -> None:
    for kind, ids in (
        ("transmitter", s.transmitter_ids),
        ("heliostat", s.heliostat_ids),
        ("receiver", s.receiver_ids),
    ):
        seen: set[str] = set()
        for identifier in ids:
            if identifier in seen:
                raise ValueError(f"{kind} `{identifier}` appears twice; identifiers must be unique")
            seen.add(identifier)


def _check_transmitters_apart(s: Scenario) -> None:
    for (i, a), (j, b) in itertools.combinations(enumerate(s.transmitter_enu_m), 2):
        if np.linalg.norm(a - b) < 1e-6:
            ids = s.transmitter_ids
            raise ValueError(f"transmitters `{ids[i]}` and `{ids[j]}` stand at the same place; move or remove one")


def _check_lines_in_band(s: Scenario) -> None:
    half_band = s.radio.sample_rate_hz / 2.0
    margin = s.radio.clock_search_ppm * 1e-6 * (s.radio.centre_frequency_hz + half_band)
    for transmitter, lines in zip(s.transmitter, s.line_hz, strict=True):
        worst = float(np.max(np.abs(lines)))
        if worst + margin >= half_band:
            raise ValueError(
                f"transmitter `{transmitter.id}` has a line {worst:.9g} Hz from the centre, outside the recorded band "
                f"of ±{half_band:.9g} Hz (less {margin:.4g} Hz for clock offset); move `carrier_hz` or raise "
                "`sample_rate_hz`"
            )


def _check_lines_apart(s: Scenario) -> None:
    resolution = s.radio.sample_rate_hz / s.radio.frame_samples
    n_line = s.line_hz.shape[1]
    lines = s.line_hz.ravel()
    order = np.argsort(lines)
    gap = np.diff(lines[order])
    tight = np.flatnonzero(gap < 2.0 * resolution)
    if tight.size:
        a, b = (divmod(int(order[k]), n_line) for k in (tight[0], tight[0] + 1))
        raise ValueError(
            f"lines of transmitters `{s.transmitter_ids[a[0]]}` and `{s.transmitter_ids[b[0]]}` are "
            f"{gap[tight[0]]:.6g} Hz apart and collide: a frame of {s.radio.frame_samples} samples resolves "
            f"{resolution:.6g} Hz and needs twice that; move a carrier, change a tone, or lengthen the frame"
        )


def _check_modulation(s: Scenario) -> None:
    total = sum(t.modulation_index for t in s.tone)
    if total > 1.0 + 1e-9:
        raise ValueError(
            f"the modulation indices add up to {total:.4g}; above 1 the envelope folds over: reduce `modulation_index`"
        )


def _check_simulation_names(s: Scenario) -> None:
    receivers = set(s.receiver_ids)
    for blockage in s.simulation.blocked:
        if blockage.transmitter not in s.transmitter_ids:
            raise ValueError(f"simulation.blocked names transmitter `{blockage.transmitter}`, which does not exist")
        for identifier in blockage.receivers:
            if identifier not in receivers and identifier not in s.heliostat_ids:
                raise ValueError(f"simulation.blocked names receiver `{identifier}`, which does not exist")
    for dropout in s.simulation.dropped:
        if dropout.receiver not in receivers:
            raise ValueError(f"simulation.dropped names receiver `{dropout.receiver}`, which does not exist")


def _check_clock_can_be_found(s: Scenario) -> None:
    if s.simulation.clock_offset_ppm > s.radio.clock_search_ppm:
        raise ValueError(
            f"simulation.clock_offset_ppm {s.simulation.clock_offset_ppm:g} lies outside what is searched, "
            f"radio.clock_search_ppm {s.radio.clock_search_ppm:g}; raise the latter"
        )


_CONSISTENCY: tuple[Callable[[Scenario], None], ...] = (
    _check_ids,
    _check_transmitters_apart,
    _check_modulation,
    _check_lines_in_band,
    _check_lines_apart,
    _check_simulation_names,
    _check_clock_can_be_found,
)

_LENGTH_KEYS = frozenset(
    {
        "aim_enu_m",
        "arm_m",
        "height_m",
        "pivot_enu_m",
        "pivot_sigma_m",
        "position_enu_m",
        "receiver_mirror_m",
        "reference_range_m",
        "survey_sigma_m",
        "wavelength_m",
    }
)


def _scale_lengths(node: Any, factor: float) -> None:
    """Multiply every length below ``node`` in place; a tone given by frequency has its wavelength scaled."""
    if isinstance(node, dict):
        if "modulation_index" in node and "frequency_hz" in node:
            node["frequency_hz"] = node["frequency_hz"] / factor
        for key, value in node.items():
            if key == "site":  # height above sea level is no part of the layout
                if "aim_enu_m" in value:
                    value["aim_enu_m"] = _times(value["aim_enu_m"], factor)
            elif key in _LENGTH_KEYS:
                node[key] = _times(value, factor)
            else:
                _scale_lengths(value, factor)
    elif isinstance(node, list | tuple):
        for item in node:
            _scale_lengths(item, factor)


def _times(value: Any, factor: float) -> Any:
    if isinstance(value, list | tuple):
        return [_times(item, factor) for item in value]
    return value * factor


# -- reading -------------------------------------------------------------------------------------------------


def load_scenario(path: str | Path, *, scale: float | None = None) -> Scenario:
    """Read and check a scenario file.

    Parameters
    ----------
    path
        A TOML file as described in ``docs/scenario.md``.
    scale
        Overrides the file's ``scale`` key: every length and tone wavelength is multiplied by it.

    Raises
    ------
    ScenarioError
        The file is missing, is not TOML, has unknown or mistyped keys, or contradicts itself. The message
        names the file, the key and the remedy.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise ScenarioError(f"{path}: cannot read the scenario: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise ScenarioError(f"{path}: not a text file; a scenario is TOML in UTF-8") from error
    return parse_scenario(text, source=str(path), scale=scale)


def parse_scenario(text: str, *, source: str = "scenario", scale: float | None = None) -> Scenario:
    """Check a scenario given as TOML text; see `load_scenario`. ``source`` names it in messages."""
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ScenarioError(f"{source}: not valid TOML: {error}") from error
    try:
        file_scale = data.pop("scale", 1.0)
        if not isinstance(file_scale, int | float) or isinstance(file_scale, bool):
            raise ScenarioError(f"`scale` must be a number, got {file_scale!r}")
        _fill_heliostats(data)
        scenario = Scenario.model_validate(data)
        return scenario.scaled(float(file_scale if scale is None else scale))
    except ValidationError as error:
        raise ScenarioError(f"{source}: {_in_words(error)}") from error
    except ScenarioError as error:
        raise ScenarioError(f"{source}: {error}") from error


def _fill_heliostats(data: dict[str, Any]) -> None:
    """Give each heliostat what the ``[mirror]`` table says unless it says so itself, and names its receivers."""
    mirror = Mirror.model_validate(data.pop("mirror", {})).model_dump(exclude_none=True)
    heliostats = data.get("heliostat", [])
    if not isinstance(heliostats, list):
        return
    for heliostat in heliostats:
        if not isinstance(heliostat, dict):
            continue
        for key, value in mirror.items():
            heliostat.setdefault(key, value)
        places = heliostat.get("receiver_mirror_m")
        if isinstance(places, list | tuple) and "id" in heliostat:
            heliostat.setdefault("receiver_ids", [f"{heliostat['id']}_r{k}" for k in range(len(places))])


def _in_words(error: ValidationError) -> str:
    """Put pydantic's first complaint as ``place: what is wrong``."""
    complaints = error.errors()
    # a misspelt key is also a missing one; the misspelling is the better message
    first = min(complaints, key=lambda c: c["type"] != "extra_forbidden")
    place = ""
    for part in first["loc"]:
        place += f"[{part}]" if isinstance(part, int) else f".{part}" if place else str(part)
    if first["type"] == "extra_forbidden":
        text = f"unknown key `{place}`; remove it or correct its spelling"
    elif first["type"] == "missing":
        text = f"`{place}` is missing"
    elif first["type"] == "value_error":
        reason = first["msg"].removeprefix("Value error, ")
        text = f"`{place}`: {reason}" if place else reason
    else:
        text = f"`{place}` {first['msg'][:1].lower()}{first['msg'][1:]}, got {str(first['input'])[:80]}"
    more = len(complaints) - 1
    return text + (f" (and {more} more)" if more else "")
