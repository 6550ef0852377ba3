"""Sensitivity maps: what every mirror's normal can be known to, before anything is built.

Everything follows from the Jacobian of the solvers in `rfpose.multilat` and from the noise of the tones; nothing is
measured. All angles are of the mirror normal; the beam turns by twice as much.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from rfpose import geometry
from rfpose.checks import FloatArray, as_float_array
from rfpose.errors import GeometryError, InvalidInputError
from rfpose.layout import _kernels
from rfpose.measurement import SCENARIO, Estimator, Noise, clock_classes, estimators_of, noise_of
from rfpose.scenario import Heliostat, Scenario

__all__ = [
    "ESTIMATORS",
    "Dilution",
    "NormalsStudy",
    "PosedMirrors",
    "check_site",
    "dilution",
    "disc_points",
    "in_words",
    "mirrors_facing",
    "mirrors_of",
    "normal_map",
    "normal_without_each",
    "posture_name",
    "study_of",
    "summarise",
]

IndexArray = npt.NDArray[np.int64]

_COINCIDENT_M = 1e-6
_FLAT = 1e-6
"""Extent of the transmitters across a line or plane, as a share of their largest, below which they lie in it."""
_MIN_TRANSMITTER = {2: 4, 3: 5}


ESTIMATORS = {
    e.name: e
    for e in (
        Estimator(name="independent", rigid=False),
        Estimator(name="rigid"),
        Estimator(name="shared-clock", clock_sigma_m=0.0),
        Estimator(name="carrier", clock_sigma_m=0.0, carrier=True),
        Estimator(name="delays", carrier=True),
        Estimator(name="pivot", clock_sigma_m=0.0, pivot_sigma_m=0.005),
    )
}
"""Ready estimators; ``delays`` compares carriers with each receiver's delay estimated in every frame, ``pivot`` has
pivots surveyed to 5 mm and a shared clock."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PosedMirrors:
    """Mirrors in one posture each.

    Attributes
    ----------
    pivot_enu_m : (mirror, xyz)
    rot_enu_from_mirror : (mirror, 3, 3)
    receiver_mirror_m : (1 or mirror, receiver, xyz)
        Receivers from the pivot, in the mirror frame [m].
    """

    pivot_enu_m: FloatArray
    rot_enu_from_mirror: FloatArray
    receiver_mirror_m: FloatArray

    def rows(self, index: IndexArray) -> PosedMirrors:
        """Return some of the mirrors."""
        places = self.receiver_mirror_m
        return PosedMirrors(
            pivot_enu_m=self.pivot_enu_m[index],
            rot_enu_from_mirror=self.rot_enu_from_mirror[index],
            receiver_mirror_m=places if len(places) == 1 else places[index],
        )

    @property
    def normal_enu(self) -> FloatArray:
        """(mirror, xyz) unit normals."""
        return self.rot_enu_from_mirror[:, :, 2]

    @property
    def receiver_enu_m(self) -> FloatArray:
        """(mirror, receiver, xyz) [m]."""
        places = np.broadcast_to(self.receiver_mirror_m, (len(self.pivot_enu_m), *self.receiver_mirror_m.shape[1:]))
        return np.asarray(self.pivot_enu_m[:, None] + np.einsum("mab,mrb->mra", self.rot_enu_from_mirror, places))


@dataclass(frozen=True, slots=True, kw_only=True)
class NormalsStudy:
    """How a site's normals are made: which estimator for which of its mirrors, and the noise; see `study_of`.

    Attributes
    ----------
    transmitter_enu_m : (transmitter, xyz)
        [m].
    noise
        Of the phases.
    rows : estimator to (mirror,)
        Which mirrors each is for.
    """

    transmitter_enu_m: FloatArray
    noise: Noise
    rows: dict[Estimator, IndexArray]

    def bound(self, mirrors: PosedMirrors, *, visible: npt.ArrayLike | None = None) -> FloatArray:
        """Return the bound of each mirror's normal (mirror,) [rad]; as `normal_map`."""
        seen = None if visible is None else np.asarray(visible)
        out = np.full(len(mirrors.pivot_enu_m), np.nan)
        for estimator, rows in self.rows.items():
            part = None if seen is None else seen[rows]
            out[rows] = normal_map(self.transmitter_enu_m, mirrors.rows(rows), self.noise, estimator, visible=part)
        return out

    def without_each(self, mirrors: PosedMirrors, *, visible: npt.ArrayLike | None = None) -> FloatArray:
        """Return it with each transmitter lost in turn (transmitter, mirror) [rad]; as `normal_without_each`."""
        seen = None if visible is None else np.asarray(visible)
        out = np.full((len(self.transmitter_enu_m), len(mirrors.pivot_enu_m)), np.nan)
        for estimator, rows in self.rows.items():
            part = None if seen is None else seen[rows]
            place, mine = self.transmitter_enu_m, mirrors.rows(rows)
            out[:, rows] = normal_without_each(place, mine, self.noise, estimator, visible=part)
        return out


@dataclass(frozen=True, slots=True, kw_only=True)
class Dilution:
    """Dilution of precision at points: RMS error per unit of ONE transmitter's range sigma; NaN where undetermined.

    Attributes
    ----------
    position, horizontal, vertical : (point,)
    """

    position: FloatArray
    horizontal: FloatArray
    vertical: FloatArray = field(repr=False)


def check_site(transmitter_enu_m: npt.ArrayLike, *, n_axis: int = 3) -> FloatArray:
    """Return the transmitters, or say which of the paper's placement guidelines they break.

    Raises
    ------
    GeometryError
        Fewer than the dimensions plus two; two at one place; all on a line or in a plane (the direction in which
        positions cannot be told is named).
    """
    transmitter = as_float_array("transmitter_enu_m", transmitter_enu_m, ("transmitter", n_axis))
    needed = _MIN_TRANSMITTER[n_axis]
    if len(transmitter) < needed:
        raise GeometryError(
            f"{len(transmitter)} transmitters cannot fix a position in {n_axis} dimensions: at least {needed} are "
            "needed (guideline: N >= D + 2); add transmitters"
        )
    extent = transmitter.max(axis=0) - transmitter.min(axis=0)
    apart = np.linalg.norm(transmitter[:, None] - transmitter, axis=2) + np.eye(len(transmitter)) * (1.0 + extent.max())
    if apart.min() < _COINCIDENT_M:
        i, j = (int(k) for k in np.argwhere(apart < _COINCIDENT_M)[0])
        raise GeometryError(f"transmitters {i} and {j} stand at the same place; move or remove one")
    _, size, axes = np.linalg.svd(transmitter - transmitter.mean(axis=0))
    if size[-1] > _FLAT * size[0]:
        return transmitter
    null = axes[-1] * np.where(axes[-1][np.argmax(np.abs(axes[-1]))] < 0.0, -1.0, 1.0)
    direction = ", ".join(f"{x:.3f}" for x in null + 0.0)
    if size[1] <= _FLAT * size[0] or n_axis == 2:
        along = ", ".join(f"{x:.3f}" for x in axes[0] + 0.0)
        raise GeometryError(
            f"all transmitters stand on one line along ({along}): nothing across it can be told (guideline: "
            "transmitters spread around the field); move some off the line"
        )
    raise GeometryError(
        f"all transmitters stand in one plane: positions along its normal ({direction}) cannot be told near the plane "
        "(guideline: transmitters at different heights); raise or lower some"
    )


def disc_points(n_point: int, *, radius_m: float = 1.0, height_m: float = 0.0) -> FloatArray:
    """Return (point, xyz) points spread evenly over a disc, each for the same area (sunflower)."""
    k = np.arange(n_point) + 0.5
    radius = radius_m * np.sqrt(k / n_point)
    angle = np.pi * (3.0 - np.sqrt(5.0)) * k
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(n_point, float(height_m))], axis=1)


def dilution(
    transmitter_enu_m: npt.ArrayLike, point_enu_m: npt.ArrayLike, *, visible: npt.ArrayLike | None = None
) -> Dilution:
    """Return the dilution of precision of positions from range differences.

    Parameters
    ----------
    transmitter_enu_m : (transmitter, xyz) or (transmitter, xy)
        [m]. Two columns solve the plane (Swart et al. Fig. 7).
    point_enu_m : (..., xyz) or (..., xy)
        [m].
    visible : (..., transmitter), optional
        Which transmitters each point receives; all by default.

    Returns
    -------
    Dilution
        Arrays (...). In the plane ``vertical`` is zero.
    """
    transmitter = as_float_array("transmitter_enu_m", transmitter_enu_m, ("transmitter", "xyz"))
    n_axis = transmitter.shape[1]
    if n_axis not in (2, 3):
        raise InvalidInputError(f"`transmitter_enu_m` must have two or three columns, got {n_axis}")
    point = as_float_array("point_enu_m", point_enu_m, ("...", n_axis), finite=False)
    lead = point.shape[:-1]
    # a copy: a read-only array would be another type to the kernels, compiled anew
    flat = np.array(point.reshape(-1, n_axis))
    if n_axis == 2:
        out = _planar(transmitter, flat, visible)
    else:
        out = np.full((3, len(flat)), np.nan)
        seen = _mask(visible, (len(flat), len(transmitter)), lead)
        _kernels.dop_rows(len(flat), np.ascontiguousarray(transmitter.T), np.ones(len(transmitter)), seen, flat, out)
    return Dilution(position=out[0].reshape(lead), horizontal=out[1].reshape(lead), vertical=out[2].reshape(lead))


def _planar(transmitter: FloatArray, point: FloatArray, visible: npt.ArrayLike | None) -> FloatArray:
    """(3, point) dilution in the plane: position, the same, and zero."""
    offset = point[:, None] - transmitter
    with np.errstate(invalid="ignore", divide="ignore"):
        u = offset / np.linalg.norm(offset, axis=2, keepdims=True)
        weight = np.ones(u.shape[:2]) if visible is None else np.asarray(visible, np.float64).reshape(u.shape[:2])
        u = u - (np.einsum("nt,ntx->nx", weight, u) / weight.sum(axis=1)[:, None])[:, None]
        m = np.einsum("nt,ntx,nty->nxy", weight, u, u)
        det = m[:, 0, 0] * m[:, 1, 1] - m[:, 0, 1] ** 2
        det = np.where(det > 1e-12 * (m[:, 0, 0] + m[:, 1, 1]) ** 2, det, np.nan)
        root = np.sqrt((m[:, 0, 0] + m[:, 1, 1]) / det)
        return np.stack([root, root, 0.0 * root])


def normal_map(
    transmitter_enu_m: npt.ArrayLike,
    mirrors: PosedMirrors,
    noise: Noise,
    estimator: Estimator,
    *,
    visible: npt.ArrayLike | None = None,
) -> FloatArray:
    """Return the bound of each mirror's normal, as the RMS angle (mirror,) [rad]; NaN where undetermined.

    Agrees with `rfpose.multilat.normal_bound` (independent) and `rfpose.multilat.rigid.rigid_bound` (rigid).

    Parameters
    ----------
    transmitter_enu_m : (transmitter, xyz)
        [m].
    mirrors, noise, estimator
        See there.
    visible : (mirror, receiver, transmitter), optional
        Which transmitters each receiver sees; all by default.

    Raises
    ------
    InvalidInputError
        Shapes that do not fit; an estimator that needs the carrier where ``noise`` has none.
    """
    transmitter = as_float_array("transmitter_enu_m", transmitter_enu_m, ("transmitter", 3))
    n_transmitter = len(transmitter)
    if noise.tone_sigma_m.shape[1] != n_transmitter:
        raise InvalidInputError(f"`noise` must hold {n_transmitter} transmitters, got {noise.tone_sigma_m.shape[1]}")
    n_mirror, n_receiver = len(mirrors.pivot_enu_m), mirrors.receiver_mirror_m.shape[1]
    seen = _mask(visible, (n_mirror, n_receiver, n_transmitter), (n_mirror, n_receiver))
    range2 = 0.0 if noise.reference_range_m is None else noise.reference_range_m**2
    out = np.full(n_mirror, np.nan)
    field_seen = kernel_field(transmitter, mirrors, range2, seen)
    if not estimator.rigid:
        _kernels.tilt_independent(
            n_mirror, field_seen, plane_slope(mirrors.receiver_mirror_m), noise.tone_sigma_m**2,
            noise.calibration_sigma_m**2, _MIN_TRANSMITTER[3], out,
        )  # fmt: skip
        return np.asarray(np.sqrt(out))
    shared = estimator.clock_sigma_m == 0.0
    roll_info = estimator.roll_sigma_rad**-2 if estimator.two_axis else 0.0
    own, common = noise.groups(carrier=estimator.carrier)
    if len(own) == 1 and not np.any(common > 0.0) and (shared or np.isinf(estimator.clock_sigma_m)):
        _kernels.tilt_calibrated(
            n_mirror, field_seen, own[0] ** -2.0, shared, estimator.pivot_sigma_m**-2, roll_info, out,
        )  # fmt: skip
        return np.asarray(np.sqrt(out))
    with np.errstate(divide="ignore"):
        bias_info = common**-2.0
    group_class = clock_classes(len(own))
    tie = 0.0
    if not shared and np.isfinite(estimator.clock_sigma_m):
        tie = 1.0 / (n_receiver * estimator.clock_sigma_m**2)
    _kernels.tilt_rigid(
        n_mirror, field_seen, own**-2.0, bias_info, group_class, len(own), shared, tie,
        estimator.pivot_sigma_m**-2, roll_info, out,
    )  # fmt: skip
    return np.asarray(np.sqrt(out))


def kernel_field(
    transmitter: FloatArray, mirrors: PosedMirrors, range2: float = 0.0, seen: npt.NDArray[np.uint8] | None = None
) -> _kernels.FieldArrays:
    """Return what the kernels take; ``range2`` and ``seen`` as there."""
    if seen is None:
        seen = np.empty((0, mirrors.receiver_mirror_m.shape[1], len(transmitter)), np.uint8)
    return _kernels.FieldArrays(
        transmitter=np.ascontiguousarray(transmitter.T),
        place=mirrors.receiver_mirror_m,
        pivot=mirrors.pivot_enu_m,
        rot=mirrors.rot_enu_from_mirror,
        range2=range2,
        visible=seen,
    )


def plane_slope(receiver_mirror_m: FloatArray) -> FloatArray:
    """(mirror, receiver, 3, 3) derivative of the plane's unit normal by each receiver's place, in the mirror frame.

    The plane is the affine image of the mirror's x-y plane, as `rfpose.multilat.mirror_normal` takes it.
    """
    centred = receiver_mirror_m - receiver_mirror_m.mean(axis=1, keepdims=True)
    a, b = np.moveaxis(np.linalg.pinv(centred, rcond=1e-3)[:, :2], 1, 0)
    p = np.einsum("mk,mkx->mx", a, centred)
    q = np.einsum("mk,mkx->mx", b, centred)
    cross = np.cross(p, q)
    length = np.linalg.norm(cross, axis=1)
    normal = cross / length[:, None]
    basis = np.eye(3)
    # d(p × q) = a_k dR × q + b_k p × dR, then only what is across the normal
    change = a[:, :, None, None] * np.cross(basis, q[:, None])[:, None]
    change = change + b[:, :, None, None] * np.cross(p[:, None], basis)[:, None]
    across = (basis - normal[:, :, None] * normal[:, None]) / length[:, None, None]
    return np.ascontiguousarray(np.einsum("mij,mkcj->mkic", across, change))


def normal_without_each(
    transmitter_enu_m: npt.ArrayLike,
    mirrors: PosedMirrors,
    noise: Noise,
    estimator: Estimator,
    *,
    visible: npt.ArrayLike | None = None,
) -> FloatArray:
    """Return the bound of each mirror's normal with each transmitter lost in turn (transmitter, mirror) [rad]."""
    transmitter = as_float_array("transmitter_enu_m", transmitter_enu_m, ("transmitter", 3))
    seen = None if visible is None else np.asarray(visible)
    rows = []
    for lost in range(len(transmitter)):
        left = np.arange(len(transmitter)) != lost
        rest = None if seen is None else seen[..., left]
        rows.append(normal_map(transmitter[left], mirrors, noise.without(lost), estimator, visible=rest))
    return np.array(rows)


def mirrors_facing(
    pivot_enu_m: npt.ArrayLike,
    receiver_mirror_m: npt.ArrayLike,
    *,
    normal_enu: npt.ArrayLike | None = None,
    aim_enu_m: npt.ArrayLike | None = None,
    sun_enu: npt.ArrayLike | None = None,
    arm_m: float = 0.0,
) -> PosedMirrors:
    """Return mirrors in a posture: a given normal, or reflecting the sun onto an aim point.

    Parameters
    ----------
    pivot_enu_m : (mirror, xyz)
        [m].
    receiver_mirror_m : (receiver, xyz) or (mirror, receiver, xyz)
        In the mirror frame, from the mirror's centre [m].
    normal_enu : (xyz,) or (mirror, xyz), optional
        Need not be of unit length.
    aim_enu_m, sun_enu : (xyz,), optional
        Aim point [m] and direction of the sun; both, where ``normal_enu`` is not given.
    arm_m
        Mirror's centre from the pivot, along the normal [m].

    Raises
    ------
    InvalidInputError
        Neither a normal nor aim and sun.
    GeometryError
        Receivers on a line; a mirror that would have to face both ways.
    """
    # copies: a read-only array would be another type to the kernels, compiled anew
    pivot = np.array(as_float_array("pivot_enu_m", pivot_enu_m, ("mirror", 3)))
    places = as_float_array("receiver_mirror_m", receiver_mirror_m, ("...", "receiver", 3))
    if places.ndim == 2:
        places = places[None]
    for place in places[:1] if len(places) == 1 else places:
        if geometry.is_collinear(place):
            raise GeometryError("`receiver_mirror_m` must hold three or more receivers that are not on a line")
    if normal_enu is None:
        if aim_enu_m is None or sun_enu is None:
            raise InvalidInputError("give `normal_enu`, or `aim_enu_m` and `sun_enu`")
        aim = as_float_array("aim_enu_m", aim_enu_m, (3,))
        normal = geometry.bisector_enu(aim - pivot, as_float_array("sun_enu", sun_enu, (3,)))
    else:
        normal = np.broadcast_to(as_float_array("normal_enu", normal_enu, ("...", 3)), pivot.shape)
    rot = geometry.rot_enu_from_mirror(normal)
    if not np.isfinite(rot).all():
        bad = int(np.flatnonzero(~np.isfinite(rot).all(axis=(1, 2)))[0])
        raise GeometryError(
            f"mirror {bad} has no posture: the sun stands opposite its aim point, or its normal is zero"
        )
    return PosedMirrors(
        pivot_enu_m=pivot,
        rot_enu_from_mirror=np.ascontiguousarray(rot),
        receiver_mirror_m=np.ascontiguousarray(places + np.array([0.0, 0.0, float(arm_m)])),
    )


def mirrors_of(
    scenario: Scenario, *, normal_enu: npt.ArrayLike | None = None, sun_enu: npt.ArrayLike | None = None
) -> PosedMirrors:
    """Return a scenario's mirrors in a posture.

    With the given normal; else facing the aim point under the given sun; else as the scenario says
    (`Scenario.posture_enu`), and level where it says nothing; `posture_name` tells which.

    Raises
    ------
    InvalidInputError
        A sun without ``[site] aim_enu_m``.
    GeometryError
        No heliostats; heliostats with different numbers of receivers; heliostats or transmitters on each other.
    """
    check_clear(scenario)
    if len({len(h.receiver_mirror_m) for h in scenario.heliostat}) > 1:
        raise GeometryError("heliostats have different numbers of receivers; study them in separate scenarios")
    places = np.array([h.receiver_mirror_m for h in scenario.heliostat])
    places[:, :, 2] += np.array([h.arm_m for h in scenario.heliostat])[:, None]
    if (places == places[0]).all():
        places = places[:1]
    if normal_enu is None and sun_enu is None:
        normal_enu = np.array(scenario.posture_enu)
        if scenario.simulated_sun_enu is None:
            normal_enu[~np.isfinite(normal_enu).all(axis=1)] = [0.0, 0.0, 1.0]
    if normal_enu is None and scenario.site.aim_enu_m is None:
        raise InvalidInputError("[site] `aim_enu_m` is missing: the mirrors have nothing to face; add it, or a normal")
    return mirrors_facing(
        scenario.pivot_enu_m, places, normal_enu=normal_enu, aim_enu_m=scenario.site.aim_enu_m, sun_enu=sun_enu
    )


def posture_name(scenario: Scenario) -> str:
    """Return where `mirrors_of` takes the mirrors' posture from: their own normals, the simulated sun, or level."""
    if any(h.normal_enu is not None for h in scenario.heliostat):
        return "own"
    return "level" if scenario.simulated_sun_enu is None else "simulated sun"


def study_of(
    scenario: Scenario,
    name: str,
    *,
    heliostats: Sequence[Heliostat] | None = None,
    tone_snr_db: float | None = None,
) -> NormalsStudy:
    """Return what maps of a scenario need for an estimator by name: one of `ESTIMATORS`, or `SCENARIO`.

    ``heliostats`` are studied instead of the scenario's, so that a site need not be checked anew at each move.
    Without calibration receivers the transmitters' electronic phases count as known for the former estimators, and as
    unknown for the latter.

    Raises
    ------
    GeometryError
        The estimator needs carriers where there are none.
    """
    heliostats = scenario.heliostat if heliostats is None else heliostats
    noise = noise_of(scenario, tone_snr_db=tone_snr_db)
    rows = estimators_of(scenario, heliostats)
    if name != SCENARIO:
        estimator = ESTIMATORS[name]
        if estimator.carrier and not scenario.has_rf_carriers:
            raise GeometryError(
                f"estimator `{name}` compares carriers, and not all of their radio frequencies are above zero: set "
                "`radio.centre_frequency_hz`, or choose another estimator"
            )
        rows = {estimator: np.arange(len(heliostats))}
        if not scenario.calibration_receiver:
            noise = replace(noise, calibration_sigma_m=np.zeros_like(noise.tone_sigma_m))
    return NormalsStudy(transmitter_enu_m=scenario.transmitter_enu_m, noise=noise, rows=rows)


def in_words(estimator: Estimator, propagation_speed_mps: float) -> str:
    """Return what an estimator uses, for tables and pictures."""
    if not estimator.rigid:
        return "each receiver located on its own"
    words = ["a clock a receiver" if np.isinf(estimator.clock_sigma_m) else "one clock a mirror"]
    if 0.0 < estimator.clock_sigma_m < np.inf:
        words[0] = f"delays known to {1e12 * estimator.clock_sigma_m / propagation_speed_mps:.3g} ps"
    words.append("with the carrier" if estimator.carrier else "without the carrier")
    if np.isfinite(estimator.pivot_sigma_m):
        words.append(f"pivots to {1e3 * estimator.pivot_sigma_m:.3g} mm")
    return ", ".join(words + (["two-axis mount"] if estimator.two_axis else []))


def check_clear(scenario: Scenario) -> None:
    """Refuse a scenario without heliostats, or with one on top of another or of a transmitter."""
    if not scenario.heliostat:
        raise GeometryError("the scenario has no heliostats; add some, or a field from CSV")
    pivot = scenario.pivot_enu_m
    pair = _coincident(pivot)
    if pair is not None:
        i, j = pair
        ids = scenario.heliostat_ids
        raise GeometryError(f"heliostats `{ids[i]}` and `{ids[j]}` stand at the same place; move or remove one")
    for transmitter_id, place in zip(scenario.transmitter_ids, scenario.transmitter_enu_m, strict=True):
        distance = np.linalg.norm(pivot - place, axis=1)
        nearest = int(np.argmin(distance))
        if distance[nearest] < _COINCIDENT_M:
            raise GeometryError(
                f"heliostat `{scenario.heliostat_ids[nearest]}` and transmitter `{transmitter_id}` stand at the same "
                "place; move one"
            )


def _coincident(place: FloatArray) -> tuple[int, int] | None:
    """Return two places that are the same, or None."""
    order = np.argsort(place[:, 0], kind="stable")
    sorted_place = place[order]
    # whoever is as near to the east stands behind in the order; the more stand beside each other, the further
    for behind in range(1, len(place)):
        step = sorted_place[behind:] - sorted_place[:-behind]
        if step[:, 0].min() > _COINCIDENT_M:
            return None
        same = np.flatnonzero(np.einsum("ni,ni->n", step, step) <= _COINCIDENT_M**2)
        if same.size:
            i, j = sorted((int(order[same[0]]), int(order[same[0] + behind])))
            return i, j
    return None


def summarise(values: FloatArray) -> dict[str, float]:
    """Return rms, median, 95th percentile and worst of a map, and the share without a solution."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return {"rms": np.nan, "median": np.nan, "p95": np.nan, "worst": np.nan, "undetermined": 1.0}
    return {
        "rms": float(np.sqrt(np.mean(finite**2))),
        "median": float(np.median(finite)),
        "p95": float(np.percentile(finite, 95)),
        "worst": float(finite.max()),
        "undetermined": 1.0 - finite.size / values.size,
    }


def _mask(visible: npt.ArrayLike | None, shape: tuple[int, ...], lead: tuple[int, ...]) -> npt.NDArray[np.uint8]:
    if visible is None:
        return np.empty((0, *shape[1:]), np.uint8)
    mask = np.asarray(visible)
    if mask.shape != (*lead, shape[-1]):
        raise InvalidInputError(f"`visible` must have shape {(*lead, shape[-1])}, got {mask.shape}")
    return np.ascontiguousarray(mask.reshape(shape).astype(np.uint8))
