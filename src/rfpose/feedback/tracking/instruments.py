"""What looks at mirrors, with its errors: the simulation draws from them, the budget propagates their variances.

An error of a look is that of the mirror's normal, to its right and up.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from rfpose.checks import FloatArray
from rfpose.feedback.columns import M, columns_of
from rfpose.feedback.drone import drone_sigma_rad
from rfpose.feedback.mount import aim_rows
from rfpose.feedback.optics import reflect
from rfpose.feedback.tracking.plant import Plant
from rfpose.feedback.tracking.postures import PosturesInTime
from rfpose.feedback.tracking.radio import RadioByPosture

__all__ = ["CameraSpots", "DroneFlights", "Instrument", "RadioPoses", "RadioVariance", "measure", "plate_looks"]

_PLATE = columns_of(("receiver_plane_right_rad", "receiver_plane_up_rad"))
_DISH_SCREEN_M = 50.0
_SHARPEST_RAD = 1e-6
_SAME_RADIO = 8
"""So many looks in turn have radio errors of one covariance."""
_N_RADIO = 6
"""Postures that stand for all where radio's variance is averaged."""


class Instrument(Protocol):
    """Something that looks at all mirrors of a plant."""

    target_enu_m: FloatArray
    """(mirror, xyz) where mirrors send the sun while it looks [m]."""
    sees_spots: bool
    """It sees where the light goes, and not the normal."""
    sees_receiver_plane: bool
    """Its normals are those of the receivers' plane, not the mirror's."""

    def draw(self, looks: PosturesInTime, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """Return errors of looks (mirror, look, 2), constant ones included, and the sigma told of them [rad]."""

    def variance_rad2(self, looks: PosturesInTime) -> FloatArray:
        """Return the variance of single looks' scatter (mirror, look, 2) [rad²]."""

    def constant_variance_rad2(self) -> FloatArray:
        """Return the variance over the field of what all looks at a mirror share (mirror, 2) [rad²]."""


def plate_looks(plant: Plant) -> tuple[int, int] | None:
    """Return when a camera finds the receivers' planes, in days from the run's first, and its looks; None: never."""
    plan = plant.scenario.tracking
    if plan.radio.plate_calibration != "camera":
        return None
    return -max(int(plan.camera.interval_days // 2), 1), plan.camera.points_per_day


def measure(instrument: Instrument, looks: PosturesInTime, rng: np.random.Generator) -> FloatArray:
    """Return what an instrument measures as rows of a fit (mirror, look, row); not finite: nothing."""
    error, sigma = instrument.draw(looks, rng)
    normal = looks.tilted(error)
    if instrument.sees_spots:
        beam = reflect(normal, np.broadcast_to(looks.sun_enu, normal.shape))
        distance = np.linalg.norm(instrument.target_enu_m[:, None] - looks.centre_enu_m, axis=-1)
        spot = looks.centre_enu_m + distance[..., None] * beam
        rows = aim_rows(np.broadcast_to(looks.sun_enu, spot.shape), spot, source_is_point=False, target_is_point=True)
    else:
        rows = aim_rows(normal, normal, source_is_point=False, target_is_point=False)
    rows[..., M.sigma_rad] = sigma
    rows[..., M.of_receiver_plane] = float(instrument.sees_receiver_plane)
    return rows


class CameraSpots:
    """Centres of spots on a calibration target, seen by a camera."""

    sees_spots, sees_receiver_plane = True, False

    def __init__(self, plant: Plant) -> None:
        self._settings, self._field = plant.scenario.tracking.camera, plant.field
        self.target_enu_m = plant.field.target[:, :3].copy()
        if self._settings.target_enu_m is not None:
            self.target_enu_m[:] = self._settings.target_enu_m
        self._constant_sigma_rad = 1e-3 * self._settings.scale_error_sigma_mrad

    def sigma_rad(self, looks: PosturesInTime) -> FloatArray:
        """Return the scatter of a look in each direction (mirror, look) [rad]."""
        distance = np.linalg.norm(self.target_enu_m[:, None] - looks.centre_enu_m, axis=-1)
        if self._field.is_dish:
            distance = np.full(distance.shape, _DISH_SCREEN_M)
        return np.asarray(np.maximum(0.5e-3 * self._settings.spot_sigma_mm / distance, _SHARPEST_RAD))

    def draw(self, looks: PosturesInTime, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """See `Instrument`."""
        sigma = self.sigma_rad(looks)
        noise = sigma[..., None] * rng.standard_normal((*sigma.shape, 2))
        return noise + self._field.camera_bias_rad[:, None], sigma

    def variance_rad2(self, looks: PosturesInTime) -> FloatArray:
        """See `Instrument`."""
        return np.repeat(self.sigma_rad(looks)[..., None] ** 2, 2, axis=-1)

    def constant_variance_rad2(self) -> FloatArray:
        """See `Instrument`."""
        return np.full((len(self._field), 2), self._constant_sigma_rad**2)


class DroneFlights:
    """A drone that stands in the mirror's beam."""

    sees_spots, sees_receiver_plane = False, False

    def __init__(self, plant: Plant) -> None:
        self._settings, self._field = plant.scenario.tracking.drone, plant.field
        self.target_enu_m = plant.field.target[:, :3]
        self._constant_sigma_rad = 1e-3 * self._settings.constant_sigma_mrad

    def sigma_rad(self, looks: PosturesInTime) -> FloatArray:
        """Return the scatter of a look in each direction (mirror, look) [rad]."""
        return drone_sigma_rad(
            looks.centre_enu_m + self._settings.distance_m * looks.sun_enu,
            looks.centre_enu_m,
            target_enu_m=np.broadcast_to(self.target_enu_m[:, None], looks.centre_enu_m.shape),
        )

    def draw(self, looks: PosturesInTime, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """See `Instrument`."""
        sigma = self.sigma_rad(looks)
        noise = rng.standard_normal((*looks.count.shape[:2], 2))
        return sigma[..., None] * noise + self._field.drone_bias_rad[:, None], sigma

    def variance_rad2(self, looks: PosturesInTime) -> FloatArray:
        """See `Instrument`."""
        return np.repeat(self.sigma_rad(looks)[..., None] ** 2, 2, axis=-1)

    def constant_variance_rad2(self) -> FloatArray:
        """See `Instrument`."""
        return np.full((len(self._field), 2), self._constant_sigma_rad**2)


class RadioVariance(NamedTuple):
    """What to expect of radio normals over some postures, right and up (mirror, 2) [rad²]."""

    noise: FloatArray
    """Variance of a frame."""
    bias: FloatArray
    """Square of what a reflection does that is not in the pose solver's model."""


class RadioPoses:
    """Normals of the receivers' plane by radio."""

    sees_spots, sees_receiver_plane = False, True

    def __init__(self, plant: Plant, radio: RadioByPosture) -> None:
        self._plant, self._field, self._radio = plant, plant.field, radio
        self.target_enu_m = plant.field.target[:, :3]

    def draw(self, looks: PosturesInTime, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """See `Instrument`; NaN: no pose."""
        plate = self._field.true[:, _PLATE]
        out = np.empty((*looks.count.shape[:2], 2))
        for j in range(looks.count.shape[1]):
            if j % _SAME_RADIO == 0:
                errors = self._radio.errors(np.nan_to_num(looks.normal_enu[:, j], nan=0.577), rng)
            noise = rng.standard_normal((len(plate), 2))
            spread = errors.spread_rad
            drift = self._field.plate_drift_rad * looks.heat[j]
            out[:, j, 0] = plate[:, 0] + drift + errors.bias_rad[:, 0] + spread[:, 0] * noise[:, 0]
            out[:, j, 1] = plate[:, 1] + errors.bias_rad[:, 1] + spread[:, 1] * noise[:, 0] + spread[:, 2] * noise[:, 1]
            out[~errors.solved, j] = np.nan
        return out, np.maximum(errors.sigma_rad / np.sqrt(2.0), _SHARPEST_RAD)[:, None]

    def expected(self, looks: PosturesInTime) -> RadioVariance:
        """Return the mean over postures, as far as they have poses."""
        rng = np.random.default_rng(0)
        noise, bias = [], []
        for i in np.linspace(0, looks.count.shape[1] - 1, _N_RADIO).astype(np.int64):
            errors = self._radio.errors(looks.normal_enu[:, i], rng)
            spread = np.where(errors.solved[:, None], errors.spread_rad, np.nan)
            noise.append(np.stack([spread[:, 0] ** 2, spread[:, 1] ** 2 + spread[:, 2] ** 2], axis=-1))
            bias.append(errors.bias_rad**2)
        known = np.isfinite(noise)
        mean = np.sum(np.nan_to_num(noise), axis=0) / np.maximum(known.sum(axis=0), 1)
        return RadioVariance(noise=mean, bias=np.mean(bias, axis=0))

    def variance_rad2(self, looks: PosturesInTime) -> FloatArray:
        """See `Instrument`."""
        return np.broadcast_to(self.expected(looks).noise[:, None], (*looks.count.shape[:2], 2))

    def constant_variance_rad2(self) -> FloatArray:
        """See `Instrument`: the receivers' plane against the mirror, as far as its calibration leaves it unknown."""
        found = plate_looks(self._plant)
        if found is None:
            sigma = 1e-3 * self._plant.scenario.tracking.radio.plate_sigma_mrad
            return np.full((len(self._field), 2), sigma**2)
        camera = CameraSpots(self._plant)
        looks = self._plant.nominal_looks(*found, camera.target_enu_m)
        seen = np.mean(camera.variance_rad2(looks), axis=1)
        return np.asarray((seen + self.expected(looks).noise) / found[1] + camera.constant_variance_rad2())

    def drift_sigma_rad(self, heat: FloatArray) -> FloatArray:
        """Return what warmth turns the receivers' planes by, to the right, since they were found (time,) [rad]."""
        plan, found = self._plant.scenario.tracking, plate_looks(self._plant)
        if found is not None:
            heat = heat - np.mean(self._plant.nominal_looks(*found, self.target_enu_m).heat)
        return np.asarray(1e-3 * plan.radio.plate_drift_mrad * heat)
