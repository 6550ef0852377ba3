"""The plant that all methods share: days, mirrors with their hidden errors, wind, what is caught of the light."""

from __future__ import annotations

import copy

import numpy as np

from rfpose import geometry
from rfpose.checks import FloatArray
from rfpose.errors import ScenarioError
from rfpose.feedback import _kernels
from rfpose.feedback.columns import constant
from rfpose.feedback.mount import CommandStatus
from rfpose.feedback.tracking.capture import capture_table
from rfpose.feedback.tracking.hidden import azimuth_course_rad, draw_field
from rfpose.feedback.tracking.postures import PosturesInTime, aim_count, aimed
from rfpose.feedback.tracking.sky import under_sky
from rfpose.feedback.tracking.timeline import Day, days, heat_of, hour_of_day, look_times, site_of
from rfpose.feedback.tracking.wind import Gusts
from rfpose.scenario import Scenario
from rfpose.sun import sun_position

__all__ = ["Plant"]

_COURSE_S = 60.0


class Plant:
    """A scenario's field on its days.

    Parameters
    ----------
    scenario
        Site, mirrors, and ``[tracking]``.
    count
        Number of mirrors; None: those of the scenario.
    seed
        Everything random follows from it.

    Attributes
    ----------
    days
        Under the sky that the scenario asks for.
    field
        The mirrors, with what nobody knows of them.
    gusts
        The wind.
    table
        What is caught of the light, see `capture_table`.

    Raises
    ------
    ScenarioError, InvalidInputError
        No mirrors, no site, no sun, a record that does not reach over the days, an aim point that no mirror reaches.
    """

    def __init__(self, scenario: Scenario, *, count: int | None, seed: int) -> None:
        self.scenario, self.seed = scenario, seed
        self.days: tuple[Day, ...] = under_sky(scenario, days(scenario), seed=seed)
        self.field = draw_field(scenario, count=count, seed=seed, sun_enu=self._course(self.days[0]))
        self.gusts = Gusts(scenario)
        self.gusts.check_covers(self.days)
        self.table = capture_table(scenario)

    def wanted_normal_enu(self, day: Day, i_step: int) -> FloatArray:
        """Return the normals that nominal mirrors should have at a step of a day (mirror, xyz)."""
        sun = day.sun_enu[i_step]
        if self.field.is_dish:
            return np.broadcast_to(sun, (len(self.field), 3)).copy()
        return geometry.bisector_enu(self.field.target[:, :3] - self.field.pivot_enu_m, sun)

    def usual_normal_enu(self) -> FloatArray:
        """Return the normals that mirrors should have at the first day's noon (mirror, xyz)."""
        day = self.days[0]
        return self.wanted_normal_enu(day, int(np.argmax(day.sun_enu[:, 2])))

    def nominal_postures(self, sun_enu: FloatArray, heat: FloatArray, target_enu_m: FloatArray) -> PosturesInTime:
        """Return how nominal mirrors stand that send the sun (time, xyz) to targets (mirror, xyz).

        Where there is no such posture they stand at count zero.
        """
        field = self.field
        target = None if field.is_dish else target_enu_m
        count, _, rows = aimed(field.nominal, field.constant, sun_enu, target)
        seen = np.asarray(np.isfinite(count).all(axis=-1))
        count = np.where(seen[..., None], count, 0.0)
        out = _kernels.posture_batch(field.nominal, field.constant, count, 0.0)
        return PosturesInTime(
            sun_enu=sun_enu, heat=heat, count=count, seen=seen, rows=rows, normal_enu=out[..., 2:5],
            centre_enu_m=out[..., 5:],
        )  # fmt: skip

    def nominal_looks(self, since_first: int, n_look: int, target_enu_m: FloatArray) -> PosturesInTime:
        """Return the same at looks that are spread over a day; see `look_times`."""
        unix_s, site = look_times(self.scenario, since_first, n_look), site_of(self.scenario)
        sun = sun_position(unix_s, site).direction_enu
        return self.nominal_postures(sun, heat_of(hour_of_day(unix_s, site)), target_enu_m)

    def first_count(self, day: Day) -> FloatArray:
        """Return about where azimuth motors begin a day, on the turn that leaves its course nearest to the middle."""
        first, middle = azimuth_course_rad(self.scenario, self.field.pivot_enu_m, self._course(day))
        home, per_rad = (constant(self.field.constant, name)[:, 0] for name in ("angle_at_zero_rad", "counts_per_unit"))
        turns = np.rint((middle - home) / (2.0 * np.pi))
        return np.asarray((first - home - 2.0 * np.pi * turns) * per_rad)

    def check_reach(self) -> None:
        """Refuse a field of which no mirror reaches its aim at noon.

        Raises
        ------
        ScenarioError
            So it is.
        """
        day = self.days[0]
        noon = day.sun_enu[int(np.argmax(day.sun_enu[:, 2]))]
        count, status = aim_count(self.field.nominal, self.field.constant, noon, self.field.target)
        if not np.isfinite(count).any():
            why = "beyond its limits" if status[0] == CommandStatus.BEYOND_LIMITS else "without a posture"
            raise ScenarioError(
                f"no mirror reaches its aim point on {day.date} at noon: {self.field.ids[0]} is {why}; check "
                "`aim_enu_m` and [tracking.drive] limits"
            )

    def sample(self, n: int) -> Plant:
        """Return the plant with up to ``n`` of its mirrors, spread evenly over their order."""
        found = copy.copy(self)
        whole = len(self.field)
        found.field = self.field.some(np.unique(np.linspace(0, whole - 1, min(n, whole)).astype(np.int64)))
        return found

    def _course(self, day: Day) -> FloatArray:
        """(time, xyz) the sun of a day, a minute apart."""
        return day.sun_enu[:: max(1, round(_COURSE_S / self.scenario.tracking.servo_interval_s))]
