"""The equations' weights, made of what is measured of mirrors and what is known besides; degrees of freedom."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.multilat.equations import MirrorArrays, MirrorPrior
from rfpose.multilat.reflection import direct_rays
from rfpose.multilat.rigid import _kernels
from rfpose.multilat.rigid.problem import MirrorProblem

__all__ = ["STIFFEST_TIE", "MirrorEquations", "equations_of", "used_priors", "weighed"]

BoolArray = npt.NDArray[np.bool_]

STIFFEST_TIE = 1e-8
"""Smallest variance of a receiver's delay, in units of the best observation's: stiff enough to be a shared clock."""


class MirrorEquations(NamedTuple):
    """What the solvers' equations weigh.

    Attributes
    ----------
    mirrors
        Clocks begin, and stay if nothing moves them, where they fit best.
    dof : (mirror,)
        Measurements and priors less unknowns: what chi² should be.
    """

    mirrors: MirrorArrays
    dof: FloatArray


def equations_of(problem: MirrorProblem) -> MirrorEquations:
    """Weigh what is measured and known, and let clocks begin where they fit best."""
    mirrors = weighed(problem)
    scene = direct_rays(problem.transmitter_enu_m, problem.range_m.shape[1])
    _kernels.clocks_many(
        len(problem.range_m), scene, mirrors, problem.start_pivot_enu_m, problem.start_rot_enu_from_mirror,
        mirrors.prior.clock,
    )  # fmt: skip
    return MirrorEquations(mirrors, _degrees_of_freedom(problem, mirrors))


def used_priors(problem: MirrorProblem) -> BoolArray:
    """(mirror, prior) which of `PRIORS` is known and used."""
    known = problem.knowledge
    surveyed = known.pivot_enu_m is not None and bool(np.isfinite(known.pivot_sigma_m))
    given = np.array([surveyed, known.two_axis, np.isfinite(known.clock_sigma_m)])
    return np.asarray(given & ~problem.dropped)


def weighed(problem: MirrorProblem, stiffest_tie: float = STIFFEST_TIE) -> MirrorArrays:
    """Return what equations weigh, about clocks of zero; a shared clock is no stiffer than told (`STIFFEST_TIE`)."""
    known, has, n_mirror = problem.knowledge, used_priors(problem), len(problem.range_m)
    sigma, common = problem.sigma_m, problem.transmitter_sigma_m
    seen = np.isfinite(problem.range_m) & np.isfinite(sigma)
    weight = np.where(seen, 1.0 / np.where(seen, sigma, 1.0) ** 2, 0.0)
    with np.errstate(divide="ignore"):
        bias_info = np.array(np.where(np.isnan(common), 0.0, 1.0 / common**2))
    own, tie = _clock_ties(problem, weight, bias_info, stiffest_tie)
    return MirrorArrays(
        receiver_mirror=np.ascontiguousarray(problem.receiver_mirror_m),
        z=np.nan_to_num(problem.range_m),
        weight=weight,
        bias_info=bias_info,
        clock_class=problem.clock_class,
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


def _degrees_of_freedom(problem: MirrorProblem, mirrors: MirrorArrays) -> FloatArray:
    """(mirror,) measurements and priors less unknowns: what chi² should be."""
    weight, bias_info, has = mirrors.weight, mirrors.bias_info, used_priors(problem)
    seen = weight > 0.0
    n = seen.sum(axis=(1, 2, 3)).astype(np.float64) - 6.0 + has[:, :2] @ [3, 1]
    n -= (np.any(seen, axis=2) & (bias_info == 0.0)).sum(axis=(1, 2))
    for k in range(mirrors.prior.clock.shape[1]):
        mine = problem.clock_class == k
        clocks = np.any(seen[:, mine], axis=(1, 3)).sum(axis=1)
        free = np.where(has[:, 2], np.minimum(clocks, 1), clocks)
        # without calibration a common clock is the transmitters' as well, and counted with them
        calibrated = np.any(bias_info[:, mine] > 0.0, axis=(1, 2))
        n -= np.where(calibrated, free, np.maximum(free - 1, 0))
    return np.asarray(n)


def _clock_ties(
    problem: MirrorProblem, weight: FloatArray, bias_info: FloatArray, stiffest: float
) -> tuple[FloatArray, FloatArray]:
    """Information on each clock and on the differences between clocks.

    Clocks c + δ_r with δ_r of standard deviation s have differences of information 1/(R s²) a pair. Where no
    transmitter is calibrated a common clock is theirs as well: the first receiver's is then held, which says
    nothing.
    """
    n_mirror, _, n_receiver, _ = weight.shape
    n_class = int(problem.clock_class.max()) + 1
    own = np.zeros((n_mirror, n_class, n_receiver))
    tie = np.zeros((n_mirror, n_class, n_receiver, n_receiver))
    tied = used_priors(problem)[:, 2]
    for k in range(n_class):
        mine = problem.clock_class == k
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
            stiff = largest / (n_receiver * np.maximum(problem.knowledge.clock_sigma_m**2 * largest, stiffest))
            tie[:, k] = np.where(tied, stiff, 0.0)[:, None, None]
    return own, tie
