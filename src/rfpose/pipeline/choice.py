"""Which estimator makes poses of phases: as asked for, else by the scenario."""

from __future__ import annotations

from dataclasses import dataclass

from rfpose.errors import InvalidInputError, ScenarioError
from rfpose.scenario import Scenario

__all__ = ["POSES", "REFLECTIONS", "PoseChoice", "choose"]

POSES = ("rigid", "site", "independent")
"""Ways to a mirror's normal. ``independent``: each receiver is located on its own, the normal is their plane's, as
published. ``rigid``: all phases of a mirror's receivers at once, with what the scenario says of clocks and pivots.
``site``: the carriers' phases, with the rays that ground, mirrors and structures send to each receiver."""

REFLECTIONS = ("estimate", "ignore")
"""What may be asked for instead of what the scenario says of reflections."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseChoice:
    """An estimator of poses.

    Attributes
    ----------
    pose
        One of `POSES`.
    reflection
        Model of the ground's coefficient, as in the scenario's ``[reflection]``; ``"none"``: the direct ray alone.
    integrity
        Whether residuals are tested, bad transmitters left out and protection levels given.
    filtered
        Whether poses are filtered over frames besides.
    """

    pose: str
    reflection: str
    integrity: bool
    filtered: bool = False


def choose(
    scenario: Scenario,
    *,
    pose: str,
    reflection: str | None = None,
    integrity: bool | None = None,
    filtered: bool | None = None,
) -> PoseChoice:
    """Put together what is asked for and what the scenario says.

    Parameters
    ----------
    scenario
    pose
        One of `POSES`.
    reflection
        One of `REFLECTIONS`; None: as the scenario says.
    integrity, filtered
        None: as the scenario says.

    Raises
    ------
    InvalidInputError
        An unknown value, or one that pose ``independent`` cannot follow.
    ScenarioError
        A filter over poses whose delays are learned.
    """
    if pose not in POSES:
        raise InvalidInputError(f"`pose` must be one of {', '.join(POSES)}, got {pose!r}")
    if reflection is not None and reflection not in REFLECTIONS:
        raise InvalidInputError(f"`reflection` must be one of {', '.join(REFLECTIONS)}, got {reflection!r}")
    if pose != "rigid":
        for name, asked in (
            ("reflection", reflection == "estimate"),
            ("integrity", integrity is True),
            ("filter", filtered is True),
        ):
            if asked:
                raise InvalidInputError(f"`{name}` is of pose `rigid`; pose `{pose}` has no such thing: leave it away")
        return PoseChoice(pose=pose, reflection="none", integrity=pose == "site")
    model: str = scenario.reflection.model
    if reflection is not None:
        model = "estimate" if reflection == "estimate" else "none"
    chosen = PoseChoice(
        pose=pose,
        reflection=model,
        integrity=scenario.integrity.enabled if integrity is None else integrity,
        filtered=scenario.motion.filtered if filtered is None else filtered,
    )
    _check_filter(scenario, chosen)
    return chosen


def _check_filter(scenario: Scenario, choice: PoseChoice) -> None:
    """Refuse to filter errors that frames have in common as if each frame had its own."""
    learning = [h.id for h in scenario.heliostat if h.receiver_delay_drift_s_per_sqrt_min is not None]
    if choice.filtered and learning:
        raise ScenarioError(
            f"heliostat `{learning[0]}` learns its receivers' delays over frames, and what they are off by is common "
            "to the frames: a filter would claim more than it knows; leave the filter off (`filtered=False`), or leave "
            "`receiver_delay_drift_s_per_sqrt_min` away"
        )
