r"""What does not change while mirrors turn, from their carriers in many postures: places, pivots, transmitters, delays.

Each frame of each mirror has its own pose and its own phase a transmitter. They are eliminated from the frame's
linearised phases (`fit.py`'s model, with its weights and its covariance); what remains says something of the constants,
and is summed over the frames of a mirror and, for the transmitters, over mirrors. Poses are free: what control
commanded is off in the same way in all frames, so that averaging it over frames would feign a knowledge. Nor are frames
of near postures independent: what nothing foresees is alike in them (`correlation.py`), and each counts as much less as
there are frames like it.

References
----------
Triggs et al., Bundle adjustment -- a modern synthesis, Vision Algorithms 1999, sections 6 and 9, for the reduced normal
equations and the gauge.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.errors import InvalidInputError
from rfpose.geometry import rot_enu_from_mirror
from rfpose.multilat.site import _kernels
from rfpose.multilat.site.correlation import PostureCorrelation, found_correlation
from rfpose.multilat.site.fit import (
    FieldAt,
    SiteKnowledge,
    SiteObservations,
    SitePoses,
    SiteSettings,
    Voltages,
    carrier_likeness,
    fit_site,
    heard_by,
)
from rfpose.propagation import RayKind

__all__ = [
    "CASES",
    "ReferencePoses",
    "Survey",
    "SurveyConstants",
    "SurveyPrior",
    "lever_to_turn",
    "survey_site",
]

ComplexArray = npt.NDArray[np.complex128]
IntArray = npt.NDArray[np.int64]

_ROUNDS = 8
_SETTLED_SIGMAS = 0.25
"""Of the change of constants by one round, beside their posterior sigma."""
_HELD_PIVOT_M = 1e-5
"""Pivots are constants here: the fit of a single pose may not move its own."""
_FREE = 1e-6
_UNDETERMINED = 0.1
"""A direction of which measurements say less than this part of what the prior says is not determined by them."""
_NAMED = 0.5
_SURVEYED_M = 1e-4
_REFERENCE_RAD = 1e-4


@dataclass(frozen=True, slots=True, kw_only=True)
class SurveyConstants:
    """What does not change.

    Attributes
    ----------
    receiver_mirror_m : (mirror, receiver, xyz)
        From the pivot, in the mirror frame [m].
    pivot_enu_m : (mirror, xyz)
        [m].
    transmitter_enu_m : (transmitter, xyz)
        [m].
    delay_m : (mirror, receiver)
        Of each receiver about the mirror's common clock [m].
    """

    receiver_mirror_m: FloatArray
    pivot_enu_m: FloatArray
    transmitter_enu_m: FloatArray
    delay_m: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class SurveyPrior:
    """How well constants are known before; in each axis.

    Attributes
    ----------
    place_sigma_m, pivot_sigma_m
        Above zero [m].
    transmitter_sigma_m : (transmitter,)
        Zero: taken as it is [m].
    delay_sigma_m
        Zero: there are none; infinity: another in every frame, which is not surveyed [m].
    correlation
        Of errors over posture; None: found from residuals.
    """

    place_sigma_m: float
    pivot_sigma_m: float
    transmitter_sigma_m: FloatArray
    delay_sigma_m: float
    correlation: PostureCorrelation | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class ReferencePoses:
    """Normals that something else than radio measured (a camera), first axis frame × mirror.

    Attributes
    ----------
    normal_enu : (frame × mirror, xyz)
        Unit vectors; NaN: none.
    sigma_rad : (frame × mirror,)
        In each of two directions [rad].
    """

    normal_enu: FloatArray
    sigma_rad: FloatArray


FieldFor = Callable[[SurveyConstants], FieldAt]
"""From constants to what mirrors would receive with them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Survey:
    """What a survey by radio found.

    Attributes
    ----------
    constants
        Where nothing was measured, as they were.
    cov : (mirror, constant, constant)
        Of each mirror's places (receiver × xyz), pivot and, if surveyed, delays, in this order [m²].
    prior_sigma_m : (constant,)
        In this order.
    transmitter_cov : (3 transmitter, 3 transmitter)
        [m²].
    n_frame : (mirror,)
        Frames that told something.
    n_independent : (mirror,)
        How many independent ones they are worth.
    correlation
        Of errors over posture.
    turn_by_constant : (frame × mirror, xy, constant)
        What an error of a mirror's constants makes of its turn about its own x and y [rad/m]; NaN: no pose.
    rank : (mirror,)
        How many directions of its constants measurements determine better than they were known.
    undetermined : (mirror,)
        In plain words, which they do not.
    transmitters_undetermined
        The same of all transmitters.
    normal_sigma_rad : (mirror, case)
        What the constants' errors leave of the normal, the worse direction; cases are `CASES`.
    poses
        Of all frames with these constants.
    rounds
        Rounds that were made; ``settled`` says whether the last one still moved something.
    settled
    """

    constants: SurveyConstants
    cov: FloatArray
    prior_sigma_m: FloatArray
    transmitter_cov: FloatArray
    n_frame: IntArray
    n_independent: FloatArray
    correlation: PostureCorrelation
    turn_by_constant: FloatArray
    rank: IntArray
    undetermined: tuple[tuple[str, ...], ...]
    transmitters_undetermined: tuple[str, ...]
    normal_sigma_rad: FloatArray
    poses: SitePoses
    rounds: int
    settled: bool

    @property
    def delay_sigma_m(self) -> FloatArray:
        """(mirror, receiver) standard deviation of delays about a mirror's mean, which no pose depends on [m]."""
        n_rx = self.constants.delay_m.shape[1]
        own = self.cov[:, 3 * n_rx + 3 :, 3 * n_rx + 3 :]
        if not own.size:
            return np.zeros(self.constants.delay_m.shape)
        about = np.eye(n_rx) - 1.0 / n_rx
        return np.asarray(np.sqrt(np.einsum("rp,mpq,rq->mr", about, own, about)))

    def normal_cov(self, mirror: int) -> FloatArray:
        """Return the covariance of a mirror's normals over frames, and between them.

        Returns
        -------
        (frame, xy, frame, xy)
            Of the components along x and y of a mirror whose x axis lies level [rad²]. NaN: frames without a pose.

        Notes
        -----
        Noise and multipath go together as near as the postures are; constants' errors are the same in all frames, a
        turn of the receivers against the plate wholly.
        """
        n_mirror = len(self.n_frame)
        own = slice(mirror, None, n_mirror)
        rot, normal = self.poses.rot_enu_from_mirror[own], self.poses.normal_enu[own]
        turn = np.einsum("fxa,fxy,fyb->fab", rot, self.poses.cov[own, 3:, 3:], rot)[:, :2, :2]
        known = np.isfinite(turn).all(axis=(1, 2))
        value, vector = np.linalg.eigh(np.where(known[:, None, None], turn, np.eye(2)))
        root = np.einsum("fab,fb,fcb->fac", vector, np.sqrt(np.maximum(value, 0.0)), vector)
        out = np.einsum("fab,fg,gcb->fagc", root, self.correlation.between(normal), root)
        by_constant = self.turn_by_constant[own]
        out += np.einsum("fap,pq,gbq->fagb", by_constant, self.cov[mirror], by_constant)
        # a turn w moves the normal z by w x z: along x by the turn about y, along y by minus that about x
        across = rot_enu_from_mirror(np.where(known[:, None], normal, [0.0, 0.0, 1.0]))[:, :, :2]
        moved = np.einsum("fxa,fxb,bc->fac", across, rot[:, :, :2], np.array([[0.0, 1.0], [-1.0, 0.0]]))
        return np.asarray(np.einsum("fac,fcgd,gbd->fagb", moved, out, moved))


CASES = ("before", "now", "one reference pose more", "one receiver surveyed")
"""Columns of `Survey.normal_sigma_rad`: a reference pose of 0.1 mrad, a receiver surveyed to 0.1 mm."""


def survey_site(
    observations: SiteObservations,
    knowledge: SiteKnowledge,
    given: SurveyConstants,
    field_for: FieldFor,
    *,
    prior: SurveyPrior,
    settings: SiteSettings | None = None,
    reference: ReferencePoses | None = None,
    on_round: Callable[[int, int], None] | None = None,
) -> Survey:
    """Find what mirrors in many postures have that does not change.

    Parameters
    ----------
    observations, knowledge
        First axis frame × mirror, mirrors fastest; of knowledge, places and pivots are taken from ``given``.
    given
        Constants as they are known.
    field_for
        Foresees what antennas receive, with other constants.
    prior
        How well ``given`` is known.
    settings
        Of the fits of poses.
    reference
        Normals from elsewhere.
    on_round
        Called with (rounds done, rounds at most).

    Raises
    ------
    InvalidInputError
        Arrays that do not fit each other.
    """
    n_mirror = len(given.pivot_enu_m)
    n_row = len(observations.carrier)
    if n_mirror == 0 or n_row % n_mirror:
        raise InvalidInputError(f"`observations` must hold whole frames of {n_mirror} mirrors, got {n_row} rows")
    chosen = settings or SiteSettings()
    system = _System(observations, knowledge, given, prior, reference)
    change = np.zeros(system.n_all)
    settled, k = False, 0
    for k in range(1, _ROUNDS + 1):
        now = system.constants(change)
        poses, voltages = system.fit(now, field_for(now), chosen)
        solved = system.solve(poses, voltages, chosen, change)
        step = solved.change - change
        change = solved.change
        if on_round is not None:
            on_round(k, _ROUNDS)
        settled = bool(np.all(np.abs(step) <= _SETTLED_SIGMAS * solved.sigma))
        if settled:
            break
    return system.outcome(solved, poses, k, settled)


def lever_to_turn(receiver_mirror_m: FloatArray) -> FloatArray:
    """Return the turn (xyz, 3 receiver) about the mirror's axes that a change of places, taken for one, feigns."""
    from_mean = receiver_mirror_m - receiver_mirror_m.mean(axis=0)
    return np.asarray(np.linalg.pinv(_turn_of_places(from_mean)))


def _turn_of_places(place: FloatArray) -> FloatArray:
    """(3 receiver, xyz) change of places by a turn about each axis."""
    return np.asarray(np.stack([np.cross(axis, place).ravel() for axis in np.eye(3)], axis=1))


@dataclass(frozen=True, slots=True)
class _Solved:
    """Constants in units of their prior sigma, mirror by mirror and the transmitters' last."""

    change: FloatArray
    sigma: FloatArray
    told: FloatArray
    """(mirror, constant, constant) information of measurements, transmitters eliminated."""
    cov: FloatArray
    transmitter_told: FloatArray
    transmitter_cov: FloatArray
    n_frame: IntArray
    worth: FloatArray
    """(frame × mirror,) in independent frames; zero: told nothing."""
    correlation: PostureCorrelation
    turn_by_constant: FloatArray


class _System:
    """The normal equations of what does not change."""

    def __init__(
        self,
        observations: SiteObservations,
        knowledge: SiteKnowledge,
        given: SurveyConstants,
        prior: SurveyPrior,
        reference: ReferencePoses | None,
    ) -> None:
        self.seen, self.known, self.given, self.reference = observations, knowledge, given, reference
        self.carrier = observations.carrier
        self.n_mirror, self.n_rx = given.receiver_mirror_m.shape[:2]
        self.n_tx = len(given.transmitter_enu_m)
        self.correlation = prior.correlation
        self.surveys_delays = 0.0 < prior.delay_sigma_m < np.inf
        self.free_delays = np.isinf(prior.delay_sigma_m)
        sigma = [np.full(3 * self.n_rx, prior.place_sigma_m), np.full(3, prior.pivot_sigma_m)]
        if self.surveys_delays:
            sigma.append(np.full(self.n_rx, prior.delay_sigma_m))
        self.prior_sigma = np.concatenate(sigma)
        self.transmitter_sigma = np.repeat(prior.transmitter_sigma_m, 3)
        self.n_own = len(self.prior_sigma)
        self.n_all = self.n_mirror * self.n_own + 3 * self.n_tx

    def constants(self, change: FloatArray) -> SurveyConstants:
        """Return the constants that differ from the given ones by so many prior sigmas."""
        own = change[: self.n_mirror * self.n_own].reshape(self.n_mirror, self.n_own) * self.prior_sigma
        n = 3 * self.n_rx
        given = self.given
        delay = given.delay_m + own[:, n + 3 :] if self.surveys_delays else given.delay_m
        moved = (change[self.n_mirror * self.n_own :] * self.transmitter_sigma).reshape(self.n_tx, 3)
        return SurveyConstants(
            receiver_mirror_m=given.receiver_mirror_m + own[:, :n].reshape(self.n_mirror, self.n_rx, 3),
            pivot_enu_m=given.pivot_enu_m + own[:, n : n + 3],
            transmitter_enu_m=given.transmitter_enu_m + moved,
            delay_m=delay,
        )

    def fit(self, now: SurveyConstants, field_at: FieldAt, settings: SiteSettings) -> tuple[SitePoses, Voltages]:
        """Fit poses with these constants, and return what would be received there."""
        n_frame = len(self.seen.carrier) // self.n_mirror
        wave = self.seen.wavenumber_radpm
        delayed = np.exp(1j * wave * np.tile(now.delay_m, (n_frame, 1))[..., None])
        known = replace(
            self.known,
            receiver_mirror_m=np.tile(now.receiver_mirror_m, (n_frame, 1, 1)),
            pivot_enu_m=np.tile(now.pivot_enu_m, (n_frame, 1)),
            pivot_sigma_m=_HELD_PIVOT_M,
            clock_sigma_m=np.inf if self.free_delays else 0.0,
        )
        self.carrier = self.seen.carrier * delayed
        poses = fit_site(replace(self.seen, carrier=self.carrier), known, field_at, settings)
        return poses, field_at(known.pivot_enu_m, poses.rot_enu_from_mirror, poses.common)

    def solve(self, poses: SitePoses, voltages: Voltages, settings: SiteSettings, change: FloatArray) -> _Solved:
        """Linearise about the poses and solve for the constants."""
        n_own, n_common = self.n_own, 3 * self.n_tx
        told = np.zeros((self.n_mirror, n_own, n_own))
        mixed = np.zeros((self.n_mirror, n_own, n_common))
        common = np.zeros((n_common, n_common))
        own_rhs, common_rhs = np.zeros((self.n_mirror, n_own)), np.zeros(n_common)
        n_frame = np.zeros(self.n_mirror, np.int64)
        correlation = self.correlation or found_correlation(poses, self.n_mirror)
        worth = np.zeros(len(poses.normal_enu))
        for m in range(self.n_mirror):
            worth[m :: self.n_mirror] = correlation.worth(poses.normal_enu[m :: self.n_mirror])
        turned = np.full((len(worth), 2, n_own), np.nan)
        linear = _Linear(self, poses, voltages, settings, change)
        for row in np.flatnonzero(worth > 0.0).tolist():
            m = row % self.n_mirror
            rows = linear.rows(row)
            if rows is None:
                worth[row] = 0.0
                continue
            turned[row] = rows.turn_by_constant(poses.rot_enu_from_mirror[row])[:, :n_own]
            reduced = linear.reduced(row, rows, worth[row])
            own, shared, left = reduced[:, :n_own], reduced[:, n_own:-1], reduced[:, -1]
            told[m] += own.T @ own
            mixed[m] += own.T @ shared
            common += shared.T @ shared
            own_rhs[m] += own.T @ left
            common_rhs += shared.T @ left
            n_frame[m] += 1
        at = change[: self.n_mirror * n_own].reshape(self.n_mirror, n_own)
        full = told + np.eye(n_own)
        inverse = np.linalg.inv(full)
        gain = inverse @ mixed
        common_told = common - np.einsum("mpq,mpr->qr", mixed, gain)
        common_cov = np.linalg.inv(common_told + np.eye(n_common))
        rhs = own_rhs - at
        moved = common_cov @ (common_rhs - change[self.n_mirror * n_own :] - np.einsum("mpq,mp->q", gain, rhs))
        step = np.einsum("mpq,mq->mp", inverse, rhs) - gain @ moved
        cov = inverse + gain @ common_cov @ gain.swapaxes(1, 2)
        others = common + np.eye(n_common)
        alone = told - mixed @ np.linalg.inv(others) @ mixed.swapaxes(1, 2)
        sigma = np.concatenate([np.sqrt(np.einsum("mpp->mp", cov)).ravel(), np.sqrt(np.diag(common_cov))])
        return _Solved(
            change + np.concatenate([step.ravel(), moved]), sigma, alone, cov, common_told, common_cov, n_frame,
            worth, correlation, turned / self.prior_sigma,
        )  # fmt: skip

    def outcome(self, solved: _Solved, poses: SitePoses, rounds: int, settled: bool) -> Survey:
        """Return what was found, in metres and words."""
        scale = self.prior_sigma
        cov = solved.cov * scale * scale[:, None]
        now = self.constants(solved.change)
        patterns = [self._patterns(place) for place in self.given.receiver_mirror_m]
        words = [_undetermined(told, named) for told, named in zip(solved.told, patterns, strict=True)]
        n = 3 * self.n_rx
        normal = [
            _normal_cases(lever_to_turn(place), c[:n, :n], scale[0], spread)
            for place, c, spread in zip(self.given.receiver_mirror_m, cov, self._pose_sigma(poses), strict=True)
        ]
        moved = self.transmitter_sigma
        return Survey(
            constants=now, cov=cov, prior_sigma_m=scale,
            transmitter_cov=solved.transmitter_cov * moved * moved[:, None],
            n_frame=solved.n_frame, n_independent=solved.worth.reshape(-1, self.n_mirror).sum(axis=0),
            correlation=solved.correlation, turn_by_constant=solved.turn_by_constant,
            rank=np.array([rank for rank, _ in words]),
            undetermined=tuple(named for _, named in words),
            transmitters_undetermined=self._transmitters_undetermined(solved.transmitter_told),
            normal_sigma_rad=np.array(normal), poses=poses, rounds=rounds, settled=settled,
        )  # fmt: skip

    def _pose_sigma(self, poses: SitePoses) -> FloatArray:
        """(mirror,) how well one frame's normal is known, were the constants exact; infinity: no frame."""
        worst = np.sqrt(np.linalg.eigvalsh(np.nan_to_num(poses.normal_cov))[:, -1]).reshape(-1, self.n_mirror)
        solved = np.isfinite(poses.normal_enu[:, 0]).reshape(worst.shape)
        return np.array([np.median(w[s]) if s.any() else np.inf for w, s in zip(worst.T, solved.T, strict=True)])

    def _patterns(self, place: FloatArray) -> dict[str, FloatArray]:
        """Directions in the space of a mirror's constants that have a name, each of length one in prior sigmas."""
        n = 3 * self.n_rx
        out = {}
        turns = _turn_of_places(place)  # about the pivot: exactly what a turn of the poses undoes
        for i, axis in enumerate("xyz"):
            out[f"rotation of the receivers against the plate about {axis}"] = turns[:, i]
        for i, axis in enumerate("xyz"):
            out[f"common shift of the receivers along {axis}"] = np.tile(np.eye(3)[i], self.n_rx)
        for i, axis in enumerate(("east", "north", "up")):
            out[f"pivot {axis}"] = np.eye(self.n_own)[n + i]
        if self.surveys_delays:
            common = np.zeros(self.n_own)
            common[n + 3 :] = 1.0
            out["delay common to the receivers"] = common
        padded = {name: np.pad(v, (0, self.n_own - len(v))) / self.prior_sigma for name, v in out.items()}
        return {name: v / np.linalg.norm(v) for name, v in padded.items()}

    def _transmitters_undetermined(self, told: FloatArray) -> tuple[str, ...]:
        surveyed = self.transmitter_sigma > 0.0
        if not surveyed.any():
            return ()
        named = {}
        for i, axis in enumerate(("east", "north", "up")):
            shift = np.where(surveyed, np.tile(np.eye(3)[i], self.n_tx), 0.0) / np.fmax(self.transmitter_sigma, 1e-300)
            named[f"common shift of the transmitters {axis}"] = np.where(surveyed, shift, 0.0)
        for t in range(self.n_tx):
            for i, axis in enumerate(("east", "north", "up")):
                named[f"transmitter {t + 1} {axis}"] = np.eye(3 * self.n_tx)[3 * t + i] * surveyed
        unit = {name: v / np.linalg.norm(v) for name, v in named.items() if v.any()}
        held = told + np.diag(np.where(surveyed, 0.0, 1.0))
        return _undetermined(held, unit)[1]


def _undetermined(told: FloatArray, named: dict[str, FloatArray]) -> tuple[int, tuple[str, ...]]:
    """Return how many directions are determined, and the names of those that are not."""
    value, vector = np.linalg.eigh(told)
    lost = vector[:, value < _UNDETERMINED]
    n_lost = lost.shape[1]
    words = []
    for name, direction in named.items():
        if float(np.sum((lost.T @ direction) ** 2)) > _NAMED:
            words.append(name)
    if n_lost > len(words):
        words.append(f"{n_lost - len(words)} more combination{'s' if n_lost - len(words) > 1 else ''} without a name")
    return len(told) - n_lost, tuple(words)


def _normal_cases(lever: FloatArray, cov: FloatArray, place_sigma: float, pose_sigma: float) -> list[float]:
    """Return what places' errors do to the normal [rad], by `CASES`."""
    tilt = lever[:2]

    def left(c: FloatArray) -> float:
        return float(np.sqrt(max(np.linalg.eigvalsh(tilt @ c @ tilt.T)[-1], 0.0)))

    n = len(cov)
    noise = _REFERENCE_RAD**2 + pose_sigma**2
    pointed = cov if np.isinf(noise) else _updated(cov, tilt, noise * np.eye(2))
    surveyed = min(left(_updated(cov, np.eye(n)[3 * r : 3 * r + 3], _SURVEYED_M**2 * np.eye(3))) for r in range(n // 3))
    return [left(place_sigma**2 * np.eye(n)), left(cov), left(pointed), surveyed]


def _updated(cov: FloatArray, rows: FloatArray, noise: FloatArray) -> FloatArray:
    """Covariance after one more measurement."""
    gain = cov @ rows.T @ np.linalg.inv(rows @ cov @ rows.T + noise)
    return np.asarray(cov - gain @ rows @ cov)


@dataclass(frozen=True, slots=True)
class _Rows:
    """Phases of one frame of one mirror, whitened: linear in pose and transmitters' phases, and in constants.

    Pose and phases are (turn about east, north, up, then a phase a transmitter); the constants are in prior sigmas,
    with the residual behind them.
    """

    nuisance: FloatArray
    rest: FloatArray

    def turn_by_constant(self, rot: FloatArray) -> FloatArray:
        """Return what an error of the constants makes of the turn about the mirror's x and y (xy, constant)."""
        scale = np.fmax(np.linalg.norm(self.nuisance, axis=0), 1e-300)
        gain = np.linalg.pinv(self.nuisance / scale, rcond=_FREE)[:3] / scale[:3, None]
        return np.asarray(-(rot.T @ gain)[:2] @ self.rest[:, :-1])


class _Linear:
    """Phases of mirrors, linear about their poses and constants."""

    def __init__(
        self, system: _System, poses: SitePoses, voltages: Voltages, settings: SiteSettings, change: FloatArray
    ) -> None:
        self._system, self._poses, self._voltages = system, poses, voltages
        self._heard = heard_by(voltages, system.seen.carrier.shape, system.known.mast, settings, poses.common)
        self._now = system.constants(change)
        nu = poses.common.tail
        self._heavy = (nu + 3.0) / (nu + 1.0)
        """How much more variance links have than their weights say: expected information of Student's t."""
        wave = system.seen.wavenumber_radpm
        self._crowd = carrier_likeness(wave, system.known.mast, settings.detour_m).sum(axis=1)

    def reduced(self, row: int, rows: _Rows, worth: float) -> FloatArray:
        """Return rows (link, constant + 1) of a frame that counts so much, pose and phases taken out."""
        size = np.sqrt(worth)
        # what a camera measured does not go together over postures
        nuisance, rest = self._with_reference(row, size * rows.nuisance, size * rows.rest)
        scale = np.fmax(np.linalg.norm(nuisance, axis=0), 1e-300)
        basis, value, _ = np.linalg.svd(nuisance / scale, full_matrices=False)
        basis = basis[:, value > _FREE * value[0]]
        return np.asarray(rest - basis @ (basis.T @ rest))

    def rows(self, row: int) -> _Rows | None:
        """Return the whitened phases of a frame; None where they cannot tell a pose."""
        system, poses, heard, now = self._system, self._poses, self._heard, self._now
        wave = system.seen.wavenumber_radpm
        n_rx, n_tx = system.n_rx, system.n_tx
        n_link = n_rx * n_tx
        pivot, rot = now.pivot_enu_m[row % system.n_mirror], poses.rot_enu_from_mirror[row]
        begin, end = int(heard.first[row * n_link]), int(heard.first[(row + 1) * n_link])
        part = np.empty(max(end - begin, 1), np.complex128)
        h, slope = np.empty(n_link, np.complex128), np.empty((n_link, 6), np.complex128)
        _kernels.voltages(begin, end, heard, wave, pivot, rot, np.zeros(3), part, h, slope)
        weight = poses.weight[row].ravel()
        use = np.flatnonzero(np.isfinite(weight) & (np.abs(h) > 0.0))
        if len(use) < 6 + n_tx:
            return None
        receiver, transmitter = np.divmod(use, n_tx)
        relative = slope[use] / h[use, None]
        nuisance = np.zeros((len(use), 3 + n_tx + (n_rx if system.free_delays else 0)))
        nuisance[:, :3] = relative[:, :3].imag
        nuisance[np.arange(len(use)), 3 + transmitter] = 1.0
        if system.free_delays:
            nuisance[np.arange(len(use)), 3 + n_tx + receiver] = -wave[transmitter]
        constant = np.zeros((len(use), system.n_own + 3 * n_tx))
        k = np.arange(len(use))
        by_place = relative[:, 3:].imag @ rot
        for q in range(3):
            constant[k, 3 * receiver + q] = by_place[:, q]
        constant[:, 3 * n_rx : 3 * n_rx + 3] = relative[:, 3:].imag
        if system.surveys_delays:
            constant[k, 3 * n_rx + 3 + receiver] = -wave[transmitter]
        by_transmitter = (self._transmitter_slope(begin, end, part, pivot, rot, now, n_link)[use] / h[use, None]).imag
        for q in range(3):
            constant[k, system.n_own + 3 * transmitter + q] = by_transmitter[:, q]
        constant *= np.concatenate([system.prior_sigma, system.transmitter_sigma])
        variance = poses.sigma_rad[row].ravel()[use] ** 2
        off = (system.carrier[row].ravel() * h.conj())[use]
        off /= np.abs(off)
        beta = np.zeros(n_tx, np.complex128)
        np.add.at(beta, transmitter, off * weight[use] / variance)
        left = np.angle(off * beta[transmitter].conj())
        covariance = np.diag(self._heavy * self._crowd[transmitter] * variance / weight[use])
        row_of = np.full(n_link, -1, np.int64)
        row_of[use] = k
        share, touched = np.zeros(n_link, np.complex128), np.empty(n_link, np.int64)
        _kernels.add_factor_errors(begin, end, heard, part, h, row_of, share, touched, covariance)
        _kernels.add_soil_errors(begin, end, heard, part, h, row_of, share, len(use), covariance)
        lower = np.linalg.cholesky(covariance)
        whitened = np.linalg.solve(lower, np.column_stack([nuisance, constant, left]))
        return _Rows(whitened[:, : nuisance.shape[1]], whitened[:, nuisance.shape[1] :])

    def _with_reference(self, row: int, nuisance: FloatArray, rest: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Add what a reference pose of this frame says of its orientation."""
        reference = self._system.reference
        if reference is None or not np.isfinite(reference.normal_enu[row]).all():
            return nuisance, rest
        normal = self._poses.normal_enu[row]
        across = np.linalg.svd(normal[None])[2][1:]
        sigma = reference.sigma_rad[row]
        more = np.zeros((2, nuisance.shape[1]))
        more[:, :3] = np.cross(normal, across) / sigma
        told = np.zeros((2, rest.shape[1]))
        told[:, -1] = across @ (reference.normal_enu[row] - normal) / sigma
        return np.concatenate([nuisance, more]), np.concatenate([rest, told])

    def _transmitter_slope(
        self,
        begin: int,
        end: int,
        part: ComplexArray,
        pivot: FloatArray,
        rot: FloatArray,
        now: SurveyConstants,
        n_link: int,
    ) -> ComplexArray:
        """(link, xyz) change of what is received by a shift of its transmitter.

        Exact for direct rays and those of level ground; rays that met something else are taken to change as the direct
        one does, which is about right where the thing stands by the mirror.
        """
        heard, n_tx = self._heard, self._system.n_tx
        link, kind = heard.link_of[begin:end], heard.kind[begin:end]
        towards = heard.source[begin:end] - pivot - heard.place[begin:end] @ rot.T
        elsewhere = kind > RayKind.GROUND
        towards[elsewhere] = (now.transmitter_enu_m - pivot)[link[elsewhere] % n_tx]
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        towards[kind == RayKind.GROUND, 2] *= -1.0
        wave = self._system.seen.wavenumber_radpm[link % n_tx]
        out = np.zeros((n_link, 3), np.complex128)
        np.add.at(out, link, -1j * (wave * part[: end - begin])[:, None] * towards)
        return out
