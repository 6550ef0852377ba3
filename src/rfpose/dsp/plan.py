"""Which spectral lines a recording holds, and where a receiver's clock puts them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING

import numpy as np

from rfpose.checks import FloatArray, as_float_array, as_positive, read_only
from rfpose.errors import InvalidInputError

if TYPE_CHECKING:
    from rfpose.scenario import Scenario

__all__ = ["LinePlan"]

_LARGEST_GRID = 2048


@dataclass(frozen=True, slots=True, kw_only=True)
class LinePlan:
    """The FDM plan: every transmitter's carrier and sidebands, offset from the centre frequency.

    Attributes
    ----------
    carrier_hz : (transmitter,)
        Carrier offsets [Hz].
    tone_hz : (tone,)
        Ranging tones [Hz].
    line_hz : (transmitter × line,)
        Every line [Hz]: of each transmitter the carrier, then upper and lower sideband of each tone.
    line_rf_cycles : (line,)
        Every line's RF over the sample rate [cycles/sample].
    sample_rate_hz, centre_frequency_hz
        Of the recording [Hz].
    clock_search_ppm
        Receiver clocks are searched within plus and minus this.
    grid
        Smallest number of samples after which every line at nominal frequency repeats, or None where that is
        longer than 2048 samples. Lines on one grid can be folded before they are separated.
    """

    carrier_hz: FloatArray
    tone_hz: FloatArray
    line_hz: FloatArray
    line_rf_cycles: FloatArray
    sample_rate_hz: float
    centre_frequency_hz: float
    clock_search_ppm: float
    grid: int | None

    @classmethod
    def create(
        cls,
        carrier_hz: FloatArray,
        tone_hz: FloatArray,
        *,
        sample_rate_hz: float,
        centre_frequency_hz: float,
        clock_search_ppm: float = 50.0,
    ) -> LinePlan:
        """Check the frequencies and find the common grid.

        Raises
        ------
        InvalidInputError
            Wrong shapes, no carrier, no tone, a line outside the band.
        """
        carrier = as_float_array("carrier_hz", carrier_hz, ("transmitter",))
        tone = as_float_array("tone_hz", tone_hz, ("tone",), positive=True)
        rate = as_positive("sample_rate_hz", sample_rate_hz)
        if not len(carrier) or not len(tone):
            raise InvalidInputError("`carrier_hz` and `tone_hz` must each hold at least one frequency")
        if np.max(np.abs(carrier)) + np.max(tone) >= rate / 2.0:
            raise InvalidInputError("`carrier_hz` ± `tone_hz` must lie inside ±`sample_rate_hz`/2")
        offset = np.array([0.0, *(sign * f for f in tone for sign in (1.0, -1.0))])
        line = (carrier[:, None] + offset).ravel()
        return cls(
            carrier_hz=read_only(carrier),
            tone_hz=read_only(tone),
            line_hz=read_only(line),
            line_rf_cycles=read_only((float(centre_frequency_hz) + line) / rate),
            sample_rate_hz=rate,
            centre_frequency_hz=float(centre_frequency_hz),
            clock_search_ppm=float(clock_search_ppm),
            grid=_common_grid(np.concatenate([carrier, tone]), rate),
        )

    @classmethod
    def from_scenario(cls, scenario: Scenario, *, tuned_hz: float | None = None) -> LinePlan:
        """Return the plan of a scenario for a receiver tuned to ``tuned_hz``; None: to what the scenario says.

        Raises
        ------
        InvalidInputError
            A line lies outside the band of a receiver that is tuned so.
        """
        radio = scenario.radio
        tuned = radio.centre_frequency_hz if tuned_hz is None else tuned_hz
        return cls.create(
            scenario.carrier_hz + (radio.centre_frequency_hz - tuned),
            scenario.tone_hz,
            sample_rate_hz=radio.sample_rate_hz,
            centre_frequency_hz=tuned,
            clock_search_ppm=radio.clock_search_ppm,
        )

    @property
    def n_transmitter(self) -> int:
        """Number of transmitters."""
        return len(self.carrier_hz)

    @property
    def n_tone(self) -> int:
        """Number of tones."""
        return len(self.tone_hz)

    @property
    def smallest_gap_hz(self) -> float:
        """Smallest distance between two lines [Hz]."""
        return float(np.min(np.diff(np.sort(self.line_hz))))

    def line_cycles(self, clock_ppm: float | FloatArray) -> FloatArray:
        """(line,) line frequencies as a receiver with this clock offset records them [cycles/sample].

        Of several offsets (candidate, 1): (candidate, line).

        One oscillator drives mixer and sampler: with ``k = 1 + clock_ppm·1e-6`` a line at RF ``f`` appears at
        ``(f − k f_c) / (k f_s)``.
        """
        k = 1.0 + clock_ppm * 1e-6
        return self.line_rf_cycles / k - self.centre_frequency_hz / self.sample_rate_hz

    def common_shift_cycles(self, clock_ppm: float) -> float:
        """Shift of the band's centre by the clock offset [cycles/sample]; what is left of a line's is small."""
        k = 1.0 + clock_ppm * 1e-6
        return self.centre_frequency_hz * (1.0 / k - 1.0) / self.sample_rate_hz

    def cycles_per_ppm(self) -> FloatArray:
        """(line,) how far one part per million moves each line [cycles/sample], to first order."""
        return -1e-6 * self.line_rf_cycles


def _common_grid(frequency_hz: FloatArray, rate_hz: float) -> int | None:
    """Return the smallest P with every ``frequency · P / rate`` an integer, or None above the largest grid."""
    rate = Fraction(rate_hz)
    period = 1
    for frequency in frequency_hz:
        ratio = (Fraction(float(frequency)) / rate).limit_denominator(_LARGEST_GRID)
        if abs(float(ratio) - frequency / rate_hz) > 1e-13:
            return None
        period = math.lcm(period, ratio.denominator)
        if period > _LARGEST_GRID:
            return None
    return period
