"""Samples through the whole chain for a few mirrors of a tracking run, beside the measurement-level model."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from rfpose import geometry
from rfpose.checks import FloatArray
from rfpose.errors import InvalidInputError
from rfpose.feedback.tracking.radio import RadioModel
from rfpose.multilat import PoseStatus
from rfpose.pipeline.process import process
from rfpose.pipeline.simulate import simulate_recording
from rfpose.scenario import Scenario

__all__ = ["IqComparison", "compare_with_iq"]


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
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        (place / "site.toml").write_text(site.to_toml(), encoding="utf-8")
        simulate_recording(place / "site.toml", place / "recording.h5", seed=seed)
        result = process(place / "recording.h5", place / "result.h5", estimator="correlator")
    rot = geometry.rot_enu_from_mirror(normal)
    off = result.poses.normal_enu[0] - normal
    error = np.stack([np.sum(off * rot[:, :, i], axis=1) for i in (0, 1)], axis=1)
    model = RadioModel(site, site.pivot_enu_m, usual_normal_enu=normal)
    errors = model.errors(normal, np.random.default_rng(seed))
    return IqComparison(
        error_rad=error, spread_rad=errors.spread_rad, solved=np.asarray(result.poses.status[0] == PoseStatus.OK)
    )


def _postures(scenario: Scenario, i_heliostat: int, normal_enu: FloatArray) -> Scenario:
    """Return the scenario with one mirror standing in each posture."""
    data = scenario.model_dump(exclude_none=True)
    like = data["heliostat"][i_heliostat]
    n_receiver = len(like["receiver_mirror_m"])
    data["heliostat"] = [
        {**like, "id": f"P{k}", "normal_enu": tuple(n), "receiver_ids": [f"P{k}_r{r}" for r in range(n_receiver)]}
        for k, n in enumerate(normal_enu.tolist())
    ]
    data["simulation"] |= {"frame_count": 1, "blocked": (), "dropped": ()}
    return Scenario.model_validate(data)
