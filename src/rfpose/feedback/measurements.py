"""What a mount is calibrated from: postures, and what was seen in each.

Every source comes down to the same row: motor positions; where light (or a radio's line of sight) came from;
where it went; how well the mirror's normal is known from it. A measured normal is a row whose source and target
both lie along it, a dish on the sun likewise. So that any mixture of sources goes into one fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rfpose import geometry
from rfpose.checks import FloatArray, as_float_array, read_only
from rfpose.errors import InvalidInputError
from rfpose.feedback.columns import M
from rfpose.feedback.mount import aim_rows

__all__ = ["Measurements", "join"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Measurements:
    """Measured postures of one heliostat; make them with one of the class methods.

    Attributes
    ----------
    count : (measurement, axis)
        Motor positions.
    row : (measurement, 10)
        Source, target and sigma as the kernels read them.
    unix_s : (measurement,)
        Times [s since 1970 UTC], or the order of measurement; used for what happens in the course of time.
    """

    count: FloatArray
    row: FloatArray
    unix_s: FloatArray

    @property
    def sigma_rad(self) -> FloatArray:
        """Stated standard deviation of each normal, one component [rad]."""
        return self.row[:, M.sigma_rad]

    def __len__(self) -> int:
        return len(self.count)

    def take(self, index: npt.NDArray[np.int64] | npt.NDArray[np.bool_] | slice) -> Measurements:
        """Return some of the measurements."""
        return Measurements(count=self.count[index], row=self.row[index], unix_s=self.unix_s[index])

    @classmethod
    def from_spots(
        cls,
        count: npt.ArrayLike,
        *,
        sun_enu: npt.ArrayLike,
        spot_enu_m: npt.ArrayLike,
        sigma_rad: npt.ArrayLike = 1e-3,
        unix_s: npt.ArrayLike | None = None,
    ) -> Measurements:
        """Take focal spots seen on a target: by PAINT, by a camera.

        Parameters
        ----------
        count : (measurement, axis)
            Motor positions.
        sun_enu : (measurement, xyz)
            Directions towards the sun.
        spot_enu_m : (measurement, xyz)
            Centres of the spots [m].
        sigma_rad : (measurement,)
            Of the mirror normal, one component: half the spot's sigma over its distance [rad].
        unix_s : (measurement,)
            Times; left out: in the order given.
        """
        sun = geometry.unit(as_float_array("sun_enu", sun_enu, ("measurement", 3), finite=False))
        spot = as_float_array("spot_enu_m", spot_enu_m, ("measurement", 3), finite=False)
        return _make(count, sun, spot, (False, True), sigma_rad, unix_s)

    @classmethod
    def from_normals(
        cls,
        count: npt.ArrayLike,
        *,
        normal_enu: npt.ArrayLike,
        sigma_rad: npt.ArrayLike = 1e-3,
        receiver_plane: bool = False,
        unix_s: npt.ArrayLike | None = None,
    ) -> Measurements:
        """Take measured normals: radio poses, or a dish's axis on the sun.

        Parameters
        ----------
        count : (measurement, axis)
            Motor positions.
        normal_enu : (measurement, xyz)
            Measured directions.
        sigma_rad : (measurement,)
            Standard deviation of one component [rad].
        receiver_plane
            The normals are those of the receivers' plane, which the mirror need not be parallel to: the two
            ``receiver_plane_..._rad`` parameters lie between. Free, they need measurements of the mirror itself
            (a camera, a drone) in the same fit; radio alone cannot tell them from the mount's own zeros.
        unix_s : (measurement,)
            Times; left out: in the order given.
        """
        normal = geometry.unit(as_float_array("normal_enu", normal_enu, ("measurement", 3), finite=False))
        made = _make(count, normal, normal, (False, False), sigma_rad, unix_s)
        row = made.row.copy()
        row[:, M.of_receiver_plane] = receiver_plane
        return Measurements(count=made.count, row=read_only(row), unix_s=made.unix_s)

    @classmethod
    def from_points(
        cls,
        count: npt.ArrayLike,
        *,
        source_enu_m: npt.ArrayLike,
        target_enu_m: npt.ArrayLike,
        sigma_rad: npt.ArrayLike = 1e-3,
        unix_s: npt.ArrayLike | None = None,
    ) -> Measurements:
        """Take pairs of points that see each other in the mirror: a drone and a target.

        Parameters
        ----------
        count : (measurement, axis)
            Motor positions.
        source_enu_m, target_enu_m : (measurement, xyz)
            The two points [m].
        sigma_rad : (measurement,)
            Of the mirror normal, one component [rad].
        unix_s : (measurement,)
            Times; left out: in the order given.
        """
        source = as_float_array("source_enu_m", source_enu_m, ("measurement", 3), finite=False)
        target = as_float_array("target_enu_m", target_enu_m, ("...", 3), finite=False)
        return _make(count, source, np.broadcast_to(target, source.shape), (True, True), sigma_rad, unix_s)


def join(parts: Sequence[Measurements]) -> Measurements:
    """Put measurements of one heliostat from several sources together, in the order of time."""
    if not parts:
        raise InvalidInputError("`parts` must hold one or more sets of measurements")
    unix_s = np.concatenate([part.unix_s for part in parts])
    order = np.argsort(unix_s, kind="stable")
    return Measurements(
        count=np.concatenate([part.count for part in parts])[order],
        row=np.concatenate([part.row for part in parts])[order],
        unix_s=unix_s[order],
    )


def _make(
    count: npt.ArrayLike,
    source: FloatArray,
    target: FloatArray,
    is_point: tuple[bool, bool],
    sigma_rad: npt.ArrayLike,
    unix_s: npt.ArrayLike | None,
) -> Measurements:
    counts = as_float_array("count", count, (len(source), 2), finite=False)
    row = aim_rows(source, target, source_is_point=is_point[0], target_is_point=is_point[1])
    row[:, M.sigma_rad] = as_float_array(
        "sigma_rad", np.broadcast_to(sigma_rad, len(source)), (len(source),), positive=True
    )
    times = np.arange(len(source), dtype=np.float64) if unix_s is None else unix_s
    return Measurements(
        count=read_only(counts),
        row=read_only(row),
        unix_s=read_only(as_float_array("unix_s", times, (len(source),), finite=False)),
    )
