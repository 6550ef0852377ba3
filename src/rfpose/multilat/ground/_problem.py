"""Arrays of many mirrors for the kernels, their state between fits, and one fit at given coefficients."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, as_float_array
from rfpose.multilat.equations import MirrorArrays
from rfpose.multilat.reflection import SharedGeometry, direct_rays, shifts_at_points
from rfpose.multilat.rigid.pose import FLOOR, FitRule, RigidFits, begin, fit, predict
from rfpose.multilat.rigid.problem import MirrorProblem
from rfpose.multilat.rigid.weights import equations_of

__all__ = ["CalibrationSight", "GroundProblem", "build", "follow"]

IntArray = npt.NDArray[np.int64]

_RULE = FitRule(max_iteration=30, floor=FLOOR, longest_turn=0.2, settled=1e-4)
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
        Where they are surveyed [m]; empty where there is no calibration.
    survey_sigma_m : (calibration receiver,)
        How well, in each axis, as far as ``transmitter_sigma_m`` of what is solved does not count it [m]; None:
        exactly. A receiver elsewhere sees another reflection, too, and all its ranges are off together.
    frame : (mirror,)
        Frame of each mirror. None: all of one.
    change_m
        How ranges change that Φ is taken off, where the ranges of each receiver are changed by ``shift_m`` (calibration
        receiver, transmitter, tone, 1 + k) first: a range and its k derivatives. Called with that and with frames
        (row,), it returns (row, transmitter, tone, 1 + k), up to one constant a row and tone. Tones are in the
        observations' order. Exact at any size: Φ is no linear mean of phases that differ by turns.
    """

    place_enu_m: FloatArray
    survey_sigma_m: FloatArray | None = None
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

    def by_survey(self, slope: FloatArray) -> FloatArray:
        """Return derivatives of receivers' ranges by the three axes of every receiver that is not surveyed exactly.

        Parameters
        ----------
        slope : (calibration receiver, transmitter, tone, xyz)
            Of a receiver's ranges by its own place.

        Returns
        -------
        (calibration receiver, transmitter, tone, 3 × unsure receiver)
            In standard deviations [m].
        """
        sigma = np.zeros(len(slope)) if self.survey_sigma_m is None else self.survey_sigma_m
        unsure = np.flatnonzero(sigma)
        out = np.zeros((*slope.shape[:3], len(unsure), 3))
        for k, c in enumerate(unsure):
            out[c, :, :, k] = sigma[c] * slope[c]
        return out.reshape(*slope.shape[:3], -1)


def follow(fits: RigidFits, step: FloatArray) -> None:
    """Let mirrors' own unknowns follow a change of the coefficients, to first order."""
    from scipy.spatial.transform import Rotation

    change = fits.follow @ step
    fits.pivot[:] += change[:, :3]
    turn = change[:, 3:6]
    length = np.linalg.norm(turn, axis=1, keepdims=True)
    turn = turn * np.minimum(1.0, 0.2 / np.maximum(length, 1e-300))
    rot = Rotation.from_rotvec(np.nan_to_num(turn)).as_matrix() @ fits.rot
    fits.rot[:] = np.where(np.isfinite(fits.rot), rot, np.nan)
    fits.clock[:] += change[:, 6 : 6 + fits.clock[0].size].reshape(fits.clock.shape)
    fits.survey[:] += change[:, 6 + fits.clock[0].size :]


@dataclass(frozen=True, slots=True, kw_only=True)
class GroundProblem:
    """Measurements of mirrors, what is known of them, and the planes.

    Attributes
    ----------
    scene
        Coefficients given are in it; estimated ones are put in by `fit`.
    mirrors
    calibration
        Whose reflections and survey Φ carries.
    dof : (mirror,)
        Measurements and priors less a mirror's own unknowns.
    """

    scene: SharedGeometry
    mirrors: MirrorArrays
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

    @property
    def n_survey(self) -> int:
        """Coordinates of calibration receivers that are not surveyed exactly: unknowns of each mirror."""
        sigma = self.calibration.survey_sigma_m
        return 0 if sigma is None or not len(self.scene.coefficient) else 3 * int(np.count_nonzero(sigma))

    def first_parameter(self) -> FloatArray:
        """No reflection; as Fresnel's formulas have it where they give the coefficient."""
        free = self.scene.column >= 0
        return np.stack([self.scene.kind[free] != 0, np.zeros(int(free.sum()))], axis=1).astype(np.float64).ravel()

    def clip(self, parameter: FloatArray) -> FloatArray:
        """Keep coefficients below one, where phases would turn over, and factors on Fresnel's formulas below two."""
        size = np.maximum(np.hypot(parameter[0::2], parameter[1::2]), 1e-300)
        largest = np.where(self.scene.kind[self.scene.column >= 0] == 0, 0.95, 2.0)
        return np.asarray(parameter * np.repeat(np.minimum(1.0, largest / size), 2))

    def take(self, rows: IntArray) -> GroundProblem:
        """Select mirrors."""
        mirrors = self.mirrors.take(rows)
        calibration = self.calibration
        if calibration.frame is not None:
            frame = calibration.frame[rows]
            calibration, mirrors = replace(calibration, frame=frame), mirrors._replace(frame=_rank(frame))
        return replace(self, mirrors=mirrors, calibration=calibration, dof=self.dof[rows])

    def scene_at(self, parameter: FloatArray) -> SharedGeometry:
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
        n_transmitter, n_group = len(scene.transmitter), len(scene.tone_k)
        seen = np.zeros((len(place), n_transmitter, n_group, 4 + self.n_parameter))
        shifts_at_points(len(place), scene, place, seen)
        away = place[:, None] - scene.transmitter
        away /= np.linalg.norm(away, axis=2, keepdims=True)
        by_survey = self.calibration.by_survey(away[:, :, None] + seen[..., 1:4])
        seen = np.concatenate([seen[..., :1], by_survey, seen[..., 4:]], axis=3)
        tones = np.flatnonzero(scene.tone_k)
        common = np.zeros((len(self.frames), n_transmitter, n_group, seen.shape[3]))
        common[:, :, tones] = self.calibration.change_m(seen[:, :, tones], self.frames)
        return scene._replace(common=common)

    def begin(self, pivot: FloatArray, rot: FloatArray, status: IntArray) -> RigidFits:
        """Return mirrors from which to begin, with the clocks that fit them best."""
        n_cov = 6 + self.mirrors.prior.clock[0].size
        counts = {"n_cov": n_cov, "n_survey": self.n_survey, "n_parameter": self.n_parameter}
        return begin(self.mirrors, pivot, rot, status, **counts)

    def fit(
        self,
        fits: RigidFits,
        parameter: FloatArray,
        *,
        turn: FloatArray = NO_TURN,
        enough: FloatArray | float = np.inf,
        max_iteration: int = _RULE.max_iteration,
    ) -> None:
        """`rfpose.multilat.rigid.pose.fit` of every mirror at given coefficients."""
        rule = _RULE._replace(max_iteration=max_iteration)
        fit(self.scene_at(parameter), self.mirrors, rule, fits, turn=turn, enough=enough)

    def predict(self, fits: RigidFits, parameter: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Ranges (mirror, group, receiver, transmitter) and their derivatives (…, 6 + parameter)."""
        predicted, slope = predict(self.scene_at(parameter), self.mirrors, fits)
        return predicted, np.delete(slope, np.arange(6, 6 + self.n_survey), axis=-1)

    def direct(self) -> GroundProblem:
        """Leave all reflections out."""
        if self.n_survey:  # which count still
            n_plane = len(self.scene.coefficient)
            none, given = np.zeros(n_plane, np.complex128), np.full(n_plane, -1, np.int64)
            dark = self.scene._replace(coefficient=none, column=given, common=self.scene.common[..., :1].copy())
            return replace(self, scene=dark)
        return replace(
            self,
            calibration=CalibrationSight(place_enu_m=np.empty((0, 3))),
            mirrors=self.mirrors._replace(frame=np.zeros_like(self.mirrors.frame)),
            scene=direct_rays(self.scene.transmitter, len(self.scene.tone_k)),
        )


def build(
    scene: SharedGeometry, mirrors: MirrorProblem, *, calibration: CalibrationSight | npt.ArrayLike | None
) -> GroundProblem:
    """Lay out mirrors with their integers resolved."""
    calibration = CalibrationSight.checked(calibration)
    arrays, dof = equations_of(mirrors)
    if calibration.frame is not None:
        arrays = arrays._replace(frame=_rank(calibration.frame))
    return GroundProblem(scene=scene, mirrors=arrays, calibration=calibration, dof=dof)


def _rank(frame: IntArray) -> IntArray:
    """Return each frame's place among those there are."""
    return np.asarray(np.unique(frame, return_inverse=True)[1].reshape(-1), np.int64)
