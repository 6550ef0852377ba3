"""How a field is tracked in simulation: the ``[tracking]`` table and what stands below it."""

from __future__ import annotations

import datetime
import itertools
import math
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

    @property
    def step_rad(self) -> float:
        """Of the axis, for the steps that a motor takes together."""
        return 2.0 * math.pi / self.steps_per_turn * self.microsteps


class Wind(Record):
    """Steady wind with gusts after Edwards (5.24), and how far it bends a mirror."""

    mean_speed_mps: NonNegative = 4.0
    record: str | None = None
    """CSV of measured speeds instead; its path from where the command is run."""
    deflection_mrad_per_mps2: Two = (0.003, 0.006)
    """Of the normal, sideways and up, by a steady wind of 1 m/s; it grows with the square of the speed."""


class Structure(Record):
    """What lies between drive and mirror: one mode of vibration (Edwards 6.1), stirred by wind and motors."""

    natural_hz: NonNegative = 2.2
    """At least 0.5, since gusts bend it as if it were stiff (5.20); 0: it does not swing. Not a multiple of
    the servo's rate, whose samples would see it stand."""
    damping: Annotated[float, Field(gt=0, lt=1)] = 0.02

    @model_validator(mode="after")
    def _faster_than_gusts(self) -> Self:
        if 0.0 < self.natural_hz < 0.5:
            raise ValueError(
                f"`natural_hz` must be 0 (stiff) or at least 0.5, got {self.natural_hz:g}: a softer structure follows "
                "gusts less than this simulation would have it"
            )
        return self


class Aperture(Record):
    """What catches the light."""

    image_ratio: Annotated[float, Field(gt=0, le=8)] = 1.0
    """Heliostats: radius of the receiver's aperture over that of a mirror's image; 1 is Malan's (3.3)."""
    h_per_deg: Positive = 3.9
    """Dishes: accuracy of the contour (Edwards, ch. 4)."""
    rim_deg: Annotated[float, Field(gt=0, le=90)] = 60.0
    area_ratio: Positive | None = None
    """Dishes: area of the dish over that of the cavity's aperture; none: the cavity that suits a perfect follower."""
    loss_w_per_m2: Positive = 2e5
    """Dishes: what a square metre of the cavity's aperture loses; chooses the cavity."""


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
    outages: Annotated[tuple[Outage, ...], Field(max_length=255)] = ()
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

    @property
    def level_rad(self) -> float:
        """Width of a level."""
        return 2.0 * math.pi / 2.0**self.bits


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

    @property
    def level_rad(self) -> float:
        """Width of a level."""
        return 2e-3 * self.range_mrad / self.levels


class RadioModel(Record):
    """What radio teaches the model of the mount."""

    interval_days: Positive = 1.0
    """Method ``radio-model``: between two fits to a day's normals."""
    points_per_day: Annotated[int, Field(ge=8)] = 60
    learn_interval_s: Positive = 60.0
    """Method ``radio-both``: between two steps of the rolling fit."""
    forget_mrad_per_sqrt_day: NonNegative = 0.05
    """Random walk that the rolling fit allows each parameter."""


class Bus(Record):
    """Messages between the centre, clusters and heliostats (Malan), and how badly they travel."""

    cluster_size: Annotated[int, Field(ge=1, le=254)] = 32
    baud: Positive = 9600.0
    lost: Annotated[float, Field(ge=0, lt=1)] = 0.01
    bit_error_rate: Annotated[float, Field(ge=0, lt=1)] = 0.0
    late: Annotated[float, Field(ge=0, lt=1)] = 0.0
    late_s: Positive = 0.5
    """Mean delay of late messages."""


class FieldControl(Record):
    """Centre, clusters and local controllers, from stow in the morning to stow in the evening."""

    bus: Bus = Bus()
    between_messages: Literal["carried-on", "held"] = "carried-on"
    """Whether mirrors carry the sun that they heard on by the clock, or stand until they hear of it again (Malan)."""
    watchdog_intervals: Positive = 3.0
    wind_average_s: Positive = 600.0
    """Wind for stow is averaged over so long."""
    wind_stow_mps: Positive = 10.0
    wind_release_mps: Positive = 8.0
    wind_release_s: Positive = 600.0
    emergency_hold_s: NonNegative = 30.0
    defocus_offset_m: Positive = 15.0
    stow_deg: tuple[float, float] = (0.0, 0.0)
    """Azimuth and elevation of the park position; Malan's: north, level."""
    calibration_target_enu_m: tuple[float, float, float] | None = None
    """Without it `camera.target_enu_m`; without both no calibration and no search."""
    calibration_target_m: Positive = 2.0
    """Its side."""
    calibration_dwell_s: Positive = 60.0
    """How long a mirror stays on the target before the camera looks (Berenguel: 18 to 60 s)."""
    search_cells: Annotated[int, Field(ge=1)] = 81
    search_dwell_s: Positive = 5.0
    homing_sigma_mrad: NonNegative = 20.0
    """Error of each axis' zero after its counts were lost and it was homed."""


EventKind = Literal[
    "stow", "approach", "point", "track", "calibrate", "defocus", "refocus", "hold", "zero-counts",
    "emergency", "release", "cluster-fails", "cluster-returns", "centre-fails", "centre-returns",
    "power-fails", "power-returns", "counts-lost",
]  # fmt: skip
OF_THE_FIELD = ("emergency", "release", "centre-fails", "centre-returns")
OF_A_CLUSTER = ("cluster-fails", "cluster-returns")
_ENDS = {"release", "cluster-returns", "centre-returns", "power-returns"}


class Event(Record):
    """Something that happens to the field, or an order to it."""

    hour: Hour
    """Local mean solar time."""
    what: EventKind
    day: Annotated[int, Field(ge=1)] | None = None
    """Number of the simulated day, from 1; none: every day."""
    heliostats: tuple[str, ...] = ()
    """By name; none: all."""
    cluster: Annotated[int, Field(ge=0)] | None = None
    """Number of a cluster, from 0; for what happens to clusters, or instead of `heliostats`."""

    @model_validator(mode="after")
    def _names_whom(self) -> Self:
        if self.what in OF_A_CLUSTER and self.cluster is None:
            raise ValueError(f"event `{self.what}` at {self.hour:g} h needs the number of a `cluster`")
        if self.what in OF_THE_FIELD and (self.heliostats or self.cluster is not None):
            raise ValueError(f"event `{self.what}` at {self.hour:g} h concerns the whole field; name nobody")
        if self.heliostats and self.cluster is not None:
            raise ValueError(f"event `{self.what}` at {self.hour:g} h names both `heliostats` and a `cluster`")
        return self

    def contradicts(self, other: Event) -> bool:
        """Whether two events of the same time cannot both be meant."""
        same_time = self.hour == other.hour and (self.day is None or other.day is None or self.day == other.day)
        if not same_time or self.what == other.what or self.what in _ENDS or other.what in _ENDS:
            return False
        if self.what in OF_A_CLUSTER or other.what in OF_A_CLUSTER or self.what.startswith("centre"):
            return False
        whole = not self.heliostats and self.cluster is None, not other.heliostats and other.cluster is None
        shared = set(self.heliostats) & set(other.heliostats) or (self.cluster == other.cluster is not None)
        return any(whole) or bool(shared)


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
    sky: Literal["clear", "bursts", "record"] = "clear"
    """Bursts: every second day or so in clouds, as at Griffith (Edwards, App. B); record: as `beam_record` has it."""
    beam_record: str | None = None
    """CSV of measured direct normal irradiance; its path from where the command is run."""
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
    structure: Structure = Structure()
    aperture: Aperture = Aperture()
    field_control: FieldControl | None = None
    """None: mirrors track from the first second, without modes and messages."""
    event: tuple[Event, ...] = ()
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
        if (self.sky == "record") != (self.beam_record is not None):
            raise ValueError('`sky = "record"` and `beam_record` belong together; give both or none')
        if not self.inner_radius_m < self.field_radius_m:
            raise ValueError("`inner_radius_m` must be less than `field_radius_m`")
        return self

    @model_validator(mode="after")
    def _events_make_sense(self) -> Self:
        if self.event and self.field_control is None:
            raise ValueError("[[tracking.event]] needs field control to act on; add a table [tracking.field_control]")
        control = self.field_control
        if control is not None and control.wind_release_mps > control.wind_stow_mps:
            raise ValueError(
                f"`wind_release_mps` {control.wind_release_mps:g} must not exceed `wind_stow_mps` "
                f"{control.wind_stow_mps:g}"
            )
        low, high = self.drive.elevation_limits_deg
        if control is not None and not low <= control.stow_deg[1] <= high:
            raise ValueError(
                f"[tracking.field_control] `stow_deg` has an elevation of {control.stow_deg[1]:g} degrees, beyond the "
                f"drive's limits of {low:g} to {high:g}"
            )
        for one, other in itertools.combinations(self.event, 2):
            if one.contradicts(other):
                raise ValueError(
                    f"events `{one.what}` and `{other.what}` contradict each other: both at {one.hour:g} h for the "
                    "same mirrors; give them different times or mirrors"
                )
        for event in self.event:
            if event.day is not None and event.day > self.days:
                raise ValueError(f"event `{event.what}` is on day {event.day}, and only {self.days} are simulated")
            if self.collector == "dish" and event.what in ("calibrate", "defocus", "refocus"):
                raise ValueError(f"event `{event.what}` is for heliostats; dishes stow or have an emergency")
            if event.what == "calibrate" and self.calibration_target_enu_m is None:
                raise ValueError(
                    "event `calibrate` needs a target: set [tracking.field_control] `calibration_target_enu_m`"
                )
        return self

    @property
    def calibration_target_enu_m(self) -> tuple[float, float, float] | None:
        """Where mirrors calibrate while the field tracks [m]; none: nowhere."""
        if self.field_control is not None and self.field_control.calibration_target_enu_m is not None:
            return self.field_control.calibration_target_enu_m
        return self.camera.target_enu_m
