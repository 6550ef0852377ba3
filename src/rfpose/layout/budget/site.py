"""The budget of pose ``site``: what each thing that it cannot know does to normals, among foreseen rays.

To first order the share of what the estimator reckons with is read off its stated covariance, and what it does not
reckon with goes through it with one step; see `rfpose.multilat.site.ForeseenMirrors`. Drawn, all of it goes into
carriers, and these through the fit; what mirrors have in common is then taken as known, and the rays are those foreseen
at the true pose.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.engine import gathered
from rfpose.errors import InvalidInputError
from rfpose.layout.budget.sources import (
    MirrorMotion,
    Misalignment,
    Quantisation,
    ReceiverPlacement,
    Thermal,
    TransmitterSurvey,
    Wavelength,
)
from rfpose.layout.budget.table import ErrorBudget, LineDraws, budget_line, target_slope, worst_first
from rfpose.layout.maps import PosedMirrors
from rfpose.multilat.site import ForeseenMirrors, WorldErrors
from rfpose.scenario import Scenario

__all__ = ["SiteMirrors", "SitePlan", "site_budget"]

IntArray = npt.NDArray[np.int64]

_STEP_M = 1e-5
_STEP_SHARE = 1e-7
_NONE = 1e-6
"""Share of the whole variance below which what the estimator reckons with is no line."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SiteMirrors:
    """Some rows of a field, foreseen: mirrors alike in receivers and in what is known of them, in one posture."""

    rows: IntArray
    foreseen: ForeseenMirrors


@dataclass(frozen=True, slots=True, kw_only=True)
class SitePlan:
    """The working point of pose ``site``.

    Attributes
    ----------
    scenario, mirrors
        The site, and the mirrors in their postures; several postures are several rows.
    parts
        All rows, foreseen; those of mirrors that cannot be solved are NaN.
    converter_share
        Variance of rounding over that of thermal noise.
    """

    scenario: Scenario
    mirrors: PosedMirrors
    parts: tuple[SiteMirrors, ...]
    converter_share: float


@dataclass(frozen=True, slots=True, kw_only=True)
class _Line:
    """One source: its words, its covariance (mirror, xyz, xyz) by first order, and its draws."""

    name: str
    remedy: str
    assumed: Callable[[SitePlan], str]
    share: Callable[[SitePlan, ForeseenMirrors], FloatArray]
    draw: Callable[[SitePlan, ForeseenMirrors, np.random.Generator], WorldErrors | FloatArray]
    """What the world has more; or what the normals (mirror, xyz) are off by past the estimator."""


def site_budget(
    plan: SitePlan,
    *,
    n_draw: int = 200,
    seed: int = 0,
    aim_enu_m: npt.ArrayLike | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> ErrorBudget:
    """Return the budget of a site whose poses are those of pose ``site``.

    Parameters
    ----------
    plan
    n_draw, seed, aim_enu_m, progress
        As `rfpose.layout.budget.error_budget`.

    Raises
    ------
    InvalidInputError
        ``n_draw`` negative.
    """
    if n_draw < 0:
        raise InvalidInputError(f"`n_draw` must not be negative, got {n_draw}")
    to_target = target_slope(plan.mirrors, aim_enu_m)
    asked = [line for line in _LINES if line.assumed(plan)]
    first_order = [_of_rows(plan, line) for line in asked]
    total = np.sum(first_order, axis=0)
    there = [np.nansum(cov) > _NONE * np.nansum(total) for cov in first_order]
    found = [(line, cov) for line, cov, present in zip(asked, first_order, there, strict=True) if present]
    streams = np.random.SeedSequence(seed).spawn(len(_LINES) + 1)
    places = [_LINES.index(line) for line, _ in found]
    draws = [LineDraws((k,), n_draw, streams[k]) for k in places] + [LineDraws(tuple(places), n_draw, streams[-1])]
    *each, (together, failed) = gathered(_drawn, draws, plan, progress)
    lines = []
    for (line, cov), (drawn, failed_alone) in zip(found, each, strict=True):
        failed += failed_alone
        lines.append(budget_line(line.name, line.assumed(plan), line.remedy, cov, drawn, to_target))
    carrier_m = plan.scenario.radio.propagation_speed_mps / plan.scenario.carrier_rf_hz
    return ErrorBudget(
        lines=worst_first(lines),
        whole=budget_line("all together", "", "", total, together, to_target),
        n_draw=n_draw,
        n_failed=failed,
        pose="site",
        wavelength_m=(float(carrier_m.mean()),),
    )


def _of_rows(plan: SitePlan, line: _Line) -> FloatArray:
    """(mirror, 2, 2) share of a source in all rows, along the mirrors' axes; NaN: not solved."""
    out = np.full((len(plan.mirrors.pivot_enu_m), 2, 2), np.nan)
    for part in plan.parts:
        axes = plan.mirrors.rot_enu_from_mirror[part.rows][:, :, :2]
        out[part.rows] = np.einsum("mxa,mxy,myb->mab", axes, line.share(plan, part.foreseen), axes)
    return out


def _drawn(plan: SitePlan, wanted: LineDraws) -> tuple[FloatArray, int]:
    """(mirror, 2, 2) mean square of the normal's error through the fit, NaN without draws; failed solutions."""
    n = len(plan.mirrors.pivot_enu_m)
    total, count = np.zeros((n, 2, 2)), np.zeros(n)
    rng, n_draw = np.random.default_rng(wanted.stream), wanted.n_draw
    lines = [_LINES[k] for k in wanted.lines]
    for _ in range(n_draw):
        for part in plan.parts:
            axes = plan.mirrors.rot_enu_from_mirror[part.rows][:, :, :2]
            error = np.einsum("mxa,mx->ma", axes, _one_draw(plan, lines, part.foreseen, rng))
            good = np.isfinite(error).all(axis=1)
            total[part.rows[good]] += error[good, :, None] * error[good, None, :]
            count[part.rows[good]] += 1
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = total / np.where(count > 0, count, np.nan)[:, None, None]
    return mean, int(n_draw * n - count.sum())


def _one_draw(
    plan: SitePlan, lines: Sequence[_Line], foreseen: ForeseenMirrors, rng: np.random.Generator
) -> FloatArray:
    """(mirror, xyz) solved less true normals."""
    world, past = WorldErrors(), np.zeros((len(foreseen.sigma), 3))
    for line in lines:
        drawn = line.draw(plan, foreseen, rng)
        if isinstance(drawn, WorldErrors):
            world = world + drawn
        else:
            past += drawn
    return past + foreseen.normal_change(world, linear=False)


# -- what the estimator reckons with -----------------------------------------------------------------------------------


def _reckoned(source: str, name: str, assumed: Callable[[SitePlan], str], remedy: str) -> _Line:
    return _Line(
        name=name,
        remedy=remedy,
        assumed=assumed,
        share=lambda _, part: part.share(source),
        draw=lambda _, part, rng: part.drawn(source, rng),
    )


def _floor(plan: SitePlan) -> str:
    common = plan.parts[0].foreseen.common
    given = "" if plan.scenario.multipath.floor is not None else ", not yet seen in a recording"
    return f"a stray field of {100.0 * common.floor:.3g} % of the direct one, Student's t of {common.tail:g}{given}"


def _factor(key: str) -> Callable[[SitePlan], str]:
    def words(plan: SitePlan) -> str:
        amplitude, phase = getattr(plan.scenario.multipath, key)
        return f"factors to {100.0 * amplitude:.3g} % and {phase:.3g} rad"

    return words


def _permittivity(plan: SitePlan) -> str:
    left = plan.parts[0].foreseen.common.soil_sigma
    return f"permittivity to {100.0 * left[0]:.2g} % and {100.0 * left[1]:.2g} %, as far as all mirrors tell it"


def _pattern(plan: SitePlan) -> str:
    return "its own statement" if plan.scenario.antenna.pattern is not None else ""


def _posture(plan: SitePlan) -> str:
    return f"{1e3 * plan.scenario.posture.sigma_rad:.3g} mrad"


def _pivot(plan: SitePlan) -> str:
    sigma = plan.parts[0].foreseen.knowledge.pivot_sigma_m
    return f"{1e3 * sigma:.3g} mm in each axis"


def _roll(plan: SitePlan) -> str:
    sigma = plan.parts[0].foreseen.knowledge.roll_sigma_rad
    return f"horizontal x axis to {1e3 * sigma:.3g} mrad" if np.isfinite(sigma) else ""


def _clock(plan: SitePlan) -> str:
    sigma = plan.parts[0].foreseen.knowledge.clock_sigma_m
    if np.isinf(sigma):
        return ""  # solved for, and nothing known of them
    delay_ns = 1e9 * sigma / plan.scenario.radio.propagation_speed_mps
    return f"{delay_ns:.3g} ns between a mirror's receivers" if sigma > 0.0 else ""


# -- what it does not reckon with --------------------------------------------------------------------------------------


def _draw_quantisation(plan: SitePlan, part: ForeseenMirrors, rng: np.random.Generator) -> WorldErrors:
    drawn = part.drawn("noise", rng)
    return WorldErrors(stray=np.sqrt(plan.converter_share) * drawn.stray)


def _through(part: ForeseenMirrors, worlds: Iterable[WorldErrors], times: float) -> FloatArray:
    """(mirror, xyz, xyz) sum of squares of what small disturbances do, each so many times as large."""
    change = times * np.array([part.normal_change(world, linear=True) for world in worlds])
    return np.asarray(np.einsum("dmx,dmy->mxy", change, change))


def _share_places(plan: SitePlan, part: ForeseenMirrors) -> FloatArray:
    _, n_receiver, _ = part.sigma.shape
    steps = _STEP_M * np.eye(3 * n_receiver).reshape(-1, n_receiver, 3)
    return _through(
        part, (WorldErrors(place_m=step) for step in steps), plan.scenario.budget.receiver_mirror_sigma_m / _STEP_M
    )


def _draw_places(plan: SitePlan, part: ForeseenMirrors, rng: np.random.Generator) -> WorldErrors:
    sigma = plan.scenario.budget.receiver_mirror_sigma_m
    return WorldErrors(place_m=sigma * rng.standard_normal((*part.sigma.shape[:2], 3)))


def _share_transmitters(plan: SitePlan, part: ForeseenMirrors) -> FloatArray:
    n_transmitter = part.sigma.shape[2]
    steps = _STEP_M * np.eye(3 * n_transmitter).reshape(-1, n_transmitter, 3)
    sigma_m = plan.scenario.budget.transmitter_survey_sigma_m
    return _through(part, (WorldErrors(transmitter_m=step) for step in steps), sigma_m / _STEP_M)


def _draw_transmitters(plan: SitePlan, part: ForeseenMirrors, rng: np.random.Generator) -> WorldErrors:
    sigma = plan.scenario.budget.transmitter_survey_sigma_m
    return WorldErrors(transmitter_m=sigma * rng.standard_normal((part.sigma.shape[2], 3)))


def _share_air(plan: SitePlan, part: ForeseenMirrors) -> FloatArray:
    return _through(part, [WorldErrors(range_scale=_STEP_SHARE)], Wavelength().sigma(plan) / _STEP_SHARE)


def _draw_air(plan: SitePlan, part: ForeseenMirrors, rng: np.random.Generator) -> WorldErrors:
    return WorldErrors(range_scale=Wavelength().sigma(plan) * float(rng.standard_normal()))


def _across(part: ForeseenMirrors) -> FloatArray:
    """(mirror, xyz, xyz) identity across the normals."""
    normal = part.knowledge.commanded_rot[:, :, 2]
    return np.asarray(np.eye(3) - normal[:, :, None] * normal[:, None, :])


def _glass_rad(plan: SitePlan) -> float:
    return 1e-3 * plan.scenario.budget.receiver_plane_sigma_mrad


def _draw_tilt(part: ForeseenMirrors, rng: np.random.Generator, sigma_rad: float) -> FloatArray:
    tilt = rng.standard_normal((len(part.sigma), 2)) * sigma_rad
    return np.asarray(np.einsum("mxa,ma->mx", part.knowledge.commanded_rot[:, :, :2], tilt))


def _draw_motion(plan: SitePlan, part: ForeseenMirrors, rng: np.random.Generator) -> FloatArray:
    return _draw_tilt(part, rng, MirrorMotion().angle_rad(plan) / np.sqrt(2.0))


_LINES: tuple[_Line, ...] = (
    _reckoned("noise", Thermal.name, Thermal().assumed, Thermal.remedy),
    _reckoned(
        "floor", "what nothing foresees", _floor,
        "tell more of the site ([site.structures], outlines, edges); higher transmitters, more of them, or a higher "
        "radio frequency; antennas that hear less from below",
    ),
    _reckoned("permittivity", "the ground's permittivity", _permittivity, "give the ground's constants better"),
    _reckoned(
        "ground", "roughness of the ground", _factor("ground_sigma"),
        "survey the ground's shape and state a smaller `ground_sigma`; transmitters farther up",
    ),
    _reckoned(
        "specular", "reflections of neighbours and tower", _factor("specular_sigma"),
        "know neighbours' outlines and postures better and state a smaller `specular_sigma`; more transmitters",
    ),
    _reckoned(
        "diffracted", "diffraction at edges", _factor("diffracted_sigma"),
        "know edges better and state a smaller `diffracted_sigma`; a higher radio frequency",
    ),
    _reckoned(
        "own plate", "the mirror's own plate", _factor("own_plate_sigma"),
        "give the antennas' pattern on their plate ([antenna] `pattern`)",
    ),
    _reckoned("pattern", "antenna pattern", _pattern, "learn or compute the pattern from more directions"),
    _reckoned("pivot", "pivot survey", _pivot, "survey the pivots better; `rfpose survey` finds them from postures"),
    _reckoned("posture", "commanded posture", _posture, "more transmitters, so that carriers tell all of the pose"),
    _reckoned("roll", "mount", _roll, "more transmitters, so that carriers tell all of the pose"),
    _reckoned("clock", "clock", _clock, "measure the delays between a mirror's receivers"),
    _Line(
        name=Quantisation.name, remedy=Quantisation.remedy, assumed=Quantisation().assumed,
        share=lambda plan, part: plan.converter_share * part.share("noise"), draw=_draw_quantisation,
    ),
    _Line(
        name=ReceiverPlacement.name,
        remedy="`rfpose survey` with reference poses of a camera; measure the receivers on the mirror better",
        assumed=ReceiverPlacement().assumed, share=_share_places, draw=_draw_places,
    ),
    _Line(
        name=TransmitterSurvey.name, remedy=TransmitterSurvey.remedy, assumed=TransmitterSurvey().assumed,
        share=_share_transmitters, draw=_draw_transmitters,
    ),
    _Line(
        name=Misalignment.name, remedy=Misalignment.remedy, assumed=Misalignment().assumed,
        share=lambda plan, part: _glass_rad(plan) ** 2 * _across(part),
        draw=lambda plan, part, rng: _draw_tilt(part, rng, _glass_rad(plan)),
    ),
    _Line(
        name=MirrorMotion.name, remedy=MirrorMotion.remedy, assumed=MirrorMotion().assumed,
        share=lambda plan, part: 0.5 * MirrorMotion().angle_rad(plan) ** 2 * _across(part), draw=_draw_motion,
    ),
    _Line(
        name=Wavelength.name, remedy=Wavelength.remedy, assumed=Wavelength().assumed,
        share=_share_air, draw=_draw_air,
    ),
)  # fmt: skip
