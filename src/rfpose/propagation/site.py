"""What a scenario says of its surroundings, in the postures of one frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, as_float_array
from rfpose.propagation.surroundings import BoxesStanding, PlatesStanding, ReceiverStand, Soil, Surroundings
from rfpose.scenario import Scenario

__all__ = ["PlacedThings", "boxes_of", "place_things", "soil_of", "stand_of"]


@dataclass(frozen=True, slots=True, kw_only=True)
class PlacedThings:
    """A scenario's things in their postures.

    Attributes
    ----------
    surroundings
        Of plates those whose posture and size are known.
    own_plate : (heliostat,)
        Which of the plates is each heliostat's own; −1: none.
    names
        Of the things, as `Surroundings` numbers them.
    """

    surroundings: Surroundings
    own_plate: npt.NDArray[np.int64]
    names: tuple[str, ...]


def place_things(
    scenario: Scenario, rot_enu_from_mirror: npt.ArrayLike, *, pivot_enu_m: npt.ArrayLike | None = None
) -> PlacedThings:
    """Stand up what a scenario has about its receivers.

    Parameters
    ----------
    scenario
        Its ``[site.structures]``, the heliostats' outlines, and the ground of ``[reflection]``.
    rot_enu_from_mirror : (mirror, 3, 3)
        Orientations of `Scenario.mirrors`, heliostats and plates. NaN: unknown, the thing is left out.
    pivot_enu_m : (mirror, xyz), optional
        Where pivots are found to be, instead of the scenario's [m]. NaN: as the scenario has it.
    """
    mirrors = scenario.mirrors
    n_heliostat, n = len(scenario.heliostat), len(mirrors)
    rot = as_float_array("rot_enu_from_mirror", rot_enu_from_mirror, (n, 3, 3), finite=False)
    pivot = scenario.mirror_pivot_enu_m
    if pivot_enu_m is not None:
        found = as_float_array("pivot_enu_m", pivot_enu_m, (n, 3), finite=False)
        pivot = np.where(np.isfinite(found), found, pivot)
    size = np.array([[m.width_m or np.nan, m.height_m or np.nan] for m in mirrors]).reshape(-1, 2)
    arm = np.array([m.arm_m for m in mirrors])
    known = np.isfinite(size).all(axis=1) & np.isfinite(rot).all(axis=(1, 2))
    number = np.where(known, np.cumsum(known) - 1, -1)
    return PlacedThings(
        surroundings=Surroundings(
            plates=PlatesStanding(
                centre_enu_m=(pivot + arm[:, None] * rot[:, :, 2])[known],
                rot_enu_from_mirror=rot[known],
                size_m=size[known],
            ),
            boxes=boxes_of(scenario),
            soil=soil_of(scenario),
        ),
        own_plate=number[:n_heliostat].astype(np.int64),
        names=(
            *(m.id for m, known_ in zip(mirrors, known, strict=True) if known_),
            *(box.id for box in scenario.site.structures.box),
            "ground",
        ),
    )


def boxes_of(scenario: Scenario) -> BoxesStanding:
    """Return the boxes of ``[site.structures]``."""
    boxes = scenario.site.structures.box
    return BoxesStanding(
        base_enu_m=np.array([b.base_enu_m for b in boxes]).reshape(-1, 3),
        size_m=np.array([b.size_m for b in boxes]).reshape(-1, 3),
        azimuth_rad=np.radians([b.azimuth_deg for b in boxes]),
        permittivity=np.array([b.permittivity for b in boxes]),
        conductivity_s_per_m=np.array([b.conductivity_s_per_m for b in boxes]),
    )


def soil_of(scenario: Scenario) -> Soil | None:
    """Return the ground of ``[reflection]``; None unless its ``model`` is ``fresnel``: no other knows what it is of."""
    table = scenario.reflection
    if table.model != "fresnel" or table.permittivity is None:
        return None
    return Soil(
        permittivity=table.permittivity,
        conductivity_s_per_m=table.conductivity_s_per_m,
        height_m=table.height_m,
        normal_enu=table.normal_enu,
    )


def stand_of(
    scenario: Scenario,
    rot_enu_from_mirror: npt.ArrayLike,
    own_plate: npt.NDArray[np.int64],
    *,
    pivot_enu_m: npt.ArrayLike | None = None,
) -> ReceiverStand:
    """Return where a scenario's receivers stand, those of heliostats with fewer than others filled up with NaN.

    Parameters
    ----------
    scenario
    rot_enu_from_mirror : (heliostat, 3, 3)
        Orientations. NaN: unknown, no rays.
    own_plate : (heliostat,)
        As `place_things` numbers them.
    pivot_enu_m : (heliostat, xyz), optional
        Instead of the scenario's [m].
    """
    n = len(scenario.heliostat)
    place = np.full((n, max((len(h.receiver_mirror_m) for h in scenario.heliostat), default=0), 3), np.nan)
    for i, heliostat in enumerate(scenario.heliostat):
        place[i, : len(heliostat.receiver_mirror_m)] = np.add(heliostat.receiver_mirror_m, [0.0, 0.0, heliostat.arm_m])
    pivot: FloatArray = scenario.pivot_enu_m
    if pivot_enu_m is not None:
        pivot = as_float_array("pivot_enu_m", pivot_enu_m, (n, 3), finite=False)
    return ReceiverStand(
        pivot_enu_m=pivot,
        rot_enu_from_mirror=as_float_array("rot_enu_from_mirror", rot_enu_from_mirror, (n, 3, 3), finite=False),
        receiver_mirror_m=place,
        own_plate=own_plate,
    )
