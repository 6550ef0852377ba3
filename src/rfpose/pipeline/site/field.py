"""What the antennas of a group of mirrors would receive in given poses: foreseen rays, weighed by the antennas."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np
import numpy.typing as npt

from rfpose import geometry
from rfpose.antenna import AntennaPattern, PatternTable, dipole_pattern, grid_directions
from rfpose.checks import FloatArray
from rfpose.errors import InvalidInputError, ScenarioError
from rfpose.multilat.site import Common, Voltages
from rfpose.pipeline.mirrors import MirrorGroup
from rfpose.propagation import Foresight, Rays, ReceiverStand, Soil, Surroundings, foresee
from rfpose.propagation.site import place_things
from rfpose.scenario import Scenario

__all__ = ["ReceivingAntenna", "SiteField", "VerticalAntenna", "antenna_of", "foresight_of"]

ComplexArray = npt.NDArray[np.complex128]
IntArray = npt.NDArray[np.int64]

_VACUUM_PERMITTIVITY = 8.8541878128e-12
_SOIL_STEP = 1e-3
"""Relative change of the permittivity by which rays' slope with it is found."""
_CERTAIN = 0.0
"""Relative uncertainty of the permittivity at which nobody asks for its slope."""
_SAME_POINT_M = 1e-4


class ReceivingAntenna(Protocol):
    """What the receivers of a mirror make of waves."""

    @property
    def strength(self) -> float:
        """Voltage of a unit field, over all directions, rms."""

    @property
    def holds_own_plate(self) -> bool:
        """Whether what the mirror's own plate does is in it already."""

    def receive(
        self,
        field_enu: ComplexArray,
        towards_enu: FloatArray,
        rot: FloatArray,
        receiver: IntArray,
        transmitter: IntArray,
    ) -> tuple[ComplexArray, ComplexArray, FloatArray]:
        """Return voltages (ray,), their slopes by a turn of the mirror (ray, xyz) and their errors (ray,).

        Parameters
        ----------
        field_enu : (ray, xyz)
        towards_enu : (ray, xyz)
            Unit vectors from the receiver to where the ray comes from.
        rot : (ray, 3, 3)
            Orientation of the mirror, to ENU from the mirror frame.
        receiver, transmitter : (ray,)
            Which of the mirror's receivers, and whose carrier.
        """


@dataclass(frozen=True, slots=True)
class VerticalAntenna:
    """Answers alike to vertically polarised waves from all directions, however the mirror stands."""

    @property
    def strength(self) -> float:
        """See `ReceivingAntenna`."""
        return 1.0

    @property
    def holds_own_plate(self) -> bool:
        """See `ReceivingAntenna`."""
        return False

    def receive(
        self,
        field_enu: ComplexArray,
        towards_enu: FloatArray,
        rot: FloatArray,
        receiver: IntArray,
        transmitter: IntArray,
    ) -> tuple[ComplexArray, ComplexArray, FloatArray]:
        """See `ReceivingAntenna`."""
        voltage = (field_enu * _theta_hat(towards_enu)).sum(axis=1)
        return voltage, np.zeros((len(voltage), 3), np.complex128), np.zeros(len(voltage))


@dataclass(frozen=True, slots=True)
class PatternAntenna:
    """Answers as a pattern says, fixed to the mirror.

    Attributes
    ----------
    table
        Of all receivers at the carrier of the first transmitter, then at that of the second, and so on.
    n_receiver
        Of a mirror.
    strength, holds_own_plate
        See `ReceivingAntenna`.
    """

    table: PatternTable
    n_receiver: int
    strength: float
    holds_own_plate: bool

    @classmethod
    def of(cls, pattern: AntennaPattern, carrier_rf_hz: FloatArray, *, holds_own_plate: bool) -> PatternAntenna:
        """Return the antenna at the transmitters' carriers: before a plate, half a per cent of frequency matters."""
        tables = [pattern.table(f) for f in carrier_rf_hz.tolist()]
        n_polar = 19
        towards = grid_directions(n_polar, 36).reshape(-1, 3)
        weight = np.repeat(np.sin(np.linspace(0.0, np.pi, n_polar)), 36)
        first = tables[0]
        power = [(np.abs(first.vector(towards, r)) ** 2).sum(axis=1) @ weight for r in range(first.n_receiver)]
        table = PatternTable(
            coefficient=np.concatenate([t.coefficient for t in tables]), sigma=np.concatenate([t.sigma for t in tables])
        )
        return cls(table, first.n_receiver, float(np.sqrt(0.5 * np.mean(power) / weight.sum())), holds_own_plate)

    def receive(
        self,
        field_enu: ComplexArray,
        towards_enu: FloatArray,
        rot: FloatArray,
        receiver: IntArray,
        transmitter: IntArray,
    ) -> tuple[ComplexArray, ComplexArray, FloatArray]:
        """See `ReceivingAntenna`."""
        field = np.einsum("kba,kb->ka", rot, field_enu)
        towards = np.einsum("kba,kb->ka", rot, towards_enu)
        vector, slope, sigma = self.table.vector_and_slope(towards, transmitter * self.n_receiver + receiver)
        out = np.empty((len(field), 3), np.complex128)
        for q, axis in enumerate(np.eye(3)):
            # the world turns the other way about the mirror: x in the mirror's frame changes by Rᵀ (x × axis)
            turned_field = np.einsum("kba,kb->ka", rot, np.cross(field_enu, axis))
            turned_towards = np.einsum("kba,kb->ka", rot, np.cross(towards_enu, axis))
            out[:, q] = (turned_field * vector).sum(axis=1)
            out[:, q] += np.einsum("ka,kab,kb->k", field, slope, turned_towards)
        return (field * vector).sum(axis=1), out, sigma * np.linalg.norm(field, axis=1)


def antenna_of(scenario: Scenario) -> ReceivingAntenna:
    """Return the antennas of a scenario's mirrors, from ``[antenna]``.

    Raises
    ------
    ScenarioError
        A pattern of other receivers than those of a mirror.
    RecordingError
        The pattern's file is missing or damaged.
    """
    table = scenario.antenna
    if table.pattern is not None:
        path, version = str(table.pattern), _version_of(table.pattern)
        pattern = _pattern(path, version)
        try:
            for heliostat in scenario.heliostat:
                pattern.check_receivers(heliostat.receiver_mirror_m)
            return _antenna(path, version, tuple(scenario.carrier_rf_hz.tolist()))
        except InvalidInputError as error:
            raise ScenarioError(f"{table.pattern}, scenario `{scenario.name}`: {error}") from error
    if table.receiver == "dipole":
        mean_hz = float(scenario.carrier_rf_hz.mean())
        # alike in all places: as many as the mirror with most receivers has
        places = max((heliostat.receiver_mirror_m for heliostat in scenario.heliostat), key=len)
        pattern = dipole_pattern(places, table.axis_mirror, mean_hz)
        return PatternAntenna.of(pattern, np.full(len(scenario.transmitter), mean_hz), holds_own_plate=False)
    return VerticalAntenna()


def foresight_of(scenario: Scenario, *, own_plate: bool) -> Foresight:
    """Return which rays a scenario wants foreseen, those off the mirror's own plate only if they are asked for."""
    table = scenario.multipath
    return Foresight(
        visibility=table.visibility,
        ground="ground" in table.foresee,
        specular="specular" in table.foresee,
        diffracted=table.edges if "diffracted" in table.foresee else "none",
        wedge=table.wedge,
        own_plate=own_plate and "own_plate" in table.foresee,
        reach_m=table.reach_m,
        antenna=scenario.antenna.transmitter,
        propagation_speed_mps=scenario.radio.propagation_speed_mps,
    )


def _version_of(path: str | Path) -> tuple[int, int] | None:
    """Tell one content of a file from another; None where there is none, of which its reader says so."""
    try:
        found = Path(path).stat()
    except OSError:
        return None
    return found.st_mtime_ns, found.st_size


# studies of a site ask for the same pattern again and again
@functools.lru_cache(maxsize=4)
def _pattern(path: str, version: tuple[int, int] | None) -> AntennaPattern:
    from rfpose.pipeline.formats.antenna_file import read_pattern  # loads HDF5, which layout studies mostly do without

    return read_pattern(path).pattern


@functools.lru_cache(maxsize=4)
def _antenna(path: str, version: tuple[int, int] | None, carrier_rf_hz: tuple[float, ...]) -> PatternAntenna:
    return PatternAntenna.of(_pattern(path, version), np.array(carrier_rf_hz), holds_own_plate=True)


class SiteField:
    """Rays and voltages of a group of mirrors, all frames, for `rfpose.multilat.site.fit_site`."""

    def __init__(
        self, scenario: Scenario, group: MirrorGroup, commanded_rot: FloatArray, antenna: ReceivingAntenna
    ) -> None:
        """Take the orientations that were commanded (frame, mirror, 3, 3), mirrors as `Scenario.mirrors` has them."""
        self._scenario, self._group, self._antenna = scenario, group, antenna
        self._commanded = commanded_rot
        self._options = foresight_of(scenario, own_plate=not antenna.holds_own_plate)

    def __call__(self, pivot_enu_m: FloatArray, rot: FloatArray, common: Common) -> Voltages:
        """Return what the mirrors would receive; the first axis is frame × heliostat of the group."""
        n_frame, n_helio = len(self._commanded), len(self._group.column)
        pivot = pivot_enu_m.reshape(n_frame, n_helio, 3)
        turned = rot.reshape(n_frame, n_helio, 3, 3)
        parts = [self._frame(pivot[f], turned[f], self._commanded[f], common) for f in range(n_frame)]
        return _joined(parts)

    def _frame(self, pivot: FloatArray, rot: FloatArray, commanded: FloatArray, common: Common) -> Voltages:
        scenario, group = self._scenario, self._group
        standing = commanded.copy()
        known = np.isfinite(rot).all(axis=(1, 2))
        standing[group.column[known]] = rot[known]
        # a plate moves with its receivers, or they would stand before it where they do not
        pivots = np.full((len(standing), 3), np.nan)
        pivots[group.column] = pivot
        found = place_things(scenario, standing, pivot_enu_m=pivots)
        stand = ReceiverStand(
            pivot_enu_m=pivot,
            rot_enu_from_mirror=rot,
            receiver_mirror_m=group.places_m,
            own_plate=found.own_plate[group.column],
        )
        things = _with_soil(found.surroundings, common.soil_change, scenario)
        rays = self._rays(stand, things)
        link = np.repeat(np.arange(len(rays.first) - 1), np.diff(rays.first))
        at_receiver, transmitter = np.divmod(link, len(scenario.transmitter))
        mirror, receiver = np.divmod(at_receiver, group.places_m.shape[1])
        towards = _towards(rays, pivot[mirror], rot[mirror], group.places_m[mirror, receiver])
        voltage, slope, error = self._antenna.receive(rays.field_enu, towards, rot[mirror], receiver, transmitter)
        vague = np.zeros(len(rays.first) - 1)
        np.add.at(vague, link, error**2)
        certain = max(common.soil_sigma) <= _CERTAIN
        soil_slope = np.zeros(rays.n_ray, np.complex128) if certain else self._soil_slope(stand, things, rays)
        return Voltages(rays=rays, voltage=voltage, slope=slope, soil_slope=soil_slope, vague=vague, reference_rot=rot)

    def _rays(self, stand: ReceiverStand, things: Surroundings) -> Rays:
        scenario = self._scenario
        return foresee(scenario.transmitter_enu_m, scenario.carrier_rf_hz, stand, things, self._options)

    def _soil_slope(self, stand: ReceiverStand, things: Surroundings, rays: Rays) -> ComplexArray:
        """Relative change of rays' fields by a relative change of the ground's complex permittivity."""
        out = np.zeros(rays.n_ray, np.complex128)
        if things.soil is None or not self._options.ground:
            return out
        other = self._rays(stand, _with_soil(things, complex(_SOIL_STEP), self._scenario))
        count = np.diff(rays.first)
        # a ray on the verge of being too faint is in one list alone: its link does without
        alike = count == np.diff(other.first)
        mine, theirs = np.repeat(alike, count), np.repeat(alike, np.diff(other.first))
        before, after = rays.field_enu[mine], other.field_enu[theirs]
        strongest = np.argmax(np.abs(before), axis=1)
        k = np.arange(len(before))
        with np.errstate(invalid="ignore", divide="ignore"):
            change = (after[k, strongest] / before[k, strongest] - 1.0) / _SOIL_STEP
        out[mine] = np.where(np.isfinite(change), change, 0.0)
        return out


def _towards(rays: Rays, pivot: FloatArray, rot: FloatArray, receiver_mirror_m: FloatArray) -> FloatArray:
    """(ray, xyz) unit vectors from receivers to where rays come from.

    The last stretch of a ray from the mirror's own plate is the image of the one that the record holds, or comes from
    the point of the edge that bent it.
    """
    if not rays.n_ray:
        return rays.source_enu_m
    at = pivot + np.einsum("kab,kb->ka", rot, rays.place_mirror_m)
    out = geometry.unit(rays.source_enu_m - at)
    off = rays.place_mirror_m - receiver_mirror_m
    elsewhere = np.linalg.norm(off, axis=1) > _SAME_POINT_M
    imaged = elsewhere & (np.hypot(off[:, 0], off[:, 1]) < _SAME_POINT_M)
    bent = elsewhere & ~imaged
    normal = rot[imaged][:, :, 2]
    out[imaged] -= 2.0 * (out[imaged] * normal).sum(axis=1)[:, None] * normal
    out[bent] = geometry.unit(np.einsum("kab,kb->ka", rot[bent], off[bent]))
    return np.asarray(out)


def _with_soil(things: Surroundings, change: complex, scenario: Scenario) -> Surroundings:
    """Return surroundings whose ground has another permittivity, by a relative change of the complex one."""
    soil = things.soil
    if soil is None or change == 0j:
        return things
    omega_eps = 2.0 * np.pi * float(scenario.carrier_rf_hz.mean()) * _VACUUM_PERMITTIVITY
    value = complex(soil.permittivity, -soil.conductivity_s_per_m / omega_eps) * (1.0 + change)
    return replace(
        things,
        soil=Soil(
            permittivity=max(value.real, 1.0),
            conductivity_s_per_m=max(-value.imag * omega_eps, 0.0),
            height_m=soil.height_m,
            normal_enu=soil.normal_enu,
        ),
    )


def _joined(parts: list[Voltages]) -> Voltages:
    """Put the rays of several frames one after the other."""
    rays = [part.rays for part in parts]
    offset = np.cumsum([0, *(r.n_ray for r in rays)])
    first = [rays[0].first[:1], *(r.first[1:] + o for r, o in zip(rays, offset[:-1], strict=True))]
    names = ("source_enu_m", "place_mirror_m", "extra_m", "field_enu", "kind", "thing")
    return Voltages(
        rays=Rays(
            first=np.concatenate(first), **{name: np.concatenate([getattr(r, name) for r in rays]) for name in names}
        ),
        **{
            name: np.concatenate([getattr(part, name) for part in parts])
            for name in ("voltage", "slope", "soil_slope", "vague", "reference_rot")
        },
    )


def _theta_hat(towards: FloatArray) -> FloatArray:
    """(ray, xyz) unit vectors of vertical polarisation, downward for what comes from the horizon."""
    across = np.maximum(np.hypot(towards[:, 0], towards[:, 1]), 1e-12)[:, None]
    up = towards[:, 2:]
    return np.concatenate([up * towards[:, :2] / across, -across], axis=1)
