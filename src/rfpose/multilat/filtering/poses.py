"""Poses over frames: a filter for mirrors that move, through outages and outliers."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum, IntFlag

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, as_float_array, read_only
from rfpose.errors import InvalidInputError
from rfpose.multilat.filtering import _kernels

__all__ = ["Contradiction", "FilterSettings", "FilterState", "FilterStatus", "FilteredPoses", "filter_poses"]

BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int64]


class FilterStatus(IntEnum):
    """What became of one frame of one mirror; ``reason`` says it in words."""

    UNKNOWN = _kernels.UNKNOWN
    UPDATED = _kernels.UPDATED
    STARTED = _kernels.STARTED
    COASTED = _kernels.COASTED
    GATED = _kernels.GATED
    RESTARTED = _kernels.RESTARTED
    LOST = _kernels.LOST

    @property
    def reason(self) -> str:
        """The status in words."""
        return (
            "no pose measured yet",
            "measured and taken in",
            "first measurement: no rate yet",
            "no measurement in this frame: predicted",
            "measurement contradicts the prediction: left out, predicted",
            "begun anew from this measurement, after an outage or several rejected frames",
            "no measurement for longer than the prediction is trusted",
        )[self]


class Contradiction(IntFlag):
    """Which parts of a rejected measurement contradict the prediction by themselves; 0: only both together."""

    POSITION = _kernels.POSITION
    ROTATION = _kernels.ROTATION


@dataclass(frozen=True, slots=True, kw_only=True)
class FilterSettings:
    """How mirrors move, and when a measurement is not believed.

    Attributes
    ----------
    rate_walk_radps_per_sqrt_s
        Random walk of the turning rate, each axis [rad/s/√s]; 0 = the rate is constant.
    pivot_walk_m_per_sqrt_s
        Random walk of the pivot, each axis [m/√s]; 0 = it stands still.
    rate_sigma_radps
        What the rate may be when nothing was measured yet, each axis [rad/s].
    gate_probability
        A measurement rarer than this under the prediction is left out.
    restart_after
        So many rejected frames in a row are believed after all: the filter begins anew from the last of them.
    max_coast_s
        A prediction older than this is given up [s].
    """

    rate_walk_radps_per_sqrt_s: float = 1e-6
    pivot_walk_m_per_sqrt_s: float = 0.0
    rate_sigma_radps: float = 1e-2
    gate_probability: float = 1e-6
    restart_after: int = 3
    max_coast_s: float = np.inf

    def __post_init__(self) -> None:
        for name in ("rate_walk_radps_per_sqrt_s", "pivot_walk_m_per_sqrt_s"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) >= 0.0):
                raise InvalidInputError(f"`{name}` must be finite and not negative, got {getattr(self, name)}")
        if not (np.isfinite(self.rate_sigma_radps) and self.rate_sigma_radps > 0.0):
            raise InvalidInputError(f"`rate_sigma_radps` must be finite and positive, got {self.rate_sigma_radps}")
        if not 0.0 < self.gate_probability < 1.0:
            raise InvalidInputError(f"`gate_probability` must lie between 0 and 1, got {self.gate_probability}")
        if self.restart_after < 1:
            raise InvalidInputError(f"`restart_after` must be at least 1, got {self.restart_after}")
        if not self.max_coast_s > 0.0:
            raise InvalidInputError(f"`max_coast_s` must be greater than zero, got {self.max_coast_s}")


@dataclass(frozen=True, slots=True, kw_only=True)
class FilterState:
    """All that the filter keeps of its mirrors between calls; arrays are read-only.

    Attributes
    ----------
    pivot_enu_m, rot_enu_from_mirror, rate_enu_radps : (mirror, xyz), (mirror, 3, 3), (mirror, xyz)
    cov : (mirror, 9, 9)
        Of pivot [m], rotation vector in ENU [rad] and rate [rad/s].
    time_s : (mirror, 2)
        Instant of the state, and of the last measurement taken in [s]; −infinity = none.
    count : (mirror, 2)
        Whether there is a state, and how many frames in a row were rejected.
    """

    pivot_enu_m: FloatArray
    rot_enu_from_mirror: FloatArray
    rate_enu_radps: FloatArray
    cov: FloatArray
    time_s: FloatArray
    count: IntArray


@dataclass(frozen=True, slots=True, kw_only=True)
class FilteredPoses:
    """Filtered poses, each at the instant ``time_s``; arrays are read-only.

    Attributes
    ----------
    time_s : (frame,)
        The instant of which the row speaks: the frame's middle plus the delay asked for [s].
    pivot_enu_m : (frame, mirror, xyz)
        [m]; NaN where nothing is known (UNKNOWN, LOST), like all that follows.
    rot_enu_from_mirror : (frame, mirror, 3, 3)
    rate_enu_radps : (frame, mirror, xyz)
        Turning rate [rad/s].
    cov : (frame, mirror, 9, 9)
        Of pivot [m], rotation vector in ENU [rad] and rate [rad/s].
    status : (frame, mirror)
        `FilterStatus`.
    distance2 : (frame, mirror)
        Squared Mahalanobis distance of the measured from the predicted pose, six degrees of freedom; NaN = no test.
    contradiction : (frame, mirror)
        `Contradiction` of rejected measurements.
    state
        To go on from, with the next frames.
    """

    time_s: FloatArray
    pivot_enu_m: FloatArray
    rot_enu_from_mirror: FloatArray
    rate_enu_radps: FloatArray
    cov: FloatArray
    status: IntArray
    distance2: FloatArray
    contradiction: IntArray
    state: FilterState

    @property
    def normal_enu(self) -> FloatArray:
        """(frame, mirror, xyz) unit normals."""
        return self.rot_enu_from_mirror[..., 2]

    @property
    def tilt_sigma_rad(self) -> FloatArray:
        """(frame, mirror) rms angle between filtered and true normal [rad]."""
        turn, normal = self.cov[..., 3:6, 3:6], self.normal_enu
        about = np.einsum("...a,...ab,...b->...", normal, turn, normal)
        return np.asarray(np.sqrt(np.trace(turn, axis1=-2, axis2=-1) - about))


def filter_poses(
    pivot_enu_m: npt.ArrayLike,
    rot_enu_from_mirror: npt.ArrayLike,
    cov: npt.ArrayLike,
    *,
    time_s: npt.ArrayLike,
    exposure_s: float = 0.0,
    usable: npt.ArrayLike | None = None,
    motion: FilterSettings | None = None,
    delay_s: float = 0.0,
    state: FilterState | None = None,
) -> FilteredPoses:
    """Filter poses of single frames over time: a Kalman filter on rotation, rate and pivot of each mirror [1]_.

    Parameters
    ----------
    pivot_enu_m, rot_enu_from_mirror : (frame, mirror, xyz), (frame, mirror, 3, 3)
        Poses as `solve_rigid` gives them; NaN = not measured: the filter coasts.
    cov : (frame, mirror, 6, 6)
        Of pivot [m] and rotation vector in ENU [rad]; errors of different frames are taken as independent.
    time_s : (frame,)
        Middle of each frame, increasing; gaps and unequal steps are allowed [s].
    exposure_s
        Length of a frame [s]. What a frame measures of a moving mirror is the mean posture over it, which is the
        posture of its middle where the rate is constant; where it walks, the difference counts as noise.
    usable : (frame, mirror), optional
        False = leave this measurement out, e.g. one whose residuals were marked.
    motion
        How mirrors move, and when a measurement is not believed.
    delay_s
        Poses are given this much after the frame's middle: half the exposure for its end, more for a controller that
        acts later [s].
    state
        What an earlier call ended with: one call for all frames equals many calls for a few.

    Returns
    -------
    FilteredPoses

    Raises
    ------
    InvalidInputError
        Shapes that do not fit, time that does not increase, a negative exposure.

    References
    ----------
    .. [1] Markley, Attitude error representations for Kalman filtering, J. Guidance 26 (2003) 311–317.
    """
    from scipy.special import chdtri

    pivot = as_float_array("pivot_enu_m", pivot_enu_m, ("frame", "mirror", 3), finite=False)
    n_frame, n_mirror = pivot.shape[:2]
    rot = as_float_array("rot_enu_from_mirror", rot_enu_from_mirror, (n_frame, n_mirror, 3, 3), finite=False)
    noise = as_float_array("cov", cov, (n_frame, n_mirror, 6, 6), finite=False)
    time = as_float_array("time_s", time_s, (n_frame,))
    kept = state or _nothing(n_mirror)
    if kept.count.shape != (n_mirror, 2):
        raise InvalidInputError(f"`state` must be of {n_mirror} mirrors, got {len(kept.count)}")
    if np.any(np.diff(time) <= 0.0) or (n_frame and np.any(time[0] <= kept.time_s[:, 0])):
        raise InvalidInputError("`time_s` must increase from frame to frame")
    if not (np.isfinite(exposure_s) and exposure_s >= 0.0):
        raise InvalidInputError(f"`exposure_s` must be finite and not negative, got {exposure_s}")
    if not np.isfinite(delay_s):
        raise InvalidInputError(f"`delay_s` must be finite, got {delay_s}")
    how = motion or FilterSettings()
    use = np.ones((n_frame, n_mirror), np.bool_) if usable is None else np.asarray(usable, np.bool_)
    if use.shape != (n_frame, n_mirror):
        raise InvalidInputError(f"`usable` must have shape {(n_frame, n_mirror)}, got {use.shape}")
    times, counts = np.array(kept.time_s), np.array(kept.count)
    now = [np.array(a) for a in (kept.pivot_enu_m, kept.rot_enu_from_mirror, kept.rate_enu_radps, kept.cov)]
    shape = (n_frame, n_mirror)
    out = [np.full((*shape, *a.shape[1:]), np.nan) for a in now]
    status, parts, distance = np.zeros(shape, np.int64), np.zeros(shape, np.int64), np.full(shape, np.nan)
    # arrays that are read-only or lie otherwise would be other types, for which all is compiled anew
    pivot, rot, noise, time = (np.require(a, requirements=["C", "W"]) for a in (pivot, rot, noise, time))
    _kernels.filter_many(
        n_mirror,
        pivot,
        rot,
        noise,
        np.require(use, requirements=["C", "W"]),
        float(exposure_s),
        how.rate_walk_radps_per_sqrt_s**2,
        how.pivot_walk_m_per_sqrt_s**2,
        how.rate_sigma_radps**2,
        chdtri([6, 3, 3], how.gate_probability),
        float(how.max_coast_s),
        how.restart_after,
        float(delay_s),
        time,
        times,
        counts,
        *now,
        *out,
        status,
        distance,
        parts,
    )
    names = ("pivot_enu_m", "rot_enu_from_mirror", "rate_enu_radps", "cov")
    return FilteredPoses(
        time_s=read_only(time + delay_s),
        **{name: read_only(a) for name, a in zip(names, out, strict=True)},
        status=read_only(status),
        distance2=read_only(distance),
        contradiction=read_only(parts),
        state=FilterState(
            **{name: read_only(a) for name, a in zip(names, now, strict=True)},
            time_s=read_only(times),
            count=read_only(counts),
        ),
    )


def _nothing(n_mirror: int) -> FilterState:
    """State before any measurement."""
    return FilterState(
        pivot_enu_m=np.zeros((n_mirror, 3)),
        rot_enu_from_mirror=np.tile(np.eye(3), (n_mirror, 1, 1)),
        rate_enu_radps=np.zeros((n_mirror, 3)),
        cov=np.zeros((n_mirror, 9, 9)),
        time_s=np.full((n_mirror, 2), -np.inf),
        count=np.zeros((n_mirror, 2), np.int64),
    )
