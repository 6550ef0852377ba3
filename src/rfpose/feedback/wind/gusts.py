"""Gusts over a field, drawn piece by piece: a sum of first-order processes with Edwards' spectrum."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rfpose.checks import FloatArray, as_positive
from rfpose.errors import InvalidInputError
from rfpose.feedback.wind import _kernels
from rfpose.feedback.wind.spectrum import ROUGHNESS, admittance, gust_spectrum

__all__ = ["GustProcess", "gust_process"]

_TIMES = np.geomspace(1.0, 0.004, 9)
"""Time constants of the processes as parts of 1200 m over the mean wind, over 2π."""


@dataclass(frozen=True, slots=True)
class GustProcess:
    """First-order processes whose sum has the spectrum of the gusts.

    Attributes
    ----------
    speed_mps
        Mean wind [m/s].
    time_s, variance_m2ps2 : (process,)
        Time constants [s] and variances [(m/s)²]; the first ``n_plain`` as they are, the others less their slow part.
    n_plain
        Number of plain processes.
    slow_s
        Time constant of the part taken away: gusts have little power at the lowest frequencies [s].
    interval_s
        Between samples [s].
    """

    speed_mps: float
    time_s: FloatArray
    variance_m2ps2: FloatArray
    n_plain: int
    slow_s: float
    interval_s: float

    @property
    def sigma_mps(self) -> float:
        """Standard deviation of the gusts [m/s]."""
        part = self.slow_s / (self.slow_s + self.time_s)
        part[: self.n_plain] = 1.0
        return float(np.sqrt(np.sum(self.variance_m2ps2 * part)))

    def spectrum(self, frequency_hz: FloatArray) -> FloatArray:
        """S(f) of the sum before sampling [(m/s)²/Hz]."""
        each = _spectra(np.asarray(frequency_hz, np.float64), self.time_s)
        each[..., self.n_plain :] *= _quick(np.asarray(frequency_hz, np.float64), self.slow_s)[..., None]
        return np.asarray(each @ self.variance_m2ps2)

    def start(self, rng: np.random.Generator, n_mirror: int) -> FloatArray:
        """Return a state (mirror, process and slow part) to go on from [m/s].

        The processes are drawn from their steady distribution, the slow part given them.
        """
        n = len(self.time_s)
        state = np.empty((n_mirror, n + 1))
        state[:, :n] = np.sqrt(self.variance_m2ps2) * rng.standard_normal((n_mirror, n))
        # covariance of a first-order process and its low-pass: T/(T + slow) of its variance, and so the low-pass' own
        share = self.time_s / (self.time_s + self.slow_s)
        share[: self.n_plain] = 0.0
        left = np.sum(self.variance_m2ps2 * share * (1.0 - share))
        state[:, n] = state[:, :n] @ share + np.sqrt(left) * rng.standard_normal(n_mirror)
        return state

    def run(self, state: FloatArray, rng: np.random.Generator, n_step: int) -> FloatArray:
        """Return the gusts (mirror, step) [m/s] that follow a state, and take it with them in place.

        One mirror drawn in pieces is the same as at once. Several mirrors share the generator, so that pieces of
        another length give other gusts of the same kind.
        """
        keep = np.exp(-self.interval_s / self.time_s)
        kick = np.sqrt(self.variance_m2ps2 * (1.0 - keep**2))
        slow = 1.0 - float(np.exp(-self.interval_s / self.slow_s))
        noise = rng.standard_normal((len(state), n_step, len(self.time_s)))
        out = np.empty((len(state), n_step))
        _kernels.filter_gusts(state, keep, kick, self.n_plain, slow, noise, out)
        return out


def _spectra(frequency_hz: FloatArray, time_s: FloatArray) -> FloatArray:
    """Spectra of first-order processes of variance one (frequency, process)."""
    return np.asarray(4.0 * time_s / (1.0 + (2.0 * np.pi * frequency_hz[..., None] * time_s) ** 2))


def _quick(frequency_hz: FloatArray, slow_s: float) -> FloatArray:
    """Power that is left when the slow part is taken away (frequency,)."""
    turns = (2.0 * np.pi * frequency_hz * slow_s) ** 2
    return np.asarray(turns / (1.0 + turns))


def gust_process(
    speed_mps: float, *, interval_s: float = 1.0, size_m: float = 0.0, roughness: float = ROUGHNESS
) -> GustProcess:
    """Return processes that come nearest to Edwards' spectrum (5.24), as a plate of this side feels it.

    Parameters
    ----------
    speed_mps
        Mean wind [m/s]; zero: no gusts.
    interval_s
        Between samples [s].
    size_m
        Side of the plate that averages small gusts [m]; 0: at a point.
    """
    from scipy.optimize import nnls

    if not (np.isfinite(speed_mps) and speed_mps >= 0.0):
        raise InvalidInputError(f"`speed_mps` must be finite and zero or greater, got {speed_mps}")
    speed = max(float(speed_mps), 1e-3)
    slow_s = 1200.0 / (2.0 * np.pi * speed)
    frequency = np.geomspace(1e-3, 0.5 / as_positive("interval_s", interval_s), 300)
    wanted = gust_spectrum(frequency, speed, roughness=roughness) * admittance(frequency, speed, size_m=size_m)
    plain = _spectra(frequency, slow_s * _TIMES)
    both = np.concatenate([plain, plain * _quick(frequency, slow_s)[:, None]], axis=1)
    # relative errors, frequencies with a hundredth of the power at a tenth of the weight: what a plate averages away
    # falls faster than any first-order process does
    weight = np.sqrt(frequency * wanted / np.max(frequency * wanted))
    variance, _ = nnls(both * (weight / wanted)[:, None], weight)
    used = np.flatnonzero(variance > 0.0)
    strength = 0.0 if speed_mps == 0.0 else 1.0
    return GustProcess(
        speed_mps=float(speed_mps),
        time_s=slow_s * np.concatenate([_TIMES, _TIMES])[used],
        variance_m2ps2=strength * variance[used],
        n_plain=int(np.sum(used < len(_TIMES))),
        slow_s=slow_s,
        interval_s=float(interval_s),
    )
