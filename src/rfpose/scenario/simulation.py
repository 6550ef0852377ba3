"""How a recording of the site is simulated: the ``[simulation]`` table."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from rfpose.errors import InvalidInputError
from rfpose.scenario.records import MAX_START_UNIX_S, Identifier, NonNegative, Positive, Record
from rfpose.sun import unix_seconds


class Ground(Record):
    """A level ground that reflects each transmitter as its mirror image (simulation)."""

    coefficient: tuple[float, float]
    """Complex reflection coefficient at RF: real and imaginary part."""
    height_m: float = 0.0


class Blockage(Record):
    """One transmitter hidden from some receivers for some frames (simulation)."""

    transmitter: Identifier
    receivers: tuple[Identifier, ...] = ()
    """Receiver or heliostat identifiers; empty means all."""
    first_frame: Annotated[int, Field(ge=0)] = 0
    last_frame: Annotated[int, Field(ge=0)] = 2**31
    attenuation_db: NonNegative = 200.0


class Dropout(Record):
    """Samples that one receiver lost (simulation): an explicit gap in the recording."""

    receiver: Identifier
    frame: Annotated[int, Field(ge=0)]
    first_sample: Annotated[int, Field(ge=0)]
    sample_count: Annotated[int, Field(gt=0)]


FileName = Annotated[str, Field(min_length=1, max_length=4096)]
PathPattern = Annotated[str, Field(min_length=1, max_length=200)]


class Simulation(Record):
    """How `rfpose simulate` makes a recording of this scenario."""

    @model_validator(mode="before")
    @classmethod
    def _starts_at_a_time(cls, data: Any) -> Any:
        """Take ``start``, a time of day and date, for the seconds that count."""
        if not isinstance(data, Mapping) or "start" not in data:
            return data
        rest = {key: value for key, value in data.items() if key != "start"}
        try:
            seconds = float(unix_seconds([data["start"]])[0])
        except InvalidInputError as error:
            raise ValueError(f"`start`: {error}") from error
        if seconds != round(seconds):
            raise ValueError(f"`start` must be a whole second, got {data['start']}")
        return {**rest, "start_unix_s": round(seconds)}

    frame_count: Annotated[int, Field(gt=0)] = 4
    frame_interval_s: NonNegative = 0.0
    """Start to start; zero records frames back to back."""
    start_unix_s: Annotated[int, Field(ge=0, le=MAX_START_UNIX_S)] = 1_782_043_200
    """First sample, in whole seconds since 1970 UTC; a file may give it as ``start``, a date and time."""
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
    """One value, or the values at the first and the last frame; without both the sun follows from site and time."""
    sun_elevation_deg: float | tuple[float, float] | None = None
    ground: Ground | None = None
    blocked: tuple[Blockage, ...] = ()
    dropped: tuple[Dropout, ...] = ()
    paths: FileName | tuple[FileName, ...] | None = None
    """Ray tables instead of rays from geometry: one file, or one a frame (docs/ray-tables.md)."""
    path_antenna: Literal["isotropic", "dipole_y"] = "isotropic"
    """What receives the rays of ``paths``."""
    paths_without: tuple[PathPattern, ...] = ()
    """Rays of ``paths`` that met such a thing are left out: shell patterns of the steps of their codes."""

    @model_validator(mode="after")
    def _paths_alone(self) -> Self:
        if self.paths is None:
            for key in ("path_antenna", "paths_without"):
                if getattr(self, key) != type(self).model_fields[key].default:
                    raise ValueError(f"`simulation.{key}` is about `simulation.paths`: give both, or neither")
            return self
        if self.ground is not None:
            raise ValueError("`simulation.paths` holds the ground's rays, too: leave `simulation.ground` out")
        if self.path_loss != "none":
            raise ValueError("`simulation.paths` holds the loss of each ray: leave `simulation.path_loss` out")
        if isinstance(self.paths, tuple) and len(self.paths) not in (1, self.frame_count):
            raise ValueError(
                f"`simulation.paths` must be one file, or one a frame: got {len(self.paths)} files and "
                f"`simulation.frame_count` = {self.frame_count}"
            )
        return self
