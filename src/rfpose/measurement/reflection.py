"""The planes that a solver knows to reflect."""

from __future__ import annotations

from typing import Literal

from rfpose.errors import GeometryError
from rfpose.multilat.ground import Reflector, Surface
from rfpose.multilat.ground.model import heights_m
from rfpose.scenario import Scenario

__all__ = ["GroundHandling", "check_reflectors", "ground_handling", "reflectors_of", "simulated_ground"]

GroundHandling = Literal["ignored", "known", "estimated"]
"""What a solver does about a ground that reflects."""


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


def check_reflectors(scenario: Scenario, model: str) -> None:
    """Refuse planes, as of `reflectors_of`, behind which something stands that is to be reflected in them.

    Raises
    ------
    ScenarioError
        Carriers without a radio frequency.
    GeometryError
        Names the plane and what lies behind it.
    """
    reflectors = reflectors_of(scenario, model)
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


def ground_handling(scenario: Scenario) -> GroundHandling:
    """Return what the solver of a budget does about the ground: by ``[budget] ground``, else as process would do."""
    if scenario.budget.ground is not None:
        return scenario.budget.ground
    table = scenario.reflection
    if table.model == "none":
        return "ignored"
    return "estimated" if table.model == "estimate" or table.scaled else "known"


def simulated_ground(
    scenario: Scenario, *, coefficient: complex | None = None, height_offset_m: float = 0.0
) -> Reflector:
    """Return the ground of ``[simulation.ground]``, which must be there, as a solver would know it.

    Parameters
    ----------
    scenario
    coefficient
        None: to be estimated.
    height_offset_m
        How much higher it lies than the scenario says [m].
    """
    ground = scenario.simulation.ground
    assert ground is not None
    return Reflector(point_enu_m=(0.0, 0.0, ground.height_m + height_offset_m), coefficient=coefficient)
