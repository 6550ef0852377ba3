"""A live field to draw: goes on some steps at a time beside the window, is disturbed from it."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, read_only
from rfpose.feedback.fieldcontrol.modes import Mode
from rfpose.feedback.tracking.live import FieldMoment, LiveField, live_scenario
from rfpose.pipeline.pictures.track_view import ON_RECEIVER, Instant, instant_at
from rfpose.scenario import Scenario

__all__ = ["LivePicture", "LiveTrack"]


@dataclass(frozen=True, slots=True, kw_only=True)
class LivePicture:
    """The steps of one stretch, and the field at its end.

    Attributes
    ----------
    seconds : (step,)
        Since the first step [s].
    rms_mrad : (step,)
        Over the field [mrad of the normal].
    time
        UTC of the end, ISO 8601.
    instant
        The mirrors at the end.
    sigma_mrad : (mirror,)
        Of one radio frame [mrad of the normal]; NaN: no pose.
    wind_mps
        With the gust under way [m/s].
    mode
        Of each mirror, in words.
    dead
        Transmitters off the air.
    over
        The day is over.
    """

    seconds: FloatArray
    rms_mrad: FloatArray
    time: str
    instant: Instant
    sigma_mrad: FloatArray
    wind_mps: float
    mode: tuple[str, ...]
    dead: tuple[str, ...]
    over: bool


class LiveTrack:
    """A `LiveField` that a thread steps while another disturbs it.

    Parameters
    ----------
    scenario
        With heliostats; what else is missing is filled in, see `live_scenario`.

    Raises
    ------
    RfposeError
        It cannot be tracked, as the message says.
    """

    def __init__(self, scenario: Scenario, *, seed: int = 0) -> None:
        self._field = LiveField(live_scenario(scenario), seed=seed)
        self._lock = threading.Lock()
        self._n_step = 0
        mirrors = self._field.field
        self.ids: tuple[str, ...] = mirrors.ids
        self.pivot_enu_m = read_only(mirrors.pivot_enu_m.copy())
        self.target_enu_m = read_only(mirrors.target[:, :3].copy())
        self.transmitter_ids = self._field.transmitter_ids
        self.transmitter_enu_m = read_only(scenario.transmitter_enu_m.copy())
        self.step_s = self._field.step_s

    def disturb(self, what: str, name: str = "") -> None:
        """Do gust, kill_transmitter or stop_motor (which take a name), emergency or normal before the next step.

        Raises
        ------
        InvalidInputError
            No transmitter or mirror of this name.
        """
        with self._lock:
            if what == "kill_transmitter":
                self._field.kill_transmitter(name)
            elif what == "stop_motor":
                self._field.stop_motor(name)
            elif what == "gust":
                self._field.gust()
            elif what == "emergency":
                self._field.emergency()
            else:
                self._field.normal()

    def advance(self, n_step: int, on_progress: Callable[[int, int], None] | None = None) -> LivePicture | None:
        """Go on by up to ``n_step`` steps, fewer at the end of the day; None if it is over already."""
        seconds, rms = [], []
        moment: FieldMoment | None = None
        for i in range(n_step):
            with self._lock:
                if self._field.over:
                    break
                moment = self._field.step()
            self._n_step += 1
            seconds.append(self._n_step * self.step_s)
            rms.append(_rms_mrad(_error_rad(moment)))
            if on_progress is not None:
                on_progress(i + 1, n_step)
        if moment is None:
            return None
        stopped = moment.stopped
        return LivePicture(
            seconds=read_only(np.array(seconds)),
            rms_mrad=read_only(np.array(rms)),
            time=str(np.datetime64(round(moment.unix_s), "s")),
            instant=instant_at(
                moment.normal_enu,
                _error_rad(moment),
                moment.sun_enu,
                self.pivot_enu_m,
                self.target_enu_m,
                mode=_shining(moment),
            ),
            sigma_mrad=1e3 * moment.radio_sigma_rad,
            wind_mps=moment.wind_mps,
            mode=tuple(
                "motors stopped" if still else Mode(mode).name.lower()
                for mode, still in zip(moment.mode, stopped, strict=True)
            ),
            dead=tuple(name for name, off in zip(self.transmitter_ids, moment.dead, strict=True) if off),
            over=self._field.over,
        )


def _error_rad(moment: FieldMoment) -> FloatArray:
    """Return the errors of mirrors on the receiver (mirror,); one in stow or on its way there has none."""
    return np.asarray(np.where(np.isin(_shining(moment), ON_RECEIVER), moment.error_rad, np.nan))


def _shining(moment: FieldMoment) -> npt.NDArray[np.int64]:
    """Return modes (mirror,) as their light knows them: a mirror whose motors stand shines on, whatever it is told."""
    return np.where(moment.stopped, int(Mode.TRACK), moment.mode).astype(np.int64)


def _rms_mrad(error_rad: FloatArray) -> float:
    known = error_rad[np.isfinite(error_rad)]
    return 1e3 * float(np.sqrt(np.mean(known**2))) if known.size else float("nan")
