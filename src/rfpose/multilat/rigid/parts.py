"""Part of a mirror problem: solvers climb by wavelengths, and solve some mirrors again without what was wrong."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.multilat.rigid.problem import MirrorProblem

__all__ = ["part_of"]


def part_of(
    problem: MirrorProblem,
    *,
    groups: slice = slice(None),
    mirrors: npt.NDArray[np.int64] | None = None,
    used: npt.NDArray[np.bool_] | None = None,
    begin: tuple[FloatArray, FloatArray] | None = None,
) -> MirrorProblem:
    """Return some of a problem's wavelengths, mirrors and links, beginning elsewhere.

    Parameters
    ----------
    problem
    groups
        Which wavelengths.
    mirrors
        Rows, in any order, also repeated; None: all. What follows is of these.
    used : (mirror, receiver, transmitter)
        Links that are kept; None: all.
    begin : (mirror, xyz), (mirror, 3, 3)
        Pivots [m] and orientations to begin with; where one is NaN, and with None, as before.
    """
    rows: Any = slice(None) if mirrors is None else mirrors
    range_m, known = problem.range_m[rows, groups], problem.knowledge
    pivot, rot = problem.start_pivot_enu_m[rows], problem.start_rot_enu_from_mirror[rows]
    if used is not None:
        range_m = np.where(used[:, None], range_m, np.nan)
    if begin is not None:
        pivot, rot = (np.where(np.isfinite(new), new, old) for new, old in zip(begin, (pivot, rot), strict=True))
    return replace(
        problem,
        receiver_mirror_m=problem.receiver_mirror_m[rows],
        range_m=range_m,
        sigma_m=problem.sigma_m[rows, groups],
        transmitter_sigma_m=problem.transmitter_sigma_m[rows, groups],
        clock_class=problem.clock_class[groups],
        start_pivot_enu_m=pivot,
        start_rot_enu_from_mirror=rot,
        knowledge=known if known.pivot_enu_m is None else replace(known, pivot_enu_m=known.pivot_enu_m[rows]),
        wavelength_m=problem.wavelength_m[groups],
        is_carrier=problem.is_carrier[groups],
        dropped=problem.dropped[rows],
    )
