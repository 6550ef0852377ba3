"""The budget: every source's share of each normal's error, by linear analysis and through the solver."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, as_float_array, read_only
from rfpose.engine import gathered
from rfpose.errors import InvalidInputError
from rfpose.layout.budget.plan import WorkingPoint
from rfpose.layout.budget.sources import SOURCES, Effect
from rfpose.layout.budget.world import DrawnSites
from rfpose.layout.gain import Gain
from rfpose.layout.maps import PosedMirrors

__all__ = ["BudgetLine", "ErrorBudget", "error_budget", "noise_bound", "target_slope"]

_BATCH_RANGES = 2_000_000
"""Ranges drawn at once, for memory."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BudgetLine:
    """One source, or several together; arrays are read-only, all angles of the mirror normal.

    Attributes
    ----------
    name, assumed, remedy
        What it is, what is assumed of it, what would reduce it.
    normal_rad : (mirror,)
        Rms angle by linear analysis [rad].
    target_m : (mirror,)
        Rms distance on the target, by the same [m]; NaN without an aim point.
    drawn_normal_rad, drawn_target_m : (mirror,)
        The same through the solver; NaN where nothing was drawn.
    """

    name: str
    assumed: str
    remedy: str
    normal_rad: FloatArray
    target_m: FloatArray
    drawn_normal_rad: FloatArray
    drawn_target_m: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class ErrorBudget:
    """Sources, worst first, and the whole.

    Attributes
    ----------
    lines
        One a source that the site has.
    whole
        Linear: the root of the sum of squares of the lines. Drawn: all sources at once.
    n_draw, n_failed
        Frames drawn for each line; solutions that failed among all of them.
    pose
        Which estimator: ``rigid``, ``independent`` or ``site``.
    wavelength_m
        Those that it uses, means over the transmitters [m].
    """

    lines: tuple[BudgetLine, ...]
    whole: BudgetLine
    n_draw: int
    n_failed: int
    pose: str
    wavelength_m: tuple[float, ...]


def error_budget(
    plan: WorkingPoint,
    *,
    n_draw: int = 200,
    seed: int = 0,
    aim_enu_m: npt.ArrayLike | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> ErrorBudget:
    """Return the budget of a site.

    Each source's slopes go through the estimator's gain: rms errors add as squares, sources being independent. With
    draws, each line and the whole are also measured: exact ranges with errors, calibrated and solved by the solver.

    Parameters
    ----------
    plan
        See `working_point`.
    n_draw
        Frames drawn for each line and for the whole; 0 for none.
    seed
        Equal seeds give equal results.
    aim_enu_m : (xyz,), optional
        Where beams go [m]; without, nothing is said of the target.
    progress
        Called with (lines done, lines).

    Raises
    ------
    InvalidInputError
        ``n_draw`` negative.
    """
    if n_draw < 0:
        raise InvalidInputError(f"`n_draw` must not be negative, got {n_draw}")
    gain = plan.gain()
    to_target = target_slope(plan.mirrors, aim_enu_m)
    there = [k for k, source in enumerate(SOURCES) if source.assumed(plan)]
    streams = np.random.SeedSequence(seed).spawn(len(SOURCES) + 1)
    draws = [LineDraws((k,), n_draw, streams[k]) for k in there] + [LineDraws(tuple(there), n_draw, streams[-1])]
    *each, (together, failed) = gathered(_draw, draws, plan, progress)
    lines, total = [], np.zeros((len(plan.mirrors.pivot_enu_m), 2, 2))
    for k, (drawn, failed_alone) in zip(there, each, strict=True):
        source = SOURCES[k]
        linear = _covariance(source.effects(plan, *_outputs(gain)), gain)
        total += linear
        failed += failed_alone
        lines.append(budget_line(source.name, source.assumed(plan), source.remedy, linear, drawn, to_target))
    whole = budget_line("all together", "", "", total, together, to_target)
    return ErrorBudget(
        lines=worst_first(lines),
        whole=whole,
        n_draw=n_draw,
        n_failed=failed,
        pose="rigid" if plan.estimator.rigid else "independent",
        wavelength_m=tuple(float(row.mean()) for row in plan.waves.wavelength_m),
    )


def noise_bound(plan: WorkingPoint) -> FloatArray:
    """Return the rms angle of each normal (mirror,) [rad] that the solver itself will state.

    What `rfpose.layout.maps.normal_map` bounds, for any solver a plan can describe: reflections estimated, too.
    """
    return np.asarray(np.sqrt(np.trace(plan.gain().cov, axis1=1, axis2=2)))


def target_slope(mirrors: PosedMirrors, aim_enu_m: npt.ArrayLike | None) -> FloatArray:
    """Return (mirror, xyz, xy): where the beam meets the target, by the normal's error along the mirror's axes [m/rad].

    The beam to the aim point turns by 2 (n·s) δn + 2 (δn·s) n, s towards the sun: twice δn in the plane of incidence,
    less by the cosine of the angle of incidence across it.
    """
    if aim_enu_m is None:
        return np.full((len(mirrors.pivot_enu_m), 3, 2), np.nan)
    aim = as_float_array("aim_enu_m", aim_enu_m, (3,)) - mirrors.pivot_enu_m
    distance = np.linalg.norm(aim, axis=1)
    normal = mirrors.normal_enu
    beam = aim / distance[:, None]
    cosine = np.einsum("mx,mx->m", normal, beam)
    sun = 2.0 * cosine[:, None] * normal - beam
    axes = mirrors.rot_enu_from_mirror[:, :, :2]
    turn = 2.0 * cosine[:, None, None] * axes + 2.0 * normal[:, :, None] * np.einsum("mx,mxk->mk", sun, axes)[:, None]
    # a mirror with its back to the aim has no beam there
    return np.asarray(np.where((cosine > 0.0)[:, None, None], distance[:, None, None] * turn, np.nan))


def _outputs(gain: Gain) -> tuple[FloatArray, FloatArray]:
    """Slopes of the normal and of what mirrors share, by ranges and by pivots."""
    return (
        np.concatenate([gain.range_slope, gain.shared_range_slope], axis=1),
        np.concatenate([gain.pivot_slope, gain.shared_pivot_slope], axis=1),
    )


def _covariance(effects: Sequence[Effect], gain: Gain) -> FloatArray:
    """(mirror, 2, 2) covariance of the normal's error along the mirror's axes [rad²]."""
    out = np.zeros((len(gain.range_slope), 2, 2))
    follow = gain.shared_slope
    for effect in effects:
        own = effect.slope[:, :2]
        if effect.past_solver or not follow.shape[2]:
            out += own @ np.swapaxes(own, 1, 2)
            continue
        shared = effect.slope[:, 2:]
        if effect.common:
            own = own + follow @ shared.sum(axis=0)
            out += own @ np.swapaxes(own, 1, 2)
            continue
        # what the other mirrors' errors do through the unknowns in common
        each = shared @ np.swapaxes(shared, 1, 2)
        others = each.sum(axis=0) - each
        out += follow @ others @ np.swapaxes(follow, 1, 2)
        own = own + follow @ shared
        out += own @ np.swapaxes(own, 1, 2)
    return out


@dataclass(frozen=True, slots=True)
class LineDraws:
    """A line's share of the Monte Carlo."""

    lines: tuple[int, ...]
    """Which sources are at work, by their place in the list of all: what they do is code, and that does not travel."""
    n_draw: int
    stream: np.random.SeedSequence


def _draw(plan: WorkingPoint, wanted: LineDraws) -> tuple[FloatArray, int]:
    """(mirror, 2, 2) mean square of the normal's error through the solver, NaN without draws; failed solutions."""
    n_mirror = len(plan.mirrors.pivot_enu_m)
    total, count = np.zeros((n_mirror, 2, 2)), np.zeros(n_mirror)
    rng, n_draw = np.random.default_rng(wanted.stream), wanted.n_draw
    batch = max(1, _BATCH_RANGES // plan.thermal_m.size)
    for begin in range(0, n_draw, batch):
        world = DrawnSites(plan, min(batch, n_draw - begin), rng)
        for k in wanted.lines:
            SOURCES[k].disturb(world)
        error = world.normal_errors()
        good: npt.NDArray[np.bool_] = np.asarray(np.isfinite(error).all(axis=2))
        error = np.where(good[..., None], error, 0.0)
        total += np.einsum("dma,dmb->mab", error, error)
        count += good.sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        return total / np.where(count > 0, count, np.nan)[:, None, None], int(n_draw * n_mirror - count.sum())


def worst_first(lines: Sequence[BudgetLine]) -> tuple[BudgetLine, ...]:
    """Return lines by how much they do to the whole field."""
    return tuple(sorted(lines, key=lambda line: -float(np.sum(np.nan_to_num(line.normal_rad) ** 2))))


def budget_line(
    name: str, assumed: str, remedy: str, linear: FloatArray, drawn: FloatArray, to_target: FloatArray
) -> BudgetLine:
    """Return a line from mean squares of the normal's error along the mirror's axes (mirror, 2, 2) [rad²]."""

    def normal(cov: FloatArray) -> FloatArray:
        return read_only(np.sqrt(np.trace(cov, axis1=1, axis2=2)))

    def target(cov: FloatArray) -> FloatArray:
        return read_only(np.sqrt(np.einsum("mxa,mab,mxb->m", to_target, cov, to_target)))

    return BudgetLine(
        name=name,
        assumed=assumed,
        remedy=remedy,
        normal_rad=normal(linear),
        target_m=target(linear),
        drawn_normal_rad=normal(drawn),
        drawn_target_m=target(drawn),
    )
