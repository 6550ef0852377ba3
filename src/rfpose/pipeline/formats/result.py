"""What processing a recording found: the stages' records, as arrays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.dsp import PhaseCalibration, TonePhases
from rfpose.errors import InvalidInputError
from rfpose.foreign import exact_number
from rfpose.multilat import RangeDifferences
from rfpose.multilat.integrity import IntegrityStatus
from rfpose.pipeline.choice import PoseChoice
from rfpose.scenario import Scenario
from rfpose.shown import Shown, counted, number
from rfpose.tables import data_frame
from rfpose.truth import Truth

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr
    from matplotlib.figure import Figure

    from rfpose.pipeline.evaluate import Evaluation

__all__ = [
    "LAST_TIME_S",
    "DelayTable",
    "FilteredTable",
    "FixTable",
    "IntegrityTable",
    "PoseTable",
    "ReflectionTable",
    "Result",
    "SiteTable",
    "StatusArray",
    "frame_time",
    "rate_of",
]

StatusArray = npt.NDArray[np.int8]


@dataclass(frozen=True, slots=True, kw_only=True)
class FixTable:
    """Positions of the receivers, each located on its own: `rfpose.multilat.Fixes` with a frame axis.

    Attributes
    ----------
    position_enu_m : (frame, receiver, xyz)
        Site ENU [m]. NaN = not solved.
    cov_enu_m2 : (frame, receiver, xyz, xyz)
        Covariance, calibration included [m²].
    clock_m : (frame, receiver)
        Range to the reference transmitter [m].
    dop : (frame, receiver)
        Position RMS over the standard deviation of one transmitter's range, all alike.
    residual_m : (frame, receiver, transmitter)
        Computed less measured range [m].
    chi2 : (frame, receiver)
        Sum of squared residuals over their variances.
    n_transmitter, n_iteration : (frame, receiver)
        Transmitters used, Gauss-Newton steps taken.
    status : (frame, receiver)
        `rfpose.multilat.FixStatus`.
    """

    position_enu_m: FloatArray
    cov_enu_m2: FloatArray
    clock_m: FloatArray
    dop: FloatArray
    residual_m: FloatArray
    chi2: FloatArray
    n_transmitter: npt.NDArray[np.int16]
    n_iteration: npt.NDArray[np.int16]
    status: StatusArray


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseTable:
    """Mirror normals: `rfpose.multilat.Normals` with the mirrors' places.

    Attributes
    ----------
    normal_enu : (frame, heliostat, xyz)
        Unit length, out of the mirror's front. NaN = not solved.
    cov_enu : (frame, heliostat, xyz, xyz)
        Covariance of ``normal_enu`` (singular along the normal) [rad²].
    sigma_rad : (frame, heliostat)
        RMS angle of the normal's error, both axes together [rad].
    azimuth_rad, elevation_rad : (frame, heliostat)
        Of the normal; azimuth from north, clockwise [rad].
    centre_enu_m : (frame, heliostat, xyz)
        Mean position of the located receivers, site ENU [m].
    n_receiver : (frame, heliostat)
        Receivers used.
    n_wavelength : (frame, heliostat)
        Wavelengths that pose ``rigid`` rests on: tones, and the carrier, whose whole wavelengths were resolved.
    integer_risk : (frame, heliostat)
        Largest probability, beforehand, that one of them has a wrong whole wavelength. NaN for pose ``independent``.
    integer_method : (frame, heliostat, clock)
        `rfpose.multilat.rigid.integers.IntegerMethod` of each tone, the coarsest first, then of the carrier.
    status : (frame, heliostat)
        `rfpose.multilat.PoseStatus`.
    """

    normal_enu: FloatArray
    cov_enu: FloatArray
    sigma_rad: FloatArray
    azimuth_rad: FloatArray
    elevation_rad: FloatArray
    centre_enu_m: FloatArray
    n_receiver: npt.NDArray[np.int16]
    n_wavelength: npt.NDArray[np.int16]
    integer_risk: FloatArray
    integer_method: npt.NDArray[np.int8]
    status: StatusArray


@dataclass(frozen=True, slots=True, kw_only=True)
class IntegrityTable:
    """What tests of the residuals found, of pose ``rigid``.

    Attributes
    ----------
    status : (frame, heliostat)
        `rfpose.multilat.integrity.IntegrityStatus`.
    transmitter_status : (frame, heliostat, transmitter)
        `rfpose.multilat.integrity.TransmitterStatus`: what was left out, and why.
    used : (frame, receiver, transmitter)
        Whether any of its phases is in the pose; false for calibration receivers.
    prior_rejected, prior_testable : (frame, heliostat, prior)
        Pivot, mount and clocks: which contradicts the data and was left out; which the data could contradict.
    probability_all, probability : (frame, heliostat)
        Of residuals as large or larger by noise alone, with everything, and with what was used.
    protection_level_rad : (frame, heliostat)
        The normal is off by more, without a warning, no more often than the scenario's ``missed_detection``, one
        transmitter being wrong by whatever amount. Infinite where nothing protects it, NaN where there is no pose.
    worst_transmitter : (frame, heliostat)
        The one that sets it; −1: another explanation of an error found, or no pose.
    """

    status: StatusArray
    transmitter_status: StatusArray
    used: npt.NDArray[np.bool_]
    prior_rejected: npt.NDArray[np.bool_]
    prior_testable: npt.NDArray[np.bool_]
    probability_all: FloatArray
    probability: FloatArray
    protection_level_rad: FloatArray
    worst_transmitter: npt.NDArray[np.int16]

    @staticmethod
    def unsolved(scenario: Scenario, n_frame: int) -> dict[str, npt.NDArray[Any]]:
        """Return the columns of a recording in which no mirror is solved yet, to be written into."""
        mirror = (n_frame, len(scenario.heliostat))
        n_transmitter = len(scenario.transmitter)
        return {
            "status": np.full(mirror, IntegrityStatus.NOT_SOLVED, np.int8),
            "transmitter_status": np.zeros((*mirror, n_transmitter), np.int8),
            "used": np.zeros((n_frame, len(scenario.receivers), n_transmitter), np.bool_),
            "prior_rejected": np.zeros((*mirror, 3), np.bool_),
            "prior_testable": np.zeros((*mirror, 3), np.bool_),
            "probability_all": np.full(mirror, np.nan),
            "probability": np.full(mirror, np.nan),
            "protection_level_rad": np.full(mirror, np.nan),
            "worst_transmitter": np.full(mirror, -1, np.int16),
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class ReflectionTable:
    """Coefficients of what reflects, as each pose was solved with.

    Attributes
    ----------
    coefficient : (frame, heliostat, reflector)
        Complex, at RF; the ground first, then the scenario's planes. With Fresnel's formulas the factor on them.
    coefficient_sigma : (frame, heliostat, reflector, 2)
        Standard deviation of real and imaginary part; 0 where given, NaN where not determined.
    probability_direct : (frame, heliostat)
        Of the residuals that the direct ray alone leaves in the tones: small says that the reflection is needed.
    """

    coefficient: npt.NDArray[np.complex128]
    coefficient_sigma: FloatArray
    probability_direct: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class SiteTable:
    """What pose ``site`` found besides poses.

    Attributes
    ----------
    weight : (frame, receiver, transmitter)
        What each link counts, beside one without surprises; NaN: not used.
    residual_rad, sigma_rad : (frame, receiver, transmitter)
        Phase that neither pose nor foreseen rays explain, and its expected standard deviation [rad].
    floor : (frame, heliostat)
        Strength of the field that nothing foresees, relative to the direct one.
    tail : (heliostat,)
        Degrees of freedom of its distribution, Student's t.
    factor_scale : (heliostat, ray kind)
        How large errors of foreseen rays' factors are beside what ``[multipath]`` says.
    permittivity_change : (heliostat,)
        Relative change of the ground's complex permittivity against the scenario's.
    permittivity_sigma : (heliostat, 2)
        Its standard deviation, real and imaginary part.
    """

    weight: FloatArray
    residual_rad: FloatArray
    sigma_rad: FloatArray
    floor: FloatArray
    tail: FloatArray
    factor_scale: FloatArray
    permittivity_change: npt.NDArray[np.complex128]
    permittivity_sigma: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class DelayTable:
    """Delays between a mirror's receivers, learned over frames.

    Attributes
    ----------
    delay_s : (frame, receiver, clock)
        Less that of the mirror's first receiver, after the frame [s]. Clocks: tones from the coarsest on, then the
        carrier. NaN: not learned, or nothing seen yet.
    sigma_s : (frame, receiver, clock)
        Its standard deviation [s].
    jumped : (frame, heliostat)
        A delay had jumped: all of the mirror's were learned anew from this frame.
    """

    delay_s: FloatArray
    sigma_s: FloatArray
    jumped: npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True, kw_only=True)
class FilteredTable:
    """Poses filtered over frames, each of the frame's middle: `rfpose.multilat.FilteredPoses`.

    Attributes
    ----------
    normal_enu : (frame, heliostat, xyz)
        Unit length; NaN = nothing known yet, or no longer.
    cov_enu : (frame, heliostat, xyz, xyz)
        Covariance of ``normal_enu`` (singular along the normal) [rad²].
    sigma_rad : (frame, heliostat)
        RMS angle of the normal's error, both axes together [rad].
    pivot_enu_m, rate_enu_radps : (frame, heliostat, xyz)
        Pivot [m]; turning rate [rad/s].
    status : (frame, heliostat)
        `rfpose.multilat.FilterStatus`.
    """

    normal_enu: FloatArray
    cov_enu: FloatArray
    sigma_rad: FloatArray
    pivot_enu_m: FloatArray
    rate_enu_radps: FloatArray
    status: StatusArray


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Result(Shown):
    """All that processing a recording found.

    Attributes
    ----------
    scenario
        The site as it was processed; its receiver axis is the receiver axis here.
    sample_rate
        Nominal, of the recording [1/s].
    choice
        The estimator of poses.
    settings
        All that the result depends on besides the recording, these two too, as text for the file.
    frame_start_index : (frame,)
        First sample of each frame, counted from the Unix epoch at the recording's sample rate.
    tones, calibration, ranges, fixes, poses
        The stages in order.
    integrity, reflection, site, delays, filtered
        What else the chosen estimator of poses found; None where it does not look for it.
    truth
        What was really there, copied from a simulated recording; else None.
    profile
        Seconds by stage and what takes longest, as `rfpose process --profile` tells them; None for a result that was
        read from a file.
    """

    scenario: Scenario
    sample_rate: Fraction
    choice: PoseChoice
    settings: Mapping[str, str]
    frame_start_index: npt.NDArray[np.int64]
    tones: TonePhases
    calibration: PhaseCalibration
    ranges: RangeDifferences
    fixes: FixTable
    poses: PoseTable
    integrity: IntegrityTable | None = None
    reflection: ReflectionTable | None = None
    site: SiteTable | None = None
    delays: DelayTable | None = None
    filtered: FilteredTable | None = None
    truth: Truth | None = None
    profile: Mapping[str, Any] | None = None

    def headline(self) -> str:
        """Return of what, how much, and how many poses were solved."""
        status = self.poses.status
        counts = f"{counted(len(status), 'frame')}, {counted(len(self.scenario.heliostat_ids), 'heliostat')}"
        return f"{self.scenario.name!r}: {counts}, {np.count_nonzero(status == 0)} of {status.size} poses solved"

    def figures(self) -> tuple[list[str], list[list[str]]]:
        """Return one row a heliostat: frames solved, and how well its normal is known."""
        mrad, good = 1e3 * self.poses.sigma_rad, self.poses.status == 0
        rows = []
        for i, name in enumerate(self.scenario.heliostat_ids):
            kept = mrad[good[:, i], i]
            sigma = float(np.sqrt(np.mean(kept**2))) if kept.size else None
            rows.append([name, f"{kept.size} of {len(mrad)}", number(sigma)])
        return ["heliostat", "frames solved", "sigma of the normal, rms [mrad]"], rows

    def summary(self) -> dict[str, Any]:
        """Return counts of what was solved and what was not, with reasons, as ``rfpose process --json`` prints them."""
        from rfpose.pipeline.formats.result_summary import summarise

        return summarise(self)

    def save(self, path: str | Path, *, force: bool = False) -> None:
        """Write the result, format ``rfpose-result``.

        Parameters
        ----------
        path
            File to write.
        force
            Overwrite what exists.

        Raises
        ------
        RecordingError
            The file exists, or cannot be written; what stood under ``path`` is untouched.
        """
        from rfpose.pipeline.formats.result_file import write_result

        write_result(self, path, force=force)

    def to_pandas(self, what: Literal["poses", "fixes"] = "poses") -> pd.DataFrame:
        """Return mirror normals, or places of receivers each located on its own, one row a frame; needs pandas.

        Raises
        ------
        InvalidInputError
            pandas is not installed; ``what`` is something else.
        """
        from rfpose.pipeline.formats.result_summary import fix_table, pose_table

        tables = {"poses": pose_table, "fixes": fix_table}
        if what not in tables:
            raise InvalidInputError(f"`what` must be one of {', '.join(tables)}, got {what!r}")
        return data_frame(*tables[what](self))

    def to_xarray(self, group: str | None = None) -> xr.Dataset:
        """Return the arrays with labelled dimensions: frame time, receiver, heliostat, transmitter, tone; needs xarray.

        Units and meanings are attributes, and a status has its codes as CF has them: ``flag_values`` and
        ``flag_meanings``.

        Parameters
        ----------
        group
            One group of the result file, ``"poses"`` for one, with its names; None: everything, named as
            ``poses_normal_enu``.

        Raises
        ------
        InvalidInputError
            xarray is not installed; the result has no such group.
        """
        from rfpose.pipeline.formats.result_file import dataset

        return dataset(self, group)

    def plot(self, *, evaluation: Evaluation | None = None, frame: int | None = None) -> Figure:
        """Draw the field from above: transmitters, heliostats, their normals, and how well these are known.

        With ``evaluation`` a mirror's colour is its error instead of the sigma that the result reports; over all
        frames, or of one ``frame``.
        """
        from rfpose.drawing import look
        from rfpose.pipeline.pictures.results import draw_field_map

        with look():
            return draw_field_map(self, evaluation=evaluation, frame=frame)


LAST_TIME_S = 253_402_300_799
"""The last second of the year 9999, after which there are no dates."""


def rate_of(settings: Mapping[str, str]) -> Fraction:
    """Return the sample rate that settings name, as a number or a ratio of two [1/s].

    Raises
    ------
    InvalidInputError
        It is none, or not greater than zero.
    """
    rate = exact_number("sample_rate", settings["sample_rate"])
    if rate <= 0:
        raise InvalidInputError(f"`sample_rate` must be greater than zero, got {settings['sample_rate']!r}")
    return rate


def frame_time(start_index: int, sample_rate: Fraction) -> datetime:
    """Return the UTC time of a sample counted from the Unix epoch, to the microsecond."""
    microseconds = int(start_index * 1_000_000 / sample_rate)
    return datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=microseconds)
