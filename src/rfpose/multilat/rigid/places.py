"""Places of a mirror's receivers, from its ranges in many postures.

A receiver that was glued on a millimetre from where the drawing has it turns the normal by half a milliradian, the same
in every posture. The distances between receivers show in every posture; with one pivot for all postures the receivers'
places about it show too, once the mirror has turned about more than one axis. What shows in no posture is a common
rotation of all receivers against the glass: radio measures receivers, and where they point as a whole. That angle comes
from light (a camera, a calorimeter, the tracking calibration), once a mirror.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rfpose.checks import FloatArray, read_only
from rfpose.errors import InvalidInputError
from rfpose.multilat.equations import rotate
from rfpose.multilat.rigid import _kernels
from rfpose.multilat.rigid.parts import part_of
from rfpose.multilat.rigid.pose import can_begin
from rfpose.multilat.rigid.problem import MirrorProblem
from rfpose.multilat.rigid.weights import MirrorEquations, equations_of, used_priors

__all__ = ["ReceiverPlaces", "places_bound", "refine_places"]

_UNSEEN = 1e-9
"""Share of the largest information below which a combination of coordinates counts as not seen."""

_TEXT = {
    "rotation": "rotation of all receivers against the glass about ({}): no radio data shows it; measure it by light",
    "shift": "shift of all receivers from the pivot along ({}): turn the mirror about other axes",
}

_CONVERGED_M = 1e-9
_MAX_ITERATION = 30


@dataclass(frozen=True, slots=True, kw_only=True)
class ReceiverPlaces:
    """Refined places of one mirror's receivers; arrays are read-only.

    Attributes
    ----------
    receiver_mirror_m : (receiver, xyz)
        From the pivot, in the mirror frame [m]. In what is not seen they agree with those given.
    cov_m2 : (3·receiver, 3·receiver)
        Covariance of what is seen, receiver by receiver; zero along what is not [m²].
    rank
        Combinations of coordinates that the postures show, of 3·receiver.
    unseen : (mode, receiver, xyz)
        Unit movements of the receivers that change no measurement.
    unseen_names
        Each in words.
    pivot_enu_m : (posture, xyz)
        [m].
    rot_enu_from_mirror : (posture, 3, 3)
    chi2, dof
        Weighted sum of squares left, and what it should be.
    converged
        Whether the steps became small.
    """

    receiver_mirror_m: FloatArray
    cov_m2: FloatArray
    rank: int
    unseen: FloatArray
    unseen_names: tuple[str, ...]
    pivot_enu_m: FloatArray
    rot_enu_from_mirror: FloatArray
    chi2: float
    dof: float
    converged: bool

    @property
    def sigma_m(self) -> FloatArray:
        """(receiver, xyz) standard deviation of what is seen of each coordinate [m]."""
        return np.sqrt(np.diag(self.cov_m2)).reshape(-1, 3)


def refine_places(problem: MirrorProblem, *, common_pivot: bool = True) -> ReceiverPlaces:
    """Refine one mirror's receiver places with its poses, from ranges in many postures.

    Parameters
    ----------
    problem
        Postures (frames) in place of mirrors, whole wavelengths resolved; the first posture's places count as drawn,
        and it begins at `solve_rigid`'s poses with these.
    common_pivot
        The pivot is the same in all postures; else each posture has its own, and only the receivers' shape is seen.
        Of surveyed pivots the first counts.

    Raises
    ------
    InvalidInputError
        No posture; a posture without a pose to begin with.

    Notes
    -----
    Gauss-Newton; poses and clocks of each posture are eliminated from the normal equations. Movements that nothing
    shows stay zero (the step of least length). Without calibrated transmitters the pivot is known only as well as it is
    surveyed, and with it where the receivers are about it; the distances between receivers are not concerned.
    """
    state = _State.begin(problem, common_pivot)
    converged = False
    for _ in range(_MAX_ITERATION):
        moved = state.step()
        if moved < _CONVERGED_M:
            converged = True
            break
    return state.result(converged)


def places_bound(problem: MirrorProblem, *, common_pivot: bool = True) -> ReceiverPlaces:
    """Return what planned postures would show of the receivers' places: the covariance, and what stays unseen.

    Parameters
    ----------
    problem
        The postures, by `MirrorProblem.expected`.
    common_pivot
        As in `refine_places`.
    """
    state = _State.begin(problem, common_pivot)
    distance, _ = state.ranges()
    state.problem = replace(state.problem, range_m=np.where(np.isfinite(problem.range_m), distance[:, None], np.nan))
    state.weighed = equations_of(state.problem)
    state.clock[:] = 0.0
    return state.result(True)


@dataclass(kw_only=True)
class _State:
    """Places, poses and clocks as they are now."""

    problem: MirrorProblem
    weighed: MirrorEquations
    surveyed: bool
    common_pivot: bool
    places: FloatArray
    pivot: FloatArray
    rot: FloatArray
    clock: FloatArray

    @classmethod
    def begin(cls, problem: MirrorProblem, common_pivot: bool) -> _State:
        if not len(problem.range_m):
            raise InvalidInputError("`range_m` must hold at least one posture")
        if not can_begin(problem).all():
            raise InvalidInputError("every posture must have a pose to begin with")
        pivot, rot = problem.start_pivot_enu_m.copy(), problem.start_rot_enu_from_mirror.copy()
        if common_pivot:
            pivot[:] = pivot.mean(axis=0)
        # surveys of the pivot count once for all postures
        dropped = problem.dropped.copy()
        dropped[:, 0] = True
        surveyed = bool(used_priors(problem)[0, 0])
        problem = replace(part_of(problem, begin=(pivot, rot)), dropped=dropped)
        weighed = equations_of(problem)
        return cls(
            problem=problem,
            weighed=weighed,
            surveyed=surveyed,
            common_pivot=common_pivot,
            places=problem.receiver_mirror_m[0].copy(),
            pivot=pivot,
            rot=rot,
            clock=weighed.mirrors.prior.clock.copy(),
        )

    def ranges(self) -> tuple[FloatArray, FloatArray]:
        """Distances (posture, receiver, transmitter) and unit vectors from the transmitters."""
        arm = np.einsum("fab,rb->fra", self.rot, self.places)
        away = (self.pivot[:, None] + arm)[:, :, None] - self.problem.transmitter_enu_m
        distance = np.linalg.norm(away, axis=-1)
        return distance, away / distance[..., None]

    def equations(self) -> tuple[FloatArray, FloatArray, float]:
        """Return the normal equations of each posture: [pivot, rotation, clocks, places], and chi²."""
        mirrors = self.weighed.mirrors
        n_f, _, n_r, n_t = mirrors.z.shape
        n = 6 + self.clock[0].size + 3 * n_r
        distance, unit = self.ranges()
        arm = np.einsum("fab,rb->fra", self.rot, self.places)
        slope = np.zeros((n_f, 1, n_r, n_t, 6 + 3 * n_r))
        slope[:, 0, ..., :3], slope[:, 0, ..., 3:6] = unit, np.cross(arm[:, :, None], unit)
        turned = np.einsum("frta,fab->frtb", unit, self.rot)
        for r in range(n_r):
            slope[:, 0, r, :, 6 + 3 * r : 9 + 3 * r] = turned[:, r]
        info, gradient, chi2 = np.empty((n_f, n, n)), np.empty((n_f, n)), np.empty(n_f)
        _kernels.equations_many(
            n_f, mirrors, distance[:, None], slope, self.pivot, self.rot, self.clock, info, gradient, chi2
        )
        return info + np.swapaxes(np.tril(info, -1), 1, 2), gradient, float(chi2.sum())

    def reduced(self) -> tuple[FloatArray, FloatArray, list[FloatArray], float]:
        """Information and gradient of [places, common pivot], all else eliminated; and what leads back."""
        info, gradient, chi2 = self.equations()
        n_place = self.places.size
        whole = info.shape[1]
        shared = np.arange(whole - n_place, whole)
        if self.common_pivot:
            shared = np.concatenate([shared, np.arange(3)])
        own = np.setdiff1d(np.arange(whole), shared)
        a_oo, a_os = info[:, own[:, None], own], info[:, own[:, None], shared]
        solved = np.linalg.solve(a_oo, np.concatenate([a_os, gradient[:, own, None]], axis=2))
        back, rest = solved[..., :-1], solved[..., -1]
        s = (info[:, shared[:, None], shared] - a_os.swapaxes(1, 2) @ back).sum(axis=0)
        g = (gradient[:, shared] - np.einsum("fos,fo->fs", a_os, rest)).sum(axis=0)
        if self.common_pivot:
            known = self.problem.knowledge
            if self.surveyed and known.pivot_enu_m is not None:
                weight, away = known.pivot_sigma_m**-2, known.pivot_enu_m[0] - self.pivot[0]
                s[n_place:, n_place:] += weight * np.eye(3)
                g[n_place:] += weight * away
                chi2 += float(weight * away @ away)
        return s, g, [back, rest, own, shared], chi2

    def step(self) -> float:
        """Move everything by one Gauss-Newton step; return how far the places went [m]."""
        s, g, (back, rest, own, shared), _ = self.reduced()
        value, vector = np.linalg.eigh(s)
        seen = value > _UNSEEN * value[-1]
        move = vector[:, seen] @ ((vector[:, seen].T @ g) / value[seen])
        step = np.zeros((len(self.pivot), len(own) + len(shared)))
        step[:, shared.astype(int)] = move
        step[:, own.astype(int)] = rest - back @ move
        self.pivot += step[:, :3]
        for f in range(len(self.pivot)):
            before = self.rot[f].copy()
            rotate(step[f, 3:6], before, self.rot[f])
        self.clock += step[:, 6 : 6 + self.clock[0].size].reshape(self.clock.shape)
        n_place = self.places.size
        self.places += move[:n_place].reshape(-1, 3)
        return float(np.max(np.abs(move[:n_place])))

    def result(self, converged: bool) -> ReceiverPlaces:
        """All that is known at the end."""
        s, _, _, chi2 = self.reduced()
        n_place = self.places.size
        if self.common_pivot:
            # the pivot's own place is eliminated as well
            s = (
                s[:n_place, :n_place]
                - s[:n_place, n_place:] @ np.linalg.pinv(s[n_place:, n_place:]) @ s[n_place:, :n_place]
            )
        value, vector = np.linalg.eigh(0.5 * (s + s.T))
        seen = value > _UNSEEN * value[-1]
        unseen = vector[:, ~seen].T
        # a posture's own unknowns are counted with it; what all share, here
        dof = float(self.weighed.dof.sum() - int(seen.sum()))
        if self.common_pivot:
            dof += 3 * len(self.pivot) - 3 + 3 * self.surveyed
        names, modes = _name(unseen, self.places)
        return ReceiverPlaces(
            receiver_mirror_m=read_only(self.places),
            cov_m2=read_only((vector[:, seen] / value[seen]) @ vector[:, seen].T),
            rank=int(seen.sum()),
            unseen=read_only(modes),
            unseen_names=names,
            pivot_enu_m=read_only(self.pivot),
            rot_enu_from_mirror=read_only(self.rot),
            chi2=chi2,
            dof=dof,
            converged=converged,
        )


def _name(unseen: FloatArray, places: FloatArray) -> tuple[tuple[str, ...], FloatArray]:
    """Split what is not seen into rotations against the glass, shifts from the pivot, and the rest."""
    rotation = np.stack([np.cross(axis, places).ravel() for axis in np.eye(3)])
    shift = np.stack([np.tile(axis, len(places)) for axis in np.eye(3)])
    names: list[str] = []
    modes: list[FloatArray] = []
    left = unseen
    for what, basis in (("rotation", rotation), ("shift", shift)):
        if modes:
            kept = np.array(modes)
            basis = basis - basis @ kept.T @ kept
        # directions of the basis that lie wholly in what is not seen
        q, _ = np.linalg.qr(basis.T)
        _, size, inside = np.linalg.svd(left @ q)
        for k in np.flatnonzero(size > 1.0 - 1e-4):
            mode = q @ inside[k]
            axis = np.linalg.lstsq(basis.T, mode, rcond=None)[0]
            names.append(_TEXT[what].format(", ".join(f"{x:.2f}" for x in axis / np.linalg.norm(axis) + 0.0)))
            modes.append(mode)
        if modes:
            kept = np.array(modes)
            _, size, rows = np.linalg.svd(left - left @ kept.T @ kept, full_matrices=False)
            left = rows[size > 0.5]
    for mode in left:
        names.append("shape of the receivers: more postures, transmitters or receivers' clocks in common would show it")
        modes.append(mode)
    return tuple(names), np.array(modes).reshape(-1, *places.shape)
