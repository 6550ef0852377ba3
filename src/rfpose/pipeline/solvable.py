"""Sites that no recording could be solved for, refused before any work is done."""

from __future__ import annotations

import numpy as np

from rfpose.errors import GeometryError, ScenarioError
from rfpose.measurement import check_reflectors
from rfpose.multilat.transmitters import check_transmitters
from rfpose.pipeline.choice import PoseChoice, choose
from rfpose.scenario import Scenario

__all__ = ["check_solvable"]


def check_solvable(scenario: Scenario, *, pose: str, choice: PoseChoice | None = None) -> None:
    """Refuse a site that no recording could be solved for, before any work is done.

    Parameters
    ----------
    scenario
    pose
        One of `rfpose.pipeline.choice.POSES`.
    choice
        The estimator; default: as the scenario says.

    Raises
    ------
    InvalidInputError
        Unknown ``pose``.
    ScenarioError
        No heliostat; or no calibration receiver where one is needed: by pose ``independent``, by mirrors whose
        pivot is not surveyed, and by reflections.
    GeometryError
        Too few transmitters, on a line or at the same place; or the field (without calibration receivers: a mirror)
        is too wide for the longest tone; or something stands behind a plane that is to reflect it.
    """
    chosen = choose(scenario, pose=pose) if choice is None else choice
    if not scenario.heliostat:
        raise ScenarioError(f"scenario `{scenario.name}` has no heliostat to measure; add a [[heliostat]]")
    check_transmitters(scenario.transmitter_enu_m, scenario.wavelength_m if scenario.is_calibrated else None)
    if not scenario.is_calibrated:
        _check_solvable_by_differences(scenario, chosen)
    if chosen.pose == "site":
        from rfpose.pipeline.site import check_site_solvable

        check_site_solvable(scenario)
    check_reflectors(scenario, chosen.reflection)


def _check_solvable_by_differences(scenario: Scenario, choice: PoseChoice) -> None:
    """Refuse what cannot do without calibration receivers."""
    if choice.pose == "site":
        return
    if choice.pose != "rigid":
        raise ScenarioError(
            f"scenario `{scenario.name}` has no calibration receiver, and pose `{choice.pose}` needs one to learn the "
            "transmitters' electronic phases; add a [[calibration_receiver]] at a surveyed place, or survey the "
            "pivots (`pivot_sigma_m`) and use pose `rigid`"
        )
    if choice.reflection != "none":
        raise ScenarioError(
            f"scenario `{scenario.name}` has no calibration receiver, and reflections cannot be told from what the "
            "transmitters' phases do without one; add a [[calibration_receiver]] at a surveyed place, or leave "
            "reflections out (`reflection='ignore'`)"
        )
    longest = float(np.max(scenario.wavelength_m))
    for heliostat in scenario.heliostat:
        if heliostat.pivot_sigma_m is None:
            raise ScenarioError(
                f"scenario `{scenario.name}` has no calibration receiver, and the pivot of heliostat "
                f"`{heliostat.id}` is not surveyed: nothing tells where it is; add a [[calibration_receiver]] at a "
                "surveyed place, or give `pivot_sigma_m`"
            )
        places = np.array(heliostat.receiver_mirror_m)
        width = float(np.max(np.linalg.norm(places[:, None] - places, axis=-1)))
        if width >= longest / 4.0:
            raise GeometryError(
                f"ambiguous: receivers of heliostat `{heliostat.id}` are {width:.3g} m apart, and without calibration "
                f"receivers that must be below a quarter of the longest tone's wavelength of {longest:.6g} m; add a "
                f"tone of wavelength above {4.0 * width:.6g} m"
            )
