"""What is measured of rigid mirrors and what is known of them besides: the record that all their solvers take."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from rfpose import geometry
from rfpose.checks import FloatArray, as_float_array
from rfpose.errors import GeometryError, InvalidInputError

__all__ = ["PRIORS", "MirrorKnowledge", "MirrorProblem", "Observation"]

BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int64]

PRIORS = ("pivot", "mount", "clocks")
"""What a mirror may rest on besides its phases."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MirrorKnowledge:
    """What is known about mirrors besides the phases.

    Attributes
    ----------
    clock_sigma_m
        Standard deviation of each receiver's delay about the mirror's common clock [m]: 0 means one shared clock
        with known delays, infinity one unknown clock a receiver.
    pivot_enu_m : (mirror, xyz) or None
        Surveyed pivots [m].
    pivot_sigma_m
        Their standard deviation in each axis [m].
    two_axis
        The mirror stands on an azimuth-elevation mount: its x axis stays horizontal.
    roll_sigma_rad
        How well it does.
    """

    clock_sigma_m: float = np.inf
    pivot_enu_m: FloatArray | None = None
    pivot_sigma_m: float = np.inf
    two_axis: bool = False
    roll_sigma_rad: float = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True)
class Observation:
    """One wavelength's phases as ranges: a tone, or the carrier.

    Attributes
    ----------
    range_m : (mirror, receiver, transmitter)
        −λ/(2π) × phase, up to whole wavelengths [m]; NaN = not received.
    sigma_m : (mirror, receiver, transmitter)
        Own noise [m].
    transmitter_sigma_m : (mirror, transmitter)
        Error common to all receivers [m]; infinity where nothing calibrates it.
    wavelength_m : (transmitter,)
        [m].
    clock_class
        Which clocks it sees: those of one number are the same.
    carrier
        Whether it is the carrier's own phase.
    """

    range_m: FloatArray
    sigma_m: FloatArray
    transmitter_sigma_m: FloatArray
    wavelength_m: FloatArray
    clock_class: int
    carrier: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class MirrorProblem:
    """Mirrors to be solved; `of`, `of_observations` and `expected` make one and check it.

    A group is one wavelength's phases: tones, coarsest first, then the carrier.

    Attributes
    ----------
    transmitter_enu_m : (transmitter, xyz)
        [m].
    receiver_mirror_m : (mirror, receiver, xyz)
        From the pivot, in the mirror frame [m].
    range_m : (mirror, group, receiver, transmitter)
        Range plus clock [m]; NaN = not received.
    sigma_m : (mirror, group, receiver, transmitter)
        Own noise of each [m]; NaN or infinity = not received.
    transmitter_sigma_m : (mirror, group, transmitter)
        Error common to all receivers: of the calibration; infinity without one [m].
    clock_class : (group,)
        Which clocks a group sees.
    start_pivot_enu_m, start_rot_enu_from_mirror : (mirror, xyz), (mirror, 3, 3)
        Where to begin; NaN: nowhere.
    knowledge
        Clocks, pivot and mount.
    wavelength_m : (group, transmitter)
        [m]; NaN where whole wavelengths are resolved already and nobody asks.
    is_carrier : (group,)
    dropped : (mirror, prior)
        Which of `PRIORS` is known but not used.
    """

    transmitter_enu_m: FloatArray
    receiver_mirror_m: FloatArray
    range_m: FloatArray
    sigma_m: FloatArray
    transmitter_sigma_m: FloatArray
    clock_class: IntArray
    start_pivot_enu_m: FloatArray
    start_rot_enu_from_mirror: FloatArray
    knowledge: MirrorKnowledge
    wavelength_m: FloatArray
    is_carrier: BoolArray
    dropped: BoolArray

    @classmethod
    def of(
        cls,
        transmitter_enu_m: npt.ArrayLike,
        receiver_mirror_m: npt.ArrayLike,
        range_m: npt.ArrayLike,
        *,
        sigma_m: npt.ArrayLike,
        transmitter_sigma_m: npt.ArrayLike,
        clock_class: npt.ArrayLike,
        start_pivot_enu_m: npt.ArrayLike,
        start_rot_enu_from_mirror: npt.ArrayLike,
        knowledge: MirrorKnowledge | None = None,
    ) -> MirrorProblem:
        """Return mirrors whose whole wavelengths are resolved; arrays as the attributes, broadcast.

        Raises
        ------
        InvalidInputError
            Shapes that do not fit, a sigma that is not positive.
        GeometryError
            Receivers on a line.
        """
        transmitter = as_float_array("transmitter_enu_m", transmitter_enu_m, ("transmitter", 3))
        z = as_float_array("range_m", range_m, ("mirror", "group", "receiver", "transmitter"), finite=False)
        n_mirror, n_group, n_receiver, n_transmitter = z.shape
        if n_transmitter != len(transmitter):
            raise InvalidInputError(
                f"`range_m` has {n_transmitter} transmitters, `transmitter_enu_m` {len(transmitter)}"
            )
        sigma = np.broadcast_to(np.asarray(sigma_m, np.float64), z.shape)
        if np.any(sigma <= 0.0):
            raise InvalidInputError("`sigma_m` must be greater than zero")
        known = knowledge or MirrorKnowledge()
        if known.pivot_enu_m is not None:
            known = replace(known, pivot_enu_m=_spread(known.pivot_enu_m, (n_mirror, 3)))
        return cls(
            transmitter_enu_m=transmitter,
            receiver_mirror_m=_places(receiver_mirror_m, n_mirror, n_receiver),
            range_m=z,
            sigma_m=sigma,
            transmitter_sigma_m=_spread(transmitter_sigma_m, (n_mirror, n_group, n_transmitter)),
            clock_class=np.asarray(clock_class, np.int64),
            start_pivot_enu_m=_spread(start_pivot_enu_m, (n_mirror, 3)),
            start_rot_enu_from_mirror=_spread(start_rot_enu_from_mirror, (n_mirror, 3, 3)),
            knowledge=known,
            wavelength_m=np.full((n_group, n_transmitter), np.nan),
            is_carrier=np.zeros(n_group, np.bool_),
            dropped=np.zeros((n_mirror, len(PRIORS)), np.bool_),
        )

    @classmethod
    def of_observations(
        cls,
        transmitter_enu_m: npt.ArrayLike,
        receiver_mirror_m: npt.ArrayLike,
        observations: Sequence[Observation],
        *,
        start_pivot_enu_m: npt.ArrayLike,
        start_rot_enu_from_mirror: npt.ArrayLike,
        knowledge: MirrorKnowledge | None = None,
    ) -> MirrorProblem:
        """Return mirrors whose finer wavelengths are to be resolved: tones, coarsest first, then the carrier.

        Raises
        ------
        InvalidInputError, GeometryError
            As `of`; no tone, or a tone after the carrier.
        """
        carrier = [o.carrier for o in observations]
        if not observations or carrier[0] or carrier != sorted(carrier):
            raise InvalidInputError("`observations` must hold at least one tone, and tones before the carrier")
        shape = np.shape(observations[0].range_m)
        n_transmitter = len(np.asarray(transmitter_enu_m))
        for k, o in enumerate(observations):
            if np.ndim(o.range_m) != 3 or np.shape(o.range_m) != shape or shape[2] != n_transmitter:
                raise InvalidInputError(
                    f"`range_m` of observation {k} must have shape (mirror, receiver, {n_transmitter}) like the first, "
                    f"got {np.shape(o.range_m)}"
                )
        problem = cls.of(
            transmitter_enu_m,
            receiver_mirror_m,
            np.stack([o.range_m for o in observations], axis=1),
            sigma_m=np.stack([np.broadcast_to(o.sigma_m, shape) for o in observations], axis=1),
            transmitter_sigma_m=np.stack(
                [np.broadcast_to(o.transmitter_sigma_m, (shape[0], shape[2])) for o in observations], axis=1
            ),
            clock_class=[o.clock_class for o in observations],
            start_pivot_enu_m=start_pivot_enu_m,
            start_rot_enu_from_mirror=start_rot_enu_from_mirror,
            knowledge=knowledge,
        )
        waves = np.stack([np.broadcast_to(np.asarray(o.wavelength_m, np.float64), shape[2:]) for o in observations])
        return replace(problem, wavelength_m=waves, is_carrier=np.array(carrier))

    @classmethod
    def expected(
        cls,
        transmitter_enu_m: npt.ArrayLike,
        receiver_mirror_m: npt.ArrayLike,
        pivot_enu_m: npt.ArrayLike,
        rot_enu_from_mirror: npt.ArrayLike,
        *,
        sigma_m: npt.ArrayLike,
        transmitter_sigma_m: npt.ArrayLike,
        clock_class: npt.ArrayLike,
        knowledge: MirrorKnowledge | None = None,
    ) -> MirrorProblem:
        """Return mirrors in known poses, of which nothing is measured yet: for bounds. Arrays as in `of`."""
        sigma = as_float_array("sigma_m", sigma_m, ("mirror", "group", "receiver", "transmitter"), finite=False)
        return cls.of(
            transmitter_enu_m,
            receiver_mirror_m,
            np.where(np.isfinite(sigma), 0.0, np.nan),
            sigma_m=sigma,
            transmitter_sigma_m=transmitter_sigma_m,
            clock_class=clock_class,
            start_pivot_enu_m=pivot_enu_m,
            start_rot_enu_from_mirror=rot_enu_from_mirror,
            knowledge=knowledge,
        )

    def observation(self, k: int) -> Observation:
        """Return one wavelength's phases."""
        return Observation(
            range_m=self.range_m[:, k],
            sigma_m=self.sigma_m[:, k],
            transmitter_sigma_m=self.transmitter_sigma_m[:, k],
            wavelength_m=self.wavelength_m[k],
            clock_class=int(self.clock_class[k]),
            carrier=bool(self.is_carrier[k]),
        )


def _places(receiver_mirror_m: npt.ArrayLike, n_mirror: int, n_receiver: int) -> FloatArray:
    """Receivers in the mirror frame, one row a mirror; three or more, not on a line."""
    places = as_float_array("receiver_mirror_m", receiver_mirror_m, ("...", n_receiver, 3))
    for mirror in places.reshape(-1, n_receiver, 3)[:1]:
        if n_receiver < 3 or geometry.is_collinear(mirror):
            raise GeometryError("`receiver_mirror_m` must hold three or more receivers that are not on a line")
    return np.array(np.broadcast_to(places, (n_mirror, n_receiver, 3)))


def _spread(values: npt.ArrayLike, shape: tuple[int, ...]) -> FloatArray:
    return np.array(np.broadcast_to(np.asarray(values, np.float64), shape))
