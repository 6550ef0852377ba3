"""Which phases a solver sees of each receiver and transmitter: the tones, and the carrier where it is compared."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, read_only
from rfpose.scenario import Scenario

__all__ = ["CARRIER", "Wavelengths", "clock_classes", "wavelengths_of"]

CARRIER = -1
"""Stands for the carrier where tones are numbered."""


def clock_classes(n_group: int) -> npt.NDArray[np.int64]:
    """Return which clocks each of so many wavelengths sees: each its own, for filters delay tones differently."""
    return np.arange(n_group)


@dataclass(frozen=True, slots=True, kw_only=True)
class Wavelengths:
    """The wavelengths in the order in which solvers take them: coarsest tone first, last the carrier.

    A group is one wavelength's phases. Arrays are read-only.

    Attributes
    ----------
    tone : (group,)
        Row of the scenario's tones, or `CARRIER`.
    tone_hz : (group,)
        Zero for the carrier [Hz].
    wavelength_m : (group, transmitter)
        [m].
    clock_class : (group,)
        Which clocks each sees.
    """

    tone: npt.NDArray[np.int64]
    tone_hz: FloatArray
    wavelength_m: FloatArray
    clock_class: npt.NDArray[np.int64]

    @property
    def n_tone(self) -> int:
        """Groups that are tones."""
        return int(np.count_nonzero(~self.is_carrier))

    @property
    def is_carrier(self) -> npt.NDArray[np.bool_]:
        """(group,) whether it is the carrier's own phase."""
        return np.asarray(self.tone == CARRIER)

    def kept(self, which: npt.NDArray[np.bool_]) -> Wavelengths:
        """Return some of them."""
        return _wavelengths(self.tone[which], self.tone_hz[which], self.wavelength_m[which])


def wavelengths_of(scenario: Scenario, *, carrier: bool = False) -> Wavelengths:
    """Return a scenario's wavelengths; ``carrier``: with the carriers' own (see `Estimator.carrier`)."""
    tone = np.argsort(-scenario.wavelength_m)
    tone_hz = scenario.tone_hz[tone]
    wavelength = np.repeat(scenario.wavelength_m[tone][:, None], len(scenario.transmitter), axis=1)
    if carrier:
        tone, tone_hz = np.append(tone, CARRIER), np.append(tone_hz, 0.0)
        wavelength = np.vstack([wavelength, scenario.radio.propagation_speed_mps / scenario.carrier_rf_hz])
    return _wavelengths(tone, tone_hz, wavelength)


def _wavelengths(tone: npt.NDArray[np.int64], tone_hz: FloatArray, wavelength_m: FloatArray) -> Wavelengths:
    return Wavelengths(
        tone=read_only(tone),
        tone_hz=read_only(tone_hz),
        wavelength_m=read_only(wavelength_m),
        clock_class=read_only(clock_classes(len(tone))),
    )
