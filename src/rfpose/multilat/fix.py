"""From range differences to receiver positions: Gauss-Newton from a cold start, for many receivers at once."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, as_float_array, as_positive, read_only
from rfpose.errors import InvalidInputError
from rfpose.multilat import _kernels
from rfpose.multilat.transmitters import check_transmitters

__all__ = ["FixStatus", "Fixes", "Side", "locate"]

Side = Literal["below", "above"] | None
"""Of the transmitters' plane."""

IntArray = npt.NDArray[np.int16]
IndexArray = npt.NDArray[np.intp]
StatusArray = npt.NDArray[np.int8]

# Steps below this many standard deviations end the iteration; what then remains is far smaller still.
STEP_TOLERANCE_SIGMA = 1e-6
# A cold start is taken again from elsewhere when its residuals are less likely than this.
RESTART_PROBABILITY = 1e-3
# Part of each Gauss-Newton step taken then: slower, but it converges where full steps swing to and fro.
RESTART_RELAX = 0.5
# A solution on the side where receivers are known to be is taken unless its residuals are less likely than this, or
# less likely than the other side's by this factor.
SIDE_PROBABILITY = 1e-6
# Of two solutions on either side of the transmitters' plane the better one counts where its chi-squared is smaller by
# this much: the other is then less likely than a ten-thousandth of it.
DECISIVE_CHI2 = 2.0 * np.log(1e4)
# Solutions nearer to each other than this many standard deviations are one.
APART_SIGMA = 3.0
# How much less than at the mirror image itself chi-squared may be where a solution is found nearby: by how far that
# lies above what decides, a row needs no second start.
IMAGE_MARGIN = 100.0
# A fix whose position RMS exceeds this part of the transmitters' extent (RMS about their centroid) is not solved:
# what is known of it is no straight line any more, and its covariance says little.
MAX_SIGMA_OF_EXTENT = 0.25


class FixStatus(IntEnum):
    """What became of one receiver's fix; ``reason`` says it in words."""

    OK = _kernels.OK
    TOO_FEW = _kernels.TOO_FEW
    NOT_FINITE = _kernels.NOT_FINITE
    SINGULAR = _kernels.SINGULAR
    NOT_CONVERGED = _kernels.NOT_CONVERGED
    WEAK_GEOMETRY = 5
    RESIDUAL = 6
    UNCALIBRATED = 7
    AMBIGUOUS = 8
    UNCERTAIN = 9

    @property
    def reason(self) -> str:
        """The status in words."""
        return _REASON[self]


_REASON = {
    FixStatus.OK: "solved",
    FixStatus.TOO_FEW: "too few transmitters received: three dimensions need five, two need four",
    FixStatus.NOT_FINITE: "no transmitter received",
    FixStatus.SINGULAR: "the transmitters received and the receiver lie in one plane or on one line",
    FixStatus.NOT_CONVERGED: "the iteration did not converge from any start",
    FixStatus.WEAK_GEOMETRY: "dilution of precision above the limit",
    FixStatus.UNCALIBRATED: "no calibration receiver: ranges are not known, only differences between receivers",
    FixStatus.AMBIGUOUS: "two places, mirrored in the transmitters' plane, fit alike; transmitters of unequal "
    "heights or a known side would tell",
    FixStatus.UNCERTAIN: "known to no better than a quarter of the transmitters' extent",
    FixStatus.RESIDUAL: "residuals far above what the sigma of the ranges allows (a reflection, a blocked path?)",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Fixes:
    """Positions of receivers, one row a receiver, in the site ENU frame; arrays are read-only.

    A row keeps its numbers where its status is OK, RESIDUAL (the best that least squares can say; its covariance is
    not to be trusted), AMBIGUOUS (one of two places) or UNCERTAIN; else it is NaN. ``xyz`` is ``xy`` where two
    dimensions were solved.

    Attributes
    ----------
    position_enu_m : (receiver, xyz)
        [m].
    clock_m : (receiver,)
        What the row's ranges lack to be true ranges: the range to the reference transmitter [m].
    cov_enu_m2 : (receiver, xyz, xyz)
        Covariance of the position for the given sigma, the clock estimated with it [m²].
    dop : (receiver,)
        Position dilution of precision: position RMS per unit of range sigma, all transmitters alike.
    residual_m : (receiver, transmitter)
        Range at the solution less range measured [m]; NaN where not received.
    chi2 : (receiver,)
        Sum of squared residuals in units of sigma.
    n_transmitter, n_iteration : (receiver,)
        Transmitters used, Gauss-Newton steps taken.
    status : (receiver,)
        `FixStatus` as int8.
    """

    position_enu_m: FloatArray
    clock_m: FloatArray
    cov_enu_m2: FloatArray
    dop: FloatArray
    residual_m: FloatArray
    chi2: FloatArray
    n_transmitter: IntArray
    n_iteration: IntArray
    status: StatusArray

    @property
    def ok(self) -> npt.NDArray[np.bool_]:
        """(receiver,) True where the status is OK."""
        return np.asarray(self.status == FixStatus.OK)

    def reasons(self) -> tuple[str, ...]:
        """Each row's status in words."""
        return tuple(FixStatus(s).reason for s in self.status)


def locate(
    transmitter_enu_m: npt.ArrayLike,
    range_difference_m: npt.ArrayLike,
    *,
    sigma_m: npt.ArrayLike | float,
    start_enu_m: npt.ArrayLike | None = None,
    max_dop: float = 100.0,
    side: Side | Sequence[Side] = "below",
    max_iteration: int = 30,
    min_probability: float = 1e-9,
) -> Fixes:
    """Locate receivers from range differences by Gauss-Newton least squares [1]_.

    Unknowns are the position and the range to the reference, d_r. With independent noise of each transmitter
    this is maximum likelihood, and the choice of the reference has no influence.

    Parameters
    ----------
    transmitter_enu_m : (transmitter, xyz)
        Surveyed positions, site ENU frame [m]. With two columns the problem is solved in the plane.
    range_difference_m : (receiver, transmitter)
        Range to each transmitter minus range to the reference, up to one constant a row [m].
        NaN = not received.
    sigma_m : scalar, (transmitter,) or (receiver, transmitter)
        Standard deviation of ONE transmitter's range [m]; not of a difference. NaN = not to be used.
    start_enu_m : (xyz,) or (receiver, xyz), optional
        Where to start; without it the start comes from linear equations, and a solution whose residuals are
        unlikely is sought again from other starts.
    max_dop
        A larger dilution of precision makes a row WEAK_GEOMETRY.
    side
        On which side of the transmitters' plane receivers are KNOWN to be; one for all or one a receiver. Transmitters
        of similar height have a second solution near the mirror image in their plane, which noise can make the better
        one. The solution on the known side is taken unless it is a million times less likely than noise or the other
        side would have it; of two there (a plane that leans), the better one, which is not marked but where a row
        has one transmitter more than it takes. None: nothing is known, and the better one counts; where neither wins
        (`DECISIVE_CHI2`) it is the lower one and the row is AMBIGUOUS. In two dimensions, where that means a line,
        nothing is known. Without effect with a given start.
    max_iteration
        Gauss-Newton steps before a row is given up (twice as many, half as long, from other starts).
    min_probability
        A row whose residuals are less likely than this is marked RESIDUAL; 0 marks none.

    Returns
    -------
    Fixes

    Raises
    ------
    InvalidInputError
        Wrong shape, non-finite transmitter, ``sigma_m <= 0``, a setting out of range.
    GeometryError
        Transmitters at too few places for any row, or all on a line.

    Notes
    -----
    A row that cannot be solved is returned as NaN with its reason in ``Fixes.status``.

    References
    ----------
    .. [1] Swart et al., A method for accurate measurement of heliostat mirror orientation, §3.4.
    """
    transmitter = check_transmitters(transmitter_enu_m)
    n_transmitter, n_axis = transmitter.shape
    ranges = as_float_array("range_difference_m", range_difference_m, ("receiver", n_transmitter), finite=False)
    max_dop = _positive_or_inf("max_dop", max_dop)
    if not 1 <= max_iteration <= 10_000:
        raise InvalidInputError(f"`max_iteration` must lie between 1 and 10000, got {max_iteration}")
    known = _known_side(side, len(ranges), n_axis)
    if not 0.0 <= min_probability < 1.0:
        raise InvalidInputError(f"`min_probability` must lie in [0, 1), got {min_probability}")
    centre = np.zeros(3)
    centre[:n_axis] = transmitter.mean(axis=0)
    scale = float(np.sqrt(np.mean(np.sum((transmitter - centre[:n_axis]) ** 2, axis=1))))
    weight = _weights(sigma_m, (len(ranges), n_transmitter), scale)
    start = None
    if start_enu_m is not None:
        start = np.atleast_2d(as_float_array("start_enu_m", start_enu_m, ("...", n_axis)))
        if start.shape not in ((1, n_axis), (len(ranges), n_axis)):
            raise InvalidInputError(f"`start_enu_m` must have shape ({n_axis},) or (receiver, {n_axis})")
    problem = _Problem(transmitter, centre, scale, max_iteration)
    result = problem.solve(ranges, weight, start)
    ambiguous = np.zeros(len(ranges), np.bool_)
    if start is None:
        _restart(problem, ranges, weight, result)
        ambiguous = _choose_side(problem, ranges, weight, result, known)
    largest_sigma_m = scale / np.sqrt(np.nanmin(weight, initial=np.inf))
    _judge(result, problem, max_dop, min_probability, ambiguous, largest_sigma_m)
    return Fixes(**{name: read_only(array) for name, array in result.items()})


def _known_side(side: Side | Sequence[Side], n_receiver: int, n_axis: int) -> FloatArray:
    """(receiver,) sign of the height above the transmitters' plane, 0 unknown."""
    sides = [side] if side is None or isinstance(side, str) else list(side)
    signs = {"below": -1.0, "above": 1.0, None: 0.0}
    for one in sides:
        if one not in signs:
            raise InvalidInputError(f"`side` must be 'below', 'above' or None, got {one!r}")
    if len(sides) not in (1, n_receiver):
        raise InvalidInputError(f"`side` must be one for all or one a receiver ({n_receiver}), got {len(sides)}")
    known = np.array([signs[one] for one in sides])
    return np.array(np.broadcast_to(known if n_axis == 3 else np.zeros(1), (n_receiver,)))


def _positive_or_inf(name: str, value: float) -> float:
    return float("inf") if value == float("inf") else as_positive(name, value)


def _weights(sigma_m: npt.ArrayLike | float, shape: tuple[int, int], scale: float) -> FloatArray:
    """Return (scale/σ)² as one row for all receivers or one a receiver; NaN stays NaN and means unused."""
    sigma = as_float_array("sigma_m", sigma_m, ("...",), finite=False, positive=True)
    if np.any(np.isinf(sigma)):
        raise InvalidInputError("`sigma_m` must be finite, or NaN where a transmitter is not to be used")
    n_receiver, n_transmitter = shape
    if sigma.shape not in ((), (n_transmitter,), (1, n_transmitter), (n_receiver, 1), (n_receiver, n_transmitter)):
        raise InvalidInputError(
            f"`sigma_m` must be a scalar or have shape (transmitter,) or (receiver, transmitter) = {shape}, "
            f"got {sigma.shape}"
        )
    rows = len(sigma) if sigma.ndim == 2 else 1
    return np.ascontiguousarray(np.broadcast_to((scale / sigma) ** 2, (rows, n_transmitter)))


@dataclass(frozen=True, slots=True)
class _Problem:
    """What all rows share; turns arrays into the kernel's form and back."""

    transmitter: FloatArray
    centre: FloatArray
    scale: float
    max_iteration: int

    def inside(self, position_enu_m: FloatArray) -> FloatArray:
        """Return positions centred, scaled and with a z."""
        out = np.zeros((len(position_enu_m), 3))
        n_axis = self.transmitter.shape[1]
        out[:, :n_axis] = (position_enu_m - self.centre[:n_axis]) / self.scale
        return out

    def solve(
        self, ranges: FloatArray, weight: FloatArray, start: FloatArray | None, *, relax: float = 1.0
    ) -> dict[str, npt.NDArray[Any]]:
        """Run the kernel on every row; steps are shortened by ``relax``, and more of them allowed."""
        n, n_transmitter = ranges.shape
        n_axis = self.transmitter.shape[1]
        result: dict[str, npt.NDArray[Any]] = {
            "position_enu_m": np.empty((n, n_axis)),
            "clock_m": np.empty(n),
            "cov_enu_m2": np.empty((n, n_axis, n_axis)),
            "dop": np.empty(n),
            "residual_m": np.empty((n, n_transmitter)),
            "chi2": np.empty(n),
            "n_transmitter": np.empty(n, np.int16),
            "n_iteration": np.empty(n, np.int16),
            "status": np.empty(n, np.int8),
        }
        even = np.concatenate([self.inside(self.transmitter), np.zeros((n_transmitter % 2, 3))])
        _kernels.locate_rows(
            -(-n // _kernels.LANES), even, ranges, weight,
            np.empty((0, 3)) if start is None else self.inside(start),
            self.scale, self.centre, 3.0 - n_axis,
            int(self.max_iteration / relax), STEP_TOLERANCE_SIGMA**2, relax, n_axis + 2, *result.values(),
        )  # fmt: skip
        return result

    def axes(self) -> FloatArray:
        """Principal axes of the transmitters, one a row, widest first; the last is their plane's normal, upwards."""
        middle = self.centre[: self.transmitter.shape[1]]
        axes = np.linalg.svd(self.transmitter - middle, full_matrices=False)[2]
        axes[-1] *= -1.0 if axes[-1, -1] < 0.0 else 1.0
        return np.asarray(axes)

    def height(self, position_enu_m: FloatArray) -> FloatArray:
        """Height above the transmitters' plane [m]."""
        up = self.axes()[-1]
        # no BLAS: its threads cost more than so little work
        return np.asarray(np.einsum("na,a->n", position_enu_m, up) - self.centre[: len(up)] @ up)

    def mirrored(self, position_enu_m: FloatArray) -> FloatArray:
        """Positions mirrored in the transmitters' plane; a NaN becomes their centroid."""
        image = position_enu_m - 2.0 * self.height(position_enu_m)[:, None] * self.axes()[-1]
        return np.where(np.isfinite(image), image, self.centre[: self.transmitter.shape[1]])

    def other_starts(self, position_enu_m: FloatArray) -> list[FloatArray]:
        """Where to try again: mirrored in the transmitters' plane, then below, above and beside their centroid."""
        axes = self.axes()
        up = axes[-1]
        offsets = [h * up for h in (-0.3, 0.3, -1.0, 1.0)]
        offsets += [s * a - 0.3 * up for a in axes[:-1] for s in (-0.7, 0.7)]
        middle = self.centre[: self.transmitter.shape[1]]
        return [self.mirrored(position_enu_m), *(middle[None] + self.scale * o for o in offsets)]


def _restart(problem: _Problem, ranges: FloatArray, weight: FloatArray, result: dict[str, npt.NDArray[Any]]) -> None:
    """Solve unlikely or failed rows again from other starts, and keep the best solution of each."""
    n_axis = problem.transmitter.shape[1]
    limit = _chi2_limit(result["n_transmitter"], n_axis, RESTART_PROBABILITY)
    hopeless = (result["status"] == FixStatus.TOO_FEW) | (result["status"] == FixStatus.NOT_FINITE)
    rows = np.flatnonzero(~hopeless & ~(result["chi2"] <= limit))
    if not rows.size:
        return
    row_weight = weight if len(weight) == 1 else weight[rows]
    for start in problem.other_starts(result["position_enu_m"][rows]):
        again = problem.solve(ranges[rows], row_weight, start, relax=RESTART_RELAX)
        with np.errstate(invalid="ignore"):
            better = (again["status"] == FixStatus.OK) & ~(again["chi2"] >= result["chi2"][rows])
        for name, array in again.items():
            result[name][rows[better]] = array[better]


def _choose_side(
    problem: _Problem,
    ranges: FloatArray,
    weight: FloatArray,
    result: dict[str, npt.NDArray[Any]],
    known: FloatArray,
) -> npt.NDArray[np.bool_]:
    """Look for each row's solution on the other side of its transmitters' plane, and take the right one.

    ``known`` (receiver,) is the sign of the height above the plane of all transmitters, 0 unknown. Returns which rows
    have two solutions that fit alike.
    """
    ambiguous = np.zeros(len(ranges), np.bool_)
    rows, image = _images(problem, weight, result, known)
    _choose(problem, ranges, weight, result, known, rows, image, ambiguous)
    # with one transmitter more than it takes, a second solution need not be near an image
    scarce = result["n_transmitter"] == problem.transmitter.shape[1] + 2
    rows = np.flatnonzero(scarce & (result["status"] == FixStatus.OK))
    for start in problem.other_starts(result["position_enu_m"][rows])[1:] if rows.size else ():
        _choose(problem, ranges, weight, result, known, rows, start, ambiguous)
    return ambiguous


def _choose(
    problem: _Problem,
    ranges: FloatArray,
    weight: FloatArray,
    result: dict[str, npt.NDArray[Any]],
    known: FloatArray,
    rows: IndexArray,
    start: FloatArray,
    ambiguous: npt.NDArray[np.bool_],
) -> None:
    """Solve some rows from another start; where that leads elsewhere, keep the right one and note what fits alike."""
    if not rows.size:
        return
    place = result["position_enu_m"]
    again = problem.solve(ranges[rows], _rows_of(weight, rows), start, relax=RESTART_RELAX)
    here, there = place[rows], again["position_enu_m"]
    apart = here - there
    with np.errstate(invalid="ignore"):
        far = np.einsum("na,nab,nb->n", apart, np.linalg.pinv(result["cov_enu_m2"][rows], hermitian=True), apart)
        other = (again["status"] == FixStatus.OK) & (far > APART_SIGMA**2)
        gain = result["chi2"][rows] - again["chi2"]
        limit = _chi2_limit(again["n_transmitter"], place.shape[1], SIDE_PROBABILITY)
        sign = known[rows]
        right, other_right = (sign * problem.height(p) >= 0.0 for p in (here, there))
        scarce = again["n_transmitter"] == place.shape[1] + 2
        alike = (np.abs(gain) <= DECISIVE_CHI2) & ((sign == 0.0) | scarce)
        lower = there[:, -1] < here[:, -1] if place.shape[1] == 3 else gain > 0.0
    both = right == other_right
    sure = -2.0 * np.log(SIDE_PROBABILITY)
    likely = ((again["chi2"] <= limit) & (gain > -sure)) | (gain > 0.0)
    wins = np.where(alike & (sign == 0.0), lower, gain > 0.0)
    better = other & np.where(both, wins, np.where(right, gain > sure, likely))
    ambiguous[rows] |= other & both & alike
    for name, array in again.items():
        result[name][rows[better]] = array[better]


def _rows_of(weight: FloatArray, rows: IndexArray) -> FloatArray:
    """Weights of some rows; one row stands for all."""
    return weight if len(weight) == 1 else weight[rows]


def _images(
    problem: _Problem, weight: FloatArray, result: dict[str, npt.NDArray[Any]], known: FloatArray
) -> tuple[IndexArray, FloatArray]:
    """Rows that may have a second solution, or lie on the wrong side, and the mirror image of each."""
    place, ok = result["position_enu_m"], result["status"] == FixStatus.OK
    height = problem.height(place)
    found, images = [np.zeros(0, np.intp)], [place[:0]]
    for pattern, rows in _patterns(result):
        plane = _Plane.of(problem.transmitter[pattern])
        here = place if rows is None else place[rows]
        info = (weight if len(weight) == 1 or rows is None else weight[rows])[:, pattern] / problem.scale**2
        at = plane.near(height if rows is None else plane.height(here), here, problem.transmitter[pattern], info)
        at = at if rows is None else rows[at]
        found.append(at[ok[at]])
        images.append(plane.mirrored(place[found[-1]]))
    if known.any():
        wrong = np.flatnonzero(ok & (known * height < 0.0))
        found.append(np.setdiff1d(wrong, np.concatenate(found), assume_unique=True))
        images.append(problem.mirrored(place[found[-1]]))
    return np.concatenate(found), np.concatenate(images)


def _patterns(result: dict[str, npt.NDArray[Any]]) -> Iterator[tuple[npt.NDArray[np.bool_], IndexArray | None]]:
    """Sort solved rows by which transmitters they received; None stands for all rows there are."""
    residual, status = result["residual_m"], result["status"]
    if not len(residual):
        return
    if np.all(result["n_transmitter"] == residual.shape[1]):
        yield np.ones(residual.shape[1], np.bool_), None
        return
    rows = np.flatnonzero(status == FixStatus.OK)
    seen = np.isfinite(residual[rows])
    patterns, pattern = np.unique(seen, axis=0, return_inverse=True)
    for k, received in enumerate(patterns):
        yield received, rows[pattern.reshape(-1) == k]


@dataclass(frozen=True, slots=True)
class _Plane:
    """The plane that fits transmitters best; in two dimensions the line."""

    point: FloatArray
    normal: FloatArray

    @classmethod
    def of(cls, transmitter: FloatArray) -> _Plane:
        middle = transmitter.mean(axis=0)
        return cls(middle, np.linalg.svd(transmitter - middle, full_matrices=True)[2][-1])

    def height(self, place: FloatArray) -> FloatArray:
        return np.asarray(np.einsum("na,a->n", place, self.normal) - self.point @ self.normal)

    def mirrored(self, place: FloatArray) -> FloatArray:
        return np.asarray(place - 2.0 * self.height(place)[:, None] * self.normal)

    def near(self, height: FloatArray, place: FloatArray, transmitter: FloatArray, info: FloatArray) -> IndexArray:
        """Tell which places, at heights above the plane, could have a second solution beyond it.

        A transmitter δ off the plane, d away, is 2hδ/d farther from or nearer to the image of a place at height h.
        Where the sum of squares of that, in standard deviations, is beyond all that could decide, there is no need to
        look. ``info`` is 1/σ², one row for all or one a place. With one transmitter more than it takes, two places far
        from being images can fit alike: then all are looked at.
        """
        if len(transmitter) == transmitter.shape[1] + 2:
            return np.flatnonzero(np.isfinite(height))
        relative = info @ self.height(transmitter) ** 2
        width = float(np.linalg.norm(transmitter - self.point, axis=1).max())
        enough = IMAGE_MARGIN * DECISIVE_CHI2 / 4.0
        with np.errstate(invalid="ignore"):
            # one reach for all tells of most rows that there is no need; the largest of all is quick to have
            farthest = np.abs(place).max(initial=0.0)
            farthest = farthest if np.isfinite(farthest) else np.nanmax(np.abs(place), initial=0.0)
            reach = 2.0 * farthest + float(np.linalg.norm(self.point)) + width
            some = np.flatnonzero(np.abs(height) < reach * np.sqrt(enough / np.maximum(relative, 1e-300)))
            own = relative if len(relative) == 1 else relative[some]
            reach_of = np.linalg.norm(place[some] - self.point, axis=1) + width
            return np.asarray(some[height[some] ** 2 * own < enough * reach_of**2])


def _chi2_limit(n_transmitter: IntArray, n_axis: int, probability: float) -> FloatArray:
    """Return the value that chi-squared exceeds with ``probability``, for each row's number of transmitters."""
    from scipy.special import chdtri

    dof = np.arange(int(n_transmitter.max(initial=0)) + 1) - (n_axis + 1)
    return np.asarray(np.take(chdtri(np.maximum(dof, 1), probability), n_transmitter), np.float64)


def _judge(
    result: dict[str, npt.NDArray[Any]],
    problem: _Problem,
    max_dop: float,
    min_probability: float,
    ambiguous: npt.NDArray[np.bool_],
    largest_sigma_m: float,
) -> None:
    """Mark solved rows whose geometry is weak (and blank them), and those not to be relied on."""
    status = result["status"]
    weak = (status == FixStatus.OK) & (result["dop"] > max_dop)
    status[weak] = FixStatus.WEAK_GEOMETRY
    for name in ("position_enu_m", "clock_m", "cov_enu_m2", "residual_m", "chi2"):
        result[name][weak] = np.nan
    if min_probability > 0.0:
        limit = _chi2_limit(result["n_transmitter"], result["position_enu_m"].shape[1], min_probability)
        status[(status == FixStatus.OK) & (result["chi2"] > limit)] = FixStatus.RESIDUAL
    limit_m = MAX_SIGMA_OF_EXTENT * problem.scale
    # no fix is worse than its dilution makes of the poorest range
    some = np.flatnonzero((status == FixStatus.OK) & (result["dop"] * largest_sigma_m > limit_m))
    vague = np.einsum("naa->n", result["cov_enu_m2"][some]) > limit_m**2
    status[some[vague]] = FixStatus.UNCERTAIN
    status[(status == FixStatus.OK) & ambiguous] = FixStatus.AMBIGUOUS
