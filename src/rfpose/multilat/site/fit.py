r"""Poses of mirrors among reflections, from their receivers' carriers.

What receiver r of a mirror hears of transmitter i is, up to a complex number a transmitter and mirror,

.. math:: h_{ri}(p, R) = \sum_k v_k\, e^{-j k_i |s_k - p - R m_k|}

over the rays that are foreseen, v their voltages. The phases of the carriers are compared with those of h. What nothing
foresees is a stray field of the same strength in all links, `SiteSettings.floor` times the transmitter's direct field;
it turns the phase of a weak link more than that of a strong one. Its distribution has heavy tails (Student's t, by
reweighting), so that single links that are far off hardly count, and its strength is found from residuals, over all
mirrors and, about that, for each mirror. Factors of foreseen rays are uncertain; rays that share one have that error in
common, and it goes into the covariance of the phases instead of being estimated.

References
----------
Lange, Little, Taylor, Robust statistical modeling using the t distribution, J. Am. Stat. Assoc. 84 (1989) 881, for the
reweighting and its covariance; Patterson and Thompson, Recovery of inter-block information when block sizes are
unequal, Biometrika 58 (1971) 545, for scales by restricted likelihood.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.errors import InvalidInputError
from rfpose.geometry import cross_matrix
from rfpose.multilat.normal import MAX_SIGMA_RAD
from rfpose.multilat.site import _kernels
from rfpose.multilat.status import PoseStatus
from rfpose.propagation import RayKind, Rays

__all__ = [
    "Common",
    "FieldAt",
    "SiteKnowledge",
    "SiteObservations",
    "SitePoses",
    "SiteSettings",
    "Voltages",
    "fit_site",
    "heard_by",
    "spread_starts",
]

BoolArray = npt.NDArray[np.bool_]
ComplexArray = npt.NDArray[np.complex128]
IntArray = npt.NDArray[np.int64]

MAX_STEPS = 100
_FIRST_FLOOR = 0.05
_TAILS = (1.5, 2.0, 3.0, 8.0, 30.0, 300.0)
_FIRST_TAIL = 3.0
_LEARN_ROUNDS = 15
_LEARN_SETTLED = 0.03
_LOST = 9.0
"""A mirror whose stray field is so much stronger than the middle one's, in power, tells no more of it than that."""
_LEARN_MIRRORS = 200
"""Mirrors, spread over all, from which is found what all have in common."""
_LEAST_FACTOR_SCALE = 0.01
_FACTOR_PRIOR = 1.0
"""So many factors' worth count the stated sigmas against what residuals say of them."""
_SOIL_STEP = 2.0
"""Standard deviations by which the permittivity is changed at once: rays are linear in it for so far."""
_LEAST_SOIL_SIGMA = 1e-3
_MORE_ROUNDS = 5
"""So many more, while the ground's constants still change by more than they are uncertain."""
_AMBIGUOUS_COST = 9.0
"""Two poses apart whose costs (twice the log likelihood) differ by less may each be the true one."""
_APART = 0.15
"""Poses whose normals differ by more than this part of a wavelength over the lever are not the same."""
_MOST_ROLL_RAD = 1.0
_TELLING = 3
"""Fewer links than this beyond those that a pose takes confirm none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SiteObservations:
    """What is measured of mirrors.

    Attributes
    ----------
    carrier : (mirror, receiver, transmitter)
        Complex amplitude of each carrier [any unit]; NaN: not received.
    sigma : (mirror, receiver, transmitter)
        Standard deviation of its real part, same unit.
    wavenumber_radpm : (transmitter,)
        2π/λ of each carrier [rad/m].
    """

    carrier: ComplexArray
    sigma: FloatArray
    wavenumber_radpm: FloatArray

    def __post_init__(self) -> None:
        if self.carrier.ndim != 3 or self.sigma.shape != self.carrier.shape:
            raise InvalidInputError(
                f"`carrier` and `sigma` must have one shape (mirror, receiver, transmitter), got {self.carrier.shape} "
                f"and {self.sigma.shape}"
            )
        if self.wavenumber_radpm.shape != self.carrier.shape[2:] or not np.all(self.wavenumber_radpm > 0.0):
            raise InvalidInputError("`wavenumber_radpm` must be above zero, one for each transmitter")


@dataclass(frozen=True, slots=True, kw_only=True)
class SiteKnowledge:
    """What is known of mirrors besides.

    Attributes
    ----------
    receiver_mirror_m : (mirror, receiver, xyz)
        From the pivot, in the mirror frame [m].
    pivot_enu_m : (mirror, xyz)
        Surveyed [m].
    pivot_sigma_m
        In each axis [m].
    commanded_rot : (mirror, 3, 3)
        Orientation that control commanded, to ENU from the mirror frame; NaN: unknown.
    posture_sigma_rad : (mirror,)
        How far orientations are from that, about axes across the normal [rad]; infinity: it is where to begin, and no
        more. About the normal it is more where that stands near the zenith: there a small tilt is a large turn of a
        mirror whose x axis keeps horizontal.
    roll_sigma_rad
        How well a mount holds the x axis horizontal [rad]; infinity: no such mount.
    clock_sigma_m
        Of each receiver's delay about the mirror's common clock [m].
    unit_field : (mirror, transmitter)
        Strength of each transmitter's direct field at the pivot, in units of the voltages: what the floor is relative
        to.
    mast : (transmitter,), optional
        Equal for carriers of one antenna, whose rays share their factors' errors; None: one carrier each.
    """

    receiver_mirror_m: FloatArray
    pivot_enu_m: FloatArray
    pivot_sigma_m: float
    commanded_rot: FloatArray
    posture_sigma_rad: FloatArray
    roll_sigma_rad: float
    clock_sigma_m: float
    unit_field: FloatArray
    mast: IntArray | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Voltages:
    """Rays of mirrors in a pose, as the mirrors' antennas receive them.

    Attributes
    ----------
    rays
    voltage : (ray,)
        Complex, the propagation phase of the path taken off.
    slope : (ray, xyz)
        Its derivative by a turn of the mirror about east, north and up [1/rad].
    soil_slope : (ray,)
        Relative change of the voltage by a relative change of the ground's complex permittivity; zero for rays that the
        ground did not turn.
    vague : (link,)
        Variance of the real part of what each link receives because the antenna's response is not known well.
    reference_rot : (mirror, 3, 3)
        The orientation they hold for.
    """

    rays: Rays
    voltage: ComplexArray
    slope: ComplexArray
    soil_slope: ComplexArray
    vague: FloatArray
    reference_rot: FloatArray


_FACTOR_SIGMA: dict[RayKind, tuple[float, float]] = {
    RayKind.DIRECT: (0.0, 0.0),
    RayKind.GROUND: (0.05, 0.05),
    RayKind.SPECULAR: (0.1, 0.3),
    RayKind.DIFFRACTED: (0.1, 0.3),
    RayKind.OWN_PLATE: (0.1, 0.3),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class SiteSettings:
    """How poses are fitted.

    Attributes
    ----------
    floor
        Strength of the field that nothing foresees, relative to the direct one; None: found from residuals.
    least_floor
        Residuals do not make it smaller than this.
    tail
        Degrees of freedom ν of Student's t: the smaller, the less a link counts that is far off. None: the one of
        1.5, 2, 3, 8, 30 and 300 that makes the residuals likeliest.
    own_scale
        How many degrees of freedom the mirrors' common floor counts against each mirror's own residuals; infinity: all
        mirrors alike.
    factor_sigma
        By `RayKind`: standard deviation of foreseen rays' factors, relative amplitude and phase [rad].
    soil_sigma
        Standard deviation of the relative change of the ground's complex permittivity, real and imaginary part.
    detour_m
        Mean detour of what nothing foresees [m]: carriers of one antenna that are not far enough apart to tell it from
        the direct ray hear the same of it, and count as one.
    missed_detection
        Risk at which protection levels are exceeded.
    rounds
        How often rays are foreseen anew from the poses found.
    """

    floor: float | None = None
    least_floor: float = 1e-6
    tail: float | None = None
    own_scale: float = 8.0
    factor_sigma: dict[RayKind, tuple[float, float]] = field(default_factory=lambda: dict(_FACTOR_SIGMA))
    soil_sigma: tuple[float, float] = (0.3, 0.1)
    detour_m: float = 1.0
    missed_detection: float = 1e-3
    rounds: int = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class SitePoses:
    """Poses of mirrors; NaN where ``status`` says why.

    Attributes
    ----------
    pivot_enu_m, rot_enu_from_mirror : (mirror, xyz), (mirror, 3, 3)
        [m].
    cov : (mirror, 6, 6)
        Of pivot [m] and turn about east, north, up [rad], in this order.
    weight : (mirror, receiver, transmitter)
        What each link counts beside one without surprises, 0 to 1.3; NaN: not used.
    residual_rad, sigma_rad : (mirror, receiver, transmitter)
        Phase that neither pose nor foreseen rays explain, and its expected standard deviation.
    floor : (mirror,)
        Of each mirror, relative to the direct field.
    dof : (mirror,)
        What remains of the measurements after all that was fitted.
    protection_level_rad : (mirror,)
        The normal is off by more than this at the stated risk.
    status : (mirror,)
        `PoseStatus`.
    common
        What all mirrors have in common.
    """

    pivot_enu_m: FloatArray
    rot_enu_from_mirror: FloatArray
    cov: FloatArray
    weight: FloatArray
    residual_rad: FloatArray
    sigma_rad: FloatArray
    floor: FloatArray
    dof: FloatArray
    protection_level_rad: FloatArray
    status: IntArray
    common: Common

    @property
    def normal_enu(self) -> FloatArray:
        """(mirror, xyz) unit normals."""
        return np.asarray(self.rot_enu_from_mirror[:, :, 2])

    @property
    def normal_cov(self) -> FloatArray:
        """(mirror, 3, 3) covariance of the normals [rad²]."""
        cross = cross_matrix(self.normal_enu)
        return np.asarray(cross @ self.cov[:, 3:, 3:] @ cross.swapaxes(1, 2))


FieldAt = Callable[[FloatArray, FloatArray, "Common"], Voltages]
"""From pivots (mirror, xyz), orientations (mirror, 3, 3; NaN: of this mirror no rays are wanted) and what is known of
the ground to what the antennas would receive there."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Common:
    """What all mirrors of a recording have in common, found from their residuals.

    Attributes
    ----------
    floor
        Strength of the field that nothing foresees, relative to the direct one.
    tail
        Degrees of freedom ν of the distribution of what nothing foresees.
    factor_scale : (kind,)
        By `RayKind`: how large factor errors are beside `SiteSettings.factor_sigma`.
    soil_change
        Relative change of the ground's complex permittivity against what was given.
    soil_sigma
        Its standard deviation, real and imaginary part.
    """

    floor: float
    tail: float
    factor_scale: FloatArray
    soil_change: complex
    soil_sigma: tuple[float, float]


def fit_site(
    observations: SiteObservations, knowledge: SiteKnowledge, field_at: FieldAt, settings: SiteSettings | None = None
) -> SitePoses:
    """Fit the poses of mirrors.

    Parameters
    ----------
    observations, knowledge
    field_at
        Called with the mirrors' poses; NaN poses may be answered with no rays.
    settings

    Returns
    -------
    SitePoses

    Raises
    ------
    InvalidInputError
        Arrays that do not fit each other.
    """
    chosen = settings or SiteSettings()
    fit = SiteFit(observations, knowledge, chosen)
    known, everyone, some = known_mirrors(knowledge)
    common, state, before = given_common(chosen), FitState.begin(knowledge), 0j
    # poses first: what all have in common cannot be told from mirrors that are whole wavelengths off
    state = _of_all_rolls(fit, field_at, _of_all_starts(fit, field_at, state, some, common), some, common)
    for k in range(chosen.rounds + _MORE_ROUNDS):
        if k >= chosen.rounds and abs(common.soil_change - before) < max(common.soil_sigma):
            break
        before = common.soil_change
        # each time about the constants found last, as uncertain as they were given: rays are not linear in them
        common = replace(common, soil_sigma=chosen.soil_sigma)
        common = fit.learn(field_of(field_at, state, some, common), state, some, common)
        state = fit.run(fit.prepare(field_of(field_at, state, some, common)), state, some, common)
    state = _of_all_rolls(fit, field_at, _of_all_starts(fit, field_at, state, everyone, common), everyone, common)
    # on the way there the ground counts as known: what it is uncertain by takes as long to foresee as all the rest
    for ground in (replace(common, soil_sigma=(0.0, 0.0)), common):
        state = fit.run(fit.prepare(field_of(field_at, state, everyone, ground)), state, everyone, ground)
    return fit.outcome(state, known, common)


def heard_by(
    voltages: Voltages, shape: tuple[int, ...], mast: IntArray | None, settings: SiteSettings, common: Common
) -> _kernels.VoltageArrays:
    """Return voltages of (mirror, receiver, transmitter) as the kernels take them."""
    return _Prepared.of(voltages, shape, mast).heard(settings, common)


def given_common(settings: SiteSettings) -> Common:
    """Return what is taken of all mirrors before any residual is seen."""
    return Common(
        floor=_FIRST_FLOOR if settings.floor is None else settings.floor,
        tail=_FIRST_TAIL if settings.tail is None else settings.tail,
        factor_scale=np.ones(len(RayKind)),
        soil_change=0j,
        soil_sigma=settings.soil_sigma,
    )


def known_mirrors(knowledge: SiteKnowledge) -> tuple[BoolArray, IntArray, IntArray]:
    """Return which mirrors can be begun with, the same as rows, and rows spread over them from which all learn."""
    known = np.asarray(
        np.isfinite(knowledge.commanded_rot).all(axis=(1, 2)) & np.isfinite(knowledge.pivot_enu_m).all(axis=1)
    )
    everyone = np.flatnonzero(known)
    spread = np.unique(np.linspace(0, max(len(everyone) - 1, 0), _LEARN_MIRRORS).astype(np.int64))
    return known, everyone, everyone[spread[: len(everyone)]]


def field_of(field_at: FieldAt, state: FitState, rows: IntArray, common: Common) -> Voltages:
    """Return what some mirrors would receive where they are found to be."""
    rot = np.full(state.rot.shape, np.nan)
    rot[rows] = state.rot[rows]
    return field_at(state.pivot, rot, common)


def spread_starts(posture_sigma_rad: float, lever_m: float, wavelength_m: float) -> FloatArray:
    """Return turns (start, xyz) from which to begin so that one is within a sixth of a wavelength of the truth.

    The first is no turn at all. Starts reach 2.5 posture sigmas; none are added where a sixth of the wavelength at the
    lever is farther than that.

    Parameters
    ----------
    posture_sigma_rad
        Of the commanded posture about each axis [rad].
    lever_m
        Of the receivers about the pivot [m].
    wavelength_m
        Of the carrier [m].
    """
    reach = 2.5 * posture_sigma_rad
    step = wavelength_m / 3.0 / lever_m
    n = min(int(np.ceil(max(reach / step - 0.5, 0.0))), 3)
    axis = step * np.arange(-n, n + 1)
    east, north, up = (g.ravel() for g in np.meshgrid(axis, axis, axis, indexing="ij"))
    turns = np.stack([east, north, up], axis=1)
    turns = turns[np.linalg.norm(turns, axis=1) <= max(reach, 1e-12) + 0.5 * step]
    return np.asarray(turns[np.argsort(np.linalg.norm(turns, axis=1), kind="stable")])


@dataclass(frozen=True, slots=True)
class FitState:
    """Where the fit of each mirror stands; arrays as the kernel gives them, pose covariance in turn, then pivot."""

    pivot: FloatArray
    rot: FloatArray
    cov: FloatArray
    weight: FloatArray
    residual: FloatArray
    sigma: FloatArray
    scale: FloatArray
    total: FloatArray
    dof: FloatArray
    cost: FloatArray
    steps: IntArray
    ambiguous: BoolArray

    @classmethod
    def begin(cls, known: SiteKnowledge) -> FitState:
        """Return mirrors as commanded, of which nothing is found yet."""
        n, n_rx = known.receiver_mirror_m.shape[:2]
        link = (n, n_rx, known.unit_field.shape[1])
        row, links = np.full(n, np.nan), np.full(link, np.nan)
        return cls(
            pivot=known.pivot_enu_m.copy(), rot=known.commanded_rot.copy(), cov=np.full((n, 6, 6), np.nan),
            weight=links.copy(), residual=links.copy(), sigma=links.copy(), scale=np.ones(n), total=row.copy(),
            dof=row.copy(), cost=row.copy(), steps=np.full(n, -1, np.int64), ambiguous=np.zeros(n, np.bool_),
        )  # fmt: skip

    def copy(self) -> FitState:
        """Return one that may be written into."""
        return FitState(*(getattr(self, name).copy() for name in FitState.__dataclass_fields__))

    def with_poses_of(self, other: FitState, rows: BoolArray) -> FitState:
        """Return this with some mirrors where the other has them."""
        out = self.copy()
        out.pivot[rows], out.rot[rows] = other.pivot[rows], other.rot[rows]
        return out


@dataclass(frozen=True, slots=True)
class FactorShares:
    """What measurements say of factor errors: (mirror, kind, 2) squares and shares told; (mirror, 2, 2) of the soil."""

    factor: FloatArray
    soil: FloatArray

    @classmethod
    def of(cls, n: int) -> FactorShares:
        return cls(np.full((n, len(RayKind), 2), np.nan), np.full((n, 2, 2), np.nan))


def _soil_as(common: Common) -> dict[str, Any]:
    return {"soil_change": common.soil_change, "soil_sigma": common.soil_sigma}


def _t_constant(nu: float) -> float:
    """Of minus twice Student's log likelihood of one residual, what does not depend on the residual."""
    from scipy.special import gammaln

    return float(np.log(nu * np.pi) - 2.0 * (gammaln(0.5 * (nu + 1.0)) - gammaln(0.5 * nu)))


def _alike(one: Common, other: Common) -> bool:
    change = np.abs(np.log(one.factor_scale / other.factor_scale)).max()
    return bool(max(change, abs(np.log(one.floor / other.floor))) < _LEARN_SETTLED)


class SiteFit:
    """The kernel with everything that does not change from call to call."""

    def __init__(
        self,
        observations: SiteObservations,
        knowledge: SiteKnowledge,
        settings: SiteSettings,
        *,
        max_steps: int = MAX_STEPS,
    ) -> None:
        n, n_rx, n_tx = observations.carrier.shape
        if knowledge.receiver_mirror_m.shape != (n, n_rx, 3) or knowledge.unit_field.shape != (n, n_tx):
            raise InvalidInputError(
                "`observations` and `knowledge` are not of the same mirrors, receivers, transmitters"
            )
        self.seen, self.known, self.settings = observations, knowledge, settings
        self._max_steps = max_steps
        self._own_scale = 0.0 if np.isinf(settings.own_scale) else settings.own_scale
        self._links = _kernels.SiteArrays(
            np.ascontiguousarray(observations.carrier, np.complex128),
            np.ascontiguousarray(observations.sigma, np.float64),
            np.ascontiguousarray(observations.wavenumber_radpm, np.float64),
            np.ascontiguousarray(knowledge.unit_field, np.float64),
            carrier_likeness(observations.wavenumber_radpm, knowledge.mast, settings.detour_m).sum(axis=1),
        )
        with np.errstate(divide="ignore"):
            pivot_info, roll_info, clock_info = (
                float(np.float64(sigma) ** -2.0)
                for sigma in (knowledge.pivot_sigma_m, knowledge.roll_sigma_rad, knowledge.clock_sigma_m)
            )
        self._prior = _kernels.SitePrior(
            pivot=np.ascontiguousarray(knowledge.pivot_enu_m),
            pivot_info=pivot_info,
            commanded_rot=np.ascontiguousarray(knowledge.commanded_rot),
            posture_info=_posture_info(knowledge),
            roll_info=roll_info,
            clock_info=clock_info,
        )

    def run(
        self, prepared: _Prepared, state: FitState, rows: IntArray, common: Common, told: FactorShares | None = None
    ) -> FitState:
        """Fit some mirrors from where they stand; the others stay."""
        out = state.copy()
        out.scale[rows] = 1.0
        for values in (out.weight, out.residual, out.sigma):
            values[rows] = np.nan
        told = FactorShares.of(0) if told is None else told
        _kernels.fit_mirrors(
            len(rows),
            rows,
            self._links,
            prepared.heard(self.settings, common),
            self._prior,
            _kernels.StrayLaw(common.floor, common.tail, self._own_scale, self._max_steps),
            _kernels.SiteFits(
                out.pivot, out.rot, out.cov, out.weight, out.residual, out.sigma, out.scale, out.total, out.dof,
                out.cost, out.steps, told.factor, told.soil,
            ),
            len(told.factor),
        )  # fmt: skip
        return out

    def prepare(self, voltages: Voltages) -> _Prepared:
        """Sort rays as the kernel wants them."""
        return _Prepared.of(voltages, self.seen.carrier.shape, self.known.mast)

    def learn(self, voltages: Voltages, state: FitState, rows: IntArray, common: Common) -> Common:
        """Return what mirrors' residuals say of what all have in common (restricted maximum likelihood)."""
        prepared = self.prepare(voltages)
        best, chosen = self._learn_with(prepared, state, rows, common)
        if self.settings.tail is not None:
            return chosen
        at = _TAILS.index(common.tail)
        # likelihood has one maximum over tails: downhill both ways, each from what was found beside it
        for tails in (_TAILS[at + 1 :], _TAILS[:at][::-1]):
            for tail in tails:
                cost, found = self._learn_with(prepared, state, rows, replace(chosen, tail=tail, **_soil_as(common)))
                if not cost < best:
                    break
                best, chosen = cost, found
            if chosen.tail != common.tail:
                break
        return chosen

    def _learn_with(self, prepared: _Prepared, state: FitState, rows: IntArray, common: Common) -> tuple[float, Common]:
        told = FactorShares.of(len(state.cost))
        for _ in range(_LEARN_ROUNDS):
            state = self.run(prepared, state, rows, common, told)
            last, common = common, self._learned(state, told, rows, common)
            if _alike(last, common):
                break
        n_link = np.isfinite(state.weight[rows]).sum(axis=(1, 2))
        cost = state.cost[rows] + n_link * _t_constant(common.tail)
        total = float(np.nansum(cost)) if np.isfinite(cost).any() else np.inf
        return total, self.with_soil(told, rows, common)

    def _learned(self, state: FitState, told: FactorShares, rows: IntArray, common: Common) -> Common:
        total, dof = state.total[rows], state.dof[rows]
        ended = np.isfinite(total) & (dof > 0.0)
        if not ended.any():
            return common
        floor = common.floor
        if self.settings.floor is None:
            # a mirror that is lost is not to be taken for a stronger field everywhere
            ratio = total[ended] / dof[ended]
            held = np.minimum(ratio, _LOST * np.median(ratio))
            floor *= float(np.sqrt(np.average(held, weights=dof[ended])))
        square, share = np.nansum(told.factor[rows], axis=0).T
        change = np.sqrt((_FACTOR_PRIOR / common.factor_scale**2 + square) / (_FACTOR_PRIOR + share))
        scale = np.clip(common.factor_scale * change, _LEAST_FACTOR_SCALE, 1.0 / _LEAST_FACTOR_SCALE)
        return replace(common, floor=max(floor, self.settings.least_floor), factor_scale=scale)

    def with_soil(self, told: FactorShares, rows: IntArray, given: Common) -> Common:
        """Join what mirrors say of the ground's permittivity, each about the mean that was given."""
        estimate, share = np.moveaxis(np.nan_to_num(told.soil[rows]), 2, 0)
        share = np.clip(share, 0.0, 1.0 - 1e-9)
        with np.errstate(invalid="ignore", divide="ignore"):
            info = np.where(share > 1e-9, share / (1.0 - share), 0.0)
            own = np.where(share > 1e-9, estimate / share, 0.0)
        sigma = np.array(given.soil_sigma)
        joint = (info * own).sum(axis=0) / (1.0 + info.sum(axis=0))
        change = sigma * np.clip(joint, -_SOIL_STEP, _SOIL_STEP)
        left = np.maximum(sigma / np.sqrt(1.0 + info.sum(axis=0)), np.minimum(_LEAST_SOIL_SIGMA, sigma))
        return replace(
            given, soil_change=given.soil_change + complex(*change), soil_sigma=(float(left[0]), float(left[1]))
        )

    def outcome(self, state: FitState, known: BoolArray, common: Common) -> SitePoses:
        """Return what was found, with reasons where nothing was."""
        from scipy.special import fdtri

        order = [3, 4, 5, 0, 1, 2]
        cov = state.cov[:, order][:, :, order]
        status = np.full(len(known), PoseStatus.OK, np.int64)
        poses = SitePoses(
            pivot_enu_m=state.pivot, rot_enu_from_mirror=state.rot, cov=cov, weight=state.weight,
            residual_rad=state.residual, sigma_rad=state.sigma, floor=common.floor * np.sqrt(state.scale),
            dof=state.dof, protection_level_rad=np.full(len(known), np.nan), status=status, common=common,
        )  # fmt: skip
        normal_cov = poses.normal_cov
        sigma = np.sqrt(np.trace(normal_cov, axis1=1, axis2=2))
        worst = np.sqrt(np.linalg.eigvalsh(np.nan_to_num(normal_cov))[:, -1])
        freedom = np.fmax(np.nan_to_num(state.dof), 1.0) + self._own_scale
        level = worst * np.sqrt(2.0 * fdtri(2.0, freedom, 1.0 - self.settings.missed_detection))
        status[~(sigma <= MAX_SIGMA_RAD)] = PoseStatus.UNCERTAIN
        status[state.ambiguous] = PoseStatus.AMBIGUOUS
        status[state.steps >= MAX_STEPS] = PoseStatus.NOT_CONVERGED
        status[_redundancy(state.weight) < _TELLING] = PoseStatus.UNKNOWNS
        status[state.steps < 0] = PoseStatus.UNKNOWNS
        status[~known] = PoseStatus.NO_POSTURE
        lost = np.isin(status, (PoseStatus.UNKNOWNS, PoseStatus.NO_POSTURE, PoseStatus.NOT_CONVERGED))
        for values in (poses.pivot_enu_m, poses.rot_enu_from_mirror, poses.cov, poses.floor):
            values[lost] = np.nan
        return replace(poses, protection_level_rad=np.where(lost, np.nan, level))


def carrier_likeness(wavenumber_radpm: FloatArray, mast: IntArray | None, detour_m: float) -> FloatArray:
    """(transmitter, transmitter) how far carriers of one antenna hear the same of what nothing foresees, 0 to 1.

    The correlation of a ray of random phase and exponentially distributed detour.
    """
    n = len(wavenumber_radpm)
    sender = np.arange(n) if mast is None else mast
    apart = np.subtract.outer(wavenumber_radpm, wavenumber_radpm) * detour_m
    return np.where(np.equal.outer(sender, sender), 1.0 / np.hypot(1.0, apart), 0.0)


def roll_sigma_rad_of(knowledge: SiteKnowledge) -> FloatArray:
    """(mirror,) how far orientations are off about their own normals."""
    normal = knowledge.commanded_rot[:, :, 2]
    sine = np.hypot(normal[:, 0], normal[:, 1])
    return np.minimum(knowledge.posture_sigma_rad / np.maximum(sine, 1e-9), _MOST_ROLL_RAD)


def _posture_info(knowledge: SiteKnowledge) -> FloatArray:
    """(mirror, 3, 3) information on turns about east, north, up."""
    normal = np.nan_to_num(knowledge.commanded_rot[:, :, 2])
    along = normal[:, :, None] * normal[:, None, :]
    across = knowledge.posture_sigma_rad[:, None, None] ** -2.0
    roll = np.where(
        np.isfinite(knowledge.posture_sigma_rad), np.nan_to_num(roll_sigma_rad_of(knowledge), nan=1.0) ** -2.0, 0.0
    )
    return np.ascontiguousarray((np.eye(3) - along) * across + along * roll[:, None, None])


def _redundancy(weight: FloatArray) -> IntArray:
    """(mirror,) links used less one a transmitter and six of the pose."""
    used = np.isfinite(weight)
    return np.asarray(used.sum(axis=(1, 2)) - used.any(axis=1).sum(axis=1) - 6)


def _of_all_starts(fit: SiteFit, field_at: FieldAt, state: FitState, rows: IntArray, common: Common) -> FitState:
    """Begin from elsewhere, too, where wavelengths are short beside what postures are off by; keep the best."""
    knowledge = fit.known
    finite = knowledge.posture_sigma_rad[np.isfinite(knowledge.posture_sigma_rad)]
    turns = spread_starts(float(finite.max(initial=0.0)), _lever_m(fit), _wavelength_m(fit))[1:]
    if not len(turns) or not len(rows):
        return state
    commanded = replace(state, pivot=knowledge.pivot_enu_m, rot=knowledge.commanded_rot)
    near = fit.prepare(field_of(field_at, commanded, rows, common))
    state = fit.run(near, state, rows[state.steps[rows] < 0], common)
    turned = np.empty((3, 3))
    for w in turns:
        _kernels.turn(w, turned)
        state = _from(
            fit, field_at, near, replace(commanded, rot=turned @ knowledge.commanded_rot), state, rows, common
        )
    return state


def _of_all_rolls(fit: SiteFit, field_at: FieldAt, state: FitState, rows: IntArray, common: Common) -> FitState:
    """Begin from elsewhere, too, where mirrors lie nearly flat, so that their roll is hardly known; keep the best."""
    knowledge = fit.known
    roll = roll_sigma_rad_of(knowledge)
    step = _wavelength_m(fit) / 3.0 / _lever_m(fit)
    rows = rows[np.nan_to_num(roll[rows]) > step]
    if not len(rows):
        return state
    commanded = replace(state, pivot=knowledge.pivot_enu_m, rot=knowledge.commanded_rot)
    near = fit.prepare(field_of(field_at, commanded, rows, common))
    n = int(np.ceil(2.0 * float(roll[rows].max()) / step))
    for k in (sign * j for j in range(1, n + 1) for sign in (1, -1)):
        there = rows[np.abs(k) * step <= 2.0 * roll[rows] + step]
        rot = knowledge.commanded_rot.copy()
        sine, cosine = np.sin(k * step), np.cos(k * step)
        # about the mirror's own normal: from the right
        rot[there] = rot[there] @ np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
        state = _from(fit, field_at, near, replace(commanded, rot=rot), state, there, common)
    return state


def _from(
    fit: SiteFit, field_at: FieldAt, near: _Prepared, start: FitState, state: FitState, rows: IntArray, common: Common
) -> FitState:
    """Fit some mirrors from another start; return what stood, with what is better, and what is as good marked."""
    apart_rad = _APART * _wavelength_m(fit) / _lever_m(fit)
    found = fit.run(near, start, rows, common)
    off = np.linalg.norm(found.rot[:, :, 2] - state.rot[:, :, 2], axis=1)
    mine = np.zeros(len(off), np.bool_)
    mine[rows] = True
    ended = mine & (found.steps > 0) & (found.steps < MAX_STEPS)
    other = ended & (off > apart_rad)
    better = ended & ((state.steps <= 0) | (found.cost < state.cost))
    alike = np.abs(found.cost - state.cost) < _AMBIGUOUS_COST
    ambiguous = np.where(better & other, alike, state.ambiguous | (other & alike))
    chosen = np.flatnonzero(better)
    if len(chosen):
        moved = state.with_poses_of(found, better)
        state = fit.run(fit.prepare(field_of(field_at, moved, chosen, common)), moved, chosen, common)
    return replace(state, ambiguous=ambiguous)


def _lever_m(fit: SiteFit) -> float:
    return max(float(np.nanmax(np.linalg.norm(fit.known.receiver_mirror_m, axis=-1), initial=0.0)), 1e-9)


def _wavelength_m(fit: SiteFit) -> float:
    return 2.0 * np.pi / float(fit.seen.wavenumber_radpm.max())


@dataclass(frozen=True, slots=True)
class _Prepared:
    """Rays in the order that the kernel wants them: those that share their factor's error beside each other.

    Attributes
    ----------
    voltages
    order : (ray,)
        Rays by mirror and group.
    group : (ray,)
        Equal for rays of one mirror that share their factor's error.
    link_of : (ray,)
        Within the mirror.
    """

    voltages: Voltages
    order: IntArray
    group: IntArray
    link_of: IntArray

    @classmethod
    def of(cls, voltages: Voltages, shape: tuple[int, ...], mast: IntArray | None) -> _Prepared:
        """Sort the rays of mirrors with so many receivers and transmitters, carriers of one antenna together."""
        rays = voltages.rays
        link = np.repeat(np.arange(len(rays.first) - 1), np.diff(rays.first))
        mirror, link_of = np.divmod(link, shape[1] * shape[2])
        ground = rays.kind == RayKind.GROUND
        sender = link_of % shape[2] if mast is None else mast[link_of % shape[2]]
        shared = np.where(ground, 0, sender)
        thing = np.where(ground, 0, rays.thing.astype(np.int64) + 1)
        group = (thing * shape[2] + shared) * len(RayKind) + rays.kind
        order = np.lexsort((group, mirror))
        return cls(voltages, np.asarray(order, np.int64), np.asarray(group, np.int64), link_of)

    def heard(self, settings: SiteSettings, common: Common) -> _kernels.VoltageArrays:
        """Return what the kernel takes."""
        voltages, rays = self.voltages, self.voltages.rays
        sigma = np.array([settings.factor_sigma.get(kind, (0.0, 0.0)) for kind in RayKind])
        amplitude, phase = (sigma * common.factor_scale[:, None])[rays.kind].T
        exact = (amplitude == 0.0) & (phase == 0.0)
        return _kernels.VoltageArrays(
            first=rays.first, link_of=self.link_of, source=rays.source_enu_m, place=rays.place_mirror_m,
            extra=rays.extra_m, voltage=voltages.voltage, slope=voltages.slope, soil_slope=voltages.soil_slope,
            vague=voltages.vague, kind=rays.kind, order=self.order, group=np.where(exact, -1, self.group),
            amplitude_error=np.ascontiguousarray(amplitude), phase_error=np.ascontiguousarray(phase),
            soil_error=np.array(common.soil_sigma), reference_rot=voltages.reference_rot,
        )  # fmt: skip
