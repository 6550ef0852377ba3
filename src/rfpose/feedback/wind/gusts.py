"""Gusts over a field, drawn piece by piece: a sum of first-order processes with Edwards' spectrum."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from rfpose.checks import FloatArray, as_positive
from rfpose.errors import InvalidInputError
from rfpose.feedback.innovation import one_kick, steady_root
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
    kick_mps : (process and slow part,)
        What a random number of variance one adds to them, all with the same one; see
        `rfpose.feedback.innovation.one_kick`.
    start_root_mps : (process and slow part, process and slow part)
        Root of their covariance.
    """

    speed_mps: float
    time_s: FloatArray
    variance_m2ps2: FloatArray
    n_plain: int
    slow_s: float
    interval_s: float
    kick_mps: FloatArray = field(init=False, repr=False)
    start_root_mps: FloatArray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        n, keep, slow = len(self.time_s), self._keep, self._follows
        quick = np.arange(n) >= self.n_plain
        # what happens to the processes, and then to the slow part that follows them
        then = np.eye(n + 1)
        then[n] = np.append(slow * quick, 1.0 - slow)
        transition = then @ np.diag(np.append(keep, 1.0))
        own = np.diag(np.append(self.variance_m2ps2 * (1.0 - keep**2), 0.0))
        kick = one_kick(transition, then @ own @ then.T, np.append(np.ones(n), -1.0))
        object.__setattr__(self, "kick_mps", kick)
        object.__setattr__(self, "start_root_mps", steady_root(transition, kick))

    @property
    def _keep(self) -> FloatArray:
        """What is left of each process after a step."""
        return np.asarray(np.exp(-self.interval_s / self.time_s))

    @property
    def _follows(self) -> float:
        """What of its distance to the processes the slow part makes up in a step."""
        return 1.0 - float(np.exp(-self.interval_s / self.slow_s))

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

        It is drawn from its steady distribution.
        """
        return np.asarray(rng.standard_normal((n_mirror, len(self.kick_mps))) @ self.start_root_mps.T)

    def run(self, state: FloatArray, rng: np.random.Generator, n_step: int) -> FloatArray:
        """Return the gusts (mirror, step) [m/s] that follow a state, and take it with them in place.

        One mirror drawn in pieces is the same as at once. Several mirrors share the generator, so that pieces of
        another length give other gusts of the same kind.
        """
        out = rng.standard_normal((len(state), n_step))
        _kernels.filter_gusts(state, self._keep, self.kick_mps, self.n_plain, self._follows, out)
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
