"""How far a result is from the truth, and from the best that its noise allows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, as_float_array
from rfpose.errors import InvalidInputError, RecordingError
from rfpose.foreign import load_json
from rfpose.geometry import angle_between_rad, unit
from rfpose.multilat import FilterStatus, FixStatus, PoseStatus, position_bound
from rfpose.pipeline.bound import normal_bound_rad
from rfpose.pipeline.formats.result import Result
from rfpose.pipeline.formats.result_file import is_result, open_result
from rfpose.pipeline.formats.result_summary import count_reasons, left_out_of
from rfpose.pipeline.formats.truth_rows import align_truth, truth_rows
from rfpose.pipeline.noise import phase_noise
from rfpose.recording import Recording, open_recording
from rfpose.scenario import Scenario
from rfpose.shown import Shown, number
from rfpose.tables import Tabled
from rfpose.truth import Truth

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = [
    "Evaluation",
    "FilteredErrors",
    "HeliostatRow",
    "Protection",
    "Statistics",
    "evaluate",
    "ratio_of",
    "read_truth",
]


@dataclass(frozen=True, slots=True, kw_only=True)
class Statistics:
    """Of errors that are never negative; NaN where there is none."""

    rms: float
    median: float
    p95: float
    max: float

    @classmethod
    def of(cls, errors: npt.ArrayLike) -> Statistics:
        """Summarise the finite ones among ``errors``, any shape."""
        values = np.asarray(errors, np.float64).ravel()
        values = values[np.isfinite(values)]
        if not values.size:
            return cls(rms=np.nan, median=np.nan, p95=np.nan, max=np.nan)
        return cls(
            rms=float(np.sqrt(np.mean(values**2))),
            median=float(np.median(values)),
            p95=float(np.percentile(values, 95)),
            max=float(values.max()),
        )

    def as_dict(self) -> dict[str, float]:
        """Return the four by name."""
        return {"rms": self.rms, "median": self.median, "p95": self.p95, "max": self.max}


@dataclass(frozen=True, slots=True, kw_only=True)
class HeliostatRow:
    """One heliostat over all frames."""

    id: str
    solved: int
    failed: int
    normal_error_mrad: Statistics
    bound_mrad: float
    sigma_mrad: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Protection:
    """How protection levels held, over solved mirror-frames.

    Attributes
    ----------
    level_mrad
        The levels themselves [mrad of the normal].
    covered, exceeded
        Mirror-frames with a finite level, and those among them whose error is larger.
    excluded
        Transmitters left out, one a mirror-frame.
    """

    level_mrad: Statistics
    covered: int
    exceeded: int
    excluded: int

    def as_dict(self) -> dict[str, Any]:
        """Return what ``rfpose evaluate --json`` prints."""
        return {
            "level_mrad": self.level_mrad.as_dict(),
            "covered": self.covered,
            "exceeded": self.exceeded,
            "exceeded_fraction": self.exceeded / self.covered if self.covered else None,
            "excluded": self.excluded,
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class FilteredErrors:
    """How far poses filtered over frames are off, wherever the filter gives one: also where it only predicts.

    Attributes
    ----------
    normal_error_mrad
        Of the mirror normal.
    sigma_mrad
        RMS of the standard deviations that the filter states.
    nees
        Mean squared error over stated covariance, two angles: 1 where the covariance is true.
    given, predicted
        Mirror-frames with a filtered pose, and those among them that were not measured or not believed.
    """

    normal_error_mrad: Statistics
    sigma_mrad: float
    nees: float
    given: int
    predicted: int

    def as_dict(self) -> dict[str, Any]:
        """Return what ``rfpose evaluate --json`` prints."""
        return {
            "normal_error_mrad": self.normal_error_mrad.as_dict(),
            "sigma_mrad": {"rms": self.sigma_mrad},
            "nees": self.nees,
            "given": self.given,
            "predicted": self.predicted,
        }


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Evaluation(Shown, Tabled):
    """Errors of a result against the truth; a milliradian here is of the mirror normal.

    Attributes
    ----------
    normal_error_mrad
        Angle between measured and true normal, over solved mirror-frames.
    position_error_m
        Distance between measured and true place of the receivers on mirrors, over solved fixes.
    bound_mrad, bound_m
        RMS of the lower bounds over the same mirror-frames and fixes.
    bound_source
        ``"truth"``: from the true signal-to-noise ratios. ``"result"``: from the sigmas that the result reports.
    ratio_to_bound
        RMS normal error over RMS bound.
    ratio_sigma
        Its standard deviation, as mirrors and frames scatter; errors that all share are not in it.
    sigma_mrad
        RMS of the standard deviations that the result reports for its normals.
    solved, failed
        Mirror-frames; one that is marked doubtful counts as failed.
    failure_reasons
        Mirror-frames by reason.
    heliostats
        One row each.
    protection
        How protection levels held; None where the result has none.
    filtered
        Of poses filtered over frames; None where the result has none.
    normal_error_rad, bound_rad : (frame, heliostat)
        What the figures were made of; NaN where not solved or not known.
    """

    normal_error_mrad: Statistics
    position_error_m: Statistics
    bound_mrad: float
    bound_m: float
    bound_source: str
    ratio_to_bound: float
    ratio_sigma: float
    sigma_mrad: float
    solved: int
    failed: int
    failure_reasons: Mapping[str, int]
    heliostats: tuple[HeliostatRow, ...]
    normal_error_rad: FloatArray
    bound_rad: FloatArray
    protection: Protection | None = None
    filtered: FilteredErrors | None = None

    def headline(self) -> str:
        """Return how far off, and what noise allows."""
        return (
            f"{number(self.normal_error_mrad.rms)} mrad of the normal, rms; bound {number(self.bound_mrad)}; "
            f"{self.solved} mirror-frames solved, {self.failed} failed"
        )

    def figures(self) -> tuple[list[str], list[list[str]]]:
        """Return one row a heliostat [mrad of the normal]."""
        rows = [
            [row.id, str(row.solved), str(row.failed), *(number(value) for value in values)]
            for row in self.heliostats
            for values in [(row.normal_error_mrad.rms, row.normal_error_mrad.max, row.bound_mrad)]
        ]
        return ["", "solved", "failed", "rms", "worst", "bound"], rows

    def table(self) -> tuple[list[str], list[list[Any]]]:
        """Return one row a heliostat: errors, bound and reported sigma [mrad of the normal]."""
        names = ("rms", "median", "p95", "max")
        header = ["heliostat", "solved", "failed", *(f"normal_{k}_mrad" for k in names), "bound_mrad", "sigma_mrad"]
        return header, [
            [h.id, h.solved, h.failed, *h.normal_error_mrad.as_dict().values(), h.bound_mrad, h.sigma_mrad]
            for h in self.heliostats
        ]

    def plot(self) -> Figure:
        """Draw error, bound and stated sigma by mirror, RMS over frames; of many mirrors their distribution."""
        from rfpose.drawing import look
        from rfpose.pipeline.pictures.results import draw_evaluation

        with look():
            return draw_evaluation(self)

    def as_dict(self) -> dict[str, Any]:
        """Return what ``rfpose evaluate --json`` prints; its keys are a contract."""
        return {
            "normal_error_mrad": self.normal_error_mrad.as_dict(),
            "position_error_m": self.position_error_m.as_dict(),
            "bound_mrad": {"rms": self.bound_mrad},
            "bound_m": {"rms": self.bound_m},
            "bound_source": self.bound_source,
            "ratio_to_bound": self.ratio_to_bound,
            "ratio_to_bound_sigma": self.ratio_sigma,
            "sigma_mrad": {"rms": self.sigma_mrad},
            "solved": self.solved,
            "failed": self.failed,
            "failure_reasons": dict(self.failure_reasons),
            "protection": None if self.protection is None else self.protection.as_dict(),
            "filtered": None if self.filtered is None else self.filtered.as_dict(),
            "heliostats": [
                {
                    "id": row.id,
                    "solved": row.solved,
                    "failed": row.failed,
                    "normal_error_mrad": row.normal_error_mrad.as_dict(),
                    "bound_mrad": {"rms": row.bound_mrad},
                    "sigma_mrad": {"rms": row.sigma_mrad},
                }
                for row in self.heliostats
            ],
        }


# -- truth ---------------------------------------------------------------------------------------------------


def read_truth(path: str | Path, scenario: Scenario, *, follow_links: bool = False) -> Truth:
    """Read a truth from a recording, a result or a JSON file, with rows in the scenario's order.

    The JSON file holds ``heliostats``, a list of ``id``, ``normal_enu`` and ``receivers_enu_m`` (positions in the
    order of the scenario's ``receiver_ids``); it holds for every frame. ``follow_links`` is as for
    `rfpose.recording.open_recording`.

    Raises
    ------
    RecordingError
        The file is missing, holds no truth, or is malformed.
    """
    path = Path(path)
    if path.suffix == ".json":
        return _truth_from_json(path, scenario)
    if is_result(path):
        truth = open_result(path).truth
    else:
        with open_recording(path, follow_links=follow_links) as recording:
            truth = recording.truth
    if truth is None:
        raise RecordingError(f"{path}: holds no truth; give a simulated recording or a JSON file")
    return align_truth(truth, scenario)


_T = TypeVar("_T")
_TRUTH_BYTES = 2**28
_TRUTH_REMEDY = (
    "it must hold `heliostats`, a list with `id`, `normal_enu` [x, y, z] and `receivers_enu_m` [[x, y, z], …] of each"
)


def _field(path: Path, entry: Any, k: int, key: str, kind: type[_T]) -> _T:
    value = entry.get(key) if isinstance(entry, dict) else None
    if not isinstance(value, kind):
        what = "is missing" if value is None else f"must be a {kind.__name__}, got {value!r:.60}"
        raise RecordingError(f"{path}: not a truth file: `heliostats[{k}].{key}` {what}; {_TRUTH_REMEDY}")
    return value


def _truth_from_json(path: Path, scenario: Scenario) -> Truth:
    normal_enu = np.full((1, len(scenario.heliostat_ids), 3), np.nan)
    receiver_enu_m = np.full((1, len(scenario.receiver_ids), 3), np.nan)
    content = load_json(path, limit=_TRUTH_BYTES, remedy=_TRUTH_REMEDY)
    entries = content.get("heliostats") if isinstance(content, dict) else None
    if not isinstance(entries, list):
        raise RecordingError(f"{path}: not a truth file: `heliostats` is missing or no list; {_TRUTH_REMEDY}")
    index = {name: i for i, name in enumerate(scenario.heliostat_ids)}
    known = 0
    for k, entry in enumerate(entries):
        i = index.get(_field(path, entry, k, "id", str))
        if i is None:
            continue
        rows = scenario.receiver_rows(i)
        try:
            name = f"heliostats[{k}].normal_enu"
            normal = as_float_array(name, _field(path, entry, k, "normal_enu", list), (3,))
            if not np.linalg.norm(normal) > 0.0:
                raise InvalidInputError(f"`{name}` must not be zero")
            places = _field(path, entry, k, "receivers_enu_m", list)
            shape = (rows.stop - rows.start, 3)
            receiver_enu_m[0, rows] = as_float_array(f"heliostats[{k}].receivers_enu_m", places, shape)
        except InvalidInputError as error:
            raise RecordingError(f"{path}: not a truth file: {error}; {_TRUTH_REMEDY}") from error
        normal_enu[0, i] = unit(normal)
        known += 1
    if not known:
        raise RecordingError(f"{path}: knows none of the result's heliostats ({', '.join(list(index)[:5])}, …)")
    return Truth(
        heliostat_ids=scenario.heliostat_ids,
        receiver_ids=scenario.receiver_ids,
        transmitter_ids=scenario.transmitter_ids,
        normal_enu=normal_enu,
        receiver_enu_m=receiver_enu_m,
    )


# -- comparison ----------------------------------------------------------------------------------------------


def evaluate(
    result: Result | str | Path,
    truth: Truth | Recording | Result | str | Path | None = None,
    *,
    follow_links: bool = False,
) -> Evaluation:
    """Compare a result with the truth and with the bound.

    The bound is that of the pose model in use, at the true geometry, with the noise of the receiver and that of the
    calibration receivers (Cramér–Rao for each phase, position and normal). Positions are always those of receivers
    located each on its own.

    Parameters
    ----------
    result
        As `rfpose.process` gives it, or the file of one.
    truth
        Rows as in ``result.scenario``; or the recording or result that carries one; or a file, see `read_truth`;
        without it what the result carries.
    follow_links
        As for `rfpose.recording.open_recording`.

    Raises
    ------
    InvalidInputError
        No truth anywhere, or none for these frames.
    RecordingError
        A file cannot be read.

    Examples
    --------
    >>> import rfpose as rf
    >>> site = rf.load_scenario(rf.shipped_scenario("table2_100m.toml"))
    >>> short = site.changed(
    ...     heliostat=site.heliostat[:2], radio={"frame_samples": 40_000}, simulation={"frame_count": 2}
    ... )
    >>> found = rf.evaluate(rf.process(rf.simulate(short, seed=1)))
    >>> found.solved, found.normal_error_mrad.rms < 1.0
    (4, True)
    """
    source = "the result" if isinstance(result, Result) else f"{result}:"
    result = result if isinstance(result, Result) else open_result(result)
    if truth is None:
        truth = result.truth
    elif isinstance(truth, Recording | Result):
        carried = truth.truth
        if carried is None:
            raise InvalidInputError(f"{truth!r} carries no truth; give what was simulated")
        truth = align_truth(carried, result.scenario)
    elif not isinstance(truth, Truth):
        truth = read_truth(truth, result.scenario, follow_links=follow_links)
    if truth is None:
        raise InvalidInputError(f"{source} carries no truth; give `truth=FILE` (a simulated recording or JSON)")
    rows = truth_rows(truth, result.frame_start_index)
    if not np.any(rows >= 0):
        raise InvalidInputError("the truth is of another time: it has none of the result's frames")
    normal_true = _of_frames(truth.normal_enu, rows)
    receiver_true = _of_frames(truth.receiver_enu_m, rows)
    is_mirror = np.array([row.heliostat is not None for row in result.scenario.receivers], bool)

    solved = result.poses.status == PoseStatus.OK
    located = (result.fixes.status == FixStatus.OK) & is_mirror
    normal_error = np.where(solved, angle_between_rad(result.poses.normal_enu, normal_true), np.nan)
    position_error = np.where(located, np.linalg.norm(result.fixes.position_enu_m - receiver_true, axis=-1), np.nan)
    choice = result.choice
    # fading changes the power of each tone, which the truth's ratios (of direct rays) do not know
    noise = phase_noise(result, truth, rows, reported=choice.reflection != "none")
    bound = normal_bound_rad(
        result.scenario,
        choice,
        noise,
        normal_enu=normal_true,
        receiver_enu_m=receiver_true,
        frame_start_index=result.frame_start_index,
        sample_rate=result.sample_rate,
        coefficient=_true_coefficient(result),
    )
    bound = np.where(np.isfinite(normal_error), bound, np.nan)
    total_m = np.hypot(noise.own_m, noise.calibration_m)
    position_cov = position_bound(result.scenario.transmitter_enu_m, receiver_true, total_m)
    bound_m = np.where(np.isfinite(position_error), np.sqrt(np.trace(position_cov, axis1=-2, axis2=-1)), np.nan)
    sigma = np.where(solved, result.poses.sigma_rad, np.nan)

    ratio, ratio_sigma = ratio_of(normal_error, bound)
    return Evaluation(
        normal_error_mrad=Statistics.of(1e3 * normal_error),
        position_error_m=Statistics.of(position_error),
        bound_mrad=1e3 * _rms(bound),
        bound_m=_rms(bound_m),
        bound_source=noise.source,
        ratio_to_bound=ratio,
        ratio_sigma=ratio_sigma,
        sigma_mrad=1e3 * _rms(sigma),
        solved=int(np.count_nonzero(solved)),
        failed=int(np.count_nonzero(~solved)),
        failure_reasons=count_reasons(result.poses.status, PoseStatus),
        heliostats=tuple(
            HeliostatRow(
                id=name,
                solved=int(np.count_nonzero(solved[:, i])),
                failed=int(np.count_nonzero(~solved[:, i])),
                normal_error_mrad=Statistics.of(1e3 * normal_error[:, i]),
                bound_mrad=1e3 * _rms(bound[:, i]),
                sigma_mrad=1e3 * _rms(sigma[:, i]),
            )
            for i, name in enumerate(result.scenario.heliostat_ids)
        ),
        normal_error_rad=normal_error,
        bound_rad=bound,
        protection=_protection(result, normal_error),
        filtered=_filtered(result, normal_true),
    )


def ratio_of(error_rad: FloatArray, bound_rad: FloatArray) -> tuple[float, float]:
    """Return RMS error (frame, heliostat) over RMS bound, and the standard deviation of this ratio; NaN: not known.

    The squared ratio is one of sums; its variance is that of its residuals, summed by mirror and by frame, since a
    mirror's errors in several frames, and a frame's in several mirrors, may have a common part [1]_.

    References
    ----------
    .. [1] Cameron, Gelbach, Miller, Robust inference with multiway clustering, J. Bus. Econ. Stat. 29 (2011), eq. 2.7.
    """
    known = np.isfinite(bound_rad) & np.isfinite(error_rad)
    allowed = float((bound_rad[known] ** 2).sum())
    if not allowed > 0.0:
        return float("nan"), float("nan")
    squared = float((error_rad[known] ** 2).sum()) / allowed
    residual = np.where(known, error_rad**2 - squared * bound_rad**2, 0.0)
    single = _between(residual[known])
    both = _between(residual[:, known.any(axis=0)].sum(axis=0)) + _between(residual[known.any(axis=1)].sum(axis=1))
    # each mirror-frame stands in both sums; chance may leave less than their own scatter
    variance = max(both - single, single) / allowed**2
    ratio = float(np.sqrt(squared))
    return ratio, float(np.sqrt(variance)) / (2.0 * ratio) if ratio > 0.0 and known.sum() > 1 else float("nan")


def _between(sums: FloatArray) -> float:
    """Return the variance of a total of independent sums whose mean is zero."""
    n = len(sums)
    return float((sums**2).sum()) * n / (n - 1) if n > 1 else 0.0


def _rms(values: FloatArray) -> float:
    return Statistics.of(values).rms


def _of_frames(array: FloatArray, rows: npt.NDArray[np.int64]) -> FloatArray:
    """Pick the truth's row of each frame; NaN where there is none."""
    picked = np.array(array[np.maximum(rows, 0)], np.float64)
    picked[rows < 0] = np.nan
    return picked


def _true_coefficient(result: Result) -> FloatArray | None:
    """(reflector,) what the simulation had, else what was found."""
    if result.reflection is None:
        return None
    found = result.reflection.coefficient.reshape(-1, result.reflection.coefficient.shape[-1])
    known = found[np.isfinite(found).all(axis=1)]
    value = np.median(known.real, axis=0) + 1j * np.median(known.imag, axis=0) if len(known) else 0.0 * found[0]
    ground = result.scenario.simulation.ground
    if ground is not None and result.choice.reflection in ("estimate", "known"):
        value[0] = complex(*ground.coefficient)
    return np.asarray(value)


def _filtered(result: Result, normal_true: FloatArray) -> FilteredErrors | None:
    table = result.filtered
    if table is None:
        return None
    given = np.isfinite(table.sigma_rad) & np.isfinite(normal_true).all(axis=-1)
    given &= np.isfinite(table.normal_enu).all(axis=-1) & np.isfinite(table.cov_enu).all(axis=(-2, -1))
    off = (table.normal_enu - normal_true)[given]
    # the normal has two angles: its covariance is singular along itself
    inverse = np.linalg.pinv(table.cov_enu[given], rcond=1e-10, hermitian=True)
    squared = np.einsum("na,nab,nb->n", off, inverse, off)
    predicted = np.isin(table.status, (FilterStatus.COASTED, FilterStatus.GATED))
    return FilteredErrors(
        normal_error_mrad=Statistics.of(1e3 * angle_between_rad(table.normal_enu[given], normal_true[given])),
        sigma_mrad=1e3 * _rms(table.sigma_rad[given]),
        nees=float(np.mean(squared) / 2.0) if squared.size else np.nan,
        given=int(np.count_nonzero(given)),
        predicted=int(np.count_nonzero(given & predicted)),
    )


def _protection(result: Result, normal_error: FloatArray) -> Protection | None:
    if result.integrity is None:
        return None
    level = result.integrity.protection_level_rad
    covered = np.isfinite(level) & np.isfinite(normal_error)
    exceeded = covered & (normal_error > level)
    left_out = left_out_of(result.integrity)
    return Protection(
        level_mrad=Statistics.of(1e3 * level[covered]),
        covered=int(np.count_nonzero(covered)),
        exceeded=int(np.count_nonzero(exceeded)),
        excluded=int(np.count_nonzero(left_out)),
    )
