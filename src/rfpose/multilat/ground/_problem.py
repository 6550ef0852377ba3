"""Arrays of many mirrors for the kernels, their state between fits, and one fit at given coefficients."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, as_float_array
from rfpose.multilat.ground import _kernels
from rfpose.multilat.rigid.problem import MirrorProblem, start_clock

__all__ = ["CalibrationSight", "Problem", "State", "build"]

IntArray = npt.NDArray[np.int64]

MAX_ITERATION = 30
_FLOOR = 1e-13
NO_TURN: FloatArray = np.zeros((1, 3))


def plain_mean(shift_m: FloatArray, frames: IntArray) -> FloatArray:
    """`CalibrationSight.change_m` of receivers that count alike in every frame."""
    return np.broadcast_to(shift_m.mean(axis=0), (len(frames), *shift_m.shape[1:]))


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationSight:
    """Receivers whose phases make the electronic phases Φ, and so carry their own reflections into all ranges.

    Attributes
    ----------
    place_enu_m : (calibration receiver, xyz)
        [m]; empty where there is no calibration.
    frame : (mirror,)
        Frame of each mirror. None: all of one.
    change_m
        How ranges change that Φ is taken off, where the ranges of each receiver are changed by ``shift_m`` (calibration
        receiver, transmitter, tone, 1 + parameter) first: a range and its derivatives. Called with that and with frames
        (row,), it returns (row, transmitter, tone, 1 + parameter), up to one constant a row and tone. Tones are in the
        observations' order. Exact at any size: Φ is no linear mean of phases that differ by turns.
    """

    place_enu_m: FloatArray
    frame: IntArray | None = None
    change_m: Callable[[FloatArray, IntArray], FloatArray] = plain_mean

    @classmethod
    def checked(cls, sight: CalibrationSight | npt.ArrayLike | None) -> CalibrationSight:
        """Return a caller's; places alone mean a plain mean."""
        if sight is None:
            return cls(place_enu_m=np.empty((0, 3)))
        if isinstance(sight, CalibrationSight):
            return sight
        return cls(place_enu_m=as_float_array("calibration_enu_m", sight, ("calibration receiver", 3)))


@dataclass(slots=True, kw_only=True)
class State:
    """Where each mirror stands: mirror is the first axis. Changed in place by fits.

    ``cov`` (unknown, unknown) of pose and clocks is at given coefficients; ``follow`` is how pose and clocks move with
    the coefficients, ``schur`` and ``rest`` the information and gradient a mirror leaves for them.
    """

    pivot: FloatArray
    rot: FloatArray
    clock: FloatArray
    cov: FloatArray
    follow: FloatArray
    schur: FloatArray
    rest: FloatArray
    chi2: FloatArray
    n_iteration: IntArray
    status: IntArray

    @classmethod
    def begin(cls, pivot: FloatArray, rot: FloatArray, clock: FloatArray, status: IntArray, n_parameter: int) -> State:
        """Nothing solved yet."""
        n_mirror, n_class, n_receiver = clock.shape
        return cls(
            pivot=pivot.copy(),
            rot=rot.copy(),
            clock=clock.copy(),
            cov=np.full((n_mirror, *2 * (6 + n_class * n_receiver,)), np.nan),
            follow=np.zeros((n_mirror, 6 + n_class * n_receiver, n_parameter)),
            schur=np.zeros((n_mirror, n_parameter, n_parameter)),
            rest=np.zeros((n_mirror, n_parameter)),
            chi2=np.full(n_mirror, np.inf),
            n_iteration=np.zeros(n_mirror, np.int64),
            status=status.copy(),
        )

    def take(self, rows: IntArray) -> State:
        """Copy some mirrors."""
        return State(**{f.name: getattr(self, f.name)[rows].copy() for f in fields(self)})

    def copy(self) -> State:
        """Copy all."""
        return State(**{f.name: getattr(self, f.name).copy() for f in fields(self)})

    def put(self, rows: IntArray, other: State) -> None:
        """Write mirrors back."""
        for f in fields(self):
            getattr(self, f.name)[rows] = getattr(other, f.name)

    def move(self, step: FloatArray) -> None:
        """Let poses and clocks follow a change of the coefficients, to first order."""
        from scipy.spatial.transform import Rotation

        change = self.follow @ step
        self.pivot += change[:, :3]
        turn = change[:, 3:6]
        length = np.linalg.norm(turn, axis=1, keepdims=True)
        turn = turn * np.minimum(1.0, 0.2 / np.maximum(length, 1e-300))
        self.rot[:] = np.where(
            np.isfinite(self.rot), Rotation.from_rotvec(np.nan_to_num(turn)).as_matrix() @ self.rot, np.nan
        )
        self.clock += change[:, 6:].reshape(self.clock.shape)


@dataclass(frozen=True, slots=True, kw_only=True)
class Problem:
    """Measurements of mirrors, what is known of them, and the planes.

    Attributes
    ----------
    scene
        Coefficients given are in it; estimated ones are put in by `fit`.
    mirrors
    calibration
        Whose reflections Φ carries.
    dof : (mirror,)
        Measurements and priors less a mirror's own unknowns.
    """

    scene: _kernels.Scene
    mirrors: _kernels.Mirrors
    calibration: CalibrationSight
    dof: FloatArray

    @property
    def frames(self) -> IntArray:
        """(row,) frames of the mirrors, in the order that ``mirrors.frame`` counts."""
        given = self.calibration.frame
        return np.zeros(1, np.int64) if given is None else np.unique(given)

    @property
    def n_parameter(self) -> int:
        """Real and imaginary parts of all estimated coefficients."""
        return 2 * int(np.sum(self.scene.column >= 0))

    def first_parameter(self) -> FloatArray:
        """No reflection; as Fresnel's formulas have it where they give the coefficient."""
        free = self.scene.column >= 0
        return np.stack([self.scene.kind[free] != 0, np.zeros(int(free.sum()))], axis=1).astype(np.float64).ravel()

    def clip(self, parameter: FloatArray) -> FloatArray:
        """Keep coefficients below one, where phases would turn over, and factors on Fresnel's formulas below two."""
        size = np.maximum(np.hypot(parameter[0::2], parameter[1::2]), 1e-300)
        largest = np.where(self.scene.kind[self.scene.column >= 0] == 0, 0.95, 2.0)
        return np.asarray(parameter * np.repeat(np.minimum(1.0, largest / size), 2))

    def take(self, rows: IntArray) -> Problem:
        """Select mirrors."""
        m = self.mirrors
        mirrors = m._replace(
            **{name: getattr(m, name)[rows] for name in m._fields if name not in ("clock_class", "roll_info")}
        )
        calibration = self.calibration
        if calibration.frame is not None:
            frame = calibration.frame[rows]
            calibration, mirrors = replace(calibration, frame=frame), mirrors._replace(frame=_rank(frame))
        return replace(self, mirrors=mirrors, calibration=calibration, dof=self.dof[rows])

    def scene_at(self, parameter: FloatArray) -> _kernels.Scene:
        """Return the scene with estimated coefficients put in, and with what the calibration carries of them.

        Carriers have none of it: what is common to a mirror's receivers is unknown there anyway.
        """
        coefficient = self.scene.coefficient.copy()
        free = self.scene.column >= 0
        coefficient[free] = parameter[0::2] + 1j * parameter[1::2]
        scene = self.scene._replace(coefficient=coefficient)
        place = self.calibration.place_enu_m
        if not (len(place) and len(coefficient)):
            return scene
        n_transmitter, n_group, n_value = scene.common.shape[1:]
        seen = np.zeros((len(place), n_transmitter, n_group, 3 + n_value))
        _kernels.shifts_at_points(len(place), scene, place, seen)
        tones = np.flatnonzero(scene.tone_k)
        common = np.zeros((len(self.frames), n_transmitter, n_group, n_value))
        common[:, :, tones] = self.calibration.change_m(np.delete(seen, (1, 2, 3), axis=3)[:, :, tones], self.frames)
        return scene._replace(common=common)

    def fit(
        self,
        state: State,
        parameter: FloatArray,
        *,
        turn: FloatArray = NO_TURN,
        enough: FloatArray | float = np.inf,
        max_iteration: int = MAX_ITERATION,
    ) -> None:
        """Solve every mirror at given coefficients from where ``state`` stands, or from there turned by ``turn``.

        One that does not converge keeps pose and chi² of its last step.
        """
        n_mirror = len(state.chi2)
        _kernels.fit_many(
            n_mirror,
            self.scene_at(parameter),
            self.mirrors,
            max_iteration,
            _FLOOR,
            turn,
            np.array(np.broadcast_to(enough, (n_mirror,)), np.float64),
            state.pivot,
            state.rot,
            state.clock,
            state.cov,
            state.follow,
            state.schur,
            state.rest,
            state.chi2,
            state.n_iteration,
            state.status,
        )

    def predict(self, state: State, parameter: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Ranges (mirror, group, receiver, transmitter) and their derivatives (…, 6 + parameter)."""
        predicted = np.empty(self.mirrors.z.shape)
        slope = np.empty((*predicted.shape, 6 + self.n_parameter))
        scene = self.scene_at(parameter)
        mirrors = self.mirrors
        _kernels.predict_many(
            len(state.pivot), scene, mirrors.frame, mirrors.receiver_mirror, state.pivot, state.rot, predicted, slope
        )
        return predicted, slope

    def direct(self) -> Problem:
        """Leave all reflections out."""
        scene = self.scene
        n_transmitter, n_group, _ = scene.common.shape[1:]
        return replace(
            self,
            calibration=CalibrationSight(place_enu_m=np.empty((0, 3))),
            mirrors=self.mirrors._replace(frame=np.zeros_like(self.mirrors.frame)),
            scene=scene._replace(
                image=scene.image[:0],
                normal=scene.normal[:0],
                kind=scene.kind[:0],
                permittivity=scene.permittivity[:0],
                coefficient=scene.coefficient[:0],
                column=scene.column[:0],
                common=np.zeros((1, n_transmitter, n_group, 1)),
            ),
        )


def build(
    scene: _kernels.Scene, mirrors: MirrorProblem, *, calibration: CalibrationSight | npt.ArrayLike | None
) -> tuple[Problem, FloatArray]:
    """Lay out mirrors with their integers resolved; also clocks (mirror, class, receiver) that fit where they begin."""
    calibration = CalibrationSight.checked(calibration)
    equations = mirrors.equations
    clock = start_clock(mirrors, mirrors.start_pivot_enu_m, mirrors.start_rot_enu_from_mirror)
    arrays = _kernels.Mirrors(
        receiver_mirror=np.ascontiguousarray(mirrors.receiver_mirror_m),
        z=np.nan_to_num(mirrors.range_m),
        weight=equations.weight,
        bias_info=equations.bias_info,
        clock_class=mirrors.clock_class,
        pivot_prior=equations.pivot,
        pivot_info=equations.pivot_info,
        roll_info=equations.roll_info,
        clock_own=equations.clock_own,
        clock_tie=equations.clock_tie,
        clock_prior=clock.copy(),
        frame=np.zeros(len(clock), np.int64) if calibration.frame is None else _rank(calibration.frame),
    )
    return Problem(scene=scene, mirrors=arrays, calibration=calibration, dof=equations.dof), clock


def _rank(frame: IntArray) -> IntArray:
    """Return each frame's place among those there are."""
    return np.asarray(np.unique(frame, return_inverse=True)[1].reshape(-1), np.int64)
