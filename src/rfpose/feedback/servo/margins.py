"""How far a sampled loop is from oscillating, and gains that keep it there.

The loop is exact: the speed is held from sample to sample, motor and structure are solved over the interval, and a
latency that is no whole number of intervals splits one of them. Margins are read off its frequency response, and limits
of latency and interval off the eigenvalues of the closed loop.

References
----------
Edwards, Arrays of paraboloidal collectors, §6.3.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, as_positive
from rfpose.errors import InvalidInputError
from rfpose.feedback.servo.law import PiLaw
from rfpose.feedback.structure import StructureMode

__all__ = [
    "LEAST_GAIN_MARGIN",
    "LEAST_PHASE_MARGIN_RAD",
    "Margins",
    "SampledPlant",
    "check_law",
    "continuous_response",
    "design_law",
    "is_stable",
    "limit_cycle_rad",
    "margins",
    "sampled_plant",
    "sampled_response",
    "sensitivity",
]

LEAST_GAIN_MARGIN = 1.5
"""Levels let the gain of a quantised error vary from 0.5 to 1.5 (Edwards, §6.3.4)."""
LEAST_PHASE_MARGIN_RAD = float(np.deg2rad(30.0))
_MAX_DELAY_S = 600.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Margins:
    """How far a loop is from oscillating.

    Attributes
    ----------
    stable
        Whether all eigenvalues of the closed loop lie inside the unit circle.
    gain
        Factor by which all gains may grow; one or less: unstable.
    phase_rad
        Further lag at unity gain that it bears [rad].
    unity_hz
        Where the open loop's gain falls through one [Hz]: the bandwidth against disturbances.
    crossover_hz
        Where its lag reaches half a turn [Hz].
    latency_s
        Further latency that it bears before an eigenvalue leaves the unit circle [s].
    interval_s
        Longest sampling interval that it bears, gains and latency as they are [s].
    """

    stable: bool
    gain: float
    phase_rad: float
    unity_hz: float
    crossover_hz: float
    latency_s: float
    interval_s: float

    @property
    def gain_db(self) -> float:
        """Gain margin [dB]."""
        return float(20.0 * np.log10(self.gain))


@dataclass(frozen=True, slots=True)
class SampledPlant:
    """Motor and structure from speed to angle over one interval: x ← keep x + before u₋ + now u; angle = row x."""

    keep: FloatArray
    before: FloatArray
    now: FloatArray
    row: FloatArray
    delay: int
    interval_s: float


def _plant(structure: StructureMode | None) -> tuple[FloatArray, FloatArray, FloatArray]:
    """State space from speed to mirror angle: motor angle, mirror angle, its rate."""
    if structure is None:
        return np.zeros((1, 1)), np.ones(1), np.ones(1)
    w = structure.natural_radps
    a = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [w**2, -(w**2), -2.0 * structure.damping * w]])
    return a, np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])


def _over(a: FloatArray, b: FloatArray, time_s: float) -> tuple[FloatArray, FloatArray]:
    """Exact motion over a time with a held input."""
    from scipy.linalg import expm

    n = len(b)
    block = np.zeros((n + 1, n + 1))
    block[:n, :n], block[:n, n] = a, b
    moved = expm(block * time_s)
    return np.ascontiguousarray(moved[:n, :n]), np.ascontiguousarray(moved[:n, n])  # else another type to kernels


def sampled_plant(structure: StructureMode | None, *, interval_s: float, latency_s: float = 0.0) -> SampledPlant:
    """Return the exact motion of motor and structure over an interval.

    Parameters
    ----------
    structure
        Between motor and mirror; None: stiff.
    interval_s
        Between samples [s].
    latency_s
        From a measurement to the speed it causes [s].
    """
    interval = as_positive("interval_s", interval_s)
    if not (np.isfinite(latency_s) and latency_s >= 0.0):
        raise InvalidInputError(f"`latency_s` must be finite and zero or greater, got {latency_s}")
    delay = int(np.floor(latency_s / interval + 1e-9))
    late = max(latency_s - delay * interval, 0.0)
    a, b, row = _plant(structure)
    keep, _ = _over(a, b, interval)
    rest, now = _over(a, b, interval - late)
    _, early = _over(a, b, late)
    return SampledPlant(keep=keep, before=rest @ early, now=now, row=row, delay=delay, interval_s=interval)


def sampled_response(law: PiLaw, plant: SampledPlant, frequency_hz: npt.ArrayLike) -> npt.NDArray[np.complex128]:
    """Return the open loop of the sampled servo at frequencies below half the sampling rate."""
    omega = 2.0 * np.pi * np.atleast_1d(np.asarray(frequency_hz, np.float64)) * plant.interval_s
    n = len(plant.row)
    a = np.zeros((n + 1, n + 1))
    a[:n, :n], a[:n, n] = plant.keep, plant.before
    b = np.append(plant.now, 1.0)
    z = np.exp(1j * omega)
    # solved as it stands: as a quotient of polynomials it would lose half the digits
    inside = np.linalg.solve(z[:, None, None] * np.eye(n + 1) - a, b[None, :, None])
    response = inside[:, :n, 0] @ plant.row
    pi = law.gain_per_s + law.integral_gain_per_s2 * plant.interval_s * z / (z - 1.0)
    return np.asarray(response * pi * z ** (-plant.delay), np.complex128)


def continuous_response(
    law: PiLaw,
    structure: StructureMode | None,
    frequency_hz: npt.ArrayLike,
    *,
    interval_s: float = 0.0,
    latency_s: float = 0.0,
) -> npt.NDArray[np.complex128]:
    """Return Edwards' open loop (6.3), (6.4), the hold of the sampler and a latency added as factors.

    Parameters
    ----------
    interval_s
        Of the sampler [s]; 0: none.
    """
    s = 2j * np.pi * np.asarray(frequency_hz, np.float64)
    response = (law.gain_per_s + law.integral_gain_per_s2 / s) / s * np.exp(-s * latency_s)
    if structure is not None:
        w = structure.natural_radps
        response = response * w**2 / (s**2 + 2.0 * structure.damping * w * s + w**2)
    if interval_s > 0.0:
        response = response * (1.0 - np.exp(-s * interval_s)) / (s * interval_s)
    return np.asarray(response, np.complex128)


def _closed_loop(law: PiLaw, plant: SampledPlant) -> FloatArray:
    """One interval of the closed loop: state of the plant, held speed, integral, measurements on their way."""
    n, d = len(plant.row), plant.delay
    size = n + 2 + d
    held, integral = n, n + 1
    seen = np.zeros(size)
    if d == 0:
        seen[:n] = -plant.row
    else:
        seen[n + 1 + d] = 1.0
    ahead = law.integral_gain_per_s2 * plant.interval_s * seen
    ahead[integral] += 1.0
    speed = law.gain_per_s * seen + ahead
    out = np.zeros((size, size))
    out[:n, :n] = plant.keep
    out[:n, held] += plant.before
    out[:n] += np.outer(plant.now, speed)
    out[held], out[integral] = speed, ahead
    for i in range(d):
        if i == 0:
            out[n + 2, :n] = -plant.row
        else:
            out[n + 2 + i, n + 1 + i] = 1.0
    return out


def is_stable(law: PiLaw, structure: StructureMode | None, *, interval_s: float, latency_s: float = 0.0) -> bool:
    """Whether the closed loop, its errors small and not quantised, settles."""
    loop = _closed_loop(law, sampled_plant(structure, interval_s=interval_s, latency_s=latency_s))
    if law.integral_gain_per_s2 == 0.0:
        i = loop.shape[0]
        own = len(_plant(structure)[1]) + 1
        kept = [j for j in range(i) if j != own]
        loop = loop[np.ix_(kept, kept)]
    return bool(np.max(np.abs(np.linalg.eigvals(loop))) < 1.0 - 1e-12)


def _limit(stable_at: Callable[[float], bool], first: float, last: float) -> float:
    """Greatest value up to which something is stable, from ``first``, which is; ``last`` if all of it is."""
    grid = np.linspace(first, last, 81)
    low, high = first, last
    for value in grid[1:]:
        if stable_at(float(value)):
            low = float(value)
            continue
        high = float(value)
        break
    else:
        return last
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if stable_at(middle) else (low, middle)
    return low


def _crossing(frequency: FloatArray, values: FloatArray, level: float) -> float:
    """Highest frequency at which falling values pass a level; NaN: nowhere."""
    at = np.flatnonzero((values[:-1] > level) & (values[1:] <= level))
    if not at.size:
        return float("nan")
    i = int(at[-1])
    part = (values[i] - level) / (values[i] - values[i + 1])
    return float(frequency[i] * (frequency[i + 1] / frequency[i]) ** part)


def margins(law: PiLaw, structure: StructureMode | None, *, interval_s: float = 1.0, latency_s: float = 0.0) -> Margins:
    """Return the margins of a sampled loop.

    Parameters
    ----------
    law
        Gains; its saturation and levels play no part here.
    structure
        Between motor and mirror; None: stiff.
    interval_s
        Of the sampler [s].
    latency_s
        From measurement to speed [s].
    """
    plant = sampled_plant(structure, interval_s=interval_s, latency_s=latency_s)
    frequency = np.geomspace(1e-5, 0.5 * (1.0 - 1e-9), 8000) / plant.interval_s
    response = sampled_response(law, plant, frequency)
    size = np.abs(response)
    phase = np.unwrap(np.angle(response))
    start = -np.pi if law.integral_gain_per_s2 > 0.0 else -0.5 * np.pi
    phase += 2.0 * np.pi * np.rint((start - phase[0]) / (2.0 * np.pi))
    unity = _crossing(frequency, size, 1.0)
    crossover = _crossing(frequency, phase, -np.pi)
    log_f = np.log(frequency)
    gain = 1.0 / size[-1] if np.isnan(crossover) else 1.0 / np.interp(np.log(crossover), log_f, size)
    phase_rad = np.nan if np.isnan(unity) else np.interp(np.log(unity), log_f, phase) + np.pi
    stable = is_stable(law, structure, interval_s=interval_s, latency_s=latency_s)
    latency = longest = 0.0
    if stable:
        bears = min(_MAX_DELAY_S, max(phase_rad, 0.1) / (2.0 * np.pi * unity)) if unity > 0.0 else 20.0 * interval_s
        latency = (
            _limit(
                lambda late: is_stable(law, structure, interval_s=interval_s, latency_s=late),
                latency_s,
                latency_s + 2.0 * bears,
            )
            - latency_s
        )
        longest = _limit(
            lambda each: is_stable(law, structure, interval_s=each, latency_s=latency_s),
            interval_s,
            interval_s + 6.0 * bears,
        )
    return Margins(
        stable=stable,
        gain=float(gain),
        phase_rad=float(phase_rad),
        unity_hz=unity,
        crossover_hz=crossover,
        latency_s=float(latency),
        interval_s=float(longest),
    )


def check_law(
    law: PiLaw,
    structure: StructureMode | None,
    *,
    interval_s: float = 1.0,
    latency_s: float = 0.0,
    least_gain: float = LEAST_GAIN_MARGIN,
    least_phase_rad: float = LEAST_PHASE_MARGIN_RAD,
    force: bool = False,
) -> Margins:
    """Return the margins of a loop, or refuse it.

    Parameters
    ----------
    least_gain, least_phase_rad
        Margins it must keep.
    force
        Let it pass whatever the margins.

    Raises
    ------
    InvalidInputError
        A margin is too small; the message names it.
    """
    found = margins(law, structure, interval_s=interval_s, latency_s=latency_s)
    if force:
        return found
    short = []
    if not found.stable or found.gain < least_gain:
        short.append(f"gain margin {found.gain:.2f} below {least_gain:.2f}")
    if not found.stable or not found.phase_rad >= least_phase_rad:
        short.append(f"phase margin {np.rad2deg(found.phase_rad):.0f}° below {np.rad2deg(least_phase_rad):.0f}°")
    if short:
        state = "too near oscillation" if found.stable else "unstable"
        raise InvalidInputError(
            f"`gain_per_s` {law.gain_per_s:g} and `integral_gain_per_s2` {law.integral_gain_per_s2:g} at "
            f"{interval_s:g} s interval and {latency_s:g} s latency are {state}: "
            f"{', '.join(short)}; lower the gains or set `force`"
        )
    return found


def design_law(
    structure: StructureMode | None,
    *,
    interval_s: float = 1.0,
    latency_s: float = 0.0,
    integral_ratio_per_s: float = 0.05,
    least_gain: float = LEAST_GAIN_MARGIN,
    least_phase_rad: float = LEAST_PHASE_MARGIN_RAD,
    template: PiLaw | None = None,
) -> PiLaw:
    """Return the law with the highest gain that keeps both margins, K1/K0 given (Edwards' rule).

    Parameters
    ----------
    integral_ratio_per_s
        K1/K0 [1/s], below the structure's natural frequency; zero: proportional only.
    template
        Everything else of the law.

    Raises
    ------
    InvalidInputError
        No gain keeps the margins: the ratio is too high for this latency.
    """
    base = template or PiLaw()
    plant = sampled_plant(structure, interval_s=interval_s, latency_s=latency_s)
    unit = dataclasses.replace(base, gain_per_s=1.0, integral_gain_per_s2=integral_ratio_per_s)
    frequency = np.geomspace(1e-5, 0.5 * (1.0 - 1e-9), 8000) / plant.interval_s
    response = sampled_response(unit, plant, frequency)
    size, phase = np.abs(response), np.unwrap(np.angle(response))
    start = -np.pi if integral_ratio_per_s > 0.0 else -0.5 * np.pi
    phase += 2.0 * np.pi * np.rint((start - phase[0]) / (2.0 * np.pi))
    # unity gain anywhere below the first frequency whose lag leaves too little
    enough = np.flatnonzero(phase + np.pi >= least_phase_rad)
    crossover = _crossing(frequency, phase, -np.pi)
    if not enough.size:
        raise InvalidInputError(
            f"`integral_ratio_per_s` {integral_ratio_per_s:g} must be lower: no gain keeps {least_gain:g} and "
            f"{np.rad2deg(least_phase_rad):.0f}° at {latency_s:g} s latency"
        )
    by_phase = 1.0 / float(size[enough[-1]])
    # a lag that stays below half a turn reaches it at half the sampling rate, where everything is real
    turned = frequency[-1] if np.isnan(crossover) else crossover
    by_gain = 1.0 / (least_gain * float(np.interp(np.log(turned), np.log(frequency), size)))
    gain = min(by_phase, by_gain)
    return dataclasses.replace(base, gain_per_s=gain, integral_gain_per_s2=integral_ratio_per_s * gain)


def limit_cycle_rad(
    law: PiLaw, structure: StructureMode | None, *, interval_s: float = 0.0, latency_s: float = 0.0
) -> float:
    """Return the amplitude of the oscillation about zero that levels cause (Edwards 6.2) [rad].

    The innermost two levels act as a relay of gain 2 Δε/(πA); the loop oscillates where its lag is half a turn, with
    the amplitude that makes the gain one. ``interval_s`` 0: Edwards' (6.5) without the sampler.
    """
    from scipy.optimize import brentq

    frequency = np.geomspace(1e-4, 0.5 / interval_s if interval_s else 10.0, 4000)
    response = continuous_response(law, structure, frequency, interval_s=interval_s, latency_s=latency_s)
    phase = np.unwrap(np.angle(response))
    start = -np.pi if law.integral_gain_per_s2 > 0.0 else -0.5 * np.pi
    phase += 2.0 * np.pi * np.rint((start - phase[0]) / (2.0 * np.pi))
    at = np.flatnonzero((phase[:-1] > -np.pi) & (phase[1:] <= -np.pi))
    if not at.size:
        return 0.0
    i = int(at[-1])

    def lag(value: float) -> float:
        there = continuous_response(law, structure, value, interval_s=interval_s, latency_s=latency_s)
        return float(np.angle(-there))

    where = brentq(lag, frequency[i], frequency[i + 1])
    gain = np.abs(continuous_response(law, structure, where, interval_s=interval_s, latency_s=latency_s))
    return float(2.0 * law.level_rad / np.pi * gain)


def sensitivity(
    law: PiLaw,
    structure: StructureMode | None,
    frequency_hz: npt.ArrayLike,
    *,
    interval_s: float = 1.0,
    latency_s: float = 0.0,
) -> FloatArray:
    """Return what part of a disturbance of the mirror is left with the loop closed, |1/(1+L)|."""
    plant = sampled_plant(structure, interval_s=interval_s, latency_s=latency_s)
    return np.asarray(1.0 / np.abs(1.0 + sampled_response(law, plant, frequency_hz)))
