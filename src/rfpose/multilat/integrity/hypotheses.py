"""Every way in which one mirror's measurements could be wrong, tested against its residuals.

A hypothesis frees a part of the model: all observations of one transmitter, one transmitter at one receiver, the
surveyed pivot, the mount, the common clock. Its statistic is the drop of chi² that this buys, exact for linear
equations; without a fault it is chi²-distributed with as many degrees of freedom as the hypothesis has.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.multilat.integrity import _kernels
from rfpose.multilat.integrity.records import Verdict
from rfpose.multilat.reflection import direct_rays
from rfpose.multilat.rigid import MirrorProblem, RigidPoses
from rfpose.multilat.rigid.problem import PRIORS
from rfpose.multilat.rigid.weights import used_priors, weighed

__all__ = ["judge"]

IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

_FLOOR = 1e-8
"""Redundancy below which a fault counts as invisible."""
_TIE_FLOOR = 1e-6
"""As `rfpose.multilat.rigid.weights.STIFFEST_TIE`, so that freeing a tie stands out of its rounding."""


def judge(problem: MirrorProblem, poses: RigidPoses) -> Verdict:
    """Test every hypothesis at the least-squares poses."""
    mirrors = weighed(problem, _TIE_FLOOR)
    n_mirror, n_group, n_receiver, n_transmitter = mirrors.z.shape
    n_hypothesis, n = n_transmitter + len(PRIORS), 6 + mirrors.prior.clock.shape[1] * n_receiver
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
    for k, (used, fault) in enumerate(zip(used_priors(problem).T, _prior_faults(problem, rot), strict=True)):
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
    n_class = int(problem.clock_class.max()) + 1
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
