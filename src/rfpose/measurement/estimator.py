"""How normals are made of phases, and what is known of each mirror besides: its clocks, pivot and mount."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rfpose.errors import InvalidInputError
from rfpose.multilat.rigid import MirrorKnowledge
from rfpose.scenario import Heliostat, Scenario

__all__ = ["SCENARIO", "Estimator", "estimator_of", "estimators_of"]

SCENARIO = "scenario"
"""Name of the estimator that a scenario describes; see `estimator_of`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimator(MirrorKnowledge):
    """What a solver is told of mirrors, but for where they stand; and how normals are made of phases.

    Attributes
    ----------
    name
        For tables and pictures.
    rigid
        All receivers of a mirror in one fit; else each by itself and the plane through them.
    carrier
        Use the carrier's phase between a mirror's receivers, too.
    delay_drift_m_per_sqrt_s
        Random walk of unknown delays that are learned over frames [m/√s]; None: they are not.
    """

    name: str
    rigid: bool = True
    carrier: bool = False
    delay_drift_m_per_sqrt_s: float | None = None

    def __post_init__(self) -> None:
        if not self.clock_sigma_m >= 0.0:
            raise InvalidInputError(f"`clock_sigma_m` must not be negative, got {self.clock_sigma_m}")
        if not self.pivot_sigma_m > 0.0:
            raise InvalidInputError(f"`pivot_sigma_m` must be greater than zero, got {self.pivot_sigma_m}")
        if not self.roll_sigma_rad > 0.0:
            raise InvalidInputError(f"`roll_sigma_rad` must be greater than zero, got {self.roll_sigma_rad}")


def estimator_of(scenario: Scenario, heliostat: Heliostat) -> Estimator:
    """Return how a heliostat's normal is made by pose rigid: its clocks, carrier, pivot and mount."""
    speed = scenario.radio.propagation_speed_mps
    delay, drift = heliostat.receiver_delay_sigma_s, heliostat.receiver_delay_drift_s_per_sqrt_min
    return Estimator(
        name=SCENARIO,
        clock_sigma_m=delay * speed if heliostat.oscillator == "shared" and delay is not None else np.inf,
        carrier=scenario.compares_carriers(heliostat),
        pivot_sigma_m=np.inf if heliostat.pivot_sigma_m is None else heliostat.pivot_sigma_m,
        two_axis=heliostat.mount == "azimuth_elevation",
        delay_drift_m_per_sqrt_s=None if drift is None else drift / math.sqrt(60.0) * speed,
    )


def estimators_of(
    scenario: Scenario, heliostats: Sequence[Heliostat] | None = None
) -> dict[Estimator, npt.NDArray[np.int64]]:
    """Return the scenario's own estimators, and which of its (or of these) heliostats each is for."""
    found: dict[Estimator, list[int]] = {}
    for i, heliostat in enumerate(scenario.heliostat if heliostats is None else heliostats):
        found.setdefault(estimator_of(scenario, heliostat), []).append(i)
    return {estimator: np.array(rows, np.int64) for estimator, rows in found.items()}
