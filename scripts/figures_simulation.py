"""The numbers behind the figures of Swart et al., "A method for accurate measurement of heliostat mirror orientation".

``figures.py`` draws what this module computes; the reference tests call it with fewer runs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import scipy.fft

import rfpose.dsp.phase_difference as pd
from rfpose.checks import FloatArray
from rfpose.geometry import angle_between_rad, rot_enu_from_mirror, unit
from rfpose.multilat import dop, locate, mirror_normal, tilt_rms_from_position
from rfpose.scenario import load_scenario

Method = Literal["dot", "compensated", "hilbert"]
Track = Callable[[Any, str], Iterable[Any]]

MAX_CHUNK_SAMPLES = 2**21


@dataclass(frozen=True, slots=True)
class Series:
    """One curve: simulated points and, where there is a formula, the predicted ones.

    Series of one ``colour`` belong together; by default each has its own.
    """

    label: str
    x: FloatArray
    simulated: FloatArray
    predicted: FloatArray | None = None
    colour: int | None = None


@dataclass(frozen=True, slots=True)
class Figure:
    """What a figure shows and how its axes are called; ``x_name`` and ``y_name`` head the columns of its table."""

    number: int
    title: str
    note: str
    x_label: str
    y_label: str
    x_name: str
    y_name: str
    series: tuple[Series, ...]
    x_scale: str = "log"
    y_scale: str = "log"
    lines: dict[str, float] = field(default_factory=dict)
    x_ticks: tuple[float, ...] | None = None


# -- two tones in noise (§3.1, §4.1) -------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class Pair:
    """Two noisy tones as in Table 1. ``snr2_ratio``: how much better the second signal is than the first."""

    n_sample: int
    samples_per_cycle: float
    bandwidth: float | None = None
    snr2_ratio: float = 1.0

    @property
    def label(self) -> str:
        """As in the legends of Figs. 3 to 5."""
        band = "none" if self.bandwidth is None else f"{self.bandwidth:g}"
        text = f"S={self.n_sample:g}, SPC={self.samples_per_cycle:g}, B={band}"
        return text if self.snr2_ratio == 1.0 else f"{text}, SNR2={self.snr2_ratio:g}"

    def noise(self, rng: np.random.Generator, runs: int, variance: float) -> FloatArray:
        """Gaussian noise (run, sample): white, or flat over ``bandwidth`` about the tone and nothing elsewhere."""
        if self.bandwidth is None:
            return np.sqrt(variance) * rng.standard_normal((runs, self.n_sample))
        frequency = np.arange(self.n_sample // 2 + 1) / self.n_sample
        tone, half_width = 1.0 / self.samples_per_cycle, self.bandwidth / 4.0
        inside = np.flatnonzero((frequency >= tone - half_width) & (frequency < tone + half_width) & (frequency > 0.0))
        spectrum = np.zeros((runs, len(frequency)), np.complex128)
        parts = rng.standard_normal((2, runs, len(inside)))
        spectrum[:, inside] = (parts[0] + 1j * parts[1]) * (0.5 * self.n_sample * np.sqrt(variance / len(inside)))
        return np.asarray(scipy.fft.irfft(spectrum, self.n_sample))

    def signal(self, rng: np.random.Generator, phase_rad: FloatArray, snr: float) -> FloatArray:
        """Noisy tones (run, sample) of amplitude one with the phases given (run,); ``snr`` linear."""
        angle = 2.0 * np.pi * np.mod(np.arange(self.n_sample) / self.samples_per_cycle, 1.0)
        return np.cos(angle + phase_rad[:, None]) + self.noise(rng, len(phase_rad), 0.5 / snr)


def phase_errors_rad(
    method: Method,
    pair: Pair,
    snr: float,
    runs: int,
    rng: np.random.Generator,
    *,
    phase_rad: float | None = None,
    assumed_noise: float = 1.0,
) -> FloatArray:
    """Errors of a method over ``runs`` pairs of noisy tones [rad].

    Parameters
    ----------
    method
        "dot" and "compensated" give no sign; as in §4.1 the right one is assumed.
    pair, snr
        The signals; ``snr`` linear, of the first.
    phase_rad
        True phase difference; without it they are spread over all angles, one drawn at random in each of ``runs``
        equal parts of the circle.
    assumed_noise
        The noise variance that "compensated" is told, over the true one.
    """
    part = 2.0 * np.pi / runs
    stratified = part * (rng.permutation(runs) + rng.uniform(size=runs)) - np.pi
    differences = stratified if phase_rad is None else np.full(runs, phase_rad)
    errors = []
    chunk = max(1, MAX_CHUNK_SAMPLES // pair.n_sample)
    for start in range(0, runs, chunk):
        difference = differences[start : start + chunk]
        phase1 = rng.uniform(-np.pi, np.pi, len(difference))
        s1 = pair.signal(rng, phase1, snr)
        s2 = pair.signal(rng, phase1 + difference, snr * pair.snr2_ratio)
        if method == "hilbert":
            estimate = pd.hilbert_phase_difference(s1, s2, edge=0)
            errors.append(wrapped_rad(estimate - difference))
        else:
            if method == "dot":
                estimate = pd.dot_phase_difference(s1, s2)
            else:
                estimate = pd.compensated_dot_phase_difference(
                    s1,
                    s2,
                    noise_variance1=assumed_noise * 0.5 / snr,
                    noise_variance2=assumed_noise * 0.5 / (snr * pair.snr2_ratio),
                )
            errors.append(estimate - np.abs(difference))
    return np.concatenate(errors)


def predicted_rms_rad(method: Method, pair: Pair, snr: float, *, phase_rad: npt.ArrayLike | None = None) -> FloatArray:
    """RMS error that theory gives `phase_errors_rad`, at each phase difference or over all of them [rad].

    For the dot products the cosine's error is taken as Gaussian and carried through the arc cosine, which folds at
    0 and π, by quadrature.
    """
    snr2 = snr * pair.snr2_ratio
    bandwidth = pair.bandwidth or 1.0
    if method == "hilbert":
        sigma = pd.predicted_sigma_rad(pair.n_sample, snr, snr2, bandwidth)
        return sigma if phase_rad is None else np.full(np.shape(phase_rad), sigma)
    n_grid = 2000
    phase = (np.arange(n_grid) + 0.5) * np.pi / n_grid if phase_rad is None else np.abs(np.asarray(phase_rad))
    if method == "dot":
        centre = phase + pd.dot_bias_rad(phase, snr, snr2)
        sigma = pd.dot_sigma_rad(pair.n_sample, phase, snr, snr2, bandwidth)
    else:
        # at 0 and π the sigma is infinite though the cosine's is not: stand beside them
        centre = phase = np.clip(phase, 1e-6, np.pi - 1e-6)
        sigma = pd.compensated_dot_sigma_rad(pair.n_sample, phase, snr, snr2, bandwidth)
    node, weight = np.polynomial.hermite_e.hermegauss(61)
    cosine = np.cos(centre)[..., None] + (sigma * np.sin(centre))[..., None] * node
    error = np.arccos(np.clip(cosine, -1.0, 1.0)) - phase[..., None]
    mean_square = (error**2) @ weight / weight.sum()
    return np.sqrt(mean_square.mean() if phase_rad is None else mean_square)


def wrapped_rad(angle_rad: FloatArray) -> FloatArray:
    """Return angles in [−π, π]."""
    return np.angle(np.exp(1j * angle_rad))


_SNR = np.logspace(0, 5, 11)
_NAME = {"dot": "dot product", "compensated": "dot product with noise compensation", "hilbert": "Hilbert transform"}
_PAIRS = (
    Pair(n_sample=1000, samples_per_cycle=10),
    Pair(n_sample=10_000, samples_per_cycle=10),
    Pair(n_sample=10_000, samples_per_cycle=100),
    Pair(n_sample=10_000, samples_per_cycle=10, bandwidth=0.04),
    Pair(n_sample=10_000, samples_per_cycle=10, snr2_ratio=10.0),
)


def _over_snr(number: int, method: Method, runs: int, rng: np.random.Generator, track: Track) -> Figure:
    points = [(pair, snr) for pair in _PAIRS for snr in _SNR]
    simulated = {
        (pair, snr): np.std(phase_errors_rad(method, pair, snr, runs, rng))
        for pair, snr in track(points, f"Fig. {number}")
    }
    series = [
        Series(
            pair.label,
            _SNR,
            np.degrees([simulated[pair, snr] for snr in _SNR]),
            np.degrees([float(predicted_rms_rad(method, pair, snr)) for snr in _SNR]),
        )
        for pair in _PAIRS
    ]
    if method == "compensated":
        pair = _PAIRS[1]
        errors = [np.std(phase_errors_rad(method, pair, snr, runs, rng, assumed_noise=0.5)) for snr in _SNR]
        series.append(Series(f"{pair.label}, noise power taken for half", _SNR, np.degrees(errors)))
    return Figure(
        number,
        f"Performance of the phase difference by {_NAME[method]}",
        f"phase differences spread over all angles, {runs} runs a point",
        "signal-to-noise ratio per sample (linear)",
        "standard deviation of the error [°]",
        "snr",
        "error_std_deg",
        tuple(series),
    )


def figure_6(runs: int, rng: np.random.Generator, track: Track) -> Figure:
    """Compare the three methods over the phase difference at SNR = 10."""
    pair, snr = Pair(n_sample=1000, samples_per_cycle=10), 10.0
    phase_deg = np.linspace(-180.0, 180.0, 37)
    methods: tuple[Method, ...] = ("dot", "compensated", "hilbert")
    points = [(method, phase) for method in methods for phase in np.radians(phase_deg)]
    rms = [
        np.sqrt(np.mean(phase_errors_rad(method, pair, snr, runs, rng, phase_rad=phase) ** 2))
        for method, phase in track(points, "Fig. 6")
    ]
    series = tuple(
        Series(
            _NAME[method],
            phase_deg,
            np.degrees(values),
            np.degrees(predicted_rms_rad(method, pair, snr, phase_rad=np.radians(phase_deg))),
        )
        for method, values in zip(methods, np.reshape(rms, (len(methods), -1)), strict=True)
    )
    return Figure(
        6,
        "Sensitivity of the methods to the phase difference, SNR = 10",
        f"{pair.label}, {runs} runs a point",
        "phase difference [°]",
        "RMS error [°]",
        "phase_difference_deg",
        "error_rms_deg",
        series,
        x_scale="linear",
        x_ticks=tuple(range(-180, 181, 45)),
    )


# -- estimators against the bound ----------------------------------------------------------------------------

ESTIMATOR_SAMPLES = 4096
ESTIMATOR_SPC = 10.0
ESTIMATOR_BANDWIDTH, ESTIMATOR_EDGE = 0.02, 150
"""Of the band-pass before the Hilbert transform: width over f_s/2 (the tone ±5 % of its frequency), and samples
left out at each end. The error at −20 dB, below the threshold, tells the width; the few per cent lost at
high ratios tell the edge."""

_HALF = ESTIMATOR_BANDWIDTH / 4.0
_TONE = 1.0 / ESTIMATOR_SPC
ESTIMATORS: dict[str, Callable[[FloatArray, FloatArray], FloatArray]] = {
    "correlator": partial(pd.correlator_phase_difference, cycles_per_sample=_TONE),
    "Hilbert mean phasor": partial(pd.hilbert_phase_difference, edge=0),
    "band-pass + Hilbert": partial(
        pd.hilbert_phase_difference, bandpass=(_TONE - _HALF, _TONE + _HALF), edge=ESTIMATOR_EDGE
    ),
}


def estimator_rms_rad(snr: float, runs: int, rng: np.random.Generator) -> dict[str, float]:
    """RMS error of each estimator in white noise, all on the same 4096-sample signals, and the bound [rad]."""
    pair = Pair(n_sample=ESTIMATOR_SAMPLES, samples_per_cycle=ESTIMATOR_SPC)
    errors: dict[str, list[FloatArray]] = {name: [] for name in ESTIMATORS}
    chunk = MAX_CHUNK_SAMPLES // pair.n_sample
    for start in range(0, runs, chunk):
        phase1, phase2 = rng.uniform(-np.pi, np.pi, (2, min(chunk, runs - start)))
        s1, s2 = pair.signal(rng, phase1, snr), pair.signal(rng, phase2, snr)
        for name, estimator in ESTIMATORS.items():
            errors[name].append(wrapped_rad(estimator(s1, s2) - (phase2 - phase1)))
    measured = {name: rms(np.concatenate(parts)) for name, parts in errors.items()}
    return {"bound": float(pd.bound_rad(pair.n_sample, snr)), **measured}


# -- positions and normals (§4.3 to §4.5), field radius one ---------------------------------------------------

WAVELENGTH_M = 4.0
SPACING_M = 0.0173
TONE = Pair(n_sample=100_000, samples_per_cycle=10, bandwidth=0.04)
TONE_SNR = 1e5
CENTRE_ENU_M, EDGE_ENU_M = (0.0, 0.0, 0.0), (1.0, 0.0, 0.0)
FACING_ENU = (0.0, -1.0, 0.5)
"""Mirror normal of Fig. 11, which the paper does not give: 27° above the horizon and square to the radius at the
edge. The vertical is what range differences on this layout measure worst, so facing decides the error."""


def table_2_enu_m() -> FloatArray:
    """Table 2's transmitters (transmitter, xyz), field radius one."""
    scenario = load_scenario(Path(__file__).resolve().parents[1] / "data" / "table2_100m.toml")
    return np.asarray(scenario.transmitter_enu_m / 100.0)


def range_sigma_m(n_sample: int) -> float:
    """Noise σ_Δ of a range difference for the tone of Fig. 11, §4.5."""
    return float(WAVELENGTH_M / (2.0 * np.pi) * pd.predicted_sigma_rad(n_sample, TONE_SNR, bandwidth1=TONE.bandwidth))


def position_errors_m(
    receiver_enu_m: npt.ArrayLike, sigma_difference_m: float, runs: int, rng: np.random.Generator
) -> FloatArray:
    """Errors (run, xyz) of positions from noisy range differences on Table 2's layout; NaN = not solved."""
    transmitter = table_2_enu_m()
    receiver = np.asarray(receiver_enu_m, np.float64)
    distance = np.linalg.norm(transmitter - receiver, axis=1)
    sigma = sigma_difference_m / np.sqrt(2.0)  # of one transmitter
    measured = distance + sigma * rng.standard_normal((runs, len(transmitter)))
    measured -= measured[:, :1]
    return np.asarray(locate(transmitter, measured, sigma_m=sigma, min_probability=0.0).position_enu_m - receiver)


def predicted_position_rms_m(receiver_enu_m: npt.ArrayLike, sigma_difference_m: float) -> FloatArray:
    """RMS position error ε_R (...) that the bound gives for places (..., xyz)."""
    return np.asarray(dop(table_2_enu_m(), receiver_enu_m) * sigma_difference_m / np.sqrt(2.0))


def triangle_enu_m(centre_enu_m: npt.ArrayLike, normal_enu: npt.ArrayLike) -> FloatArray:
    """Receivers (..., 3, xyz) on an equilateral triangle of side `SPACING_M`, counter-clockwise from the front."""
    angle = 2.0 * np.pi * np.arange(3) / 3.0
    place = SPACING_M / np.sqrt(3.0) * np.stack([np.cos(angle), np.sin(angle), np.zeros(3)], axis=-1)
    return np.asarray(centre_enu_m) + place @ np.swapaxes(rot_enu_from_mirror(normal_enu), -1, -2)


def normal_errors_rad(true_normal_enu: npt.ArrayLike, receiver_enu_m: FloatArray) -> FloatArray:
    """Angles (run,) between true normals and those of the receivers' planes, receivers (run, 3, xyz)."""
    normals = mirror_normal(receiver_enu_m, np.zeros((len(receiver_enu_m), 9, 9)))
    return angle_between_rad(normals.normal_enu, np.broadcast_to(true_normal_enu, normals.normal_enu.shape))


def measured_differences_rad(
    phase_rad: FloatArray, n_sample: int, rng: np.random.Generator, *, through_hilbert: bool
) -> FloatArray:
    """Measure tone phases (receiver, transmitter) against those of the first transmitter [rad].

    Through the estimator: each tone is synthesised with its noise and each pair goes through the Hilbert method.
    Else each phase gets the Gaussian noise that §4.5 predicts; a difference has two of them.
    """
    if not through_hilbert:
        sigma = pd.predicted_sigma_rad(n_sample, TONE_SNR, bandwidth1=TONE.bandwidth) / np.sqrt(2.0)
        noisy = phase_rad + sigma * rng.standard_normal(phase_rad.shape)
        return wrapped_rad(noisy - noisy[..., :1])
    tone = replace(TONE, n_sample=n_sample)
    differences = np.zeros(phase_rad.shape)
    for i_receiver, phases in enumerate(phase_rad):
        signals = tone.signal(rng, phases, TONE_SNR)
        differences[i_receiver, 1:] = pd.hilbert_phase_difference(signals[0], signals[1:], edge=0)
    return differences


def tracking_errors_rad(
    centre_enu_m: npt.ArrayLike,
    n_sample: int,
    runs: int,
    rng: np.random.Generator,
    *,
    facing_enu: npt.ArrayLike | None = FACING_ENU,
    through_hilbert: bool = False,
) -> FloatArray:
    """Errors of the normal (run,) over the whole way of Fig. 11: tones, ranges, three fixes, cross product [rad].

    ``facing_enu`` None: a mirror that faces anywhere, each direction alike, anew for each run.
    """
    transmitter = table_2_enu_m()
    drawn = rng.standard_normal((runs, 3)) if facing_enu is None else np.broadcast_to(facing_enu, (runs, 3))
    normal = unit(drawn)
    receiver = triangle_enu_m(centre_enu_m, normal).reshape(-1, 3)
    distance = np.linalg.norm(receiver[:, None] - transmitter, axis=-1)
    phase = wrapped_rad(-2.0 * np.pi * distance / WAVELENGTH_M)
    difference = measured_differences_rad(phase, n_sample, rng, through_hilbert=through_hilbert)
    # within the field no difference to the first transmitter reaches λ/2, so n = 0 (§3.2)
    range_difference = -difference * WAVELENGTH_M / (2.0 * np.pi)
    sigma = range_sigma_m(n_sample) / np.sqrt(2.0)
    fixes = locate(transmitter, range_difference, sigma_m=sigma, min_probability=0.0)
    return normal_errors_rad(normal, fixes.position_enu_m.reshape(runs, 3, 3))


def predicted_tracking_rms_rad(centre_enu_m: npt.ArrayLike, n_sample: int) -> float:
    """T_RMS of §4.5: σ_φ, σ_Δ, ε_R, √(4/3) ε_R/d_R; position errors taken as alike in all directions [rad]."""
    return tilt_rms_from_position(float(predicted_position_rms_m(centre_enu_m, range_sigma_m(n_sample))), SPACING_M)


def rms(error: FloatArray) -> float:
    """Root mean square over all numbers (a vector's components summed first)."""
    power = error**2 if error.ndim == 1 else np.sum(error**2, axis=-1)
    return float(np.sqrt(np.mean(power)))


def figure_9(runs: int, rng: np.random.Generator, track: Track) -> Figure:
    """Position error along the x axis of the field for several range errors."""
    radius = np.linspace(0.0, 1.5, 16)
    place = np.stack([radius, np.zeros_like(radius), np.zeros_like(radius)], axis=-1)
    sigmas = (1e-4, 1e-3, 1e-2)
    points = [(sigma, receiver) for sigma in sigmas for receiver in place]
    error = [rms(position_errors_m(receiver, sigma, runs, rng)) for sigma, receiver in track(points, "Fig. 9")]
    series = tuple(
        Series(f"σ_Δ = {sigma:g}", radius, values, predicted_position_rms_m(place, sigma))
        for sigma, values in zip(sigmas, np.reshape(error, (len(sigmas), -1)), strict=True)
    )
    return Figure(
        9,
        "Receiver position error on the layout of Table 2",
        f"along +x at z = 0, {runs} runs a point; the paper: 0.99 σ_Δ at the centre, 1.85 σ_Δ at the edge",
        "distance from the centre of the field [field radii]",
        "RMS position error ε_R [field radii]",
        "radius",
        "position_rms",
        series,
        x_scale="linear",
    )


def figure_10(runs: int, rng: np.random.Generator, track: Track) -> Figure:
    """Show the normal's error over the ratio of receiver spacing and position error."""
    ratio = np.logspace(1, 4, 13)
    normal = unit(FACING_ENU)
    receiver = triangle_enu_m(CENTRE_ENU_M, normal)
    error = []
    for r in track(ratio, "Fig. 10"):
        noise = SPACING_M / r / np.sqrt(3.0) * rng.standard_normal((runs, 3, 3))
        error.append(1e3 * rms(normal_errors_rad(normal, receiver + noise)))
    predicted = [1e3 * tilt_rms_from_position(SPACING_M / r, SPACING_M) for r in ratio]
    return Figure(
        10,
        "Receiver plane normal error",
        f"three receivers d_R apart, independent position errors alike in all directions, {runs} runs a point",
        "d_R / ε_R",
        "RMS error of the mirror normal [mrad]",
        "spacing_over_position_rms",
        "normal_rms_mrad",
        (Series("cross product of three receivers", ratio, np.array(error), np.array(predicted)),),
        lines={"1 mrad": 1.0},
    )


def figure_11(runs: int, rng: np.random.Generator, track: Track) -> Figure:
    """Show the normal's error over the number of samples, the whole way from tones to normals."""
    n_grid = np.arange(100_000, 1_000_001, 100_000)
    # the estimator's work grows with S, so fewer runs there
    n_hilbert = {100_000: max(5, runs // 4), 1_000_000: max(5, runs // 20)}
    series = []
    for colour, (name, place) in enumerate({"centre": CENTRE_ENU_M, "edge (1, 0, 0)": EDGE_ENU_M}.items()):
        predicted = np.array([1e3 * predicted_tracking_rms_rad(place, n) for n in n_grid])
        for facing, words in ((FACING_ENU, "facing (0, −1, ½)"), (None, "facing anywhere")):
            error = [1e3 * rms(tracking_errors_rad(place, n, 10 * runs, rng, facing_enu=facing)) for n in n_grid]
            series.append(Series(f"{name}, {words}", n_grid, np.array(error), predicted, colour))
        error = []
        for n, count in n_hilbert.items():
            # one run at a time: its thirty signals of S samples fill memory enough
            steps = track(range(count), f"Fig. 11, {name}, S = {n}")
            one = [tracking_errors_rad(place, n, 1, rng, through_hilbert=True) for _ in steps]
            error.append(1e3 * rms(np.concatenate(one)))
        label = f"{name}, facing (0, −1, ½), with tones"
        series.append(Series(label, np.array(list(n_hilbert)), np.array(error), colour=colour))
    return Figure(
        11,
        "Overall error of the mirror normal",
        "SPC = 10, SNR = 10⁵, B = 0.04, λ = 4, d_R = 0.0173; the paper predicts 1.69 mrad at the edge for S = 10⁶\n"
        f"{10 * runs} runs a point with phases drawn as predicted; "
        f"{' and '.join(map(str, n_hilbert.values()))} with tones through the Hilbert method",
        "number of samples S",
        "RMS error of the mirror normal [mrad]",
        "n_sample",
        "normal_rms_mrad",
        tuple(series),
        x_scale="linear",
        lines={"1 mrad": 1.0, "10 mrad": 10.0},
        x_ticks=tuple(range(100_000, 1_000_001, 150_000)),
    )


FIGURES: dict[int, Callable[[int, np.random.Generator, Track], Figure]] = {
    3: partial(_over_snr, 3, "dot"),
    4: partial(_over_snr, 4, "compensated"),
    5: partial(_over_snr, 5, "hilbert"),
    6: figure_6,
    9: figure_9,
    10: figure_10,
    11: figure_11,
}
