"""Places of a mirror's receivers, from its ranges in many postures.

A receiver that was glued on a millimetre from where the drawing has it turns the normal by half a milliradian, the same
in every posture. The distances between receivers show in every posture; with one pivot for all postures the receivers'
places about it show too, once the mirror has turned about more than one axis. What shows in no posture is a common
rotation of all receivers against the glass: radio measures receivers, and where they point as a whole. That angle comes
from light (a camera, a calorimeter, the tracking calibration), once a mirror.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, as_float_array, read_only
from rfpose.errors import InvalidInputError
from rfpose.multilat.rigid import _kernels
from rfpose.multilat.rigid.arrays import bias_information, clock_ties, spread_places, start_clock, weights
from rfpose.multilat.rigid.knowledge import Knowledge

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


def refine_places(
    transmitter_enu_m: npt.ArrayLike,
    receiver_mirror_m: npt.ArrayLike,
    range_m: npt.ArrayLike,
    *,
    sigma_m: npt.ArrayLike,
    transmitter_sigma_m: npt.ArrayLike,
    clock_class: npt.ArrayLike,
    pivot_enu_m: npt.ArrayLike,
    rot_enu_from_mirror: npt.ArrayLike,
    common_pivot: bool = True,
    knowledge: Knowledge | None = None,
) -> ReceiverPlaces:
    """Refine one mirror's receiver places with its poses, from ranges in many postures.

    Parameters
    ----------
    transmitter_enu_m : (transmitter, xyz)
        [m].
    receiver_mirror_m : (receiver, xyz)
        As drawn, from the pivot, in the mirror frame [m].
    range_m : (posture, group, receiver, transmitter)
        Range plus clock, integers resolved [m]; NaN = not received. A posture is a frame.
    sigma_m, transmitter_sigma_m, clock_class
        As in `solve_rigid`, postures in place of mirrors.
    pivot_enu_m, rot_enu_from_mirror : (posture, xyz), (posture, 3, 3)
        Where to begin: `solve_rigid`'s poses with the places as drawn.
    common_pivot
        The pivot is the same in all postures; else each posture has its own, and only the receivers' shape is seen.
    knowledge
        For clocks, mount, and the surveyed common pivot: its first row counts.

    Raises
    ------
    InvalidInputError
        Shapes that do not fit; no posture.
    GeometryError
        Receivers on a line.

    Notes
    -----
    Gauss-Newton; poses and clocks of each posture are eliminated from the normal equations. Movements that nothing
    shows stay zero (the step of least length). Without calibrated transmitters the pivot is known only as well as it is
    surveyed, and with it where the receivers are about it; the distances between receivers are not concerned.
    """
    z = as_float_array("range_m", range_m, ("posture", "group", "receiver", "transmitter"), finite=False)
    if not len(z):
        raise InvalidInputError("`range_m` must hold at least one posture")
    problem = _Problem(
        transmitter_enu_m, receiver_mirror_m, z, sigma_m, transmitter_sigma_m, clock_class, knowledge, common_pivot
    )
    state = _State.begin(problem, z, pivot_enu_m, rot_enu_from_mirror)
    converged = False
    for _ in range(_MAX_ITERATION):
        moved = state.step(problem, z)
        if moved < _CONVERGED_M:
            converged = True
            break
    return state.result(problem, z, converged)


def places_bound(
    transmitter_enu_m: npt.ArrayLike,
    receiver_mirror_m: npt.ArrayLike,
    pivot_enu_m: npt.ArrayLike,
    rot_enu_from_mirror: npt.ArrayLike,
    *,
    sigma_m: npt.ArrayLike,
    transmitter_sigma_m: npt.ArrayLike,
    clock_class: npt.ArrayLike,
    common_pivot: bool = True,
    knowledge: Knowledge | None = None,
) -> ReceiverPlaces:
    """Return what planned postures would show of the receivers' places: the covariance, and what stays unseen.

    Parameters
    ----------
    pivot_enu_m, rot_enu_from_mirror : (posture, xyz), (posture, 3, 3)
        The postures.
    sigma_m : (posture, group, receiver, transmitter)
        NaN or infinity = not received [m].
    transmitter_enu_m, receiver_mirror_m, transmitter_sigma_m, clock_class, common_pivot, knowledge
        As in `refine_places`.
    """
    sigma = as_float_array("sigma_m", sigma_m, ("posture", "group", "receiver", "transmitter"), finite=False)
    seen = np.isfinite(sigma)
    given = np.where(seen, 0.0, np.nan)
    problem = _Problem(
        transmitter_enu_m,
        receiver_mirror_m,
        given,
        np.where(seen, sigma, 1.0),
        transmitter_sigma_m,
        clock_class,
        knowledge,
        common_pivot,
    )
    state = _State.begin(problem, given, pivot_enu_m, rot_enu_from_mirror)
    distance, _ = state.ranges(problem)
    exact = np.where(seen, distance[:, None], np.nan)
    state.clock[:] = 0.0
    return state.result(problem, exact, True)


class _Problem:
    """What stays the same from step to step."""

    def __init__(
        self,
        transmitter_enu_m: npt.ArrayLike,
        receiver_mirror_m: npt.ArrayLike,
        z: FloatArray,
        sigma_m: npt.ArrayLike,
        transmitter_sigma_m: npt.ArrayLike,
        clock_class: npt.ArrayLike,
        knowledge: Knowledge | None,
        common_pivot: bool,
    ) -> None:
        n_posture, n_group, n_receiver, n_transmitter = z.shape
        self.transmitter = as_float_array("transmitter_enu_m", transmitter_enu_m, (n_transmitter, 3))
        self.nominal = spread_places(
            as_float_array("receiver_mirror_m", receiver_mirror_m, (n_receiver, 3)), 1, n_receiver
        )[0]
        self.weight = weights(z, sigma_m)
        self.bias_info = bias_information(transmitter_sigma_m, (n_posture, n_group, n_transmitter))
        self.classes = np.asarray(clock_class, np.int64)
        self.n_class = int(self.classes.max()) + 1
        self.known = knowledge or Knowledge()
        self.own, self.tie = clock_ties(
            self.known.clock_sigma_m, self.weight, self.bias_info, self.classes, self.n_class
        )
        self.common_pivot = common_pivot
        self.n_receiver, self.n_posture = n_receiver, n_posture


@dataclass(kw_only=True)
class _State:
    """Places, poses and clocks as they are now."""

    places: FloatArray
    pivot: FloatArray
    rot: FloatArray
    clock: FloatArray

    @classmethod
    def begin(cls, p: _Problem, z: FloatArray, pivot_enu_m: npt.ArrayLike, rot: npt.ArrayLike) -> _State:
        pivot = np.array(as_float_array("pivot_enu_m", pivot_enu_m, (p.n_posture, 3)))
        turn = np.array(as_float_array("rot_enu_from_mirror", rot, (p.n_posture, 3, 3)))
        if p.common_pivot:
            pivot[:] = pivot.mean(axis=0)
        places = np.array(p.nominal)
        many = np.broadcast_to(places, (p.n_posture, *places.shape))
        clock = start_clock(p.transmitter, many, pivot, turn, z, p.classes, p.n_class)
        return cls(places=places, pivot=pivot, rot=turn, clock=clock)

    def ranges(self, p: _Problem) -> tuple[FloatArray, FloatArray]:
        """Distances (posture, receiver, transmitter) and unit vectors from the transmitters."""
        arm = np.einsum("fab,rb->fra", self.rot, self.places)
        away = (self.pivot[:, None] + arm)[:, :, None] - p.transmitter
        distance = np.linalg.norm(away, axis=-1)
        return distance, away / distance[..., None]

    def equations(self, p: _Problem, z: FloatArray) -> tuple[FloatArray, FloatArray, float]:
        """Return the normal equations of each posture: [pivot, rotation, clocks, places], and chi²."""
        n_f, n_g, n_r, n_t = p.weight.shape
        n_clock = p.n_class * n_r
        n = 6 + n_clock + 3 * n_r
        distance, unit = self.ranges(p)
        arm = np.einsum("fab,rb->fra", self.rot, self.places)
        jacobian = np.zeros((n_f, n_g, n_r, n_t, n))
        jacobian[..., :3] = unit[:, None]
        jacobian[..., 3:6] = np.cross(arm[:, :, None], unit)[:, None]
        turned = np.einsum("frta,fab->frtb", unit, self.rot)
        for r in range(n_r):
            for g in range(n_g):
                jacobian[:, g, r, :, 6 + p.classes[g] * n_r + r] = 1.0
            jacobian[:, :, r, :, 6 + n_clock + 3 * r : 9 + n_clock + 3 * r] = turned[:, None, r]
        left = np.where(p.weight > 0.0, z - distance[:, None] - self.clock[:, p.classes][..., None], 0.0)
        # the transmitters' own errors: a weighted mean over receivers comes off
        total = p.weight.sum(axis=2) + p.bias_info
        scale = np.where(total > 0.0, 1.0 / np.where(total > 0.0, total, 1.0), 0.0)
        sum_row = np.einsum("fgrt,fgrtn->fgtn", p.weight, jacobian)
        bias = scale * np.einsum("fgrt,fgrt->fgt", p.weight, left)
        weighted = p.weight[..., None] * jacobian
        info = np.einsum("fgrtn,fgrtm->fnm", weighted, jacobian, optimize=True)
        info -= np.einsum("fgtn,fgt,fgtm->fnm", sum_row, scale, sum_row, optimize=True)
        free = left - bias[:, :, None]
        gradient = np.einsum("fgrtn,fgrt->fn", weighted, free)
        with np.errstate(invalid="ignore"):
            chi2 = float(np.sum(p.weight * free**2) + np.nansum(np.where(bias == 0.0, 0.0, p.bias_info) * bias**2))
        self._add_priors(p, info, gradient)
        return info, gradient, chi2

    def _add_priors(self, p: _Problem, info: FloatArray, gradient: FloatArray) -> None:
        n_r = p.n_receiver
        for k in range(p.n_class):
            for a in range(n_r):
                i = 6 + k * n_r + a
                # a clock that is held stays where it is: no gradient
                info[:, i, i] += p.own[:, k, a]
                for b in range(a):
                    j, w = 6 + k * n_r + b, p.tie[:, k, a, b]
                    apart = self.clock[:, k, b] - self.clock[:, k, a]
                    info[:, i, i] += w
                    info[:, j, j] += w
                    info[:, i, j] -= w
                    info[:, j, i] -= w
                    gradient[:, i] += w * apart
                    gradient[:, j] -= w * apart
        if p.known.two_axis:
            slope = np.stack([self.rot[:, 1, 0], -self.rot[:, 0, 0]], axis=1)
            level = p.known.roll_sigma_rad**-2
            info[:, 3:5, 3:5] += level * slope[:, :, None] * slope[:, None]
            gradient[:, 3:5] += level * slope * -self.rot[:, 2, :1]

    def reduced(self, p: _Problem, z: FloatArray) -> tuple[FloatArray, FloatArray, list[FloatArray], float]:
        """Information and gradient of [places, common pivot], all else eliminated; and what leads back."""
        info, gradient, chi2 = self.equations(p, z)
        n_place = 3 * p.n_receiver
        whole = info.shape[1]
        shared = np.arange(whole - n_place, whole)
        if p.common_pivot:
            shared = np.concatenate([shared, np.arange(3)])
        own = np.setdiff1d(np.arange(whole), shared)
        a_oo, a_os = info[:, own[:, None], own], info[:, own[:, None], shared]
        solved = np.linalg.solve(a_oo, np.concatenate([a_os, gradient[:, own, None]], axis=2))
        back, rest = solved[..., :-1], solved[..., -1]
        s = (info[:, shared[:, None], shared] - a_os.swapaxes(1, 2) @ back).sum(axis=0)
        g = (gradient[:, shared] - np.einsum("fos,fo->fs", a_os, rest)).sum(axis=0)
        if p.common_pivot and p.known.pivot_enu_m is not None and np.isfinite(p.known.pivot_sigma_m):
            w, away = p.known.pivot_sigma_m**-2, np.ravel(p.known.pivot_enu_m)[:3] - self.pivot[0]
            s[n_place:, n_place:] += w * np.eye(3)
            g[n_place:] += w * away
            chi2 += float(w * away @ away)
        return s, g, [back, rest, own, shared], chi2

    def step(self, p: _Problem, z: FloatArray) -> float:
        """Move everything by one Gauss-Newton step; return how far the places went [m]."""
        s, g, (back, rest, own, shared), _ = self.reduced(p, z)
        value, vector = np.linalg.eigh(s)
        seen = value > _UNSEEN * value[-1]
        move = vector[:, seen] @ ((vector[:, seen].T @ g) / value[seen])
        step = np.zeros((p.n_posture, len(own) + len(shared)))
        step[:, shared.astype(int)] = move
        step[:, own.astype(int)] = rest - back @ move
        self.pivot += step[:, :3]
        for f in range(p.n_posture):
            before = self.rot[f].copy()
            _kernels.rotate(step[f, 3:6], before, self.rot[f])
        n_clock = p.n_class * p.n_receiver
        self.clock += step[:, 6 : 6 + n_clock].reshape(self.clock.shape)
        n_place = 3 * p.n_receiver
        self.places += move[:n_place].reshape(-1, 3)
        return float(np.max(np.abs(move[:n_place])))

    def result(self, p: _Problem, z: FloatArray, converged: bool) -> ReceiverPlaces:
        """All that is known at the end."""
        s, _, _, chi2 = self.reduced(p, z)
        n_place = 3 * p.n_receiver
        if p.common_pivot:
            # the pivot's own place is eliminated as well
            s = (
                s[:n_place, :n_place]
                - s[:n_place, n_place:] @ np.linalg.pinv(s[n_place:, n_place:]) @ s[n_place:, :n_place]
            )
        value, vector = np.linalg.eigh(0.5 * (s + s.T))
        seen = value > _UNSEEN * value[-1]
        unseen = vector[:, ~seen].T
        pose = 3 * p.n_posture + (3 if p.common_pivot else 3 * p.n_posture)
        used = p.weight > 0.0
        bias = int((used.any(axis=2) & (p.bias_info == 0.0)).sum())
        clocks = p.n_class * (p.n_receiver if not np.isfinite(p.known.clock_sigma_m) else 1)
        calibrated = [bool(np.any(p.bias_info[:, p.classes == k] > 0.0)) for k in range(p.n_class)]
        clocks -= sum(not c for c in calibrated)
        dof = float(used.sum() - bias - pose - clocks * p.n_posture - int(seen.sum()))
        dof += p.n_posture * float(p.known.two_axis)
        dof += 3.0 * (p.common_pivot and p.known.pivot_enu_m is not None and np.isfinite(p.known.pivot_sigma_m))
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
