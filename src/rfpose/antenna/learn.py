"""Antenna patterns learned from carriers that mirrors of one type received in many postures.

What a receiver hears is, direction by direction, linear in the currents that stand for its antenna and its plate. What
is not known beside them is taken out of the equations: a complex factor a mirror, posture and transmitter, common to
the receivers, by projection; errors of the postures as noise that their covariance describes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from rfpose.antenna.currents import Currents, MirrorType
from rfpose.antenna.pattern import AntennaPattern
from rfpose.antenna.sphere import ComplexArray, grid_directions
from rfpose.checks import FloatArray, as_float_array, as_positive, read_only
from rfpose.errors import InvalidInputError
from rfpose.propagation import RayKind, Rays

__all__ = ["LearnedPattern", "PostureCarriers", "learn_pattern"]

_FREEDOM = 3.0
"""Of Student's t, by which links that reflections disturb weigh less."""
_FIRST_FLOOR = 1.0
_LESS_A_ROUND = 1.6
"""The floor falls by no more than this a round: a pattern that is far off yet must not be trusted link by link."""
_MOST_ROUNDS = 30
_SETTLED, _SETTLED_FLOOR = 2e-3, 0.02
_FEWEST_LEFT = 0.1
"""Of the equations: fewer left over after all that is fitted do not tell a floor."""
_HELD_OUT = 5
"""One posture of so many is held out to choose the prior and to tell what the pattern foresees."""
_STRENGTHS = (0.1, 0.3)
"""Of a plate's current at `_NEAR_M` from the antenna, in dipoles; they fall with the distance."""
_NEAR_M = 0.2
_OWN_SIGMA = 0.3
_STRENGTHS_NEAR, _OWN_SIGMA_NEAR = (0.01, 0.03, 0.1), 0.1
"""The same about a pattern that is nearly known."""
_FIXED = 1e6
_NEAR_RAD = np.radians(10.0)
_UNSURE = 0.1
_UNDETERMINED = ("a factor common to all receivers", "a rotation common to all postures")

BoolArray = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True, kw_only=True)
class PostureCarriers:
    """Carriers that mirrors of one type received, each mirror in each posture a row, and what is known of the rows.

    Attributes
    ----------
    amplitude : (posture, receiver, transmitter)
        Complex amplitudes of the carriers, as h in exp(+jωt); NaN = not received. A factor common to the receivers of a
        posture and transmitter means nothing.
    rays
        Foreseen rays of the links, in the believed postures; ``mirror`` of their numbering is the posture. Without rays
        of the mirror's own plate, which belong to the pattern.
    pivot_enu_m : (posture, xyz)
        Believed pivots [m].
    rot_enu_from_mirror : (posture, xyz, xyz)
        Believed orientations. NaN = unknown; such a row is left out.
    wavelength_m : (transmitter,)
        Of the carriers [m].
    rotation_sigma_rad, pivot_sigma_m
        Errors (1 σ, each axis) of the postures: independent from row to row.

    Raises
    ------
    InvalidInputError
        Wrong shapes or values, or rays that do not fit.
    """

    amplitude: ComplexArray
    rays: Rays
    pivot_enu_m: FloatArray
    rot_enu_from_mirror: FloatArray
    wavelength_m: FloatArray
    rotation_sigma_rad: float = 0.005
    pivot_sigma_m: float = 0.005

    def __post_init__(self) -> None:
        put = object.__setattr__
        amplitude = np.asarray(self.amplitude, np.complex128)
        if amplitude.ndim != 3 or min(amplitude.shape) < 1 or amplitude.shape[1] < 2:
            raise InvalidInputError(
                "`amplitude` must have shape (posture, receiver, transmitter) with two receivers or more, got "
                f"{amplitude.shape}"
            )
        n_posture, _, n_transmitter = amplitude.shape
        put(self, "amplitude", read_only(amplitude))
        put(self, "pivot_enu_m", as_float_array("pivot_enu_m", self.pivot_enu_m, (n_posture, 3), finite=False))
        rot = as_float_array("rot_enu_from_mirror", self.rot_enu_from_mirror, (n_posture, 3, 3), finite=False)
        put(self, "rot_enu_from_mirror", rot)
        put(self, "wavelength_m", as_float_array("wavelength_m", self.wavelength_m, (n_transmitter,), positive=True))
        put(self, "rotation_sigma_rad", as_positive("rotation_sigma_rad", self.rotation_sigma_rad))
        put(self, "pivot_sigma_m", as_positive("pivot_sigma_m", self.pivot_sigma_m))
        if len(self.rays.first) != amplitude.size + 1:
            raise InvalidInputError(f"`rays` must be of {amplitude.size} links, got {len(self.rays.first) - 1}")
        if np.any(self.rays.kind == RayKind.OWN_PLATE):
            raise InvalidInputError(
                "`rays` must not hold the mirror's own plate, which is what is learned: leave it out"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class LearnedPattern:
    """A pattern, how far it is known, and what it explains.

    A factor common to all receivers is undetermined and means nothing. So is a rotation that the errors of all postures
    have in common: it turns the pattern with it, and poses that are found with the pattern have it too; only reference
    poses (a camera, a surveyed mirror) tell it.

    Attributes
    ----------
    pattern
        With its errors over direction as ``sigma``.
    coefficient : (receiver, element)
        The currents.
    covariance : (receiver · element, receiver · element)
        Of the coefficients, complex: of E[δ δᴴ]; without the common factor.
    floor
        What is left a link, relative to the direct field: mostly reflections that the rays lack.
    floor_held_out
        The same in postures that were held out while learning; NaN: there were fewer than ten.
    floor_dipole
        The same with dipoles in free space for a pattern.
    strength
        Of the prior, as chosen by the postures held out.
    heard : (receiver, polar, azimuth)
        Rays that came from within ten degrees of each of the pattern's directions. Where there are none the pattern
        rests on what currents on a plate can do; its ``sigma`` tells how far.
    settled
        Whether pattern and floor had come to rest when the rounds were over.
    n_posture, n_link
        What was used.
    """

    pattern: AntennaPattern
    coefficient: ComplexArray
    covariance: ComplexArray
    floor: float
    floor_held_out: float
    floor_dipole: float
    strength: float
    heard: npt.NDArray[np.int64]
    settled: bool
    n_posture: int
    n_link: int

    @property
    def explained(self) -> float:
        """Variance, of postures held out, that the pattern explains of what a lone dipole leaves."""
        return 1.0 - (self.floor_held_out / self.floor_dipole) ** 2

    @property
    def unheard(self) -> tuple[float, ...]:
        """(receiver,) part of the sphere from within ten degrees of which no ray came."""
        return self._part_of_sphere(self.heard == 0)

    @property
    def unsure(self) -> tuple[float, ...]:
        """(receiver,) part of the sphere where the pattern is known to no better than a tenth of a dipole."""
        return self._part_of_sphere(self.pattern.sigma[0] > _UNSURE)

    def _part_of_sphere(self, where: BoolArray) -> tuple[float, ...]:
        area = np.sin(np.linspace(0.0, np.pi, where.shape[1]))[:, None] * np.ones(where.shape[2])
        return tuple(float(np.average(one, weights=area)) for one in where)

    def as_dict(self) -> dict[str, Any]:
        """Return what was learned, ready for JSON; NaN where too few postures could be held out."""
        return {
            "postures": self.n_posture,
            "links": self.n_link,
            "settled": self.settled,
            "floor": self.floor,
            "floor_held_out": self.floor_held_out,
            "floor_dipole": self.floor_dipole,
            "explained": self.explained,
            "unheard": list(self.unheard),
            "unsure": list(self.unsure),
            "undetermined": list(_UNDETERMINED),
        }

    def report(self) -> str:
        """Return what was learned in a few lines."""
        unheard, unsure = ([f"{part:.0%}" for part in parts] for parts in (self.unheard, self.unsure))
        held_out = "too few to hold some out"
        if np.isfinite(self.floor_held_out):
            held_out = f"in postures held out {self.floor_held_out:.3f}, {self.explained:.0%} of the variance explained"
        settled = "" if self.settled else "; DID NOT SETTLE, do not use it"
        return (
            f"{self.n_posture} postures, {self.n_link} links{settled}\n"
            f"left of the direct field: {self.floor:.3f}, with lone dipoles {self.floor_dipole:.3f}; {held_out}\n"
            f"directions that no ray came from within 10 degrees of, by receiver: {', '.join(unheard)}; "
            f"with sigma above {_UNSURE:g}: {', '.join(unsure)}\n"
            f"undetermined: {'; '.join(_UNDETERMINED)}"
        )


def learn_pattern(
    postures: PostureCarriers,
    mirror: MirrorType,
    *,
    frequency_hz: float,
    start: AntennaPattern | None = None,
    on_progress: Callable[[int, int], None] | None = None,
) -> LearnedPattern:
    """Learn the pattern of a type of mirror from carriers in postures that are roughly known.

    Parameters
    ----------
    postures
        Carriers, rays and postures. Thirty postures of eight mirrors are plenty, five are few.
    mirror
        Receivers, dipoles and plate.
    frequency_hz
        Of the carriers [Hz]; the pattern is of this one.
    start
        A pattern that the true one is near to, as NEC gives it: fewer postures are enough. None: nothing is known.
    on_progress
        Called with (rounds done, rounds at most).

    Raises
    ------
    InvalidInputError
        No usable links, other receivers than the mirror's, a start of others or another frequency, or a plate too large
        to be learned.
    """
    if postures.amplitude.shape[1] != mirror.n_receiver:
        raise InvalidInputError(
            f"`postures` must be of the mirror's {mirror.n_receiver} receivers, got {postures.amplitude.shape[1]}"
        )
    speed = float(np.mean(postures.wavelength_m)) * as_positive("frequency_hz", frequency_hz)
    currents = Currents.of(mirror, frequency_hz, speed_mps=speed)
    prior = _Prior(currents.dipoles(), _OWN_SIGMA, _STRENGTHS)
    if start is not None:
        start.check_receivers(mirror.receiver_mirror_m)
        near = currents.nearest_to(start.table(frequency_hz), _plate_sigma(currents, _STRENGTHS[-1]))
        prior = _Prior(near, _OWN_SIGMA_NEAR, _STRENGTHS_NEAR)
    problem = _Problem(postures, currents, frequency_hz)
    if on_progress is not None:
        problem.tell = _counting(on_progress, (len(prior.strengths) + 1) * _MOST_ROUNDS)
    strength, floor_held_out = _chosen_strength(problem, prior)
    final = problem.fit(prior.mean, prior.sigma(currents, strength), problem.usable)
    return LearnedPattern(
        pattern=currents.pattern(final.coefficient, frequency_hz, _sigma_of(currents, final.covariance)),
        coefficient=read_only(final.coefficient),
        covariance=read_only(final.covariance),
        floor=final.floor,
        floor_held_out=floor_held_out,
        floor_dipole=problem.floor_of(currents.dipoles(), problem.usable),
        strength=strength,
        heard=read_only(problem.heard()),
        settled=final.settled,
        n_posture=int(problem.usable.any(axis=(1, 2)).sum()),
        n_link=int(problem.usable.sum()),
    )


def _counting(on_progress: Callable[[int, int], None], total: int) -> Callable[[int], None]:
    """Return what is told of rounds, one after the other; a fit that comes to rest early tells of all its rounds."""
    done = 0

    def tell(rounds: int) -> None:
        nonlocal done
        done += rounds
        on_progress(min(done, total), total)

    return tell


@dataclass(frozen=True, slots=True)
class _Prior:
    """What is held likely before anything was heard: currents, and how far off they may be, for some strengths."""

    mean: ComplexArray
    own_sigma: float
    strengths: tuple[float, ...]

    def sigma(self, currents: Currents, strength: float) -> FloatArray:
        """Return how far each element (receiver, element) may be from the mean."""
        plate = _plate_sigma(currents, strength)
        return np.concatenate([np.full((len(plate), 3), self.own_sigma), plate, plate], axis=1)


def _plate_sigma(currents: Currents, strength: float) -> FloatArray:
    """Return how large currents may be on the plate's points (receiver, point)."""
    away = np.linalg.norm(currents.place_mirror_m[None] - currents.mirror.receiver_mirror_m[:, None], axis=-1)
    return np.asarray(strength * _NEAR_M / np.maximum(away, 0.5 * _NEAR_M))


def _chosen_strength(problem: _Problem, prior: _Prior) -> tuple[float, float]:
    """Return the strength whose pattern foresees postures held out best, and their floor.

    Where there are too few it is the largest, which claims least, and NaN.
    """
    if problem.n_posture < 2 * _HELD_OUT:
        return prior.strengths[-1], float("nan")
    held = (np.arange(problem.n_posture) % _HELD_OUT == _HELD_OUT - 1)[:, None, None]
    tried = {}
    for strength in prior.strengths:
        learned = problem.fit(prior.mean, prior.sigma(problem.currents, strength), problem.usable & ~held)
        tried[strength] = problem.floor_of(learned.coefficient, problem.usable & held)
    best = min(tried, key=tried.__getitem__)
    return best, tried[best]


def _sigma_of(currents: Currents, covariance: ComplexArray) -> FloatArray:
    """Return the errors of the effective lengths (receiver, polar, azimuth) that the currents' covariance leaves."""
    n = currents.n_coefficient
    found = []
    for r in range(currents.mirror.n_receiver):
        lengths = currents.effective_lengths(r)
        own = covariance[r * n : (r + 1) * n, r * n : (r + 1) * n]
        variance = np.einsum("pxan,pxan->px", lengths @ own, lengths.conj()).real
        found.append(np.sqrt(np.maximum(variance, 0.0)) / 2.0)  # two components, real and imaginary part each
    return np.array(found)


@dataclass(frozen=True, slots=True)
class _Fit:
    """Currents, their covariance, the floor, and whether all of them settled."""

    coefficient: ComplexArray
    covariance: ComplexArray
    floor: float
    settled: bool


class _Problem:
    """The equations of one set of postures: carriers = factor · design · currents, relative to the direct field."""

    def __init__(self, postures: PostureCarriers, currents: Currents, frequency_hz: float) -> None:
        self.tell: Callable[[int], None] = lambda rounds: None
        self.currents, self.frequency_hz = currents, frequency_hz
        self._field: ComplexArray
        self.n_posture, self.n_receiver, self.n_transmitter = shape = postures.amplitude.shape
        self.prior_size = np.array([postures.rotation_sigma_rad] * 3 + [postures.pivot_sigma_m] * 3)
        self._take_rays(postures)
        pose = np.concatenate([postures.pivot_enu_m, postures.rot_enu_from_mirror.reshape(-1, 9)], axis=1)
        known = np.isfinite(pose @ np.ones(12))
        direct = np.zeros(postures.amplitude.size)
        np.maximum.at(direct, self._link_of_ray, np.linalg.norm(self._field, axis=1))
        scale = direct.reshape(shape).max(axis=1, keepdims=True)
        received = np.isfinite(postures.amplitude) & (direct.reshape(shape) > 0.0) & known[:, None, None]
        self.usable = received & (received.sum(axis=1, keepdims=True) >= 2)
        if not self.usable.any():
            raise InvalidInputError(
                "no link of a known posture was received by two receivers of a mirror; nothing to learn"
            )
        scale = np.where(scale > 0.0, scale, 1.0)
        self.carrier = np.where(self.usable, postures.amplitude, 0.0) / scale
        self._field = self._field / np.broadcast_to(scale, shape).reshape(-1)[self._link_of_ray][:, None]
        self.design = np.where(self.usable[..., None], self._design(), 0.0)
        self._lengths = [currents.effective_lengths(r) for r in range(self.n_receiver)]

    def _take_rays(self, postures: PostureCarriers) -> None:
        """Bring the rays into the frames of their mirrors, the phase of their ways included."""
        rays = postures.rays
        n_link = postures.amplitude.size
        link = np.repeat(np.arange(n_link), np.diff(rays.first))
        posture = link // (self.n_receiver * self.n_transmitter)
        rot = np.nan_to_num(postures.rot_enu_from_mirror)[posture]
        pivot = np.nan_to_num(postures.pivot_enu_m)[posture]
        towards = rays.source_enu_m - pivot - np.einsum("nij,nj->ni", rot, rays.place_mirror_m)
        length = np.maximum(np.linalg.norm(towards, axis=1), np.finfo(float).tiny)
        self._wave_number = 2.0 * np.pi / postures.wavelength_m[link % self.n_transmitter]
        turned = np.exp(-1j * self._wave_number * (length + rays.extra_m))
        self._link_of_ray = link
        self._receiver_of_ray = link // self.n_transmitter % self.n_receiver
        self._direction = np.einsum("nji,nj->ni", rot, towards / length[:, None])
        self._field = np.einsum("nji,nj->ni", rot, rays.field_enu) * turned[:, None]
        self._place = rays.place_mirror_m
        from scipy.sparse import csr_array  # learning alone needs it, and all processing loads this package

        self._sum = csr_array((np.ones(rays.n_ray), np.arange(rays.n_ray), rays.first), shape=(n_link, rays.n_ray))

    def _design(self) -> ComplexArray:
        """Return what each element brings to each link (posture, receiver, transmitter, element)."""
        n = self.currents.n_coefficient
        found = np.zeros((self.n_posture, self.n_receiver, self.n_transmitter, n), np.complex128)
        for r in range(self.n_receiver):
            of_this = np.flatnonzero(self._receiver_of_ray == r)
            brought = self.currents.responses(self._direction[of_this], self._field[of_this], r)
            summed = np.asarray(self._sum[:, of_this] @ brought)
            found[:, r] = summed.reshape(found.shape)[:, r]
        return found

    def heard(self) -> npt.NDArray[np.int64]:
        """Return how many rays of usable links came from near each direction (receiver, polar, azimuth)."""
        grid = grid_directions(*self.currents.grid())
        found = np.zeros((self.n_receiver, *grid.shape[:2]), np.int64)
        used = self.usable.reshape(-1)[self._link_of_ray]
        for r in range(self.n_receiver):
            towards = self._direction[used & (self._receiver_of_ray == r)].T
            for i, row in enumerate(grid):
                found[r, i] = (row @ towards > np.cos(_NEAR_RAD)).sum(axis=1)
        return found

    def modelled(self, coefficient: ComplexArray) -> ComplexArray:
        """Return what the currents make of the links (posture, receiver, transmitter), but for the factors."""
        return np.stack([self.design[:, r] @ coefficient[r] for r in range(self.n_receiver)], axis=1)

    def _left(
        self, model: ComplexArray, used: BoolArray, floor: float
    ) -> tuple[ComplexArray, ComplexArray, FloatArray]:
        """Return factors (posture, transmitter), what they leave of the links, and the links' weights.

        Both are relative to a posture's usual factor: an amplifier's gain means nothing.
        """
        weight = used / floor**2
        for _ in range(5):
            power = (weight * np.abs(model) ** 2).sum(axis=1)
            factor = (weight * model.conj() * self.carrier).sum(axis=1) / np.where(power > 0.0, power, 1.0)
            heard = np.where(used.any(axis=1), np.abs(factor), np.nan)
            rows = used.any(axis=(1, 2))
            gain = np.ones((self.n_posture, 1))
            gain[rows, 0] = np.nanmedian(heard[rows], axis=1)
            left = (self.carrier - factor[:, None] * model) / gain[:, :, None]
            weight = _student(np.abs(left) ** 2, floor) * used / floor**2
        return factor / gain, left, weight

    def floor_of(self, coefficient: ComplexArray, used: BoolArray) -> float:
        """Return the scatter of links about a pattern that was not fitted to them, relative to the direct field."""
        model = self.modelled(coefficient)
        floor = _FIRST_FLOOR
        for _ in range(10):
            _, left, _ = self._left(model, used, floor)
            floor = _scatter(np.abs(left[used]) ** 2, self._n_left(used))
        return floor

    def _n_left(self, used: BoolArray) -> float:
        return float(used.sum() - used.any(axis=1).sum())

    def fit(self, mean: ComplexArray, sigma: FloatArray, used: BoolArray) -> _Fit:
        """Return the currents by Gauss-Newton with Student weights, the floor found beside them.

        Parameters
        ----------
        mean, sigma : (receiver, element)
            The prior.
        used : (posture, receiver, transmitter)
            Which links to take.
        """
        coefficient, floor, settled = mean, _FIRST_FLOOR, False
        # as large as they please, all currents together would shrink: their unit is that dipoles are 1 in the mean
        own = self.currents.dipoles().ravel() / self.n_receiver
        information = np.diag(1.0 / sigma.ravel() ** 2) + _FIXED * np.outer(own, own.conj())
        for k in range(_MOST_ROUNDS):
            self.tell(1)
            factor, left, weight = self._left(self.modelled(coefficient), used, floor)
            normal, slope = self._normal_equations(coefficient, factor, left, weight)
            covariance = np.linalg.inv(normal + information)
            step = covariance @ (slope - information @ (coefficient - mean).ravel())
            n_fitted = float(np.vdot(covariance, normal).real)  # as much of the coefficients as is not the prior's
            n_left = max(self._n_left(used) - n_fitted, _FEWEST_LEFT * self._n_left(used))
            found = _scatter(np.abs(left[used]) ** 2, n_left)
            coefficient = coefficient + step.reshape(coefficient.shape)
            moved = float(np.linalg.norm(step) / np.linalg.norm(coefficient))
            settled = moved < _SETTLED and abs(found / floor - 1.0) < _SETTLED_FLOOR
            floor = max(found, floor / _LESS_A_ROUND)
            if settled:
                self.tell(_MOST_ROUNDS - k - 1)
                break
        return _Fit(coefficient, _without_common_factor(np.asarray(covariance), coefficient.ravel()), floor, settled)

    def _normal_equations(
        self, coefficient: ComplexArray, factor: ComplexArray, left: ComplexArray, weight: FloatArray
    ) -> tuple[ComplexArray, ComplexArray]:
        """Return JᴴQJ and JᴴQε of the currents; Q weighs with the factors and the errors of postures taken out."""
        n_link = self.n_receiver * self.n_transmitter
        n_receiver, n = coefficient.shape
        sweep = self._taken_out(coefficient, factor)
        weight = weight.reshape(self.n_posture, n_link)
        weighed = weight[:, :, None] * sweep
        inner = sweep.conj().transpose(0, 2, 1) @ weighed
        inner[:, np.arange(self.n_transmitter), np.arange(self.n_transmitter)] += 1e-9  # transmitters not received
        inner[:, np.arange(-6, 0), np.arange(-6, 0)] += 1.0
        kept = weight[:, :, None] * np.eye(n_link) - weighed @ np.linalg.solve(inner, weighed.conj().transpose(0, 2, 1))
        shape = (self.n_posture, n_receiver, self.n_transmitter)
        by_receiver = kept.reshape(*shape, n_receiver, self.n_transmitter)
        over = (kept @ left.reshape(self.n_posture, n_link, 1)).reshape(shape)
        rows = [factor[:, :, None] * self.design[:, r] for r in range(n_receiver)]
        normal, slope = (
            np.empty((n_receiver, n, n_receiver, n), np.complex128),
            np.empty((n_receiver, n), np.complex128),
        )
        for r in range(n_receiver):
            adjoint = rows[r].reshape(-1, n).conj().T
            slope[r] = adjoint @ over[:, r].ravel()
            for other in range(r, n_receiver):
                normal[r, :, other] = adjoint @ (by_receiver[:, r, :, other] @ rows[other]).reshape(-1, n)
                normal[other, :, r] = normal[r, :, other].conj().T
        return normal.reshape(n_receiver * n, n_receiver * n), slope.ravel()

    def _taken_out(self, coefficient: ComplexArray, factor: ComplexArray) -> ComplexArray:
        """Return what is not asked for (posture, link of it, transmitter + 6): factors, and errors of the posture.

        The latter are in units of their sigma; rotations about the mirror's axes, then shifts along them.
        """
        vector = np.stack([self._lengths[r] @ coefficient[r] for r in range(self.n_receiver)])
        table = self.currents.pattern_of_lengths(vector, self.frequency_hz).table(self.frequency_hz)
        length, slope, _ = table.vector_and_slope(self._direction, self._receiver_of_ray)
        heard = np.sum(self._field * length, axis=1)
        per_ray = np.empty((len(heard), 6), np.complex128)
        for axis, unit in enumerate(np.eye(3)):
            turned = -np.cross(unit, self._direction)
            moved = np.cross(unit, self._place)
            per_ray[:, axis] = (
                np.sum(-np.cross(unit, self._field) * length, axis=1)
                + np.einsum("nc,ncx,nx->n", self._field, slope, turned)
                + 1j * self._wave_number * np.sum(self._direction * moved, axis=1) * heard
            )
            per_ray[:, 3 + axis] = 1j * self._wave_number * self._direction[:, axis] * heard
        shape = (self.n_posture, self.n_receiver, self.n_transmitter)
        errors = (self._sum @ (per_ray * self.prior_size)).reshape(*shape, 6) * factor[:, None, :, None]
        model = (self._sum @ heard).reshape(shape)
        factors = model[..., None] * np.eye(self.n_transmitter)
        both = np.where(self.usable[..., None], np.concatenate([factors, errors], axis=-1), 0.0)
        return both.reshape(self.n_posture, -1, self.n_transmitter + 6)


def _student(square: FloatArray, floor: float) -> FloatArray:
    """Return weights of complex residuals by their squares, under Student's t."""
    return (_FREEDOM + 2.0) / (_FREEDOM + 2.0 * square / floor**2)


def _scatter(square: FloatArray, n_left: float) -> float:
    """Return the scale of Student's t that residuals have, of which so many are left over."""
    found = float(np.sqrt(square.sum() / n_left))
    for _ in range(30):
        found = float(np.sqrt((_student(square, found) * square).sum() / n_left))
    return max(found, 1e-9)


def _without_common_factor(covariance: ComplexArray, coefficient: ComplexArray) -> ComplexArray:
    """Return the covariance without its part along the coefficients themselves."""
    along = coefficient / np.linalg.norm(coefficient)
    right = covariance - np.outer(covariance @ along, along.conj())
    return np.asarray(right - np.outer(along, along.conj() @ right))
