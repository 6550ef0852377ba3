"""Wind as it was measured: CSV in, an even record out, and when mirrors belong into stow."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, as_float_array, as_positive
from rfpose.errors import InvalidInputError
from rfpose.feedback.series import Quantity, read_series_csv

__all__ = ["WindRecord", "read_wind_csv", "stow_mask"]

_SPEED = Quantity(
    name="speed",
    units={"mps": 1.0, "kmh": 1.0 / 3.6, "knots": 1852.0 / 3600.0, "mph": 0.44704},
    unit="m/s",
    most=75.0,  # more than any anemometer at the height of a mirror has survived
    beyond="any wind",
)


@dataclass(frozen=True, slots=True)
class WindRecord:
    """Wind at even times.

    Attributes
    ----------
    start_unix_s
        Of the first sample, seconds since 1970-01-01 UTC [s].
    interval_s
        Between samples [s].
    speed_mps : (time,)
        NaN in gaps [m/s].
    """

    start_unix_s: float
    interval_s: float
    speed_mps: FloatArray

    @property
    def unix_s(self) -> FloatArray:
        """Times of the samples [s]."""
        return np.asarray(self.start_unix_s + self.interval_s * np.arange(len(self.speed_mps)), np.float64)


def read_wind_csv(path: Path | str, *, interval_s: float = 1.0, longest_gap_s: float = 60.0) -> WindRecord:
    """Read a wind record; see `rfpose.feedback.series.read_series_csv`.

    The speed's column is ``speed_mps``, ``speed_kmh``, ``speed_knots`` or ``speed_mph``.
    """
    start, speed = read_series_csv(path, _SPEED, interval_s=interval_s, longest_gap_s=longest_gap_s)
    return WindRecord(start_unix_s=start, interval_s=float(interval_s), speed_mps=speed)


def stow_mask(
    speed_mps: npt.ArrayLike,
    *,
    interval_s: float,
    stow_mps: float = 10.0,
    release_mps: float = 8.0,
    release_s: float = 600.0,
    longest_gap_s: float = 60.0,
) -> npt.NDArray[np.bool_]:
    """Return when mirrors belong into stow for the wind.

    Parameters
    ----------
    speed_mps : (time,)
        Wind [m/s], NaN unknown; unknown for longer than ``longest_gap_s`` counts as strong.
    interval_s
        Between samples [s].
    stow_mps
        Stow from this wind on [m/s].
    release_mps, release_s
        Come back once the wind has stayed below this [m/s] for this long [s].

    Returns
    -------
    (time,)
    """
    speed = as_float_array("speed_mps", speed_mps, ("time",), finite=False)
    if not release_mps <= stow_mps:
        raise InvalidInputError(f"`release_mps` {release_mps} must not exceed `stow_mps` {stow_mps}")
    gap_n = longest_gap_s / as_positive("interval_s", interval_s)
    out = np.zeros(len(speed), np.bool_)
    stowed, calm, blind = False, 0.0, 0
    for i, value in enumerate(speed):
        blind = 0 if np.isfinite(value) else blind + 1
        strong = value >= stow_mps or blind > gap_n
        calm = calm + interval_s if value < release_mps else 0.0
        stowed = strong or (stowed and calm < release_s)
        out[i] = stowed
    return out
