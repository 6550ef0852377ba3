"""Which tones a site needs: the coarsest spans the field, the finest is accurate, those between lead down safely."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, as_float_array, as_positive, read_only
from rfpose.errors import GeometryError, InvalidInputError
from rfpose.multilat.ranges import AMBIGUITY_MARGIN_SIGMA

__all__ = ["Share", "ToneDesign", "design_tones", "ladder_risk", "ladder_sigma_m"]

SPEED_OF_LIGHT_MPS = 299_792_458.0
MAX_TONE = 6

Share = Literal["none", "power", "index"]
_NOISE_GROWS = {"none": 0.0, "power": 0.5, "index": 1.0}


@dataclass(frozen=True, slots=True, kw_only=True)
class ToneDesign:
    """Tones, coarsest first, and what they reach; arrays are read-only.

    Attributes
    ----------
    frequency_hz, wavelength_m : (tone,)
    phase_sigma_rad
        Of each tone of the set: what is shared among tones is counted.
    range_sigma_m
        Of ONE transmitter's range, all tones together [m].
    step_risk : (tone,)
        Probability that any of the integers of a tone is wrong; 0 for the first.
    wrong_risk
        Probability that any integer of the whole set is wrong.
    """

    frequency_hz: FloatArray
    wavelength_m: FloatArray
    phase_sigma_rad: float
    range_sigma_m: float
    step_risk: FloatArray
    wrong_risk: float


def ladder_sigma_m(wavelength_m: npt.ArrayLike, phase_sigma_rad: float) -> FloatArray:
    """Range noise of one transmitter with the first one, two, … tones: 1/√Σ(2π/λσ)² (tone,) [m]."""
    wavelength = as_float_array("wavelength_m", wavelength_m, ("tone",), positive=True)
    return np.asarray(phase_sigma_rad / (2.0 * np.pi) / np.sqrt(np.cumsum(wavelength**-2.0)))


def ladder_risk(wavelength_m: npt.ArrayLike, phase_sigma_rad: float, *, n_difference: int = 1) -> FloatArray:
    """Probability that a tone's whole wavelengths, rounded from the tones before, are wrong (tone,).

    Parameters
    ----------
    wavelength_m : (tone,)
        Falling [m].
    phase_sigma_rad
        Of one phase of one tone [rad].
    n_difference
        Range differences that must all be right.

    Notes
    -----
    A difference of two ranges, predicted with √2 σ_before and measured with √2 σ_tone, goes wrong beyond λ/2:
    erfc(λ/2 / (√2 · √(2σ_before² + 2σ_tone²))), as in `range_differences`.
    """
    from scipy.special import erfc

    wavelength = as_float_array("wavelength_m", wavelength_m, ("tone",), positive=True)
    before = ladder_sigma_m(wavelength, phase_sigma_rad)[:-1]
    own = wavelength[1:] * phase_sigma_rad / (2.0 * np.pi)
    one = erfc(wavelength[1:] / 4.0 / np.sqrt(before**2 + own**2))
    return np.concatenate([[0.0], -np.expm1(n_difference * np.log1p(-np.minimum(one, 1.0 - 1e-16)))])


def design_tones(
    *,
    reach_m: float,
    phase_sigma_rad: float,
    range_sigma_m: float,
    success: float = 1.0 - 1e-6,
    band_hz: tuple[float, float] = (0.0, math.inf),
    n_tone: int | None = None,
    n_difference: int = 1,
    share: Share = "index",
    speed_mps: float = SPEED_OF_LIGHT_MPS,
    shown: tuple[float, str] = (1.0, "m"),
) -> ToneDesign:
    """Choose the tones that reach an accuracy with a wanted rate of success, in as little band as does it.

    Parameters
    ----------
    reach_m
        Largest range difference that must be told apart: distance of the reference transmitter to the farthest other
        [m]. The coarsest tone's half wavelength exceeds it by six sigmas of the difference.
    phase_sigma_rad
        Of one phase, were there one tone only [rad].
    range_sigma_m
        Wanted noise of ONE transmitter's range, all tones together [m].
    success
        Wanted probability that all whole wavelengths of ``n_difference`` range differences are right.
    band_hz
        Lowest and highest tone frequency allowed [Hz].
    n_tone
        How many tones at most; the fewest that do are taken.
    n_difference
        Range differences that must all be right: receivers × (transmitters − 1) for a mirror.
    share
        What tones share: the ``index`` of modulation (n tones of m/n each: phase noise × n), the ``power`` (× √n), or
        ``none``.
    speed_mps
        Of propagation [m/s].
    shown
        What the range noise is multiplied by in messages, and the unit that it then has: what was asked for.

    Raises
    ------
    InvalidInputError
        A number out of its range; the band ends below the tone that the accuracy needs; too few tones for the wanted
        success. Each says what would do.
    GeometryError
        The band begins above the coarsest tone that the field needs: a field wider than the coarse wavelength allows.
    """
    reach, sigma = as_positive("reach_m", reach_m), as_positive("phase_sigma_rad", phase_sigma_rad)
    wanted, speed = as_positive("range_sigma_m", range_sigma_m), as_positive("speed_mps", speed_mps)
    if not 0.0 < success < 1.0:
        raise InvalidInputError(f"`success` must lie between 0 and 1, got {success}")
    if not 0.0 <= band_hz[0] < band_hz[1]:
        raise InvalidInputError(f"`band_hz` must begin at zero or above and end higher, got {band_hz}")
    if share not in _NOISE_GROWS:
        raise InvalidInputError(f"`share` must be one of {', '.join(_NOISE_GROWS)}, got {share!r}")
    if n_tone is not None and not 1 <= n_tone <= MAX_TONE:
        raise InvalidInputError(f"`n_tone` must lie between 1 and {MAX_TONE}, got {n_tone}")
    if n_difference < 1:
        raise InvalidInputError(f"`n_difference` must be at least 1, got {n_difference}")
    failure: InvalidInputError | GeometryError | None = None
    for n in range(1, (n_tone or MAX_TONE) + 1):
        try:
            growth = n ** _NOISE_GROWS[share]
            return _design(n, reach, sigma * growth, wanted, success, band_hz, n_difference, speed, shown)
        except _TooFewTonesError as error:
            failure = InvalidInputError(str(error))
        except (GeometryError, InvalidInputError) as error:
            # more tones share what there is: they make neither better
            failure = error
            break
    assert failure is not None
    raise failure


class _TooFewTonesError(Exception):
    """More tones may do."""


def _design(
    n: int,
    reach: float,
    sigma: float,
    wanted: float,
    success: float,
    band_hz: tuple[float, float],
    n_difference: int,
    speed: float,
    shown: tuple[float, str],
) -> ToneDesign:
    factor, unit = shown
    low, high = band_hz
    # λ/2 = reach + 6 · √2 · λσ/2π
    room = 0.5 - AMBIGUITY_MARGIN_SIGMA * math.sqrt(2.0) * sigma / (2.0 * math.pi)
    if room <= 0.0:
        raise InvalidInputError(f"a phase noise of {sigma:.3g} rad a tone is too large for any coarse tone; lower it")
    longest = reach / room
    if low > 0.0 and speed / low < longest:
        raise GeometryError(
            f"a field wider than the coarse wavelength allows: a reach of {reach:.4g} m needs a tone of "
            f"{longest:.4g} m ({speed / longest / 1e6:.4g} MHz) or longer, the band begins at {low / 1e6:.4g} MHz "
            f"({speed / low:.4g} m); let the band begin lower"
        )

    alone = longest * sigma / (2.0 * math.pi)
    if n == 1 and alone > wanted:
        raise _TooFewTonesError(
            f"one tone that spans the field gives {factor * alone:.3g} {unit}, wanted {factor * wanted:.3g}; "
            "allow more tones"
        )
    tones = np.array([longest]) if n == 1 else _least_band(longest, n, sigma, wanted)
    needed = speed / float(tones[-1])
    if needed > high * (1.0 + 1e-9):
        reached = ladder_sigma_m(np.append(tones[:-1], speed / high), sigma)[-1]
        raise InvalidInputError(
            f"band too narrow: {factor * wanted:.3g} {unit} needs a tone of {needed / 1e6:.4g} MHz, the band ends at "
            f"{high / 1e6:.4g} MHz, which gives {factor * reached:.3g} {unit}; widen it, lower the noise, or accept "
            "less"
        )
    risk = ladder_risk(tones, sigma, n_difference=n_difference)
    total = max(0.0, float(-np.expm1(np.log1p(-np.minimum(risk, 1.0 - 1e-16)).sum())))
    if total > 1.0 - success:
        raise _TooFewTonesError(
            f"{n} tones reach the accuracy with a risk of {total:.2g} of a wrong integer, wanted {1.0 - success:.2g}; "
            "allow more tones, lower the noise, or accept less accuracy"
        )
    return ToneDesign(
        frequency_hz=read_only(speed / tones),
        wavelength_m=read_only(tones),
        phase_sigma_rad=sigma,
        range_sigma_m=float(ladder_sigma_m(tones, sigma)[-1]),
        step_risk=read_only(risk),
        wrong_risk=total,
    )


def _least_band(longest: float, n: int, sigma: float, wanted: float) -> FloatArray:
    """Tones whose finest is the longest that is accurate enough, all tones counted."""
    from scipy.optimize import brentq

    finest_alone = wanted * 2.0 * math.pi / sigma

    def surplus(log_shortest: float) -> float:
        tones = _ladder(longest, math.exp(log_shortest), n, sigma)
        return math.log(float(ladder_sigma_m(tones, sigma)[-1]) / wanted)

    if finest_alone >= longest or surplus(math.log(longest)) <= 0.0:
        return _ladder(longest, min(finest_alone, longest), n, sigma)
    return _ladder(
        longest, math.exp(brentq(surplus, math.log(finest_alone) - 1e-6, math.log(longest), xtol=1e-10)), n, sigma
    )


def _ladder(longest: float, shortest: float, n: int, sigma: float) -> FloatArray:
    """Tones from the longest to the shortest whose steps are equally safe.

    A step is safe by x = λ/4 / √(σ_before² + σ_tone²), its argument of erfc: for a given x each next tone follows from
    those before, and the last falls as x does.
    """
    from scipy.optimize import brentq

    per_m = sigma / (2.0 * math.pi)

    def descend(x: float) -> FloatArray:
        tones = [longest]
        for _ in range(n - 1):
            before = per_m / math.sqrt(sum(t**-2.0 for t in tones))
            # λ²(1/16 − x² per_m²) = x² before²
            tones.append(x * before / math.sqrt(1.0 / 16.0 - (x * per_m) ** 2))
        return np.array(tones)

    ceiling = 0.25 / per_m
    small, large = 1e-9 * ceiling, (1.0 - 1e-9) * ceiling

    def gap(x: float) -> float:
        return math.log(float(descend(x)[-1]) / shortest)

    if gap(large) < 0.0:
        return descend(large)
    return descend(brentq(gap, small, large, xtol=1e-13 * ceiling, rtol=1e-14))
