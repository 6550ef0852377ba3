"""Position and orientation of a mirror from all phases of its receivers at once.

Maximum likelihood for a rigid mirror. What is known enters as it is: the receivers' places on the mirror, their common
oscillator, the surveyed pivot, the two-axis mount, and the transmitters' own errors, which are the same for all
receivers of a frame.

`MirrorProblem` says what is measured of mirrors, what is known besides, and the equations' weights made of both;
`solve_rigid` solves it; `begin`, `fit` and `predict` are the step that all solvers of rigid mirrors take.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from rfpose import geometry
from rfpose.checks import FloatArray, as_float_array
from rfpose.errors import GeometryError, InvalidInputError
from rfpose.multilat.equations import MirrorArrays, MirrorPrior
from rfpose.multilat.reflection import SharedGeometry, direct_rays
from rfpose.multilat.rigid import _kernels
from rfpose.multilat.rigid._kernels import FitRule, RigidFits
from rfpose.multilat.status import PoseStatus

__all__ = [
    "FLOOR",
    "NO_TURN",
    "PRIORS",
    "FitRule",
    "MirrorKnowledge",
    "MirrorProblem",
    "Observation",
    "RigidFits",
    "RigidPoses",
    "begin",
    "fit",
    "full_covariance",
    "predict",
    "rigid_bound",
    "solve_rigid",
    "tilt_sigma_rad",
]

BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int64]

PRIORS = ("pivot", "mount", "clocks")
"""What a mirror may rest on besides its phases."""

STIFFEST_TIE = 1e-8
"""Smallest variance of a receiver's delay, in units of the best observation's: stiff enough to be a shared clock."""

FLOOR = 1e-13
"""Smallest share of an unknown's information that the other unknowns may leave before it counts as unobserved."""

NO_TURN: FloatArray = np.zeros((0, 3))

_RULE = FitRule(max_iteration=40, floor=FLOOR, longest_turn=0.5, settled=1e-6)  # a thousandth of a sigma


@dataclass(frozen=True, slots=True, kw_only=True)
class MirrorKnowledge:
    """What is known about mirrors besides the phases.

    Attributes
    ----------
    clock_sigma_m
        Standard deviation of each receiver's delay about the mirror's common clock [m]: 0 means one shared clock
        with known delays, infinity one unknown clock a receiver.
    pivot_enu_m : (mirror, xyz) or None
        Surveyed pivots [m].
    pivot_sigma_m
        Their standard deviation in each axis [m].
    two_axis
        The mirror stands on an azimuth-elevation mount: its x axis stays horizontal.
    roll_sigma_rad
        How well it does.
    """

    clock_sigma_m: float = np.inf
    pivot_enu_m: FloatArray | None = None
    pivot_sigma_m: float = np.inf
    two_axis: bool = False
    roll_sigma_rad: float = 1e-6

    @property
    def has_pivot(self) -> bool:
        """Whether pivots are surveyed."""
        return self.pivot_enu_m is not None and bool(np.isfinite(self.pivot_sigma_m))

    def take(self, rows: IntArray) -> MirrorKnowledge:
        """Select mirrors."""
        return self if self.pivot_enu_m is None else replace(self, pivot_enu_m=self.pivot_enu_m[rows])


@dataclass(frozen=True, slots=True, kw_only=True)
class Observation:
    """One wavelength's phases as ranges: a tone, or the carrier.

    Attributes
    ----------
    range_m : (mirror, receiver, transmitter)
        −λ/(2π) × phase, up to whole wavelengths [m]; NaN = not received.
    sigma_m : (mirror, receiver, transmitter)
        Own noise [m].
    transmitter_sigma_m : (mirror, transmitter)
        Error common to all receivers [m]; infinity where nothing calibrates it.
    wavelength_m : (transmitter,)
        [m].
    clock_class
        Which clocks it sees: those of one number are the same.
    carrier
        Whether it is the carrier's own phase.
    """

    range_m: FloatArray
    sigma_m: FloatArray
    transmitter_sigma_m: FloatArray
    wavelength_m: FloatArray
    clock_class: int
    carrier: bool = False


@dataclass(frozen=True, kw_only=True)
class MirrorProblem:
    """Mirrors to be solved; `of`, `of_observations` and `expected` make one and check it.

    A group is one wavelength's phases: tones, coarsest first, then the carrier.

    Attributes
    ----------
    transmitter_enu_m : (transmitter, xyz)
        [m].
    receiver_mirror_m : (mirror, receiver, xyz)
        From the pivot, in the mirror frame [m].
    range_m : (mirror, group, receiver, transmitter)
        Range plus clock [m]; NaN = not received.
    sigma_m : (mirror, group, receiver, transmitter)
        Own noise of each [m]; NaN or infinity = not received.
    transmitter_sigma_m : (mirror, group, transmitter)
        Error common to all receivers: of the calibration; infinity without one [m].
    clock_class : (group,)
        Which clocks a group sees.
    start_pivot_enu_m, start_rot_enu_from_mirror : (mirror, xyz), (mirror, 3, 3)
        Where to begin; NaN: nowhere.
    knowledge
        Clocks, pivot and mount.
    wavelength_m : (group, transmitter)
        [m]; NaN where whole wavelengths are resolved already and nobody asks.
    is_carrier : (group,)
    dropped : (mirror, prior)
        Which of `PRIORS` is known but not used.
    """

    transmitter_enu_m: FloatArray
    receiver_mirror_m: FloatArray
    range_m: FloatArray
    sigma_m: FloatArray
    transmitter_sigma_m: FloatArray
    clock_class: IntArray
    start_pivot_enu_m: FloatArray
    start_rot_enu_from_mirror: FloatArray
    knowledge: MirrorKnowledge
    wavelength_m: FloatArray
    is_carrier: BoolArray
    dropped: BoolArray

    @classmethod
    def of(
        cls,
        transmitter_enu_m: npt.ArrayLike,
        receiver_mirror_m: npt.ArrayLike,
        range_m: npt.ArrayLike,
        *,
        sigma_m: npt.ArrayLike,
        transmitter_sigma_m: npt.ArrayLike,
        clock_class: npt.ArrayLike,
        start_pivot_enu_m: npt.ArrayLike,
        start_rot_enu_from_mirror: npt.ArrayLike,
        knowledge: MirrorKnowledge | None = None,
    ) -> MirrorProblem:
        """Return mirrors whose whole wavelengths are resolved; arrays as the attributes, broadcast.

        Raises
        ------
        InvalidInputError
            Shapes that do not fit, a sigma that is not positive.
        GeometryError
            Receivers on a line.
        """
        transmitter = as_float_array("transmitter_enu_m", transmitter_enu_m, ("transmitter", 3))
        z = as_float_array("range_m", range_m, ("mirror", "group", "receiver", "transmitter"), finite=False)
        n_mirror, n_group, n_receiver, n_transmitter = z.shape
        if n_transmitter != len(transmitter):
            raise InvalidInputError(
                f"`range_m` has {n_transmitter} transmitters, `transmitter_enu_m` {len(transmitter)}"
            )
        sigma = np.broadcast_to(np.asarray(sigma_m, np.float64), z.shape)
        if np.any(sigma <= 0.0):
            raise InvalidInputError("`sigma_m` must be greater than zero")
        known = knowledge or MirrorKnowledge()
        if known.pivot_enu_m is not None:
            known = replace(known, pivot_enu_m=_spread(known.pivot_enu_m, (n_mirror, 3)))
        return cls(
            transmitter_enu_m=transmitter,
            receiver_mirror_m=_places(receiver_mirror_m, n_mirror, n_receiver),
            range_m=z,
            sigma_m=sigma,
            transmitter_sigma_m=_spread(transmitter_sigma_m, (n_mirror, n_group, n_transmitter)),
            clock_class=np.asarray(clock_class, np.int64),
            start_pivot_enu_m=_spread(start_pivot_enu_m, (n_mirror, 3)),
            start_rot_enu_from_mirror=_spread(start_rot_enu_from_mirror, (n_mirror, 3, 3)),
            knowledge=known,
            wavelength_m=np.full((n_group, n_transmitter), np.nan),
            is_carrier=np.zeros(n_group, np.bool_),
            dropped=np.zeros((n_mirror, len(PRIORS)), np.bool_),
        )

    @classmethod
    def of_observations(
        cls,
        transmitter_enu_m: npt.ArrayLike,
        receiver_mirror_m: npt.ArrayLike,
        observations: Sequence[Observation],
        *,
        start_pivot_enu_m: npt.ArrayLike,
        start_rot_enu_from_mirror: npt.ArrayLike,
        knowledge: MirrorKnowledge | None = None,
    ) -> MirrorProblem:
        """Return mirrors whose finer wavelengths are to be resolved: tones, coarsest first, then the carrier.

        Raises
        ------
        InvalidInputError, GeometryError
            As `of`; no tone, or a tone after the carrier.
        """
        carrier = [o.carrier for o in observations]
        if not observations or carrier[0] or carrier != sorted(carrier):
            raise InvalidInputError("`observations` must hold at least one tone, and tones before the carrier")
        shape = np.shape(observations[0].range_m)
        n_transmitter = len(np.asarray(transmitter_enu_m))
        for k, o in enumerate(observations):
            if np.ndim(o.range_m) != 3 or np.shape(o.range_m) != shape or shape[2] != n_transmitter:
                raise InvalidInputError(
                    f"`range_m` of observation {k} must have shape (mirror, receiver, {n_transmitter}) like the first, "
                    f"got {np.shape(o.range_m)}"
                )
        problem = cls.of(
            transmitter_enu_m,
            receiver_mirror_m,
            np.stack([o.range_m for o in observations], axis=1),
            sigma_m=np.stack([np.broadcast_to(o.sigma_m, shape) for o in observations], axis=1),
            transmitter_sigma_m=np.stack(
                [np.broadcast_to(o.transmitter_sigma_m, (shape[0], shape[2])) for o in observations], axis=1
            ),
            clock_class=[o.clock_class for o in observations],
            start_pivot_enu_m=start_pivot_enu_m,
            start_rot_enu_from_mirror=start_rot_enu_from_mirror,
            knowledge=knowledge,
        )
        waves = np.stack([np.broadcast_to(np.asarray(o.wavelength_m, np.float64), shape[2:]) for o in observations])
        return replace(problem, wavelength_m=waves, is_carrier=np.array(carrier))

    @classmethod
    def expected(
        cls,
        transmitter_enu_m: npt.ArrayLike,
        receiver_mirror_m: npt.ArrayLike,
        pivot_enu_m: npt.ArrayLike,
        rot_enu_from_mirror: npt.ArrayLike,
        *,
        sigma_m: npt.ArrayLike,
        transmitter_sigma_m: npt.ArrayLike,
        clock_class: npt.ArrayLike,
        knowledge: MirrorKnowledge | None = None,
    ) -> MirrorProblem:
        """Return mirrors in known poses, of which nothing is measured yet: for bounds. Arrays as in `of`."""
        sigma = as_float_array("sigma_m", sigma_m, ("mirror", "group", "receiver", "transmitter"), finite=False)
        return cls.of(
            transmitter_enu_m,
            receiver_mirror_m,
            np.where(np.isfinite(sigma), 0.0, np.nan),
            sigma_m=sigma,
            transmitter_sigma_m=transmitter_sigma_m,
            clock_class=clock_class,
            start_pivot_enu_m=pivot_enu_m,
            start_rot_enu_from_mirror=rot_enu_from_mirror,
            knowledge=knowledge,
        )

    @property
    def n_tone(self) -> int:
        """Groups that are tones."""
        return int(np.count_nonzero(~self.is_carrier))

    @property
    def n_class(self) -> int:
        """Clocks of each receiver."""
        return int(self.clock_class.max()) + 1

    def take(self, rows: IntArray) -> MirrorProblem:
        """Select mirrors."""
        return replace(
            self,
            receiver_mirror_m=self.receiver_mirror_m[rows],
            range_m=self.range_m[rows],
            sigma_m=self.sigma_m[rows],
            transmitter_sigma_m=self.transmitter_sigma_m[rows],
            start_pivot_enu_m=self.start_pivot_enu_m[rows],
            start_rot_enu_from_mirror=self.start_rot_enu_from_mirror[rows],
            knowledge=self.knowledge.take(rows),
            dropped=self.dropped[rows],
        )

    def groups(self, which: slice) -> MirrorProblem:
        """Select wavelengths."""
        return replace(
            self,
            range_m=self.range_m[:, which],
            sigma_m=self.sigma_m[:, which],
            transmitter_sigma_m=self.transmitter_sigma_m[:, which],
            clock_class=self.clock_class[which],
            wavelength_m=self.wavelength_m[which],
            is_carrier=self.is_carrier[which],
        )

    def observation(self, k: int) -> Observation:
        """Return one wavelength's phases."""
        return Observation(
            range_m=self.range_m[:, k],
            sigma_m=self.sigma_m[:, k],
            transmitter_sigma_m=self.transmitter_sigma_m[:, k],
            wavelength_m=self.wavelength_m[k],
            clock_class=int(self.clock_class[k]),
            carrier=bool(self.is_carrier[k]),
        )

    def started(self, pivot_enu_m: FloatArray, rot_enu_from_mirror: FloatArray) -> MirrorProblem:
        """Return the mirrors beginning elsewhere; where that is nowhere, as before."""
        rot = rot_enu_from_mirror
        return replace(
            self,
            start_pivot_enu_m=np.where(np.isfinite(pivot_enu_m), pivot_enu_m, self.start_pivot_enu_m),
            start_rot_enu_from_mirror=np.where(np.isfinite(rot), rot, self.start_rot_enu_from_mirror),
        )

    def only(self, used: BoolArray) -> MirrorProblem:
        """Leave out what is not used (mirror, receiver, transmitter)."""
        return replace(self, range_m=np.where(used[:, None], self.range_m, np.nan))

    @property
    def has_start(self) -> BoolArray:
        """(mirror,) whether there is a pose to begin with."""
        pivot, rot = self.start_pivot_enu_m, self.start_rot_enu_from_mirror
        return np.asarray(np.isfinite(pivot).all(axis=1) & np.isfinite(rot).all(axis=(1, 2)))

    @property
    def has_prior(self) -> BoolArray:
        """(mirror, prior) which of `PRIORS` is used."""
        known = self.knowledge
        given = np.array([known.has_pivot, known.two_axis, np.isfinite(known.clock_sigma_m)])
        return np.asarray(given & ~self.dropped)

    @cached_property
    def equations(self) -> MirrorArrays:
        """What the solvers' equations weigh; clocks begin, and stay if nothing moves them, where they fit best."""
        mirrors = self.weighed()
        scene = direct_rays(self.transmitter_enu_m, self.range_m.shape[1])
        _kernels.clocks_many(
            len(self.range_m), scene, mirrors, self.start_pivot_enu_m, self.start_rot_enu_from_mirror,
            mirrors.prior.clock,
        )  # fmt: skip
        return mirrors

    def weighed(self, stiffest_tie: float = STIFFEST_TIE) -> MirrorArrays:
        """`equations` about clocks of zero, where a shared clock is no stiffer than told (see `STIFFEST_TIE`)."""
        known, has, n_mirror = self.knowledge, self.has_prior, len(self.range_m)
        sigma, common = self.sigma_m, self.transmitter_sigma_m
        seen = np.isfinite(self.range_m) & np.isfinite(sigma)
        weight = np.where(seen, 1.0 / np.where(seen, sigma, 1.0) ** 2, 0.0)
        with np.errstate(divide="ignore"):
            bias_info = np.array(np.where(np.isnan(common), 0.0, 1.0 / common**2))
        own, tie = self._clock_ties(weight, bias_info, stiffest_tie)
        return MirrorArrays(
            receiver_mirror=np.ascontiguousarray(self.receiver_mirror_m),
            z=np.nan_to_num(self.range_m),
            weight=weight,
            bias_info=bias_info,
            clock_class=self.clock_class,
            prior=MirrorPrior(
                pivot=np.zeros((n_mirror, 3)) if known.pivot_enu_m is None else np.array(known.pivot_enu_m),
                pivot_info=has[:, 0, None, None] * (np.eye(3) / known.pivot_sigma_m**2),
                roll_info=np.where(has[:, 1], known.roll_sigma_rad**-2, 0.0),
                clock_own=own,
                clock_tie=tie,
                clock=np.zeros_like(own),
            ),
            frame=np.zeros(n_mirror, np.int64),
        )

    @cached_property
    def dof(self) -> FloatArray:
        """(mirror,) measurements and priors less unknowns: what chi² should be."""
        weight, bias_info, has = self.equations.weight, self.equations.bias_info, self.has_prior
        seen = weight > 0.0
        n = seen.sum(axis=(1, 2, 3)).astype(np.float64) - 6.0 + has[:, :2] @ [3, 1]
        n -= (np.any(seen, axis=2) & (bias_info == 0.0)).sum(axis=(1, 2))
        for k in range(self.n_class):
            mine = self.clock_class == k
            clocks = np.any(seen[:, mine], axis=(1, 3)).sum(axis=1)
            free = np.where(has[:, 2], np.minimum(clocks, 1), clocks)
            # without calibration a common clock is the transmitters' as well, and counted with them
            calibrated = np.any(bias_info[:, mine] > 0.0, axis=(1, 2))
            n -= np.where(calibrated, free, np.maximum(free - 1, 0))
        return np.asarray(n)

    def _clock_ties(self, weight: FloatArray, bias_info: FloatArray, stiffest: float) -> tuple[FloatArray, FloatArray]:
        """Information on each clock and on the differences between clocks.

        Clocks c + δ_r with δ_r of standard deviation s have differences of information 1/(R s²) a pair. Where no
        transmitter is calibrated a common clock is theirs as well: the first receiver's is then held, which says
        nothing.
        """
        n_mirror, _, n_receiver, _ = weight.shape
        own = np.zeros((n_mirror, self.n_class, n_receiver))
        tie = np.zeros((n_mirror, self.n_class, n_receiver, n_receiver))
        tied = self.has_prior[:, 2]
        for k in range(self.n_class):
            mine = self.clock_class == k
            # each mirror's and class's own scale: no mirror's result depends on its neighbours, and the stiffest tie of
            # a coarse tone stays comparable with what that tone observes
            largest = np.maximum(weight[:, mine].max(axis=(1, 2, 3), initial=0.0), 1e-300)
            known = np.any(bias_info[:, mine] > 0.0, axis=(1, 2))
            own[:, k, 0] = np.where(known, 0.0, largest)
            # a clock that nothing observes is held as well; it takes part in nothing
            seen = np.any(weight[:, mine] > 0.0, axis=(1, 3))
            lost = np.where(tied[:, None], ~seen.any(axis=1, keepdims=True) & (np.arange(n_receiver) == 0), ~seen)
            own[:, k] = np.where(lost, largest[:, None], own[:, k])
            if tied.any():
                stiff = largest / (n_receiver * np.maximum(self.knowledge.clock_sigma_m**2 * largest, stiffest))
                tie[:, k] = np.where(tied, stiff, 0.0)[:, None, None]
        return own, tie


@dataclass(frozen=True, slots=True, kw_only=True)
class RigidPoses:
    """Poses of many mirrors.

    Attributes
    ----------
    pivot_enu_m : (mirror, xyz)
        [m]; NaN where not solved, like all that follows.
    rot_enu_from_mirror : (mirror, 3, 3)
    clock_m : (mirror, class, receiver)
        Clocks as ranges [m].
    cov : (mirror, 6, 6)
        Of pivot [m] and rotation vector in ENU [rad].
    chi2 : (mirror,)
        Weighted sum of squares left.
    dof : (mirror,)
        Measurements and priors less unknowns: what ``chi2`` should be.
    n_iteration, status : (mirror,)
        ``status`` is `rfpose.multilat.PoseStatus`.
    """

    pivot_enu_m: FloatArray
    rot_enu_from_mirror: FloatArray
    clock_m: FloatArray
    cov: FloatArray
    chi2: FloatArray
    dof: FloatArray
    n_iteration: npt.NDArray[np.int64]
    status: npt.NDArray[np.int64]

    @property
    def normal_enu(self) -> FloatArray:
        """(mirror, xyz) unit normals."""
        return self.rot_enu_from_mirror[:, :, 2]

    @property
    def tilt_sigma_rad(self) -> FloatArray:
        """(mirror,) rms angle between estimated and true normal [rad]."""
        return tilt_sigma_rad(self.cov, self.normal_enu)


def tilt_sigma_rad(cov: FloatArray, normal_enu: FloatArray) -> FloatArray:
    """Rms angle of the normal from the covariance (…, 6, 6): the rotation's variance less that about the normal."""
    turn = cov[..., 3:, 3:]
    about = np.einsum("...a,...ab,...b->...", normal_enu, turn, normal_enu)
    return np.asarray(np.sqrt(np.trace(turn, axis1=-2, axis2=-1) - about))


def solve_rigid(problem: MirrorProblem) -> RigidPoses:
    """Solve rigid poses of many mirrors by Gauss-Newton; whole wavelengths count as resolved."""
    mirrors = problem.equations
    status = np.zeros(len(problem.range_m), np.int64)
    status[np.sum(mirrors.weight > 0, axis=(1, 2, 3)) < 4] = PoseStatus.UNKNOWNS
    status[~problem.has_start] = PoseStatus.TOO_FEW
    fits = begin(mirrors, problem.start_pivot_enu_m, problem.start_rot_enu_from_mirror, status, n_cov=6)
    fit(direct_rays(problem.transmitter_enu_m, mirrors.z.shape[1]), mirrors, _RULE, fits)
    bad = fits.status != PoseStatus.OK
    for array in (fits.pivot, fits.rot, fits.clock, fits.cov, fits.chi2):
        array[bad] = np.nan
    return RigidPoses(
        pivot_enu_m=fits.pivot,
        rot_enu_from_mirror=fits.rot,
        clock_m=fits.clock,
        cov=fits.cov,
        chi2=fits.chi2,
        dof=problem.dof,
        n_iteration=fits.n_iteration,
        status=fits.status,
    )


def begin(
    mirrors: MirrorArrays,
    pivot: FloatArray,
    rot: FloatArray,
    status: npt.NDArray[np.int64],
    *,
    n_cov: int,
    n_parameter: int = 0,
) -> RigidFits:
    """Nothing solved yet; covariances are kept of the first ``n_cov`` unknowns."""
    clock = mirrors.prior.clock
    n_mirror, n_class, n_receiver = clock.shape
    return RigidFits(
        pivot=pivot.copy(),
        rot=rot.copy(),
        clock=clock.copy(),
        cov=np.full((n_mirror, n_cov, n_cov), np.nan),
        follow=np.zeros((n_mirror, 6 + n_class * n_receiver, n_parameter)),
        schur=np.zeros((n_mirror, n_parameter, n_parameter)),
        rest=np.zeros((n_mirror, n_parameter)),
        chi2=np.full(n_mirror, np.inf),
        n_iteration=np.zeros(n_mirror, np.int64),
        status=status.copy(),
    )


def fit(
    scene: SharedGeometry,
    mirrors: MirrorArrays,
    rule: FitRule,
    fits: RigidFits,
    *,
    turn: FloatArray = NO_TURN,
    enough: FloatArray | float = np.inf,
) -> None:
    """Solve every mirror from where ``fits`` stands, or from there turned by each of ``turn`` until it fits.

    One that does not converge keeps pose and chi² of its last step.
    """
    n_mirror = len(fits.chi2)
    enough = np.array(np.broadcast_to(enough, (n_mirror,)), np.float64)
    _kernels.fit_many(n_mirror, scene, mirrors, rule, turn, enough, fits)


def predict(scene: SharedGeometry, mirrors: MirrorArrays, fits: RigidFits) -> tuple[FloatArray, FloatArray]:
    """Ranges (mirror, group, receiver, transmitter) and their derivatives (…, 6 + parameter)."""
    n_group = mirrors.z.shape[1] if len(scene.image) else 1
    predicted = np.empty((len(mirrors.z), n_group, *mirrors.z.shape[2:]))
    slope = np.empty((*predicted.shape, 6 + fits.schur.shape[1]))
    _kernels.predict_many(len(predicted), scene, mirrors, fits.pivot, fits.rot, predicted, slope)
    shape = mirrors.z.shape
    return np.array(np.broadcast_to(predicted, shape)), np.array(np.broadcast_to(slope, (*shape, slope.shape[-1])))


def rigid_bound(problem: MirrorProblem) -> FloatArray:
    """Cramér–Rao bound of rigid poses: covariance of pivot [m] and rotation [rad].

    Parameters
    ----------
    problem
        Its starts are the true poses; see `MirrorProblem.expected`.

    Returns
    -------
    (mirror, 6, 6)
        NaN where the pose is not determined. `tilt_sigma_rad` makes the normal's rms angle of it.
    """
    return full_covariance(problem)[:, :6, :6]


def full_covariance(problem: MirrorProblem) -> FloatArray:
    """Return the covariance of pivot [m], rotation [rad] and every clock [m], at the poses to begin with.

    Returns
    -------
    (mirror, unknown, unknown)
        Order: pivot, rotation, then clocks by class and receiver. NaN where the pose is not determined.
    """
    mirrors = problem.weighed()
    n_mirror, _, n_receiver, _ = mirrors.z.shape
    n_unknown = 6 + problem.n_class * n_receiver
    cov = np.full((n_mirror, n_unknown, n_unknown), np.nan)
    _kernels.covariance_many(
        n_mirror,
        direct_rays(problem.transmitter_enu_m, mirrors.z.shape[1]),
        mirrors,
        FLOOR,
        problem.start_pivot_enu_m,
        problem.start_rot_enu_from_mirror,
        mirrors.prior.clock,
        cov,
    )
    return cov


def _places(receiver_mirror_m: npt.ArrayLike, n_mirror: int, n_receiver: int) -> FloatArray:
    """Receivers in the mirror frame, one row a mirror; three or more, not on a line."""
    places = as_float_array("receiver_mirror_m", receiver_mirror_m, ("...", n_receiver, 3))
    for mirror in places.reshape(-1, n_receiver, 3)[:1]:
        if n_receiver < 3 or geometry.is_collinear(mirror):
            raise GeometryError("`receiver_mirror_m` must hold three or more receivers that are not on a line")
    return np.array(np.broadcast_to(places, (n_mirror, n_receiver, 3)))


def _spread(values: npt.ArrayLike, shape: tuple[int, ...]) -> FloatArray:
    return np.array(np.broadcast_to(np.asarray(values, np.float64), shape))
