"""Delays between a mirror's receivers, learned over frames.

One nanosecond of cable between two receivers is 0.3 m. Unknown delays make three clocks of one; but they change slowly,
so that what one frame tells of them serves the next. A Kalman filter over frames keeps each mirror's clock differences
as random walks. In every frame they are measured together with the pose (three clocks); what the filter knew before
moves the pose by their correlation. To first order this is maximum likelihood with the prediction as prior, and the
pose's error is milliradians, so that first order is all there is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, as_float_array
from rfpose.errors import InvalidInputError
from rfpose.multilat.equations import rotate

__all__ = ["DelayState", "LearnedDelays", "learn_delays"]

UNSEEN_M = 10.0
"""Standard deviation of a difference that nothing has observed yet: 30 ns."""

_JUMP_PROBABILITY = 1e-9
"""Differences rarer than this under prediction and noise mean that a delay has jumped: it is learned anew."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DelayState:
    """All that the filter keeps of its mirrors between calls.

    Attributes
    ----------
    known : (mirror,)
        Whether a frame was solved.
    difference_m, difference_cov_m2 : (mirror, difference), (mirror, difference, difference)
        As in `LearnedDelays`, after the last frame [m].
    time_s : (mirror,)
        Of the last frame solved [s].
    """

    known: npt.NDArray[np.bool_]
    difference_m: FloatArray
    difference_cov_m2: FloatArray
    time_s: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class LearnedDelays:
    """Poses with what was learned of the delays, frame by frame.

    Attributes
    ----------
    pivot_enu_m : (frame, mirror, xyz)
        [m]; NaN where the frame was not solved, like all that follows.
    rot_enu_from_mirror : (frame, mirror, 3, 3)
    cov : (frame, mirror, 6, 6)
        Of pivot [m] and rotation vector in ENU [rad].
    difference_m : (frame, mirror, difference)
        Clock of each receiver less that of the mirror's first, class by class, after the frame [m].
    difference_cov_m2 : (frame, mirror, difference, difference)
        Its covariance.
    jumped : (frame, mirror)
        A delay had jumped; it was learned anew from this frame.
    state
        To go on from, with the next frames.
    unseen_m
        Standard deviation of differences that nothing has observed yet [m].
    """

    pivot_enu_m: FloatArray
    rot_enu_from_mirror: FloatArray
    cov: FloatArray
    difference_m: FloatArray
    difference_cov_m2: FloatArray
    jumped: npt.NDArray[np.bool_]
    state: DelayState
    unseen_m: float = UNSEEN_M


def learn_delays(
    pivot_enu_m: npt.ArrayLike,
    rot_enu_from_mirror: npt.ArrayLike,
    clock_m: npt.ArrayLike,
    cov: npt.ArrayLike,
    *,
    time_s: npt.ArrayLike,
    drift_m_per_sqrt_s: float,
    observed: npt.ArrayLike | None = None,
    state: DelayState | None = None,
) -> LearnedDelays:
    """Filter the clock differences of many mirrors over frames, and refine each frame's pose by them.

    Parameters
    ----------
    pivot_enu_m, rot_enu_from_mirror : (frame, mirror, xyz), (frame, mirror, 3, 3)
        Poses of single frames with one unknown clock a receiver; NaN = not solved.
    clock_m : (frame, mirror, class, receiver)
        Their clocks [m].
    cov : (frame, mirror, unknown, unknown)
        `full_covariance` of each: pivot, rotation, clocks.
    time_s : (frame,)
        Increasing [s].
    drift_m_per_sqrt_s
        Random-walk rate of each receiver's delay [m/√s]; 1 ps/√min is 3.9e-5.
    observed : (frame, mirror, class, receiver), optional
        Which clocks the frame's phases tell of (a carrier without integers tells nothing); default: all.
    state
        What an earlier call ended with: one call for all frames equals many calls for a few.

    Notes
    -----
    Walks of one receiver's classes (tones, carrier) may be the same or independent; covariances hold for either,
    because the walk is taken as large as the number of classes times its rate.

    Raises
    ------
    InvalidInputError
        Shapes that do not fit, time going back, a negative rate.
    """
    from scipy.special import chdtri

    pivot = np.array(as_float_array("pivot_enu_m", pivot_enu_m, ("frame", "mirror", 3), finite=False))
    n_frame, n_mirror = pivot.shape[:2]
    rot = np.array(as_float_array("rot_enu_from_mirror", rot_enu_from_mirror, (n_frame, n_mirror, 3, 3), finite=False))
    clock = as_float_array("clock_m", clock_m, (n_frame, n_mirror, "class", "receiver"), finite=False)
    n_class, n_receiver = clock.shape[2:]
    n_unknown = 6 + n_class * n_receiver
    whole = as_float_array("cov", cov, (n_frame, n_mirror, n_unknown, n_unknown), finite=False)
    time = as_float_array("time_s", time_s, (n_frame,))
    if np.any(np.diff(time) <= 0.0):
        raise InvalidInputError("`time_s` must increase from frame to frame")
    if not drift_m_per_sqrt_s >= 0.0:
        raise InvalidInputError(f"`drift_m_per_sqrt_s` must not be negative, got {drift_m_per_sqrt_s}")

    to_difference = np.kron(np.eye(n_class), np.column_stack([-np.ones(n_receiver - 1), np.eye(n_receiver - 1)]))
    walk = n_class * drift_m_per_sqrt_s**2 * to_difference @ to_difference.T
    seen_clock = np.ones(clock.shape, np.bool_) if observed is None else np.array(observed, np.bool_)
    if seen_clock.shape != clock.shape:
        raise InvalidInputError(f"`observed` must have the shape of `clock_m`, {clock.shape}, got {seen_clock.shape}")
    blind = ~(seen_clock[..., :1] & seen_clock[..., 1:]).reshape(n_frame, n_mirror, -1)
    n_difference = len(to_difference)
    limit = float(chdtri(n_difference, _JUMP_PROBABILITY))
    before = state or DelayState(
        known=np.zeros(n_mirror, np.bool_),
        difference_m=np.zeros((n_mirror, n_difference)),
        difference_cov_m2=np.zeros((n_mirror, n_difference, n_difference)),
        time_s=np.zeros(n_mirror),
    )
    known, seen_at = before.known.copy(), before.time_s.copy()
    mean, spread = before.difference_m, before.difference_cov_m2
    out_cov = np.full((n_frame, n_mirror, 6, 6), np.nan)
    out_state = np.full((n_frame, n_mirror, n_difference), np.nan)
    out_spread = np.full((n_frame, n_mirror, n_difference, n_difference), np.nan)
    jumped = np.zeros((n_frame, n_mirror), np.bool_)
    for f in range(n_frame):
        solved = np.isfinite(whole[f]).all(axis=(1, 2)) & np.isfinite(clock[f]).all(axis=(1, 2))
        measured = clock[f].reshape(n_mirror, -1) @ to_difference.T
        noise = to_difference @ whole[f][:, 6:, 6:] @ to_difference.T
        # what was not observed is held in the pose's covariance: here it is anything, and correlated with nothing
        either = blind[f][:, :, None] | blind[f][:, None, :]
        noise = np.where(either, np.eye(n_difference) * UNSEEN_M**2, noise)
        measured = np.where(blind[f], mean, measured)
        out_cov[f] = whole[f][:, :6, :6]
        predicted = spread + (time[f] - seen_at)[:, None, None] * walk
        both = solved & known
        innovation = np.where(both[:, None], measured - mean, 0.0)
        total = np.where(both[:, None, None], predicted + noise, np.eye(n_difference))
        weighed = np.linalg.solve(total, innovation[..., None])[..., 0]
        jumped[f] = both & (np.sum(innovation * weighed, axis=1) > limit)
        use = both & ~jumped[f]
        with_pose = np.where(blind[f][:, None], 0.0, whole[f][:, :6, 6:] @ to_difference.T)
        gain = np.linalg.solve(total, np.where(use[:, None, None], with_pose, 0.0).swapaxes(1, 2)).swapaxes(1, 2)
        move = -np.einsum("mad,md->ma", gain, innovation)
        pivot[f, use] += move[use, :3]
        for m in np.flatnonzero(use):
            turned = np.empty((3, 3))
            rotate(move[m, 3:], rot[f, m], turned)
            rot[f, m] = turned
        out_cov[f, use] -= (gain @ with_pose.swapaxes(1, 2))[use]
        kalman = np.where(use[:, None, None], np.linalg.solve(total, predicted).swapaxes(1, 2), 0.0)
        mean = np.where(use[:, None], mean + np.einsum("mab,mb->ma", kalman, innovation), mean)
        spread = np.where(use[:, None, None], predicted - kalman @ predicted, spread)
        first = solved & ~use
        mean, spread = np.where(first[:, None], measured, mean), np.where(first[:, None, None], noise, spread)
        seen_at[solved] = time[f]
        known |= solved
        out_state[f, solved], out_spread[f, solved] = mean[solved], spread[solved]
    return LearnedDelays(
        pivot_enu_m=pivot,
        rot_enu_from_mirror=rot,
        cov=out_cov,
        difference_m=out_state,
        difference_cov_m2=out_spread,
        jumped=jumped,
        state=DelayState(known=known, difference_m=mean, difference_cov_m2=spread, time_s=seen_at),
    )
