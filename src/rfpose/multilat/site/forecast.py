"""What a fit would state of mirrors that stand as commanded, source by source, and what it makes of drawn errors.

The share of each source is found from the stated covariance alone: it is the least that any weights reach, so that a
small change of one source's variance changes it as if the weights stayed, and by that source's part of it. Since the
covariance is proportional to all variances together, the parts add up to the whole (Euler).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.geometry import cross_matrix
from rfpose.multilat.site.fit import (
    MAX_STEPS,
    Common,
    FactorShares,
    FieldAt,
    FitState,
    SiteFit,
    SiteKnowledge,
    SiteObservations,
    SitePoses,
    SiteSettings,
    Voltages,
    carrier_likeness,
    field_of,
    given_common,
    known_mirrors,
    roll_sigma_rad_of,
)
from rfpose.propagation import RayKind

__all__ = ["SOURCES", "ForeseenMirrors", "WorldErrors"]

ComplexArray = npt.NDArray[np.complex128]

_STEP = 0.05
"""Relative change of a source's variance by which its share is found."""

SOURCES = (
    "noise",
    "floor",
    "permittivity",
    "ground",
    "specular",
    "diffracted",
    "own plate",
    "pattern",
    "pivot",
    "posture",
    "roll",
    "clock",
)
"""What the stated covariance is made of: noise of the carriers; the field that nothing foresees; the ground's
permittivity; factors of foreseen rays, by kind; the antennas' patterns; and what was known before: pivots, commanded
postures, mounts that keep the x axis horizontal, clocks."""

_FACTORS = {
    "ground": RayKind.GROUND,
    "specular": RayKind.SPECULAR,
    "diffracted": RayKind.DIFFRACTED,
    "own plate": RayKind.OWN_PLATE,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class WorldErrors:
    """How the world differs from what the fit takes it for; zeros by default.

    Attributes
    ----------
    place_m : (mirror, receiver, xyz) or (receiver, xyz)
        Receivers beside where they are taken to be, in the mirror frame [m].
    transmitter_m : (transmitter, xyz)
        [m].
    delay_m : (mirror, receiver)
        Of each receiver about the mirror's clock [m].
    range_scale
        Share by which all ranges are longer.
    factor : (ray,) complex
        Relative change of each ray's voltage.
    stray : (mirror, receiver, transmitter) complex
        Added to what each link receives, in units of the voltages.
    pivot_m : (mirror, xyz)
        Surveyed less true [m].
    posture_rad : (mirror, xyz)
        Turn from the true to the commanded orientation [rad].
    """

    place_m: FloatArray | float = 0.0
    transmitter_m: FloatArray | float = 0.0
    delay_m: FloatArray | float = 0.0
    range_scale: float = 0.0
    factor: ComplexArray | float = 0.0
    stray: ComplexArray | float = 0.0
    pivot_m: FloatArray | float = 0.0
    posture_rad: FloatArray | float = 0.0

    def __add__(self, other: WorldErrors) -> WorldErrors:
        """Return both at once."""
        return WorldErrors(**{f.name: getattr(self, f.name) + getattr(other, f.name) for f in fields(self)})


@dataclass(frozen=True, slots=True, kw_only=True)
class ForeseenMirrors:
    """Mirrors that stand as commanded, with what they are expected to receive; see `ForeseenMirrors.of`.

    Attributes
    ----------
    sigma : (mirror, receiver, transmitter)
        Standard deviation of the real part of each carrier, in units of the voltages.
    wavenumber_radpm : (transmitter,)
    knowledge, settings
        As `fit_site` has them.
    voltages
        Of the rays foreseen.
    common
        What the fit takes all mirrors to have in common.
    """

    sigma: FloatArray
    wavenumber_radpm: FloatArray
    knowledge: SiteKnowledge
    settings: SiteSettings
    voltages: Voltages
    common: Common
    _link: npt.NDArray[np.int64] = field(repr=False)

    @classmethod
    def of(
        cls,
        sigma: FloatArray,
        wavenumber_radpm: FloatArray,
        knowledge: SiteKnowledge,
        field_at: FieldAt,
        settings: SiteSettings | None = None,
    ) -> ForeseenMirrors:
        """Foresee what mirrors receive, and find what they tell of the ground's permittivity.

        Parameters
        ----------
        sigma : (mirror, receiver, transmitter)
            Standard deviation of the real part of each carrier, in units of the voltages.
        wavenumber_radpm : (transmitter,)
            2π/λ of each carrier [rad/m].
        knowledge, field_at, settings
            As `fit_site` has them. What nothing foresees is as strong as ``settings.floor`` says (None: 0.05 of the
            direct field) and has Student's distribution of ``settings.tail`` (None: 3) degrees of freedom.

        Raises
        ------
        InvalidInputError
            Arrays that do not fit each other.
        """
        chosen = settings or SiteSettings()
        known, everyone, some = known_mirrors(knowledge)
        common = given_common(chosen)
        voltages = field_of(field_at, FitState.begin(knowledge), everyone, common)
        link = np.repeat(np.arange(len(voltages.rays.first) - 1), np.diff(voltages.rays.first))
        mirrors = cls(
            sigma=sigma, wavenumber_radpm=wavenumber_radpm, knowledge=knowledge, settings=chosen, voltages=voltages,
            common=common, _link=link,
        )  # fmt: skip
        fit, told = mirrors._fit(mirrors.received()), FactorShares.of(len(known))
        fit.run(fit.prepare(voltages), FitState.begin(knowledge), some, common, told)
        return replace(mirrors, common=fit.with_soil(told, some, common))

    def poses(self) -> SitePoses:
        """Return what `fit_site` would state of mirrors that stand as commanded.

        Nothing is learned but the ground's permittivity, from all these mirrors; rays' factors are as uncertain as
        given. Poses are taken to be found: whether a second one fits alike is not asked.
        """
        fit = self._fit(self.received())
        known, everyone, _ = known_mirrors(self.knowledge)
        # one step from the truth: residuals are zero, so that links keep the weight that they have on average
        state = fit.run(fit.prepare(self.voltages), FitState.begin(self.knowledge), everyone, self.common)
        return fit.outcome(state, known, self.common)

    def share(self, source: str) -> FloatArray:
        """Return the part of the normals' covariance (mirror, 3, 3) that one of `SOURCES` is to blame for [rad²]."""
        more, less = (self._scaled(source, 1.0 + sign * _STEP).poses().normal_cov for sign in (1.0, -1.0))
        return np.asarray((more - less) / (2.0 * _STEP))

    def received(self, disturbance: WorldErrors | None = None) -> ComplexArray:
        """(mirror, receiver, transmitter) sum of the rays in a world that is disturbed; NaN where there is none."""
        off = disturbance or WorldErrors()
        shape = self.sigma.shape
        rays, link = self.voltages.rays, self._link
        at_receiver, transmitter = np.divmod(link, shape[2])
        mirror, receiver = np.divmod(at_receiver, shape[1])
        place_m = np.broadcast_to(off.place_m, (*shape[:2], 3))[mirror, receiver]
        rot = self.knowledge.commanded_rot[mirror]
        at = self.knowledge.pivot_enu_m[mirror] + np.einsum("kab,kb->ka", rot, rays.place_mirror_m + place_m)
        source = rays.source_enu_m + self._moved(np.broadcast_to(off.transmitter_m, (shape[2], 3))[transmitter])
        path_m = (np.linalg.norm(source - at, axis=1) + rays.extra_m) * (1.0 + off.range_scale)
        path_m += np.broadcast_to(off.delay_m, shape[:2])[mirror, receiver]
        out = np.zeros(int(np.prod(shape)), np.complex128)
        phase = np.exp(-1j * self.wavenumber_radpm[transmitter] * path_m)
        np.add.at(out, link, self.voltages.voltage * (1.0 + off.factor) * phase)
        return np.asarray(np.where(out == 0.0, np.nan, out).reshape(shape) + off.stray)

    def _moved(self, shift: FloatArray) -> FloatArray:
        """(ray, xyz) shift of a ray's source by one of its transmitter: mirrored by level ground, else as it is."""
        below = self.voltages.rays.kind == RayKind.GROUND
        return np.asarray(np.where(below[:, None], shift * [1.0, 1.0, -1.0], shift))

    def normal_change(self, disturbance: WorldErrors, *, linear: bool) -> FloatArray:
        """Return solved less true normals (mirror, xyz) in a disturbed world; NaN where a fit failed.

        Parameters
        ----------
        disturbance
        linear
            Take one step only, which is right for a small disturbance.
        """
        known, off = self.knowledge, disturbance
        _, everyone, _ = known_mirrors(known)
        told = replace(
            known,
            pivot_enu_m=known.pivot_enu_m + off.pivot_m,
            commanded_rot=_turned(known.commanded_rot, np.broadcast_to(off.posture_rad, known.pivot_enu_m.shape)),
        )
        fit = self._fit(self.received(off), knowledge=told, max_steps=1 if linear else MAX_STEPS)
        state = fit.run(fit.prepare(self.voltages), FitState.begin(known), everyone, self.common)
        ended = (state.steps >= 0) & (linear | (state.steps < MAX_STEPS))
        return np.asarray(np.where(ended[:, None], state.rot[:, :, 2] - known.commanded_rot[:, :, 2], np.nan))

    def drawn(self, source: str, rng: np.random.Generator) -> WorldErrors:
        """Return what one of `SOURCES` may do, drawn at random; zeros where it does nothing."""
        return _DRAWS.get(source, _draw_factor)(self, source, rng)

    def _fit(self, carrier: ComplexArray, *, knowledge: SiteKnowledge | None = None, max_steps: int = 1) -> SiteFit:
        observed = SiteObservations(carrier=carrier, sigma=self.sigma, wavenumber_radpm=self.wavenumber_radpm)
        return SiteFit(observed, knowledge or self.knowledge, self.settings, max_steps=max_steps)

    def _scaled(self, source: str, variance: float) -> ForeseenMirrors:
        """Return it with one source's variance so many times as large."""
        root = float(np.sqrt(variance))
        known, common, voltages = self.knowledge, self.common, self.voltages
        if source == "noise":
            return replace(self, sigma=root * self.sigma)
        if source == "floor":
            return replace(self, common=replace(common, floor=root * common.floor))
        if source == "permittivity":
            real, imaginary = common.soil_sigma
            return replace(self, common=replace(common, soil_sigma=(root * real, root * imaginary)))
        if source == "pattern":
            return replace(self, voltages=replace(voltages, vague=variance * voltages.vague))
        if source in _FACTORS:
            scale = common.factor_scale.copy()
            scale[_FACTORS[source]] *= root
            return replace(self, common=replace(common, factor_scale=scale))
        name = {"pivot": "pivot_sigma_m", "posture": "posture_sigma_rad", "roll": "roll_sigma_rad"}.get(
            source, "clock_sigma_m"
        )
        return replace(self, knowledge=replace(known, **{name: root * getattr(known, name)}))


def _turned(rot: FloatArray, turn_rad: FloatArray) -> FloatArray:
    """Orientations after small turns about east, north and up, to third order."""
    k = cross_matrix(turn_rad)
    return np.asarray(rot + k @ rot + 0.5 * k @ k @ rot + k @ k @ k @ rot / 6.0)


# -- what sources may do -----------------------------------------------------------------------------------------------


def _complex(rng: np.random.Generator, shape: tuple[int, ...]) -> ComplexArray:
    """Real and imaginary part standard normal."""
    real, imaginary = rng.standard_normal((2, *shape))
    return np.asarray(real + 1j * imaginary)


def _draw_noise(mirrors: ForeseenMirrors, _: str, rng: np.random.Generator) -> WorldErrors:
    return WorldErrors(stray=mirrors.sigma * _complex(rng, mirrors.sigma.shape))


def _draw_floor(mirrors: ForeseenMirrors, _: str, rng: np.random.Generator) -> WorldErrors:
    shape, nu = mirrors.sigma.shape, mirrors.common.tail
    heavy = np.sqrt(nu / rng.chisquare(nu, shape))
    strength = mirrors.common.floor * mirrors.knowledge.unit_field[:, None]
    together = carrier_likeness(mirrors.wavenumber_radpm, mirrors.knowledge.mast, mirrors.settings.detour_m)
    drawn = _complex(rng, shape) @ np.linalg.cholesky(together + 1e-9 * np.eye(shape[2])).T
    return WorldErrors(stray=np.asarray(strength * heavy * drawn, np.complex128))


def _draw_pattern(mirrors: ForeseenMirrors, _: str, rng: np.random.Generator) -> WorldErrors:
    sigma = np.sqrt(mirrors.voltages.vague).reshape(mirrors.sigma.shape)
    return WorldErrors(stray=sigma * _complex(rng, mirrors.sigma.shape))


def _draw_permittivity(mirrors: ForeseenMirrors, _: str, rng: np.random.Generator) -> WorldErrors:
    real, imaginary = rng.standard_normal(2) * mirrors.common.soil_sigma
    return WorldErrors(factor=mirrors.voltages.soil_slope * complex(real, imaginary))


def _draw_factor(mirrors: ForeseenMirrors, source: str, rng: np.random.Generator) -> WorldErrors:
    kind, rays, shape = _FACTORS[source], mirrors.voltages.rays, mirrors.sigma.shape
    amplitude, phase = np.array(mirrors.settings.factor_sigma.get(kind, (0.0, 0.0)))
    scale = mirrors.common.factor_scale[kind]
    mine = rays.kind == kind
    mirror, link_of = np.divmod(mirrors._link[mine], shape[1] * shape[2])
    ground = kind == RayKind.GROUND
    mast = mirrors.knowledge.mast
    sender = link_of % shape[2] if mast is None else mast[link_of % shape[2]]
    key = np.stack([
        mirror,
        np.where(ground, 0, rays.thing[mine]),
        np.where(ground, 0, sender),
    ], axis=1)  # fmt: skip
    _, same = np.unique(key, axis=0, return_inverse=True)
    n = int(same.max(initial=-1)) + 1
    error = scale * (amplitude * rng.standard_normal(n) + 1j * phase * rng.standard_normal(n))
    factor = np.zeros(rays.n_ray, np.complex128)
    factor[mine] = error[same.ravel()]
    return WorldErrors(factor=factor)


def _draw_pivot(mirrors: ForeseenMirrors, _: str, rng: np.random.Generator) -> WorldErrors:
    known = mirrors.knowledge
    return WorldErrors(pivot_m=known.pivot_sigma_m * rng.standard_normal(known.pivot_enu_m.shape))


def _draw_posture(mirrors: ForeseenMirrors, _: str, rng: np.random.Generator) -> WorldErrors:
    known = mirrors.knowledge
    sigma = np.where(np.isfinite(known.posture_sigma_rad), known.posture_sigma_rad, 0.0)
    turn = sigma[:, None] * rng.standard_normal(known.pivot_enu_m.shape)
    normal = known.commanded_rot[:, :, 2]
    # across the normal: about it the mount holds the mirror
    return WorldErrors(posture_rad=turn - (turn * normal).sum(axis=1)[:, None] * normal)


def _draw_roll(mirrors: ForeseenMirrors, _: str, rng: np.random.Generator) -> WorldErrors:
    known = mirrors.knowledge
    if not np.isfinite(known.roll_sigma_rad):
        return WorldErrors()
    steep = np.maximum(np.abs(known.commanded_rot[:, 2, 1]), 1e-9)
    turn = np.minimum(known.roll_sigma_rad / steep, roll_sigma_rad_of(known)) * rng.standard_normal(len(steep))
    # receivers that turn about the normal leave it where it is
    return WorldErrors(place_m=np.cross([0.0, 0.0, 1.0], known.receiver_mirror_m) * turn[:, None, None])


def _draw_clock(mirrors: ForeseenMirrors, _: str, rng: np.random.Generator) -> WorldErrors:
    sigma = mirrors.knowledge.clock_sigma_m
    delay = rng.standard_normal(mirrors.sigma.shape[:2])
    return WorldErrors(delay_m=(sigma if np.isfinite(sigma) else 0.0) * delay)


_DRAWS: dict[str, Callable[[ForeseenMirrors, str, np.random.Generator], WorldErrors]] = {
    "noise": _draw_noise,
    "floor": _draw_floor,
    "pattern": _draw_pattern,
    "permittivity": _draw_permittivity,
    "pivot": _draw_pivot,
    "posture": _draw_posture,
    "roll": _draw_roll,
    "clock": _draw_clock,
}
