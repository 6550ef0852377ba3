"""The ways of one frame's waves: how long each is, and what is left of the wave; here from geometry alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.errors import ScenarioError
from rfpose.scenario import Scenario

__all__ = ["Paths", "paths_from_geometry"]

ComplexArray = npt.NDArray[np.complex128]
_MIN_RANGE_M = 1e-6


@dataclass(frozen=True, slots=True)
class Paths:
    """Rays of all links of one frame, nothing being in their way; in units of a transmitter of amplitude one.

    Attributes
    ----------
    length_m : (receiver, transmitter, ray)
        [m].
    gain : (receiver, transmitter, ray)
        Complex; the phase that the length makes is not in it. Zero where a link has fewer rays than others.
    signal : (receiver, transmitter)
        What the truth's signal-to-noise ratio is about: the amplitude of the direct ray, or of the sum of a table's.
    """

    length_m: FloatArray
    gain: ComplexArray
    signal: FloatArray


def paths_from_geometry(scenario: Scenario, position_enu_m: FloatArray) -> Paths:
    """Return direct rays, then those reflected by the ground if there is one.

    Parameters
    ----------
    scenario
    position_enu_m : (receiver, xyz)
        [m].

    Raises
    ------
    ScenarioError
        A receiver stands where a transmitter stands, or one of them is below the ground.
    """
    simulation = scenario.simulation
    ground = simulation.ground
    source = scenario.transmitter_enu_m[:, None, :]
    if ground is not None:
        _check_above_ground(scenario, position_enu_m, ground.height_m)
        image = source * [1.0, 1.0, -1.0] + [0.0, 0.0, 2.0 * ground.height_m]
        source = np.concatenate([source, image], axis=1)
    length = np.linalg.norm(position_enu_m[:, None, None, :] - source, axis=-1)
    if np.any(length < _MIN_RANGE_M):
        r, i, _ = np.argwhere(length < _MIN_RANGE_M)[0]
        raise ScenarioError(
            f"receiver `{scenario.receiver_ids[r]}` stands where transmitter `{scenario.transmitter_ids[i]}` stands; "
            "move one of them"
        )
    amplitude = np.array([t.amplitude for t in scenario.transmitter])[:, None] * np.ones(length.shape)
    if simulation.path_loss == "free_space":
        amplitude *= simulation.reference_range_m / length
    gain = amplitude.astype(np.complex128)
    if ground is not None:
        gain[..., 1] *= complex(*ground.coefficient)
    return Paths(length_m=length, gain=gain, signal=amplitude[..., 0])


def _check_above_ground(scenario: Scenario, position_enu_m: FloatArray, ground_height_m: float) -> None:
    for kind, ids, height_m in (
        ("transmitter", scenario.transmitter_ids, scenario.transmitter_enu_m[:, 2]),
        ("receiver", scenario.receiver_ids, position_enu_m[:, 2]),
    ):
        if np.any(height_m < ground_height_m):
            i = int(np.argmax(height_m < ground_height_m))
            raise ScenarioError(
                f"{kind} `{ids[i]}` at height {height_m[i]:.4g} m lies below the ground at {ground_height_m:g} m; "
                "lower `simulation.ground.height_m` or raise the position"
            )
