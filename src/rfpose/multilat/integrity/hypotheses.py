"""Every way in which one mirror's measurements could be wrong, tested against its residuals.

A hypothesis frees a part of the model: all observations of one transmitter, one transmitter at one receiver, the
surveyed pivot, the mount, the common clock. Its statistic is the drop of chi² that this buys, exact for linear
equations; without a fault it is chi²-distributed with as many degrees of freedom as the hypothesis has.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, read_only
from rfpose.multilat.integrity import _kernels
from rfpose.multilat.reflection import direct_rays
from rfpose.multilat.rigid import MirrorProblem, RigidPoses
from rfpose.multilat.rigid.problem import PRIORS

__all__ = [
    "Verdict",
    "judge",
    "largest_eigenvalue",
    "limit",
    "log_probability",
    "noncentrality",
    "quiet_median",
    "tilt_quantile",
    "widened",
]

IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

_FLOOR = 1e-8
"""Redundancy below which a fault counts as invisible."""
_TIE_FLOOR = 1e-6
"""As `rfpose.multilat.rigid.problem.STIFFEST_TIE`, so that freeing a tie stands out of its rounding."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """Statistics of all hypotheses: transmitters first, then `PRIORS`.

    Attributes
    ----------
    ok : (mirror,)
        Whether the pose was determined at all; False: the rest is 0.
    stat, dof : (mirror, hypothesis)
        Drop of chi², and degrees of freedom; 0 = cannot be tested.
    hidden : (mirror, hypothesis)
        Part of the fault leaves no trace in the residuals, yet tilts the normal.
    shift_rad : (mirror, hypothesis, 2)
        What the fault, as estimated, did to the normal: rotation about the mirror's x and y axes.
    spread_rad2 : (mirror, hypothesis, 2, 2)
        What leaving it free adds to the covariance of that rotation.
    cov_rad2 : (mirror, 2, 2)
        Covariance of that rotation, nothing left free.
    common, common_dof : (mirror, transmitter)
        The same for an error common to all receivers.
    link, link_dof : (mirror, receiver, transmitter)
        The same for an error at one receiver.
    """

    ok: BoolArray
    stat: FloatArray
    dof: IntArray
    hidden: BoolArray
    shift_rad: FloatArray
    spread_rad2: FloatArray
    cov_rad2: FloatArray
    common: FloatArray
    common_dof: IntArray
    link: FloatArray
    link_dof: IntArray

    def take(self, rows: IntArray) -> Verdict:
        """Select mirrors."""
        return Verdict(**{f.name: getattr(self, f.name)[rows] for f in fields(Verdict)})


def judge(problem: MirrorProblem, poses: RigidPoses) -> Verdict:
    """Test every hypothesis at the least-squares poses."""
    mirrors = problem.weighed(_TIE_FLOOR)
    n_mirror, n_group, n_receiver, n_transmitter = mirrors.z.shape
    n_hypothesis, n = n_transmitter + len(PRIORS), 6 + problem.n_class * n_receiver
    solved = _kernels.SolvedMirrors(
        ok=np.zeros(n_mirror, np.bool_),
        data_info=np.zeros((n_mirror, n, n)),
        data_gradient=np.zeros((n_mirror, n)),
        cov=np.zeros((n_mirror, n, n)),
    )
    tests = _kernels.HypothesisTests(
        stat=np.zeros((n_mirror, n_hypothesis)),
        dof=np.zeros((n_mirror, n_hypothesis), np.int64),
        hidden=np.zeros((n_mirror, n_hypothesis), np.bool_),
        shift=np.zeros((n_mirror, n_hypothesis, 2)),
        spread=np.zeros((n_mirror, n_hypothesis, 2, 2)),
        common=np.zeros((n_mirror, n_transmitter)),
        common_dof=np.zeros((n_mirror, n_transmitter), np.int64),
        link=np.zeros((n_mirror, n_receiver, n_transmitter)),
        link_dof=np.zeros((n_mirror, n_receiver, n_transmitter), np.int64),
    )
    rot = np.ascontiguousarray(poses.rot_enu_from_mirror)
    scene = direct_rays(problem.transmitter_enu_m, n_group)
    pivot, clock = np.ascontiguousarray(poses.pivot_enu_m), np.ascontiguousarray(poses.clock_m)
    _kernels.judge_many(n_mirror, scene, mirrors, _FLOOR, pivot, rot, clock, solved, tests)
    axes = rot[:, :, :2]
    cov_tilt = np.einsum("mac,mab,mbd->mcd", axes, solved.cov[:, 3:6, 3:6], axes)
    for k, (used, fault) in enumerate(zip(problem.has_prior.T, _prior_faults(problem, rot), strict=True)):
        rows = np.flatnonzero(used & solved.ok)
        if rows.size:
            _free_prior(solved, tests, rows, n_transmitter + k, axes[rows], cov_tilt[rows], fault[rows])
    for array in tests:
        array[~solved.ok] = 0
    return Verdict(
        ok=solved.ok, stat=tests.stat, dof=tests.dof, hidden=tests.hidden, shift_rad=tests.shift,
        spread_rad2=tests.spread, cov_rad2=cov_tilt, common=tests.common, common_dof=tests.common_dof,
        link=tests.link, link_dof=tests.link_dof,
    )  # fmt: skip


def _prior_faults(problem: MirrorProblem, rot: FloatArray) -> list[FloatArray]:
    """Unknowns (mirror, unknown, fault) that each of `PRIORS` would leave free."""
    n_mirror, _, n_receiver, _ = problem.range_m.shape
    n_class = problem.n_class
    eye = np.eye(6 + n_class * n_receiver)
    mount = np.zeros((n_mirror, len(eye), 1))
    mount[:, 3, 0], mount[:, 4, 0] = rot[:, 1, 0], -rot[:, 0, 0]
    mount /= np.maximum(np.linalg.norm(mount, axis=1, keepdims=True), 1e-300)
    delays = [6 + k * n_receiver + r for k in range(n_class) for r in range(1, n_receiver)]
    return [
        np.broadcast_to(eye[:, :3], (n_mirror, len(eye), 3)),
        mount,
        np.broadcast_to(eye[:, delays], (n_mirror, len(eye), len(delays))),
    ]


def _free_prior(
    solved: _kernels.SolvedMirrors,
    tests: _kernels.HypothesisTests,
    rows: IntArray,
    h: int,
    axes: FloatArray,
    cov_tilt: FloatArray,
    fault: FloatArray,
) -> None:
    """Test what freeing the unknowns ``fault`` of their prior does to each of ``rows``."""
    through = solved.data_info[rows] @ fault
    answer = solved.cov[rows] @ through
    matrix = np.swapaxes(fault, 1, 2) @ through - np.swapaxes(through, 1, 2) @ answer
    right = np.einsum("mnf,mn->mf", fault, solved.data_gradient[rows])
    tilt = np.swapaxes(axes, 1, 2) @ (answer - fault)[:, 3:6]
    # each unknown in units of what the data alone would say of it
    unit = np.sqrt(np.maximum(np.einsum("mnf,mnf->mf", fault, through), 1e-300))
    matrix = matrix / (unit[:, :, None] * unit[:, None, :])
    right, tilt = right / unit, tilt / unit[:, None, :]
    blind = 1e-5 * np.sqrt(np.trace(cov_tilt, axis1=1, axis2=2))
    for k, m in enumerate(rows):
        tests.stat[m, h], tests.dof[m, h], tests.hidden[m, h] = _kernels.explain(
            matrix[k], right[k], tilt[k], _FLOOR, blind[k], tests.shift[m, h], tests.spread[m, h]
        )


def log_probability(stat: FloatArray, dof: IntArray) -> FloatArray:
    """Logarithm of the probability that chi² of ``dof`` exceeds ``stat``; 0 without degrees of freedom."""
    from scipy.special import gammaincc, gammaln

    half, x = np.maximum(dof, 1) / 2.0, np.maximum(stat, 0.0) / 2.0
    far = x > 300.0 + half
    with np.errstate(divide="ignore"):
        near = np.log(gammaincc(half, np.where(far, 0.0, x)))
        # first terms of the asymptotic series of Γ(a, x)
        tail = (half - 1.0) * np.log(x) - x - gammaln(half) + np.log1p(np.where(far, (half - 1.0) / x, 0.0))
    return np.asarray(np.where(dof > 0, np.where(far, tail, near), 0.0))


def limit(probability: float | FloatArray, dof: IntArray) -> FloatArray:
    """Value that chi² of ``dof`` exceeds with ``probability``."""
    from scipy.special import chdtri

    return np.asarray(np.where(dof > 0, chdtri(np.maximum(dof, 1), probability), np.inf))


def noncentrality(threshold: FloatArray, dof: IntArray, missed: float) -> FloatArray:
    """Noncentrality at which a chi² of ``dof`` stays below ``threshold`` with probability ``missed``."""
    from scipy.special import chndtrinc

    out = np.full(dof.shape, np.inf)
    for d in np.unique(dof[dof > 0]):
        at = dof == d
        out[at] = chndtrinc(threshold[at][0], float(d), missed)
    return out


def largest_eigenvalue(matrix: FloatArray) -> FloatArray:
    """Larger eigenvalue of symmetric 2×2 matrices."""
    a, b, d = matrix[..., 0, 0], matrix[..., 0, 1], matrix[..., 1, 1]
    return np.asarray(0.5 * (a + d) + np.sqrt(0.25 * (a - d) ** 2 + b * b))


def tilt_quantile(probability: float) -> float:
    """How many of its larger sigmas a two-dimensional normal error exceeds with at most ``probability``."""
    return float(np.sqrt(-2.0 * np.log(probability)))


def widened(poses: RigidPoses, left_out: BoolArray, level_rad: FloatArray, missed: float) -> RigidPoses:
    """Return poses whose covariance allows for what their protection levels do, where something was left out.

    Where one transmitter proved wrong, the others are no longer known to be right: the normal's standard deviation,
    whichever way, is at least that of an error which exceeds the level with probability ``missed``.

    Parameters
    ----------
    poses
    left_out : (mirror,)
        Where any transmitter or prior was.
    level_rad : (mirror,)
        Protection level; where it is infinite nothing is changed.
    missed
        Missed-detection probability of the level.
    """
    rows = np.flatnonzero(left_out & np.isfinite(level_rad) & np.isfinite(poses.cov).all(axis=(1, 2)))
    cov = np.array(poses.cov)
    axes = poses.rot_enu_from_mirror[rows][:, :, :2]
    size, way = np.linalg.eigh(np.swapaxes(axes, 1, 2) @ cov[rows, 3:, 3:] @ axes)
    lacking = np.maximum((level_rad[rows, None] / tilt_quantile(missed)) ** 2 - size, 0.0)
    turn = axes @ way
    cov[rows, 3:, 3:] += (turn * lacking[:, None]) @ np.swapaxes(turn, 1, 2)
    return replace(poses, cov=read_only(cov))


def quiet_median(x: FloatArray) -> FloatArray:
    """Median over the last axis without NaN; NaN where nothing is left."""
    ordered = np.sort(x, axis=-1)  # NaN last
    count = np.isfinite(x).sum(axis=-1)
    low, high = (np.maximum(k, 0)[..., None] for k in ((count - 1) // 2, np.minimum(count // 2, x.shape[-1] - 1)))
    middle = 0.5 * (np.take_along_axis(ordered, low, -1) + np.take_along_axis(ordered, high, -1))[..., 0]
    return np.asarray(np.where(count > 0, middle, np.nan))
