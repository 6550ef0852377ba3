"""Which parameters of a mount the measurements carry: candidates with priors, judged by what they predict.

Every candidate is fitted with priors about the mount as planned (or last calibrated), so that what the measurements do
not tell stays there. Time is cut into blocks and each block predicted from the others, since to predict other hours
and seasons than those measured is what a plant does. The smallest candidate that predicts as well as the best one, to
within a fiftieth, is chosen.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from types import MappingProxyType

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.feedback import _kernels
from rfpose.feedback.calibrated import PARAMETER_SETS, CalibratedMount, FieldCalibration, FitSettings, ParameterChoice
from rfpose.feedback.calibration import fit, row_status, solve, working_alone
from rfpose.feedback.columns import columns_of
from rfpose.feedback.measurements import Measurements
from rfpose.feedback.mount import Mount, stack_mounts
from rfpose.feedback.uncertainty import RAYLEIGH_MEDIAN

__all__ = [
    "AUTO",
    "PLANNED_SIGMA",
    "candidates",
    "choose",
    "chosen_errors_rad",
    "fit_chosen",
    "held_out_sigma",
    "refit",
    "refit_errors_rad",
    "with_priors",
]

AUTO = "auto"
_BLOCKS = 5
_CAP = 3.0
_AS_GOOD = 1.02

PLANNED_SIGMA: Mapping[str, float] = MappingProxyType(
    # zeros and the twist are set up by eye or by a sensor's flag: degrees
    dict.fromkeys(("axis_1_zero_rad", "axis_2_zero_rad", "pedestal_twist_rad"), 50e-3)
    # masons and riggers: half a degree
    | dict.fromkeys(("pedestal_tilt_north_rad", "pedestal_tilt_east_rad"), 10e-3)
    | dict.fromkeys(("canting_up_rad", "canting_right_rad"), 15e-3)
    | dict.fromkeys(("receiver_plane_up_rad", "receiver_plane_right_rad"), 15e-3)
    # the workshop
    | {"nonorthogonality_rad": 2e-3}
    | dict.fromkeys((f"actuator_{a}_{side}_m" for a in (1, 2) for side in ("stroke", "radius", "offset")), 1e-3)
    | dict.fromkeys(("axis_1_gain", "axis_2_gain"), 2e-3)
    | dict.fromkeys(("arm_normal_m", "arm_up_m", "arm_right_m", "axis_offset_m"), 2e-2)
    | dict.fromkeys((f"worm_{a}_{part}_rad" for a in (1, 2) for part in ("sin", "cos")), 1e-3)
    | {"gravity_sag_rad": 1e-3}
    # survey
    | dict.fromkeys(("location_east_m", "location_north_m", "location_up_m", "pylon_length_m"), 5e-2)
    | dict.fromkeys(("drone_camera_east_m", "drone_camera_north_m", "drone_camera_up_m"), 0.3)
)
"""How far a mount may be from its plan, one standard deviation, before anything is measured."""


def candidates(mount: Mount) -> tuple[str, ...]:
    """Return the parameter sets to choose from, from few to many, by how axis 1 lies."""
    level = abs(float(mount.rot_enu_from_mount[2, 2])) < 0.5
    return (
        ("offsets", "level-4", "level-5", "level-canting", "level-full")
        if level
        else ("offsets", "edwards-4", "edwards-7", "malan")
    )


def with_priors(mount: Mount, free: Sequence[str], settings: FitSettings | None = None) -> FitSettings:
    """Return settings with a prior about the mount's value for each free parameter that has none yet."""
    chosen = settings or FitSettings()
    priors = {name: (mount.parameters[name], PLANNED_SIGMA[name]) for name in free}
    return dataclasses.replace(chosen, priors={**priors, **chosen.priors})


def fit_chosen(
    mount: Mount, measurements: Measurements, *, also: Sequence[str] = (), settings: FitSettings | None = None
) -> CalibratedMount:
    """Fit a heliostat with the parameters that its measurements carry, and priors.

    Parameters
    ----------
    mount
        As planned or as last calibrated: the start, and what the priors are about.
    measurements
        From one or several sources.
    also
        Parameters that are free besides, such as the receivers' plane.
    settings
        As for `calibration.fit`; its priors take the place of `PLANNED_SIGMA`.
    """
    usable = row_status(mount, measurements) == 0
    (choice,) = choose(mount, measurements, usable[None], also=also, settings=settings)
    chosen = with_priors(mount, choice.free, settings)
    # what is left out of the fit scatters more than what is in it, and over the seasons more than that
    chosen = dataclasses.replace(chosen, least_noise=max(chosen.least_noise, choice.held_out_sigma))
    found = fit(mount, measurements, free=choice.free, settings=chosen)
    return dataclasses.replace(found, choice=choice)


def choose(
    mount: Mount,
    measurements: Measurements,
    masks: npt.NDArray[np.bool_],
    *,
    also: Sequence[str] = (),
    settings: FitSettings | None = None,
) -> tuple[ParameterChoice, ...]:
    """Choose parameters for each of several selections of a heliostat's measurements.

    Parameters
    ----------
    mount, measurements, also, settings
        As for `fit_chosen`.
    masks : (selection, measurement)
        Usable measurements that each choice may look at.
    """
    sets = {
        name: (*PARAMETER_SETS[name], *(extra for extra in also if extra not in PARAMETER_SETS[name]))
        for name in candidates(mount)
    }
    folds = [_folds(measurements, mask) for mask in masks]
    stacked = np.concatenate([mask & ~held for mask, held in zip(masks, folds, strict=True)])
    held = np.concatenate(folds)
    errors: dict[str, FloatArray] = {}
    for name, free in sets.items():
        # a single measurement leaves none to predict it from
        some = with_priors(mount, free, settings)
        error = refit_errors_rad(mount, measurements, stacked, free, some) if len(held) else held
        errors[name] = np.where(held, error, np.nan)
    edges = np.cumsum([0, *(len(fold) for fold in folds)])
    return tuple(
        _choice(sets, {name: error[a:b] for name, error in errors.items()}, measurements.sigma_rad)
        for a, b in itertools.pairwise(edges)
    )


def held_out_sigma(
    mount: Mount, measurements: Measurements, *, free: Sequence[str], settings: FitSettings | None = None
) -> float:
    """Scatter of time-blocks predicted from the others, in units of the stated sigma, for parameters that are given.

    To be held against `ParameterChoice.held_out_sigma`. NaN where there are too few measurements.
    """
    held = _folds(measurements, row_status(mount, measurements) == 0)
    if not len(held):
        return float("nan")
    usable = held.any(axis=0)
    error = refit_errors_rad(mount, measurements, usable & ~held, tuple(free), settings or FitSettings())
    error = error[held] / np.broadcast_to(measurements.sigma_rad, held.shape)[held]
    return float(np.median(error)) / RAYLEIGH_MEDIAN


def chosen_errors_rad(
    mount: Mount,
    measurements: Measurements,
    masks: npt.NDArray[np.bool_],
    *,
    also: Sequence[str] = (),
    settings: FitSettings | None = None,
) -> FloatArray:
    """Let each selection choose and fit; return the errors of all measurements (selection, measurement) [rad]."""
    choices = choose(mount, measurements, masks, also=also, settings=settings)
    out = np.full(masks.shape, np.nan)
    for free in {choice.free for choice in choices}:
        chose = np.array([choice.free == free for choice in choices])
        out[chose] = refit_errors_rad(mount, measurements, masks[chose], free, with_priors(mount, free, settings))
    return out


def _folds(measurements: Measurements, mask: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Blocks of time, each to be predicted from the others (block, measurement); none with fewer than two."""
    index = np.flatnonzero(mask)
    index = index[np.argsort(measurements.unix_s[index], kind="stable")]
    blocks = np.array_split(index, min(_BLOCKS, len(index))) if len(index) > 1 else []
    folds = np.zeros((len(blocks), len(mask)), np.bool_)
    for fold, block in zip(folds, blocks, strict=True):
        fold[block] = True
    return folds


def _choice(
    sets: Mapping[str, tuple[str, ...]], errors: Mapping[str, FloatArray], sigma_rad: FloatArray
) -> ParameterChoice:
    """Smallest set that predicts as well as the best, to within a fiftieth."""
    held = {name: error[np.isfinite(error)] for name, error in errors.items()}
    n = min(len(error) for error in held.values())
    smallest = next(iter(sets))
    if n < 2 or len({len(error) for error in held.values()}) > 1:
        return ParameterChoice(
            chosen=smallest,
            free=sets[smallest],
            held_out_rad={},
            held_out_sigma=0.0,
            reason="too few measurements to hold any out",
        )
    if n < 2 * _BLOCKS:
        # of blocks this small zeros alone win by luck; priors keep the larger sets in check
        held.pop(smallest)
    cap = _CAP * min(float(np.median(error)) for error in held.values())
    capped = {name: np.minimum(error, cap) for name, error in held.items()}
    mean = {name: float(error.mean()) for name, error in capped.items()}
    best = min(mean, key=lambda name: mean[name])
    name = next(name for name in mean if mean[name] <= _AS_GOOD * mean[best])
    told = f"{1e3 * mean[name]:.2f} mrad on the time-blocks held out"
    reason = (
        f"best of {len(mean)}: {told}"
        if name == best
        else f"{told}, as good as {best} ({1e3 * mean[best]:.2f}), with fewer parameters"
    )
    scatter = float(np.nanmedian(errors[name] / sigma_rad)) / RAYLEIGH_MEDIAN
    return ParameterChoice(chosen=name, free=sets[name], held_out_rad=mean, held_out_sigma=scatter, reason=reason)


def refit(
    mount: Mount,
    measurements: Measurements,
    masks: npt.NDArray[np.bool_],
    free: tuple[str, ...],
    settings: FitSettings,
) -> tuple[FloatArray, FieldCalibration]:
    """Fit each mask's measurements; return the errors of all measurements under each fit [rad], and the fits.

    Parameters
    ----------
    mount, measurements, free, settings
        As for `calibration.fit`.
    masks : (fit, measurement)
        What each fit may use.
    """
    p, k, count, row = _repeated(mount, measurements, len(masks))
    found = solve(p, k, count, row, masks, free, settings)
    p[:, columns_of(free)] = found.working
    return _errors_rad(p, k, count, row, measurements.sigma_rad), found


def refit_errors_rad(
    mount: Mount,
    measurements: Measurements,
    masks: npt.NDArray[np.bool_],
    free: tuple[str, ...],
    settings: FitSettings,
) -> FloatArray:
    """Return the errors of `refit` (fit, measurement) [rad] without what is known of each fit, which costs time."""
    p, k, count, row = _repeated(mount, measurements, len(masks))
    p[:, columns_of(free)] = working_alone(p, k, count, row, masks, free, settings)
    return _errors_rad(p, k, count, row, measurements.sigma_rad)


def _repeated(
    mount: Mount, measurements: Measurements, n: int
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Parameters, constants, counts and rows of a mount and what was measured of it, so many times over."""
    p, k = stack_mounts([mount])
    one = (p, k, measurements.count[None], measurements.row[None])
    p, k, count, row = (np.repeat(values, n, axis=0) for values in one)
    return p, k, count, row


def _errors_rad(p: FloatArray, k: FloatArray, count: FloatArray, row: FloatArray, sigma_rad: FloatArray) -> FloatArray:
    """Angles between modelled and measured normals (fit, measurement) [rad]."""
    residual = _kernels.residuals_batch(p, k, count, row, np.ones(row.shape[:2], np.bool_))
    chord = np.linalg.norm(residual, axis=-1) * sigma_rad
    return np.asarray(2.0 * np.arcsin(np.minimum(0.5 * chord, 1.0)))
