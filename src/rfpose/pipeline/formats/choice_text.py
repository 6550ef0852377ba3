"""The estimator of poses among a result's settings, which are text."""

from __future__ import annotations

from collections.abc import Mapping

from rfpose.errors import InvalidInputError
from rfpose.pipeline.choice import PoseChoice, choose
from rfpose.scenario import Scenario

__all__ = ["choice_of", "settings_of"]

_MODELS = ("none", "estimate", "known", "fresnel")
_SWITCH = ("on", "off")


def settings_of(choice: PoseChoice) -> dict[str, str]:
    """Return a choice as text."""
    return {
        "pose": choice.pose,
        "reflection": choice.reflection,
        "integrity": "on" if choice.integrity else "off",
        "filter": "on" if choice.filtered else "off",
    }


def choice_of(settings: Mapping[str, str], scenario: Scenario) -> PoseChoice:
    """Return what a result's settings say; what they do not say is as the scenario has it.

    Raises
    ------
    InvalidInputError
        They say what no estimator of poses is.
    """
    for name, allowed in (("reflection", _MODELS), ("integrity", _SWITCH), ("filter", _SWITCH)):
        if settings.get(name, allowed[0]) not in allowed:
            raise InvalidInputError(f"`{name}` must be one of {', '.join(allowed)}, got {settings[name]!r:.60}")
    default = choose(scenario, pose=settings["pose"])
    if default.pose != "rigid":
        return default
    return PoseChoice(
        pose=default.pose,
        reflection=settings.get("reflection", default.reflection),
        integrity=settings.get("integrity", "on" if default.integrity else "off") == "on",
        filtered=settings.get("filter", "on" if default.filtered else "off") == "on",
    )
