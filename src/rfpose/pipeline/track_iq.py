"""Samples through the whole chain for a few mirrors of a tracking run, beside the measurement-level model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from rfpose import geometry
from rfpose.checks import FloatArray
from rfpose.errors import InvalidInputError
from rfpose.feedback.tracking.radio import RadioByPosture
from rfpose.feedback.tracking.timeline import days
from rfpose.multilat import PoseStatus
from rfpose.pipeline.process import process
from rfpose.pipeline.simulate import simulate
from rfpose.scenario import Scenario

__all__ = ["IqCheck", "IqComparison", "check_with_iq", "compare_with_iq"]


@dataclass(frozen=True, slots=True, kw_only=True)
class IqCheck:
    """One mirror's normals from samples beside what the tracking's radio model says of them.

    Attributes
    ----------
    heliostat, postures, solved
        Whose, how many, and how many gave a pose.
    error_rms_mrad, model_rms_mrad
        Errors from the samples, and noise by the model, both angles of the normal.
    variance_ratio
        Squared errors over the model's covariance; one if the model holds.
    """

    heliostat: str
    postures: int
    solved: int
    error_rms_mrad: float
    model_rms_mrad: float
    variance_ratio: float

    def as_dict(self) -> dict[str, Any]:
        """Return plain values."""
        return asdict(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class IqComparison:
    """Normals measured from samples, and what the model says of their errors.

    Attributes
    ----------
    error_rad : (posture, 2)
        Measured less true, along the mirror's right and up [rad]; NaN where no pose was found.
    spread_rad : (posture, 3)
        The model's noise, lower triangle of right and up [rad].
    solved : (posture,)
        Poses of status OK.
    """

    error_rad: FloatArray
    spread_rad: FloatArray
    solved: npt.NDArray[np.bool_]

    @property
    def chi2(self) -> FloatArray:
        """(posture,) squared errors over the model's covariance; two on the average if the model holds."""
        first = self.error_rad[:, 0] / self.spread_rad[:, 0]
        second = (self.error_rad[:, 1] - self.spread_rad[:, 1] * first) / self.spread_rad[:, 2]
        return np.asarray(first**2 + second**2)


def compare_with_iq(scenario: Scenario, *, heliostat: str, normal_enu: FloatArray, seed: int) -> IqComparison:
    """Record a mirror in several postures, process the recording, and compare with the tracking's radio model.

    Parameters
    ----------
    scenario
        As for tracking; its recording has the impairments of ``[simulation]``.
    heliostat
        Name of the mirror.
    normal_enu : (posture, xyz)
        Its normals. All postures are in one recording, as if each were a mirror of its own in the same place.
    seed
        Of the recording.

    Raises
    ------
    InvalidInputError
        No such mirror.
    """
    if heliostat not in scenario.heliostat_ids:
        raise InvalidInputError(f"`heliostat` must be one of the scenario's, got {heliostat!r}")
    normal = geometry.unit(normal_enu)
    site = _postures(scenario, scenario.heliostat_ids.index(heliostat), normal)
    result = process(simulate(site, seed=seed), estimator="correlator")
    rot = geometry.rot_enu_from_mirror(normal)
    off = result.poses.normal_enu[0] - normal
    error = np.stack([np.sum(off * rot[:, :, i], axis=1) for i in (0, 1)], axis=1)
    model = RadioByPosture(site, site.pivot_enu_m, usual_normal_enu=normal)
    errors = model.errors(normal, np.random.default_rng(seed))
    return IqComparison(
        error_rad=error, spread_rad=errors.spread_rad, solved=np.asarray(result.poses.status[0] == PoseStatus.OK)
    )


def check_with_iq(scenario: Scenario, heliostats: Sequence[str], *, seed: int, n_posture: int = 16) -> list[IqCheck]:
    """Take chosen mirrors through the samples in postures of the run's first day; one frame of each posture.

    Raises
    ------
    InvalidInputError
        A mirror that the scenario does not have, or a field of dishes.
    """
    for name in heliostats:
        if name not in scenario.heliostat_ids:
            raise InvalidInputError(
                f"samples can be made of the scenario's own mirrors only, not of {name!r}; it has "
                f"{scenario.heliostat_ids[0]} to {scenario.heliostat_ids[-1]}"
            )
    if not heliostats:
        return []
    if scenario.tracking.collector != "heliostat":
        raise InvalidInputError("samples are compared for heliostats; leave `check_iq` out for dishes")
    day = days(scenario)[0]
    at = np.flatnonzero(day.works)
    sun = day.sun_enu[at[np.linspace(0, len(at) - 1, n_posture).astype(np.int64)]]
    found = []
    for i, name in enumerate(heliostats):
        pivot = scenario.pivot_enu_m[scenario.heliostat_ids.index(name)]
        normal = geometry.bisector_enu(np.asarray(scenario.site.aim_enu_m) - pivot, sun)
        both = compare_with_iq(scenario, heliostat=name, normal_enu=normal, seed=seed + i)
        good = both.solved
        found.append(
            IqCheck(
                heliostat=name,
                postures=n_posture,
                solved=int(good.sum()),
                error_rms_mrad=1e3 * _rms(both.error_rad[good]),
                model_rms_mrad=1e3 * _rms(both.spread_rad[good]),
                variance_ratio=0.5 * float(np.mean(both.chi2[good])) if good.any() else float("nan"),
            )
        )
    return found


def _rms(parts: FloatArray) -> float:
    """Root of the mean squared length of vectors (row, part)."""
    return float(np.sqrt(np.mean(np.sum(parts**2, axis=1)))) if len(parts) else float("nan")


def _postures(scenario: Scenario, i_heliostat: int, normal_enu: FloatArray) -> Scenario:
    """Return the scenario with one mirror standing in each posture."""
    like = scenario.heliostat[i_heliostat]
    receivers = range(len(like.receiver_mirror_m))
    heliostats = [
        like.changed(id=f"P{k}", normal_enu=n, receiver_ids=[f"P{k}_r{r}" for r in receivers])
        for k, n in enumerate(normal_enu)
    ]
    return scenario.changed(heliostat=heliostats, simulation={"frame_count": 1, "blocked": None, "dropped": None})
