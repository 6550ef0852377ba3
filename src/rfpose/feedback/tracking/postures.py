"""Postures of a field's mirrors: where models send their motors, and how they then stand."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from rfpose import geometry
from rfpose.checks import FloatArray
from rfpose.feedback import _kernels
from rfpose.feedback.mount import CommandStatus, aim_rows

__all__ = ["PosturesInTime", "aim_count", "aimed"]


@dataclass(frozen=True, slots=True, kw_only=True)
class PosturesInTime:
    """Mirrors at some times.

    Attributes
    ----------
    sun_enu : (time, xyz)
        Towards the sun.
    heat : (time,)
        See `rfpose.feedback.tracking.timeline.heat_of`.
    count : (mirror, time, axis)
        Motor positions.
    seen : (mirror, time)
        Whether there is such a posture.
    rows : (mirror, time, row)
        What was aimed at, as the kernels read it.
    normal_enu, centre_enu_m : (mirror, time, xyz)
        Of the mirrors.
    """

    sun_enu: FloatArray = field(repr=False)
    heat: FloatArray
    count: FloatArray
    seen: npt.NDArray[np.bool_]
    rows: FloatArray
    normal_enu: FloatArray
    centre_enu_m: FloatArray

    @property
    def right_up(self) -> tuple[FloatArray, FloatArray]:
        """The mirrors' right and up (mirror, time, xyz)."""
        rot = geometry.rot_enu_from_mirror(self.normal_enu)
        return rot[..., 0], rot[..., 1]

    @property
    def cos_elevation(self) -> FloatArray:
        """(mirror, time) of the normal."""
        return np.hypot(self.normal_enu[..., 0], self.normal_enu[..., 1])

    def tilted(self, right_up_rad: FloatArray) -> FloatArray:
        """Return the normals turned by small angles (mirror, time, 2)."""
        right, up = self.right_up
        return geometry.unit(self.normal_enu + right_up_rad[..., :1] * right + right_up_rad[..., 1:] * up)

    def only(self, i_time: int) -> PosturesInTime:
        """Return one of the times."""
        at = slice(i_time, i_time + 1)
        return PosturesInTime(
            sun_enu=self.sun_enu[at],
            heat=self.heat[at],
            count=self.count[:, at].copy(),
            seen=self.seen[:, at],
            rows=self.rows[:, at].copy(),
            normal_enu=self.normal_enu[:, at],
            centre_enu_m=self.centre_enu_m[:, at],
        )

    def of_turns(self, i_time: npt.NDArray[np.int64]) -> PosturesInTime:
        """Return one time of each mirror; the sun is then no longer the same for all, and left out."""
        row = np.arange(len(i_time))
        return PosturesInTime(
            sun_enu=np.empty((0, 3)),
            heat=np.empty(0),
            count=self.count[row, i_time][:, None],
            seen=self.seen[row, i_time][:, None],
            rows=self.rows[row, i_time][:, None],
            normal_enu=self.normal_enu[row, i_time][:, None],
            centre_enu_m=self.centre_enu_m[row, i_time][:, None],
        )


def aimed(
    model: FloatArray, constants: FloatArray, sun_enu: FloatArray, target_enu_m: FloatArray | None
) -> tuple[FloatArray, npt.NDArray[np.int8], FloatArray]:
    """Return the counts at which models send the sun to targets, a `CommandStatus` of each, and the kernels' rows.

    Parameters
    ----------
    model, constants : (mirror, parameter), (mirror, constant)
        Mounts.
    sun_enu : (time, xyz)
        Towards the sun.
    target_enu_m : (mirror, xyz)
        Aim points [m]; None: dishes, which look at the sun.

    Returns
    -------
    count : (mirror, time, axis)
        NaN where there is no posture; beyond the limits what would be wanted.
    """
    shape = (len(model), len(sun_enu), 3)
    sun = np.broadcast_to(sun_enu, shape)
    goal = sun if target_enu_m is None else np.broadcast_to(target_enu_m[:, None], shape)
    rows = aim_rows(sun, goal, source_is_point=False, target_is_point=target_enu_m is not None)
    rows = np.ascontiguousarray(rows)
    count, status = _kernels.command_batch(model, constants, rows)
    return count, status, rows


def aim_count(
    model: FloatArray, constants: FloatArray, sun_enu: FloatArray, target: FloatArray
) -> tuple[FloatArray, npt.NDArray[np.int8]]:
    """Return counts at which models send the sun to `HiddenField.target` (mirror, 2), NaN where they cannot, and why.

    The status is a `CommandStatus` of each mirror.
    """
    count, status, _ = aimed(model, constants, sun_enu[None], None if target[0, 3] else target[:, :3])
    return np.where(status != CommandStatus.OK, np.nan, count[:, 0]), status[:, 0]
