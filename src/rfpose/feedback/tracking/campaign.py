"""Mirrors at the calibration target while the field tracks: they take turns, are looked at, searched for, corrected.

After Berenguel et al., §4.6, and Malan, §5.4 and App. E.2: a mirror that the camera does not find on the target
goes through an outward spiral until it does; then its offset is known, and taken off.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from rfpose import geometry
from rfpose.checks import FloatArray
from rfpose.feedback import _kernels as mount_kernels
from rfpose.feedback.columns import P
from rfpose.feedback.fieldcontrol.control import ControlledField
from rfpose.feedback.fieldcontrol.modes import Mode, ModeEvent
from rfpose.feedback.optics import reflect, target_offset_m
from rfpose.feedback.tracking import _kernels
from rfpose.feedback.tracking.calibrations import correct_zeros
from rfpose.feedback.tracking.hidden import TILTS, HiddenField, generator
from rfpose.feedback.tracking.timeline import Day
from rfpose.scenario import Scenario

__all__ = ["Campaign"]

_LONGEST_S = 3600.0


class Campaign:
    """Takes the mirrors in its queue to the calibration target, one after the other.

    Parameters
    ----------
    scenario, field
        The run.
    feedback
        What the method measures. With radio the camera's offset goes to the receivers' plane, else to the axes' zeros.
    seed
        Of the run.

    Attributes
    ----------
    found : (mirror,)
        Whose beam is on the target now, of those that search.
    results
        What came of each: ``heliostat``, ``outcome`` (corrected, on target, not found, given up), ``searched``,
        ``offset_mm`` that the camera saw, ``at_s`` after the day's first step, ``took_s``.
    """

    def __init__(self, scenario: Scenario, field: HiddenField, *, feedback: int, seed: int) -> None:
        self._plan, self._field, self._seed, self._feedback = scenario.tracking, field, seed, feedback
        self._waiting: list[int] = []
        self._there: dict[str, Any] | None = None
        self.results: list[dict[str, Any]] = []
        self.found = np.zeros(len(field), np.bool_)

    @property
    def active(self) -> bool:
        """Whether mirrors are at the target or wait for it."""
        return bool(self._waiting) or self._there is not None

    def queue(self, index: npt.NDArray[np.int64]) -> None:
        """Let mirrors take turns, after those that wait already."""
        self._waiting += [i for i in index.tolist() if i not in self._waiting]

    def proceed(
        self, control: ControlledField, s: int, day: Day, aim_enu_m: FloatArray, state: FloatArray, model: FloatArray,
        true: FloatArray,
    ) -> None:  # fmt: skip
        """Go on at step ``s`` of the day: order the next mirror, look at the one that is there, correct its model.

        Parameters
        ----------
        control
            Of the field.
        aim_enu_m : (mirror, xyz)
            Where mirrors were last told to aim [m].
        state, model, true
            Of the method's mirrors, as the kernels have them; ``model`` is corrected in place.
        """
        self.found[:] = False
        if self._there is None:
            self._call(control, s)
            return
        i, stage = int(self._there["mirror"]), self._there["stage"]
        now_s = s * self._plan.servo_interval_s
        reported = Mode(int(control.reported_mode[i]))
        silent_s = self._plan_control().watchdog_intervals * self._plan.control_interval_s
        silent = silent_s < control.report_age_s[i] < np.inf
        if now_s - self._there["called_s"] > _LONGEST_S or silent:
            self._dismiss(control, now_s, "given up", order=ModeEvent.TRACK if reported == Mode.CALIBRATE else None)
        elif control.waiting[i]:
            return
        elif reported == Mode.SEARCH:
            self._there["stage"] = "searching"
            self._search(i, s, day, aim_enu_m, state, model, true)
        elif reported == Mode.DEFOCUS and stage == "searching":
            self._dismiss(control, now_s, "not found", order=ModeEvent.REFOCUS)
        elif reported != Mode.CALIBRATE:  # something else took it away
            self._dismiss(control, now_s, "given up", order=None)
        elif stage != "there":
            self._there |= {"stage": "there", "since_s": now_s, "looks": []}
        elif now_s - self._there["since_s"] >= self._plan_control().calibration_dwell_s:
            self._look(control, i, s, day, state, model, true)

    def _plan_control(self) -> Any:
        assert self._plan.field_control is not None
        return self._plan.field_control

    def _call(self, control: ControlledField, s: int) -> None:
        """Order the first mirror of the queue that can come."""
        reported = control.reported_mode
        for i in self._waiting:
            if reported[i] in (Mode.POINT, Mode.TRACK, Mode.DEFOCUS) and not control.waiting[i]:
                if control.command(ModeEvent.CALIBRATE, [i]).accepted[i]:
                    self._waiting.remove(i)
                    now_s = s * self._plan.servo_interval_s
                    self._there = {"mirror": i, "stage": "called", "called_s": now_s, "searched": False, "looks": []}
                return

    def _dismiss(self, control: ControlledField, now_s: float, outcome: str, *, order: ModeEvent | None) -> None:
        assert self._there is not None
        i = int(self._there["mirror"])
        if order is not None:
            control.command(order, [i])
        offset = np.mean(self._there["looks"], axis=0).tolist() if self._there["looks"] else None
        self.results.append(
            {
                "heliostat": self._field.ids[i],
                "outcome": outcome,
                "searched": self._there["searched"],
                "offset_mm": None if offset is None else [1e3 * each for each in offset],
                "at_s": self._there["called_s"],
                "took_s": now_s - self._there["called_s"],
            }
        )
        self._there = None

    # -- the camera ----------------------------------------------------------------------------------------

    def _posture(self, i: int, s: int, day: Day, state: FloatArray, true: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return a mirror's normal and centre as they are; wind and swing average out over a look."""
        p = true[i : i + 1].copy()
        p[:, TILTS] += self._field.lean_rad[i] * day.heat[s]
        count = np.ascontiguousarray(state[i : i + 1, None, _kernels.AXIS : _kernels.AXIS + 2])
        out = mount_kernels.posture_batch(p, self._field.constant[i : i + 1], count, 0.0)[0, 0]
        return out[2:5], out[5:8]

    def _spot_m(self, i: int, s: int, day: Day, normal: FloatArray, centre: FloatArray) -> FloatArray:
        """Return where the camera sees the beam, from the target's centre: right, up [m]; NaN: not on its plane."""
        target = np.asarray(self._plan.calibration_target_enu_m)
        beam = reflect(normal, day.sun_enu[s])
        seen = target_offset_m(centre, beam, target_enu_m=target, target_normal_enu=centre - target)
        camera = self._plan.camera
        distance = float(np.linalg.norm(target - centre))
        noise = 1e-3 * camera.spot_sigma_mm * generator(self._seed, 41, i, s).standard_normal(2)
        return np.asarray(seen + noise + 2.0 * distance * self._field.camera_bias_rad[i])

    def _on_target(self, spot_m: FloatArray) -> bool:
        return bool((np.abs(spot_m) <= 0.5 * self._plan_control().calibration_target_m).all())

    def _look(
        self, control: ControlledField, i: int, s: int, day: Day, state: FloatArray, model: FloatArray, true: FloatArray
    ) -> None:
        """Look at the mirror for a while; not on the target: let it search."""
        assert self._there is not None
        now_s, dwell_s = s * self._plan.servo_interval_s, self._plan_control().calibration_dwell_s
        normal, centre = self._posture(i, s, day, state, true)
        spot = self._spot_m(i, s, day, normal, centre)
        if not self._on_target(spot):
            self._there |= {"stage": "sought", "searched": True, "looks": []}
            control.command(ModeEvent.SEARCH, [i])
            return
        self._there["looks"].append(spot.tolist())
        if now_s - self._there["since_s"] < 2.0 * dwell_s:
            return
        offset = np.mean(self._there["looks"], axis=0)
        outcome = "on target"
        if np.hypot(*offset) > 1e-3 * self._plan.camera.berenguel_tolerance_mm:
            self._correct(i, offset, normal, centre, model)
            outcome = "corrected"
        self._dismiss(control, now_s, outcome, order=ModeEvent.TRACK)

    def _search(
        self, i: int, s: int, day: Day, aim_enu_m: FloatArray, state: FloatArray, model: FloatArray, true: FloatArray
    ) -> None:
        """See whether the beam has come upon the target; then the mirror is as far off as it was told to aim beside."""
        assert self._there is not None
        still = np.abs(
            state[i, _kernels.COMMAND : _kernels.COMMAND + 2] - state[i, _kernels.MOTOR : _kernels.MOTOR + 2]
        )
        if (still > 20.0 * self._plan.drive.microsteps).any():
            return  # between two cells
        normal, centre = self._posture(i, s, day, state, true)
        spot = self._spot_m(i, s, day, normal, centre)
        if self._on_target(spot):
            target = np.asarray(self._plan.calibration_target_enu_m)
            rot = geometry.rot_enu_from_mirror(centre - target)
            told = (aim_enu_m[i] - target) @ rot[:, :2]
            self._correct(i, spot - told, normal, centre, model)
            self.found[i] = True

    def _correct(self, i: int, offset_m: FloatArray, normal: FloatArray, centre: FloatArray, model: FloatArray) -> None:
        """Take an offset on the target off what the method believes."""
        target = np.asarray(self._plan.calibration_target_enu_m)
        distance = float(np.linalg.norm(target - centre))
        rot = geometry.rot_enu_from_mirror(centre - target)
        beam = geometry.unit(target - centre)
        moved = rot[:, 0] * offset_m[0] + rot[:, 1] * offset_m[1]
        # a turn of the normal that moves the beam by as much as it is off; see reflect
        sun = 2.0 * float(normal @ beam) * normal - beam
        wanted = geometry.unit(sun + beam)
        is_now = geometry.unit(sun + geometry.unit(beam + moved / distance))
        if self._feedback == _kernels.RADIO:
            mirror = geometry.rot_enu_from_mirror(is_now)
            model[i, P.receiver_plane_right_rad] += (wanted - is_now) @ mirror[:, 0]
            model[i, P.receiver_plane_up_rad] += (wanted - is_now) @ mirror[:, 1]
        else:
            correct_zeros(model[i : i + 1], wanted[None], is_now[None])

    # -- interruption --------------------------------------------------------------------------------------

    def text(self) -> dict[str, Any]:
        """Return all that going on depends on, for `restore`."""
        return {"waiting": self._waiting, "there": self._there, "results": self.results}

    def restore(self, text: Mapping[str, Any]) -> None:
        """Go back to what `text` gave."""
        self._waiting, self._there, self.results = list(text["waiting"]), text["there"], list(text["results"])
