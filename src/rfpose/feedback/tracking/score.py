"""How well a method did: errors, light caught, motors spared, what lost radio cost."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, read_only
from rfpose.feedback.energy import Bursts, response_loss
from rfpose.feedback.fieldcontrol.modes import Mode
from rfpose.feedback.tracking import _kernels as kernels
from rfpose.feedback.tracking.run import MethodSums

__all__ = ["Score", "score"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Score:
    """One method over all days; angles in rad, NaN where nothing was scored.

    Attributes
    ----------
    normal_rms_rad, normal_p95_rad, normal_worst_rad
        Error of the normal over all mirrors and steps.
    beam_rms_rad, beam_worst_rad
        Error of the beam; of a dish: of its axis.
    intercept
        Light caught over light that a perfect tracker would catch.
    energy_j_per_m2
        Light caught by a square metre of mirror, from the sky as it was, whatever its mode.
    motor_steps, motor_starts
        By mirror and day, both axes together.
    heliostat_rms_rad, heliostat_p95_rad, heliostat_worst_rad, heliostat_intercept : (mirror,)
    hour_rms_rad : (24,)
        By hour of local mean solar time.
    day_rms_rad, day_worst_heliostat_rad : (day,)
        Over the field; the worst mirror's rms.
    day_intercept : (day,)
    outage_rms_rad, outage_intercept, outage_loss_j_per_m2 : (outage,)
        While radio was out, outage by outage; the last is light spilt by mirror, beyond what is spilt at other times.
        NaN where nothing was scored meanwhile.
    sunshine_s, bursts
        Time with the sun out, and how often it came out, by mirror.
    burst_error_rad
        Mean error of the normal in the second in which the sun comes out; NaN if it never does.
    response_loss
        Part of the light offered that is spilt in the first `RESPONSE_S` after that, beyond what is spilt at other
        times; negative where chance has it so, NaN if the sun never comes out.
    response_loss_j_per_m2
        The same light, by mirror.
    turning_loss
        Part of the sunshine that would pass if mirrors turned by the error at full speed (Edwards §5.4.9).
    by_mode : (mode, 3)
        Seconds, light offered and caught [J/m²] by mirror, in each `Mode` while the field was to work.
    availability
        Light caught over light offered in all modes: what ways, alarms, calibrations and faults cost, too.
    lost_frames
        Part of the radio frames that brought nothing.
    out_of_reach
        Part of the steps in which a mirror could not face its aim.
    """

    normal_rms_rad: float
    normal_p95_rad: float
    normal_worst_rad: float
    beam_rms_rad: float
    beam_worst_rad: float
    intercept: float
    energy_j_per_m2: float
    motor_steps: float
    motor_starts: float
    heliostat_rms_rad: FloatArray
    heliostat_p95_rad: FloatArray
    heliostat_worst_rad: FloatArray
    heliostat_intercept: FloatArray
    hour_rms_rad: FloatArray
    day_rms_rad: FloatArray
    day_worst_heliostat_rad: FloatArray
    day_intercept: FloatArray
    outage_rms_rad: FloatArray
    outage_intercept: FloatArray
    outage_loss_j_per_m2: FloatArray
    sunshine_s: float
    bursts: float
    burst_error_rad: float
    response_loss: float
    response_loss_j_per_m2: float
    turning_loss: float
    by_mode: FloatArray
    availability: float
    lost_frames: float
    out_of_reach: float

    def as_dict(self) -> dict[str, Any]:
        """Return plain values with stable keys; milliradians say of what."""
        return {
            "normal_mrad": {
                "rms": 1e3 * self.normal_rms_rad,
                "p95": 1e3 * self.normal_p95_rad,
                "worst": 1e3 * self.normal_worst_rad,
                "worst_heliostat_rms": 1e3 * _largest(self.heliostat_rms_rad),
            },
            "beam_mrad": {"rms": 1e3 * self.beam_rms_rad, "worst": 1e3 * self.beam_worst_rad},
            "intercept": self.intercept,
            "spillage": 1.0 - self.intercept,
            "energy_kwh_per_m2": self.energy_j_per_m2 / 3.6e6,
            "motor_steps_per_day": self.motor_steps,
            "motor_starts_per_day": self.motor_starts,
            "day_rms_mrad": 1e3 * self.day_rms_rad,
            "day_intercept": self.day_intercept,
            "hour_rms_mrad": 1e3 * self.hour_rms_rad,
            "outages": [
                {"rms_mrad": 1e3 * rms, "intercept": intercept, "loss_kwh_per_m2": loss / 3.6e6}
                for rms, intercept, loss in zip(
                    self.outage_rms_rad.tolist(),
                    self.outage_intercept.tolist(),
                    self.outage_loss_j_per_m2.tolist(),
                    strict=True,
                )
            ],
            "sunshine": {
                "hours": self.sunshine_s / 3600.0,
                "bursts": self.bursts,
                "error_mrad": 1e3 * self.burst_error_rad,
                "response_window_s": kernels.RESPONSE_S,
                "response_loss": self.response_loss,
                "response_loss_kwh_per_m2": self.response_loss_j_per_m2 / 3.6e6,
                "turning_loss": self.turning_loss,
            },
            "availability": self.availability,
            "modes": {
                mode.name.lower(): {
                    "hours": seconds / 3600.0,
                    "offered_kwh_per_m2": offered / 3.6e6,
                    "lost_kwh_per_m2": (offered - caught) / 3.6e6,
                }
                for mode, (seconds, offered, caught) in zip(Mode, self.by_mode.tolist(), strict=True)
                if seconds > 0.0
            },
            "lost_frames": self.lost_frames,
            "out_of_reach": self.out_of_reach,
        }


def score(sums: MethodSums) -> Score:
    """Return a method's score."""
    total = sums.total
    n_day, n_mirror = total.shape[:2]
    by_mirror = total.sum(axis=0)
    everything = by_mirror.sum(axis=0)
    worst = total.max(axis=0)
    day = total.sum(axis=1)
    hours = sums.hours.sum(axis=0)
    intercept = _ratio(everything[kernels.CAUGHT], everything[kernels.ENERGY])
    out = sums.by_outage.sum(axis=0)
    fresh = everything[kernels.FRESH_ENERGY], everything[kernels.FRESH_CAUGHT]
    settled = _ratio(everything[kernels.CAUGHT] - fresh[1], everything[kernels.ENERGY] - fresh[0])
    lost_j = float((settled - _ratio(fresh[1], fresh[0])) * fresh[0])
    with np.errstate(invalid="ignore", divide="ignore"):
        rms = np.sqrt(by_mirror[:, kernels.SQUARE] / by_mirror[:, kernels.STEPS])
        by_day = np.sqrt(total[..., kernels.SQUARE] / total[..., kernels.STEPS])
        hour_rms = np.sqrt(hours[:, 1] / hours[:, 0])
        day_rms = np.sqrt(day[:, kernels.SQUARE] / day[:, kernels.STEPS])
        caught = by_mirror[:, kernels.CAUGHT] / by_mirror[:, kernels.ENERGY]
        day_caught = day[:, kernels.CAUGHT] / day[:, kernels.ENERGY]
        out_rms = np.sqrt(out[:, kernels.OUT_SQUARE] / out[:, kernels.OUT_STEPS])
        out_caught = out[:, kernels.OUT_CAUGHT] / out[:, kernels.OUT_ENERGY]
    lit = _ratio(
        everything[kernels.CAUGHT] - out[:, kernels.OUT_CAUGHT].sum(),
        everything[kernels.ENERGY] - out[:, kernels.OUT_ENERGY].sum(),
    )
    out_loss = np.maximum(lit - out_caught, 0.0) * out[:, kernels.OUT_ENERGY] / n_mirror
    scored = by_mirror[:, kernels.STEPS] > 0.0
    by_mode = sums.by_mode.sum(axis=0).mean(axis=0)
    return Score(
        normal_rms_rad=float(np.sqrt(_ratio(everything[kernels.SQUARE], everything[kernels.STEPS]))),
        normal_p95_rad=float(quantile(sums.histogram.sum(axis=0)[None], 0.95)[0]),
        normal_worst_rad=float(worst[:, kernels.WORST].max()) if scored.any() else np.nan,
        beam_rms_rad=float(np.sqrt(_ratio(everything[kernels.BEAM_SQUARE], everything[kernels.STEPS]))),
        beam_worst_rad=float(worst[:, kernels.BEAM_WORST].max()) if scored.any() else np.nan,
        intercept=intercept,
        energy_j_per_m2=float(by_mode[:, kernels.MODE_CAUGHT].sum()),
        motor_steps=float(everything[kernels.MOTOR_1] + everything[kernels.MOTOR_2]) / (n_mirror * n_day),
        motor_starts=float(everything[kernels.STARTS]) / (n_mirror * n_day),
        heliostat_rms_rad=read_only(rms),
        heliostat_p95_rad=read_only(quantile(sums.histogram, 0.95)),
        heliostat_worst_rad=read_only(np.where(scored, worst[:, kernels.WORST], np.nan)),
        heliostat_intercept=read_only(caught),
        hour_rms_rad=read_only(hour_rms),
        day_rms_rad=read_only(day_rms),
        day_worst_heliostat_rad=read_only(np.array([_largest(row) for row in by_day])),
        day_intercept=read_only(day_caught),
        outage_rms_rad=read_only(out_rms),
        outage_intercept=read_only(out_caught),
        outage_loss_j_per_m2=read_only(out_loss),
        sunshine_s=float(everything[kernels.SUNSHINE]) / n_mirror,
        bursts=float(everything[kernels.BURSTS]) / n_mirror,
        burst_error_rad=_ratio(everything[kernels.BURST_ERROR], everything[kernels.BURSTS]),
        response_loss=_ratio(lost_j, everything[kernels.ENERGY]),
        response_loss_j_per_m2=lost_j / n_mirror,
        turning_loss=_turning_loss(everything),
        by_mode=read_only(by_mode),
        availability=_ratio(by_mode[:, kernels.MODE_CAUGHT].sum(), by_mode[:, kernels.MODE_OFFERED].sum()),
        lost_frames=_ratio(everything[kernels.FRAMES_LOST], everything[kernels.FRAMES]),
        out_of_reach=_ratio(
            everything[kernels.OUT_OF_REACH], everything[kernels.OUT_OF_REACH] + everything[kernels.STEPS]
        ),
    )


def quantile(histogram: npt.NDArray[np.integer], part: float) -> FloatArray:
    """Return a quantile of each row's normal errors (row,) [rad], linear in the logarithm within a bin."""
    cumulated = np.cumsum(histogram, axis=1)
    wanted = part * cumulated[:, -1:]
    slot = np.minimum(np.sum(cumulated < wanted, axis=1), histogram.shape[1] - 1)
    row = np.arange(len(histogram))
    below = cumulated[row, slot] - histogram[row, slot]
    with np.errstate(invalid="ignore", divide="ignore"):
        inside = (wanted[:, 0] - below) / histogram[row, slot]
        value = kernels.LOWEST_RAD * 10.0 ** ((slot + inside) / kernels.BINS_PER_DECADE)
    return np.asarray(np.where(cumulated[:, -1] > 0, value, np.nan))


def _turning_loss(sums: FloatArray) -> float:
    """Edwards §5.4.9 with the sunshine, the bursts and the errors of this run."""
    if not sums[kernels.BURSTS] > 0.0:
        return float("nan")
    sky = Bursts(sunshine_h=float(sums[kernels.SUNSHINE]) / 3600.0, per_year=float(sums[kernels.BURSTS]))
    return float(response_loss(sums[kernels.TURNING] / sums[kernels.BURSTS], bursts=sky))


def _ratio(part: float, whole: float) -> float:
    return float(part) / float(whole) if whole > 0.0 else float("nan")


def _largest(values: FloatArray) -> float:
    finite = values[np.isfinite(values)]
    return float(finite.max()) if finite.size else float("nan")
