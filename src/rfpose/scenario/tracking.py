"""How a field is tracked in simulation: the ``[tracking]`` table and what stands below it."""

from __future__ import annotations

import datetime
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from rfpose.scenario.records import NonNegative, Positive, Record

Share = Annotated[float, Field(ge=0, le=1)]
Hour = Annotated[float, Field(ge=0, le=24)]
Two = tuple[NonNegative, NonNegative]


class MountErrors(Record):
    """What is wrong with the mounts and nobody knows: standard deviations over the field, each mirror its own draw."""

    tilt_sigma_mrad: NonNegative = 2.0
    """Pedestal, towards north and towards east."""
    zero_sigma_mrad: NonNegative = 2.0
    nonorthogonality_sigma_mrad: NonNegative = 1.0
    canting_sigma_mrad: NonNegative = 0.5
    location_sigma_mm: NonNegative = 10.0
    worm_sigma_mrad: NonNegative = 0.3
    """Amplitude of the error once a turn of the worm, of each axis."""
    sag_sigma_mrad: NonNegative = 0.2
    thermal_sigma_mrad: NonNegative = 0.1
    """Amplitude of the pedestal's daily lean."""
    creep_sigma_mrad_per_month: NonNegative = 0.05
    """Lean of the foundation, steady."""
    fixed: dict[str, float] = Field(default_factory=dict)
    """Parameters of the mount by name that all mirrors have alike [rad, m], instead of a draw."""


class Drive(Record):
    """Motors and gears of both axes."""

    steps_per_turn: Positive = 48_000.0
    microsteps: Annotated[int, Field(ge=1)] = 1
    """Steps that a motor always takes together: 8 is Malan's full-step mode."""
    speed_mradps: Positive = 10.0
    backlash_mrad: Two = (0.1, 0.05)
    stiction_mrad: Two = (0.0, 0.0)
    """How far a drive winds up before the axis breaks loose."""
    dead_band_steps: NonNegative = 0.0
    """A motor waits until it is further than this from where it should be; 0: half a step."""
    worm_ratio: NonNegative = 30.0
    elevation_limits_deg: tuple[float, float] = (-5.0, 95.0)
    azimuth_limits_deg: tuple[float, float] = (-540.0, 540.0)
    """From the middle of each mirror's travel on the first day."""


class Wind(Record):
    """Steady wind with gusts after Edwards (5.24), and how far it bends a mirror."""

    mean_speed_mps: NonNegative = 4.0
    record: str | None = None
    """CSV of measured speeds instead; its path from where the command is run."""
    deflection_mrad_per_mps2: Two = (0.003, 0.006)
    """Of the normal, sideways and up, by a steady wind of 1 m/s; it grows with the square of the speed."""


class Outage(Record):
    """Radio lost for a while."""

    first_hour: Hour
    last_hour: Hour
    """Local mean solar time."""
    share: Share = 1.0
    """Part of the mirrors."""

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if not self.first_hour < self.last_hour:
            raise ValueError(f"`first_hour` {self.first_hour:g} must be before `last_hour` {self.last_hour:g}")
        return self


class RadioFeedback(Record):
    """Mirror normals by radio, as the control loop gets them."""

    latency_s: NonNegative = 1.0
    lost_frames: Share = 0.1
    hidden_transmitters: Share = 0.0
    """Part of the pairs of mirror and transmitter that are without line of sight, drawn anew every 15 minutes."""
    outages: tuple[Outage, ...] = ()
    tone_snr_db: float | None = None
    """Instead of that of ``[simulation]``."""
    ground: Literal["none", "estimated", "ignored"] = "estimated"
    """What the pose solver does about the reflection of ``[simulation.ground]``."""
    plate_sigma_mrad: NonNegative = 0.6
    """Receivers' plane against the mirror, each of two directions: survey of the receivers, mounting of the plate."""
    plate_calibration: Literal["camera", "none"] = "camera"
    """Whether the camera's first day also finds that tilt."""
    plate_drift_mrad: NonNegative = 0.0
    """Amplitude of its daily change, which nothing finds."""
    gain_per_s: NonNegative = 0.06
    integral_gain_per_s2: NonNegative = 0.0004
    force_gains: bool = False
    """Run with gains that leave no margin."""


class Camera(Record):
    """Spots on a calibration target, seen by a camera."""

    target_enu_m: tuple[float, float, float] | None = None
    """Centre of the target; without it the aim point."""
    spot_sigma_mm: NonNegative = 30.0
    """Scatter of a measured centre, each direction."""
    scale_error_sigma_mrad: NonNegative = 0.05
    """Constant error of a mirror's normal from the target's survey and the camera's rectification."""
    interval_days: Positive = 90.0
    """Between two calibration days of a mirror."""
    worm: bool = False
    """Whether the fitted model also has the worm gears' periodic error."""
    points_per_day: Annotated[int, Field(ge=1)] = 16
    bias_interval_days: Positive = 1.0
    """Between two looks at a mirror for method ``bias``."""
    berenguel_interval_days: Positive = 7.0
    berenguel_tolerance_mm: NonNegative = 74.0
    """How near the middle counts as there."""
    berenguel_corrections: Annotated[int, Field(ge=1)] = 3


class Drone(Record):
    """Calibration by drone (Gouws)."""

    distance_m: Positive = 32.0
    """From the mirror to the drone; the noise is that of Gouws' GPS seen from there."""
    constant_sigma_mrad: NonNegative = 0.05
    interval_days: Positive = 30.0
    points: Annotated[int, Field(ge=4)] = 20


class Encoder(Record):
    """Encoders on the axes of the mirror."""

    bits: Annotated[int, Field(ge=8, le=26)] = 16
    gain_per_s: NonNegative = 0.5


class SunSensor(Record):
    """Shadow-bar sensor on a dish (Edwards, App. F)."""

    range_mrad: Positive = 5.0
    """Saturates at plus and minus this."""
    levels: Annotated[int, Field(ge=2)] = 32
    offset_sigma_mrad: NonNegative = 0.3
    """Null against the optical axis, constant."""
    drift_mrad: NonNegative = 0.5
    """Over a day."""
    gain_per_s: NonNegative = 0.2
    integral_gain_per_s2: NonNegative = 0.01


class RadioModel(Record):
    """What radio teaches the model of the mount."""

    interval_days: Positive = 1.0
    """Method ``radio-model``: between two fits to a day's normals."""
    points_per_day: Annotated[int, Field(ge=8)] = 60
    learn_interval_s: Positive = 60.0
    """Method ``radio-both``: between two steps of the rolling fit."""
    forget_mrad_per_sqrt_day: NonNegative = 0.05
    """Random walk that the rolling fit allows each parameter."""


class Tracking(Record):
    """What `rfpose track` simulates."""

    date: datetime.date = datetime.date(2026, 3, 20)
    days: Annotated[int, Field(ge=1)] = 1
    day_interval: Annotated[int, Field(ge=1)] = 1
    """Days from one simulated day to the next; 30 with ``days`` 12 is a year."""
    collector: Literal["heliostat", "dish"] = "heliostat"
    field_radius_m: Positive = 100.0
    """Where ``--heliostats`` puts mirrors that the scenario does not list."""
    inner_radius_m: NonNegative = 10.0
    sky: Literal["clear", "bursts"] = "clear"
    """Bursts: every second day or so in clouds, as at Griffith (Edwards, App. B)."""
    servo_interval_s: Positive = 1.0
    control_interval_s: Positive = 4.0
    first_hour: Hour = 0.0
    last_hour: Hour = 24.0
    """Local mean solar time within which the field tracks."""
    min_sun_elevation_deg: Annotated[float, Field(ge=0, lt=90)] = 10.0
    settle_s: NonNegative = 120.0
    """Not scored, at the beginning of each day."""
    mirror_area_m2: Positive = 4.0
    slope_error_mrad: NonNegative = 1.5
    stored: Annotated[int, Field(ge=0)] = 8
    """Mirrors whose courses are kept."""
    store_interval_s: Positive = 60.0
    mount_errors: MountErrors = MountErrors()
    drive: Drive = Drive()
    wind: Wind = Wind()
    radio: RadioFeedback = RadioFeedback()
    camera: Camera = Camera()
    drone: Drone = Drone()
    encoder: Encoder = Encoder()
    sun_sensor: SunSensor = SunSensor()
    radio_model: RadioModel = RadioModel()

    @model_validator(mode="after")
    def _intervals_fit(self) -> Self:
        for name in ("control_interval_s", "store_interval_s"):
            ratio = getattr(self, name) / self.servo_interval_s
            if abs(ratio - round(ratio)) > 1e-9 or round(ratio) < 1:
                raise ValueError(
                    f"`{name}` {getattr(self, name):g} must be a multiple of `servo_interval_s` "
                    f"{self.servo_interval_s:g}"
                )
        ratio = self.store_interval_s / self.control_interval_s
        if abs(ratio - round(ratio)) > 1e-9:
            raise ValueError("`store_interval_s` must be a multiple of `control_interval_s`")
        if not self.first_hour < self.last_hour:
            raise ValueError(f"`first_hour` {self.first_hour:g} must be before `last_hour` {self.last_hour:g}")
        if not self.inner_radius_m < self.field_radius_m:
            raise ValueError("`inner_radius_m` must be less than `field_radius_m`")
        return self
