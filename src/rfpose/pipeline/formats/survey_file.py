"""The file of a survey: format ``rfpose-survey``, HDF5; see ``docs/survey.md``."""

from __future__ import annotations

import io
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from rfpose import __version__, geometry
from rfpose.checks import FloatArray
from rfpose.dsp import TonePhases
from rfpose.errors import InvalidInputError, RecordingError, ScenarioError
from rfpose.feedback.correlated import AXES_AND_ZEROS
from rfpose.feedback.correlated import CASES as MOUNT_CASES
from rfpose.files import write_atomically
from rfpose.multilat.site import CASES, lever_to_turn
from rfpose.pipeline.formats.columns import Column, ColumnWriter, Labels, text_label
from rfpose.pipeline.formats.hdf5_values import FileReader, opened, text_of
from rfpose.pipeline.formats.result import Result
from rfpose.scenario import Scenario

__all__ = ["SURVEY_FORMAT", "SURVEY_VERSION", "SurveyFile", "SurveyedMounts", "read_survey", "write_survey"]

SURVEY_FORMAT = "rfpose-survey"
SURVEY_VERSION = 1

_AGAIN = "make it again with `rfpose survey`"
_LENGTHS = {
    "xyz": 3, "part": 2, "case": len(CASES), "mount_case": len(MOUNT_CASES), "parameter": len(AXES_AND_ZEROS),
    "parameter_other": len(AXES_AND_ZEROS),
}  # fmt: skip
_FAR_SIGMAS = 6.0
_ROUNDING_M = 1e-6
_LEAST_PERMITTIVITY = 1.001
_VACUUM_PERMITTIVITY = 8.8541878128e-12
_KEYS = {
    "receiver_mirror_m": Column(("heliostat", "receiver", "xyz"), "f8", "m", "places on the mirror; NaN: no receiver"),
    "receiver_cov_m2": Column(("heliostat", "place", "place_other"), "f8", "m2", "covariance, receiver by receiver"),
    "pivot_enu_m": Column(("heliostat", "xyz"), "f8", "m", "pivots"),
    "pivot_sigma_m": Column(("heliostat", "xyz"), "f8", "m", "standard deviation"),
    "transmitter_enu_m": Column(("transmitter", "xyz"), "f8", "m", "transmitters"),
    "transmitter_sigma_m": Column(("transmitter", "xyz"), "f8", "m", "standard deviation; 0: not surveyed"),
    "delay_m": Column(("heliostat", "receiver"), "f8", "m", "receivers' delays about the mirror's clock"),
    "delay_sigma_m": Column(
        ("heliostat", "receiver"), "f8", "m", "of a delay about the mirror's mean; 0: not surveyed"
    ),
    "permittivity_change": Column(("part",), "f8", "1", "relative change of the ground's complex permittivity"),
    "permittivity_sigma": Column(("part",), "f8", "1", "standard deviation of that"),
    "frame_count": Column(("heliostat",), "i8", "1", "frames that told something"),
    "frame_worth": Column(("heliostat",), "f8", "1", "how many independent ones they are worth"),
    "correlation_share": Column(("heliostat",), "f8", "1", "of errors' variance, what turns slowly with posture"),
    "correlation_rad": Column(("heliostat",), "f8", "rad", "angle between normals over which that falls to 1/e"),
    "rank": Column(("heliostat",), "i8", "1", "directions that measurements determine"),
    "normal_sigma_rad": Column(("heliostat", "case"), "f8", "rad", "error of normals that constants leave"),
}
_MOUNT_KEYS = {
    "parameter": Column(("heliostat", "parameter"), "f8", "rad", "what mounts are off by"),
    "cov": Column(("heliostat", "parameter", "parameter_other"), "f8", "rad2", "covariance of that"),
    "rank": Column(("heliostat",), "i8", "1", "directions of it that normals determine"),
    "scatter": Column(("heliostat",), "f8", "1", "of normals about the mount, in stated sigmas; NaN: too few to tell"),
    "normal_sigma_rad": Column(("heliostat", "mount_case"), "f8", "rad", "error of a mount's normals; NaN: no posture"),
}
"""In the file each has `mount_` before its name."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SurveyedMounts:
    """What mounts are off by.

    Attributes
    ----------
    parameter : (heliostat, parameter)
        In the order of `rfpose.feedback.correlated.AXES_AND_ZEROS` [rad].
    cov : (heliostat, parameter, parameter)
        [rad²].
    rank : (heliostat,)
        Directions that normals determine.
    scatter : (heliostat,)
        Of normals about the mount, in stated sigmas; NaN: too few to tell.
    normal_sigma_rad : (heliostat, case)
        See `rfpose.feedback.correlated.CASES`; NaN: no posture.
    undetermined
        By heliostat, in words.
    """

    parameter: FloatArray
    cov: FloatArray
    rank: np.ndarray[Any, Any]
    scatter: FloatArray
    normal_sigma_rad: FloatArray
    undetermined: tuple[tuple[str, ...], ...]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class SurveyFile:
    """A survey: what does not change, and how well it is known.

    Attributes
    ----------
    scenario
        The site as it was known before.
    receiver_mirror_m, receiver_cov_m2 : (heliostat, receiver, xyz), (heliostat, 3 receiver, 3 receiver)
        Places in the mirror frame, from its centre, and their covariance [m, m²]; NaN where a heliostat has fewer.
    pivot_enu_m, pivot_sigma_m : (heliostat, xyz)
        [m].
    transmitter_enu_m, transmitter_sigma_m : (transmitter, xyz)
        [m].
    delay_m, delay_sigma_m : (heliostat, receiver)
        Sigma about the mirror's mean; zero: not surveyed [m].
    permittivity_change, permittivity_sigma : (real and imaginary part,)
        Of the ground, relative.
    frame_count, frame_worth : (heliostat,)
        Frames that told something, and how many independent ones they are worth.
    correlation_share, correlation_rad : (heliostat,)
        See `rfpose.multilat.site.PostureCorrelation`.
    rank : (heliostat,)
    normal_sigma_rad : (heliostat, case)
        See `rfpose.multilat.site.CASES`.
    undetermined
        By heliostat, in words, what measurements do not tell.
    transmitters_undetermined
        The same of the transmitters.
    mounts
    """

    scenario: Scenario
    receiver_mirror_m: FloatArray
    receiver_cov_m2: FloatArray
    pivot_enu_m: FloatArray
    pivot_sigma_m: FloatArray
    transmitter_enu_m: FloatArray
    transmitter_sigma_m: FloatArray
    delay_m: FloatArray
    delay_sigma_m: FloatArray
    permittivity_change: FloatArray
    permittivity_sigma: FloatArray
    frame_count: np.ndarray[Any, Any]
    frame_worth: FloatArray
    correlation_share: FloatArray
    correlation_rad: FloatArray
    rank: np.ndarray[Any, Any]
    normal_sigma_rad: FloatArray
    undetermined: tuple[tuple[str, ...], ...]
    transmitters_undetermined: tuple[str, ...]
    mounts: SurveyedMounts

    def __repr__(self) -> str:
        seen = int(np.count_nonzero(self.frame_count))
        return (
            f"<SurveyFile {self.scenario.name!r}: {seen} of {len(self.frame_count)} heliostats in "
            f"{int(self.frame_count.max(initial=0))} frames or fewer>"
        )

    def save(self, path: str | Path, *, force: bool = False) -> None:
        """Write it; see `write_survey`."""
        write_survey(path, self, force=force)

    def applied(self, scenario: Scenario) -> Scenario:
        """Return a scenario with what was surveyed.

        Raises
        ------
        ScenarioError
            It is of another site: other heliostats or transmitters, or places farther off than they may be.
        """
        row = {name: i for i, name in enumerate(self.scenario.heliostat_ids)}
        heliostats = []
        # one for all, so that mirrors stay alike and are solved together
        pivot_sigma = float(np.sqrt(np.mean(self.pivot_sigma_m**2)))
        delay_sigma = float(np.sqrt(np.nanmean(self.delay_sigma_m**2))) / scenario.radio.propagation_speed_mps
        for h in scenario.heliostat:
            if h.id not in row:
                raise ScenarioError(f"the survey is of another site: it has no heliostat `{h.id}`; survey this site")
            i, n = row[h.id], len(h.receiver_mirror_m)
            places = self.receiver_mirror_m[i, :n]
            if len(places) < n or np.isnan(places).any() or np.isfinite(self.receiver_mirror_m[i, n:]).any():
                raise ScenarioError(
                    f"the survey is of another site: heliostat `{h.id}` has another number of receivers there"
                )
            _near(f"receivers of heliostat `{h.id}`", places, h.receiver_mirror_m, h.receiver_survey_sigma_m)
            _near(f"pivot of heliostat `{h.id}`", self.pivot_enu_m[i], h.pivot_enu_m, h.pivot_sigma_m or 0.0)
            surveyed = {"receiver_mirror_m": places, "pivot_enu_m": self.pivot_enu_m[i], "pivot_sigma_m": pivot_sigma}
            if delay_sigma > 0.0 and h.receiver_delay_sigma_s:
                surveyed["receiver_delay_sigma_s"] = delay_sigma
            heliostats.append(h.changed(**surveyed))
        of = {t.id: k for k, t in enumerate(self.scenario.transmitter)}
        transmitters = []
        for t in scenario.transmitter:
            if t.id not in of:
                raise ScenarioError(f"the survey is of another site: it has no transmitter `{t.id}`; survey this site")
            place = self.transmitter_enu_m[of[t.id]]
            _near(f"transmitter `{t.id}`", place, t.position_enu_m, t.survey_sigma_m)
            transmitters.append(t.changed(position_enu_m=place))
        return scenario.changed(heliostat=heliostats, transmitter=transmitters, **self._ground(scenario))

    def without_delays(self, tones: TonePhases, scenario: Scenario) -> TonePhases:
        """Return phases without the delays that were surveyed, of a scenario that `applied` took."""
        row = {name: i for i, name in enumerate(self.scenario.heliostat_ids)}
        delay = np.zeros(tones.carrier.shape[1])
        for k, h in enumerate(scenario.heliostat):
            rows = scenario.receiver_rows(k)
            delay[rows] = self.delay_m[row[h.id], : len(h.receiver_mirror_m)]
        if not delay.any():
            return tones
        speed = scenario.radio.propagation_speed_mps
        carrier_rad = 2.0 * np.pi / speed * delay[:, None] * scenario.carrier_rf_hz
        tone_rad = 2.0 * np.pi * delay[:, None, None] / scenario.wavelength_m
        return replace(tones, carrier=tones.carrier * np.exp(1j * carrier_rad), phase_rad=tones.phase_rad + tone_rad)

    def mounts_of(self, scenario: Scenario) -> SurveyedMounts:
        """Return the mounts of a scenario's heliostats, in its order; of one that `applied` took."""
        row = {name: i for i, name in enumerate(self.scenario.heliostat_ids)}
        pick = [row[h.id] for h in scenario.heliostat]
        own = self.mounts
        return SurveyedMounts(
            undetermined=tuple(own.undetermined[i] for i in pick),
            **{name: getattr(own, name)[pick] for name in _MOUNT_KEYS},
        )

    def _ground(self, scenario: Scenario) -> dict[str, Any]:
        """Return the tables that the ground's surveyed permittivity changes."""
        table = scenario.reflection
        if table.model != "fresnel" or table.permittivity is None or not self.permittivity_change.any():
            return {}
        per_siemens = 1.0 / (2.0 * np.pi * float(scenario.carrier_rf_hz.mean()) * _VACUUM_PERMITTIVITY)
        value = complex(table.permittivity, -table.conductivity_s_per_m * per_siemens)
        value *= 1.0 + complex(*self.permittivity_change)
        return {
            "reflection": {
                "permittivity": max(value.real, _LEAST_PERMITTIVITY),
                "conductivity_s_per_m": max(-value.imag, 0.0) / per_siemens,
            },
            "multipath": {"permittivity_sigma": self.permittivity_sigma.tolist()},
        }

    def widened(self, result: Result) -> Result:
        """Return a result whose sigmas know how well places were surveyed."""
        row = {name: i for i, name in enumerate(self.scenario.heliostat_ids)}
        poses = result.poses
        cov, level = poses.cov_enu.copy(), result.integrity.protection_level_rad.copy() if result.integrity else None
        risk = -2.0 * np.log(result.scenario.integrity.missed_detection)
        for column, h in enumerate(result.scenario.heliostat):
            i, n = row[h.id], len(h.receiver_mirror_m)
            tilt = lever_to_turn(self.receiver_mirror_m[i, :n])[:2]
            by_turn = tilt @ self.receiver_cov_m2[i, : 3 * n, : 3 * n] @ tilt.T
            solved = np.flatnonzero(np.isfinite(poses.normal_enu[:, column, 0]))
            rot = geometry.rot_enu_from_mirror(poses.normal_enu[solved, column])
            across = np.stack([-rot[:, :, 1], rot[:, :, 0]], axis=2)  # of the normal, by a turn about x and y
            cov[solved, column] += across @ by_turn @ across.swapaxes(1, 2)
            if level is not None:
                level[:, column] = np.sqrt(level[:, column] ** 2 + risk * float(np.linalg.eigvalsh(by_turn)[-1]))
        sigma = np.sqrt(np.trace(cov, axis1=2, axis2=3))
        wider = replace(result, poses=replace(poses, cov_enu=cov, sigma_rad=sigma))
        if level is not None and wider.integrity is not None:
            wider = replace(wider, integrity=replace(wider.integrity, protection_level_rad=level))
        return wider

    def as_dict(self) -> dict[str, Any]:
        """Return the report, ready for JSON."""
        heliostats = {}
        for i, h in enumerate(self.scenario.heliostat):
            n = len(h.receiver_mirror_m)
            place_sigma = np.sqrt(np.diagonal(self.receiver_cov_m2[i])[: 3 * n]).reshape(n, 3)
            heliostats[h.id] = {
                "frames": int(self.frame_count[i]),
                "frames_worth": float(self.frame_worth[i]),
                "correlation_share": float(self.correlation_share[i]),
                "correlation_deg": float(np.degrees(self.correlation_rad[i])),
                "rank": int(self.rank[i]),
                "undetermined": list(self.undetermined[i]),
                "receiver_mirror_m": self.receiver_mirror_m[i, :n].tolist(),
                "receiver_sigma_m": place_sigma.tolist(),
                "receiver_prior_sigma_m": h.receiver_survey_sigma_m,
                "pivot_enu_m": self.pivot_enu_m[i].tolist(),
                "pivot_sigma_m": self.pivot_sigma_m[i].tolist(),
                "pivot_prior_sigma_m": h.pivot_sigma_m,
                "delay_m": self.delay_m[i, :n].tolist(),
                "delay_sigma_m": self.delay_sigma_m[i, :n].tolist(),
                "normal_sigma_mrad": dict(zip(CASES, (1e3 * self.normal_sigma_rad[i]).tolist(), strict=True)),
                "mount": self._mount_as_dict(i),
            }
        transmitters = {
            t.id: {
                "position_enu_m": self.transmitter_enu_m[k].tolist(),
                "sigma_m": self.transmitter_sigma_m[k].tolist(),
                "prior_sigma_m": t.survey_sigma_m,
            }
            for k, t in enumerate(self.scenario.transmitter)
        }
        return {
            "heliostats": heliostats,
            "transmitters": transmitters,
            "transmitters_undetermined": list(self.transmitters_undetermined),
            "permittivity_change": self.permittivity_change.tolist(),
            "permittivity_sigma": self.permittivity_sigma.tolist(),
        }

    def _mount_as_dict(self, i: int) -> dict[str, Any]:
        mounts = self.mounts
        sigma = np.sqrt(np.diagonal(mounts.cov[i]))
        normal, scatter = mounts.normal_sigma_rad[i], float(mounts.scatter[i])
        return {
            "parameters": dict(zip(AXES_AND_ZEROS, mounts.parameter[i].tolist(), strict=True)),
            "sigma": dict(zip(AXES_AND_ZEROS, sigma.tolist(), strict=True)),
            "rank": int(mounts.rank[i]),
            "undetermined": list(mounts.undetermined[i]),
            "scatter": scatter if np.isfinite(scatter) else None,
            "normal_sigma_mrad": {
                case: 1e3 * x if np.isfinite(x) else None for case, x in zip(MOUNT_CASES, normal.tolist(), strict=True)
            },
        }


def _near(what: str, found: FloatArray, said: Any, sigma: float) -> None:
    off = float(np.abs(found - np.array(said)).max())
    if off > _FAR_SIGMAS * sigma + _ROUNDING_M:
        raise ScenarioError(
            f"the survey is of another site: {what} is {off:.3g} m from where the scenario has it, "
            f"known to {sigma:.3g} m; survey this site, or correct the scenario"
        )


def write_survey(path: str | Path, survey: SurveyFile, *, force: bool = False) -> None:
    """Write a survey.

    Raises
    ------
    RecordingError
        The file exists and may not be replaced, or cannot be written.
    """
    n = survey.receiver_cov_m2.shape[1]
    labels: Labels = {
        "heliostat": text_label(survey.scenario.heliostat_ids, "heliostat"),
        "transmitter": text_label([t.id for t in survey.scenario.transmitter], "transmitter"),
        "receiver": (np.arange(n // 3), {"long_name": "receiver of a mirror, in the scenario's order"}),
        "place": (np.arange(n), {"long_name": "3 receiver + axis"}),
        "place_other": (np.arange(n), {"long_name": "3 receiver + axis"}),
        "xyz": text_label("xyz", "axis"),
        "part": text_label(["real", "imaginary"], "part"),
        "case": text_label(CASES, "what is known"),
        "mount_case": text_label(MOUNT_CASES, "what is known"),
        "parameter": text_label(AXES_AND_ZEROS, "of a mount"),
        "parameter_other": text_label(AXES_AND_ZEROS, "of a mount"),
    }
    image = io.BytesIO()
    with h5py.File(image, "w", libver=("v110", "v110")) as file:
        file.attrs.update({"format": SURVEY_FORMAT, "version": SURVEY_VERSION, "made_by": f"rfpose {__version__}"})
        file["scenario"] = survey.scenario.to_toml()
        file["undetermined"] = json.dumps(
            [survey.undetermined, survey.transmitters_undetermined, survey.mounts.undetermined]
        )
        writer = ColumnWriter(file, labels)
        for name, column in _KEYS.items():
            writer.write(file, name, column, getattr(survey, name))
        for name, column in _MOUNT_KEYS.items():
            writer.write(file, f"mount_{name}", column, getattr(survey.mounts, name))
    write_atomically(path, image.getvalue(), force=force)


def read_survey(path: str | Path) -> SurveyFile:
    """Read a survey.

    Raises
    ------
    RecordingError
        Missing, another kind of file or version, or damaged: the place is named.
    """
    path = Path(path)
    with opened(path, wanted="survey", version=SURVEY_VERSION, again=_AGAIN) as file:
        reader = FileReader(path, file, length=_LENGTHS, again=_AGAIN)
        scenario = reader.scenario()
        n = max((len(h.receiver_mirror_m) for h in scenario.heliostat), default=0)
        reader.length.update(
            heliostat=len(scenario.heliostat), transmitter=len(scenario.transmitter), receiver=n, place=3 * n,
            place_other=3 * n,
        )  # fmt: skip
        values = {name: reader.array(name, column) for name, column in _KEYS.items()}
        mounts = {name: reader.array(f"mount_{name}", column) for name, column in _MOUNT_KEYS.items()}
        own, common, of_mounts = _words(reader, len(scenario.heliostat))
    found = SurveyFile(
        scenario=scenario, undetermined=own, transmitters_undetermined=common,
        mounts=SurveyedMounts(undetermined=of_mounts, **mounts), **values,
    )  # fmt: skip
    for name in ("pivot_enu_m", "pivot_sigma_m", "transmitter_enu_m", "transmitter_sigma_m"):
        if not np.isfinite(values[name]).all() or (name.endswith("sigma_m") and (values[name] < 0.0).any()):
            raise reader.error(name, "holds what is no place or sigma")
    for name in ("permittivity_change", "permittivity_sigma"):
        if not np.isfinite(values[name]).all() or (name.endswith("sigma") and (values[name] < 0.0).any()):
            raise reader.error(name, "must be finite, and a sigma not below zero")
    for i, h in enumerate(scenario.heliostat):
        delays = np.stack([values[name][i, : len(h.receiver_mirror_m)] for name in ("delay_m", "delay_sigma_m")])
        if not np.isfinite(delays).all() or (delays[1] < 0.0).any():
            raise reader.error("delay_m", f"or delay_sigma_m is none for heliostat `{h.id}`")
        cov = values["receiver_cov_m2"][i, : 3 * len(h.receiver_mirror_m), : 3 * len(h.receiver_mirror_m)]
        if not _is_covariance(cov):
            raise reader.error("receiver_cov_m2", f"is no covariance for heliostat `{h.id}`")
        if not _is_covariance(mounts["cov"][i]) or not np.isfinite(mounts["parameter"][i]).all():
            raise reader.error("mount_cov", f"or mount_parameter is none for heliostat `{h.id}`")
    try:
        found.applied(scenario)
    except (ScenarioError, InvalidInputError) as error:
        raise RecordingError(f"{path}: {error}; the file is damaged: {_AGAIN}") from error
    return found


def _is_covariance(square: FloatArray) -> bool:
    return bool(np.isfinite(square).all() and np.linalg.eigvalsh(0.5 * (square + square.T))[0] >= -1e-12)


_Words = tuple[tuple[str, ...], ...]


def _words(reader: FileReader, n_heliostat: int) -> tuple[_Words, tuple[str, ...], _Words]:
    """Return what is not determined: of each heliostat, of the transmitters, of each mount."""
    try:
        own, common, mounts = json.loads(text_of(reader.file, "/undetermined"))
        lists = [*own, common, *mounts]
        if not len(own) == len(mounts) == n_heliostat or not all(
            isinstance(w, list) and all(isinstance(t, str) for t in w) for w in lists
        ):
            raise ValueError("is no list of words for each heliostat")
    except (ValueError, TypeError, RecursionError) as error:
        raise reader.error("undetermined", f"cannot be read ({error!s:.80})") from error
    own, mounts = (tuple(tuple(t[:200] for t in w) for w in words) for words in (own, mounts))
    return own, tuple(t[:200] for t in common), mounts
