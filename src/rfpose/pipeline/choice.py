"""Which estimator makes poses of phases: by the command line, else by the scenario; kept in a result's settings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from rfpose.errors import GeometryError, InvalidInputError, ScenarioError
from rfpose.multilat.ground import Reflector, Surface
from rfpose.multilat.ground.model import heights_m
from rfpose.scenario import Scenario

__all__ = ["POSES", "REFLECTIONS", "PoseChoice", "check_reflectors", "choose", "reflectors_of"]

POSES = ("rigid", "independent")
"""Ways to a mirror's normal. ``independent``: each receiver is located on its own, the normal is their plane's, as
published. ``rigid``: all phases of a mirror's receivers at once, with what the scenario says of clocks and pivots."""

REFLECTIONS = ("estimate", "ignore")
"""What may be asked for instead of what the scenario says of reflections."""


_MODELS = ("none", "estimate", "known", "fresnel")
_SWITCH = ("on", "off")


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

    @classmethod
    def of(cls, settings: Mapping[str, str], scenario: Scenario) -> PoseChoice:
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
        return cls(
            pose=default.pose,
            reflection=settings.get("reflection", default.reflection),
            integrity=settings.get("integrity", "on" if default.integrity else "off") == "on",
            filtered=settings.get("filter", "on" if default.filtered else "off") == "on",
        )

    def as_settings(self) -> dict[str, str]:
        """Return the choice as text for a result file."""
        return {
            "pose": self.pose,
            "reflection": self.reflection,
            "integrity": "on" if self.integrity else "off",
            "filter": "on" if self.filtered else "off",
        }


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
        return PoseChoice(pose=pose, reflection="none", integrity=False)
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
            "to the frames: a filter would claim more than it knows; leave the filter off (`--no-filter`), or leave "
            "`receiver_delay_drift_s_per_sqrt_min` away"
        )


def reflectors_of(scenario: Scenario, model: str) -> tuple[Reflector, ...]:
    """Return the planes of a scenario, the ground first, its coefficient by ``model``."""
    table = scenario.reflection
    if model == "none":
        return ()
    surface = None
    if model == "fresnel" and table.permittivity is not None:
        surface = Surface(
            permittivity=table.permittivity,
            conductivity_s_per_m=table.conductivity_s_per_m,
            polarisation=table.polarisation,
        )
    ground = Reflector(
        name="ground",
        point_enu_m=(0.0, 0.0, table.height_m),
        normal_enu=table.normal_enu,
        coefficient=complex(*table.coefficient) if model == "known" and table.coefficient is not None else None,
        surface=surface,
        scaled=table.scaled and surface is not None,
    )
    walls = tuple(
        Reflector(
            name=plane.name,
            point_enu_m=plane.point_enu_m,
            normal_enu=plane.normal_enu,
            coefficient=None if plane.coefficient is None else complex(*plane.coefficient),
        )
        for plane in table.plane
    )
    return (ground, *walls)


def check_reflectors(scenario: Scenario, reflectors: tuple[Reflector, ...]) -> None:
    """Refuse planes behind which something stands that is to be reflected in them.

    Raises
    ------
    ScenarioError
        Carriers without a radio frequency.
    GeometryError
        Names the plane and what lies behind it.
    """
    if reflectors:
        scenario.need_rf_carriers("the model of reflections")
    standing = (
        ("transmitter", scenario.transmitter_ids, scenario.transmitter_enu_m),
        ("calibration receiver", tuple(r.id for r in scenario.calibration_receiver), scenario.calibration_enu_m),
        ("pivot of heliostat", scenario.heliostat_ids, scenario.pivot_enu_m),
    )
    for reflector in reflectors:
        for kind, names, place in standing:
            for name, height in zip(names, heights_m(place, reflector), strict=True):
                if height <= 0.0:
                    raise GeometryError(
                        f"{kind} `{name}` lies {-height:.3g} m behind reflector `{reflector.name}`: nothing is "
                        "reflected there; move the plane (`height_m`, `point_enu_m`), turn its `normal_enu` around, or "
                        "leave it out"
                    )
