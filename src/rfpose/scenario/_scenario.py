"""The whole site: records, the arrays made of them, and scaling."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, NamedTuple, Self

import numpy as np
import numpy.typing as npt
import tomli_w
from pydantic import Field, ValidationError, model_validator

from rfpose import geometry, sun
from rfpose.checks import FloatArray, as_float_array, read_only
from rfpose.errors import ScenarioError
from rfpose.files import write_atomically
from rfpose.scenario._consistency import CHECKS
from rfpose.scenario._scaling import scale_lengths
from rfpose.scenario._words import in_words
from rfpose.scenario.budget import Budget
from rfpose.scenario.estimation import Integrity, Motion, Reflection
from rfpose.scenario.multipath import Antenna, Multipath
from rfpose.scenario.positions import read_positions
from rfpose.scenario.records import CalibrationReceiver, Heliostat, Radio, Record, Tone, Transmitter
from rfpose.scenario.simulation import Simulation
from rfpose.scenario.site import Posture, Site, StructurePlate
from rfpose.scenario.tracking import Tracking
from rfpose.shown import counted, html_table, listed


class Receiver(NamedTuple):
    """One row of the receiver axis: where it belongs. Calibration receivers have no heliostat."""

    id: str
    heliostat: int | None
    calibration: int | None
    oscillator: str


class Scenario(Record):
    """A whole site. Load one with `load_scenario`; array properties are read-only.

    The receiver axis holds every heliostat's receivers in order, then the calibration receivers.
    """

    name: str
    site: Site = Site()
    radio: Radio
    tone: Annotated[tuple[Tone, ...], Field(min_length=1)]
    transmitter: Annotated[tuple[Transmitter, ...], Field(min_length=1)]
    calibration_receiver: tuple[CalibrationReceiver, ...] = ()
    heliostat: tuple[Heliostat, ...] = ()
    simulation: Simulation = Simulation()
    reflection: Reflection = Reflection()
    posture: Posture = Posture()
    antenna: Antenna = Antenna()
    multipath: Multipath = Multipath()
    integrity: Integrity = Integrity()
    motion: Motion = Motion()
    budget: Budget = Budget()
    tracking: Tracking = Tracking()

    def __eq__(self, other: object) -> bool:
        # not pydantic's own comparison, which trips over the cached arrays
        return isinstance(other, Scenario) and self.model_dump() == other.model_dump()

    def __hash__(self) -> int:
        return hash(self.to_toml())

    # -- arrays ------------------------------------------------------------------------------------------

    @cached_property
    def transmitter_enu_m(self) -> FloatArray:
        """(transmitter, xyz) positions [m]."""
        return read_only(np.array([t.position_enu_m for t in self.transmitter], np.float64))

    @cached_property
    def mast(self) -> npt.NDArray[np.int64]:
        """(transmitter,) at which antenna each carrier is sent, by the first transmitter there."""
        at = {t.id: k for k, t in enumerate(self.transmitter)}
        return np.array([at.get(t.mast or t.id, k) for k, t in enumerate(self.transmitter)], np.int64)

    @cached_property
    def mast_enu_m(self) -> FloatArray:
        """(mast, xyz) places of the transmitters, each once [m]."""
        return self.transmitter_enu_m[np.unique(self.mast)]

    @cached_property
    def carrier_hz(self) -> FloatArray:
        """(transmitter,) carrier offsets from the centre frequency [Hz]."""
        return read_only(np.array([t.carrier_hz for t in self.transmitter], np.float64))

    @cached_property
    def carrier_rf_hz(self) -> FloatArray:
        """(transmitter,) carrier frequencies at RF [Hz]; those of a recording about frequency zero may be negative."""
        return read_only(self.radio.centre_frequency_hz + self.carrier_hz)

    @cached_property
    def has_rf_carriers(self) -> bool:
        """Whether every carrier has a wavelength to measure or reflect with: a radio frequency above zero."""
        return bool(np.all(self.carrier_rf_hz > 0.0))

    @cached_property
    def tone_hz(self) -> FloatArray:
        """(tone,) tone frequencies [Hz]."""
        speed = self.radio.propagation_speed_mps
        return read_only(np.array([t.frequency_hz or speed / (t.wavelength_m or np.nan) for t in self.tone]))

    @cached_property
    def wavelength_m(self) -> FloatArray:
        """(tone,) tone wavelengths [m]."""
        return read_only(self.radio.propagation_speed_mps / self.tone_hz)

    @cached_property
    def line_hz(self) -> FloatArray:
        """(transmitter, line) spectral lines, offset from the centre frequency [Hz].

        Lines of a transmitter: carrier, then upper and lower sideband of each tone.
        """
        offset = [0.0]
        for tone_hz in self.tone_hz:
            offset += [tone_hz, -tone_hz]
        return read_only(self.carrier_hz[:, None] + np.array(offset)[None, :])

    @cached_property
    def calibration_enu_m(self) -> FloatArray:
        """(calibration receiver, xyz) surveyed positions [m]."""
        return read_only(np.array([r.position_enu_m for r in self.calibration_receiver]).reshape(-1, 3))

    @cached_property
    def pivot_enu_m(self) -> FloatArray:
        """(heliostat, xyz) pivot positions [m]."""
        return read_only(np.array([h.pivot_enu_m for h in self.heliostat]).reshape(-1, 3))

    @cached_property
    def mirrors(self) -> tuple[Heliostat | StructurePlate, ...]:
        """All mirrors that stand on the site: the heliostats, then the plates of ``[site.structures]``."""
        return (*self.heliostat, *self.site.structures.plate)

    @cached_property
    def mirror_pivot_enu_m(self) -> FloatArray:
        """(mirror, xyz) pivots of `mirrors` [m]."""
        return read_only(np.array([m.pivot_enu_m for m in self.mirrors]).reshape(-1, 3))

    @cached_property
    def transmitter_ids(self) -> tuple[str, ...]:
        """Transmitter identifiers in file order."""
        return tuple(t.id for t in self.transmitter)

    @cached_property
    def heliostat_ids(self) -> tuple[str, ...]:
        """Heliostat identifiers in file order."""
        return tuple(h.id for h in self.heliostat)

    @cached_property
    def receivers(self) -> tuple[Receiver, ...]:
        """The receiver axis."""
        rows = []
        for i, heliostat in enumerate(self.heliostat):
            for receiver_id in heliostat.receiver_ids:
                shared = heliostat.oscillator == "shared"
                rows.append(Receiver(receiver_id, i, None, heliostat.id if shared else receiver_id))
        for i, calibration in enumerate(self.calibration_receiver):
            rows.append(Receiver(calibration.id, None, i, calibration.id))
        return tuple(rows)

    @cached_property
    def receiver_ids(self) -> tuple[str, ...]:
        """Identifiers along the receiver axis."""
        return tuple(r.id for r in self.receivers)

    # -- derived -----------------------------------------------------------------------------------------

    def receiver_rows(self, i_heliostat: int) -> slice:
        """Rows of the receiver axis that belong to one heliostat."""
        return self.rows_by_heliostat[i_heliostat]

    @cached_property
    def rows_by_heliostat(self) -> list[slice]:
        """Rows of the receiver axis that belong to each heliostat."""
        ends = list(itertools.accumulate(len(h.receiver_ids) for h in self.heliostat))
        return [slice(end - len(h.receiver_ids), end) for h, end in zip(self.heliostat, ends, strict=True)]

    def need_rf_carriers(self, what: str) -> None:
        """Refuse what cannot be told without carriers at radio frequencies above zero.

        Raises
        ------
        ScenarioError
            Some are not; says for ``what`` they are needed.
        """
        if not self.has_rf_carriers:
            raise ScenarioError(
                f"{what} needs carriers whose radio frequencies are above zero, and that of transmitter "
                f"`{self.transmitter_ids[int(np.argmin(self.carrier_rf_hz))]}` is {self.carrier_rf_hz.min():g} Hz; set "
                "`radio.centre_frequency_hz`, or leave reflections out"
            )

    @property
    def is_calibrated(self) -> bool:
        """Whether the transmitters' electronic phases are measured; if not, receivers of a mirror are compared."""
        return bool(self.calibration_receiver)

    @property
    def learns_delays(self) -> bool:
        """Whether any heliostat's delays between receivers are learned over frames."""
        return any(h.receiver_delay_drift_s_per_sqrt_min is not None for h in self.heliostat)

    def compares_carriers(self, heliostat: Heliostat) -> bool:
        """Whether the carriers' own phases are compared between a heliostat's receivers.

        Only on one oscillator do the receivers' phases cancel, and only at radio frequencies above zero is there a
        wavelength. Whoever needs to know whether the carrier takes part in a normal asks here.
        """
        return heliostat.oscillator == "shared" and heliostat.carrier_phase and self.has_rf_carriers

    def sun_enu(self, unix_s: npt.ArrayLike) -> FloatArray | None:
        """Return the sun over the site (time, xyz), as unit vectors; None where the site's place is not told.

        Parameters
        ----------
        unix_s : (time,)
            [s since 1970 UTC]. NaN: unknown.

        Returns
        -------
        (time, xyz)
            NaN by night, and at unknown times.
        """
        site = self.site
        if site.latitude_deg is None or site.longitude_deg is None:
            return None
        time = as_float_array("unix_s", unix_s, ("time",), finite=False)
        direction = np.full((len(time), 3), np.nan)
        known = np.isfinite(time)
        if known.any():
            place = sun.site_from_degrees(site.latitude_deg, site.longitude_deg, site.height_m)
            direction[known] = sun.sun_position(time[known], place).direction_enu
        direction[direction[:, 2] <= 0.0] = np.nan
        return direction

    @cached_property
    def simulated_suns_enu(self) -> FloatArray | None:
        """(frame, xyz) towards the sun of each simulated frame; None where the scenario does not tell it.

        As ``[simulation]`` places it by hand, evenly from first to last; else that of the site at the frames' times,
        NaN by night.
        """
        simulation = self.simulation
        by_hand = (simulation.sun_azimuth_deg, simulation.sun_elevation_deg)
        if by_hand == (None, None):
            interval_s = simulation.frame_interval_s or self.radio.frame_samples / self.radio.sample_rate_hz
            suns = self.sun_enu(simulation.start_unix_s + interval_s * np.arange(simulation.frame_count))
            return None if suns is None else read_only(suns)
        if None in by_hand:
            return None
        share = np.linspace(0.0, 1.0, simulation.frame_count)
        first_last = [np.radians(np.broadcast_to(np.array(angle, np.float64), 2)) for angle in by_hand]
        return read_only(geometry.enu_from_azimuth_elevation(*(a + share * (b - a) for a, b in first_last)))

    @cached_property
    def simulated_sun_enu(self) -> FloatArray | None:
        """(xyz,) towards the simulated sun of the first frame; None by night, and without it or an aim point."""
        suns = None if self.site.aim_enu_m is None else self.simulated_suns_enu
        return None if suns is None or not np.isfinite(suns[0]).all() else suns[0]

    def following_enu(self, sun_enu: FloatArray) -> FloatArray | None:
        """Return the normals of `mirrors` that follow a sun: they send it to the aim point; dishes face it.

        Parameters
        ----------
        sun_enu : (time, xyz)

        Returns
        -------
        (time, mirror, xyz)
            NaN where the sun is, and where it is opposite to the aim point. None: heliostats without an aim point.
        """
        n_mirror = len(self.mirrors)
        if self.tracking.collector == "dish":
            return np.repeat(sun_enu[:, None], n_mirror, axis=1)
        if self.site.aim_enu_m is None:
            return None
        to_aim = np.asarray(self.site.aim_enu_m) - self.mirror_pivot_enu_m
        return geometry.bisector_enu(*np.broadcast_arrays(sun_enu[:, None], to_aim))

    @cached_property
    def posture_enu(self) -> FloatArray:
        """(heliostat, xyz) unit normals that the scenario gives its mirrors; NaN where it gives none.

        Each heliostat's own ``normal_enu``; else that which follows the simulated sun of the first frame, as `rfpose
        simulate` begins. Whatever shows or studies "the scenario's posture" takes it from here.
        """
        out = np.full((len(self.heliostat), 3), np.nan)
        suns = self.simulated_suns_enu
        following = None if suns is None or not self.heliostat else self.following_enu(suns[:1])
        if following is not None:
            out = following[0, : len(self.heliostat)].copy()
        for i, heliostat in enumerate(self.heliostat):
            if heliostat.normal_enu is not None:
                out[i] = geometry.unit(heliostat.normal_enu)
        return read_only(out)

    @cached_property
    def impossible_sun(self) -> str:
        """Why no sun stands where ``[simulation]`` places it by hand at this latitude; empty where one may."""
        azimuth, elevation = self.simulation.sun_azimuth_deg, self.simulation.sun_elevation_deg
        if azimuth is None or elevation is None:
            return ""
        first_last = [np.broadcast_to(np.array(angle, np.float64), 2).tolist() for angle in (azimuth, elevation)]
        for azimuth_deg, elevation_deg in zip(*first_last, strict=True):
            why = sun.why_never(azimuth_deg, elevation_deg, self.site.latitude_deg)
            if why:
                return f"[simulation] places the sun at azimuth {azimuth_deg:g}°, elevation {elevation_deg:g}°: {why}"
        return ""

    def scaled(self, factor: float) -> Scenario:
        """Return the scenario with every length, and every tone's wavelength, multiplied by ``factor``.

        Swart et al. §4.5: positions and normals scale with it, so one layout serves every field size. Carrier
        frequencies stay as they are.
        """
        if not (math.isfinite(factor) and factor > 0):
            raise ScenarioError(f"`scale` must be a finite number greater than zero, got {factor}")
        if factor == 1.0:
            return self
        data = self.model_dump(exclude_none=True)
        scale_lengths(data, factor)
        return Scenario.model_validate(data)

    # -- another scenario --------------------------------------------------------------------------------

    def changed(self, **tables: Any) -> Self:
        """Return the scenario with some of its tables changed, and checked as a file is.

        Parameters
        ----------
        **tables
            By the names of the file. Of a table, the keys that are given are changed, down through tables in it, and
            the others stay; None takes a key away, so that its default holds. A table given for a list of tables
            changes each of them. Anything else takes the place of what was there; records may stand for tables.

        Raises
        ------
        ScenarioError
            Unknown keys, or a scenario that contradicts itself; in the words for a file.

        Examples
        --------
        >>> import rfpose as rf
        >>> site = rf.load_scenario(rf.shipped_scenario("table2_100m.toml"))
        >>> short = site.changed(heliostat=site.heliostat[:3], simulation={"frame_count": 2, "tone_snr_db": 30.0})
        >>> short.heliostat_ids, short.simulation.frame_count
        (('H01', 'H02', 'H03'), 2)
        >>> [mirror.pivot_sigma_m for mirror in short.changed(heliostat={"pivot_sigma_m": 0.005}).heliostat]
        [0.005, 0.005, 0.005]

        Each record in it can be changed alone:

        >>> short.changed(heliostat=[mirror.changed(arm_m=0.2) for mirror in short.heliostat]).heliostat[0].arm_m
        0.2
        """
        return super().changed(**tables)

    def with_field(self, field: str | Path | npt.ArrayLike, *, ids: Sequence[str] | None = None) -> Scenario:
        """Return the scenario with another field, each heliostat like the first, its own posture left out.

        Impairments of receivers are left out, too, since they name those of the old field.

        Parameters
        ----------
        field : (heliostat, xyz)
            Pivots, site ENU [m]; or a CSV file of them, see `rfpose.scenario.read_positions`.
        ids
            Names of the heliostats; by default those of the file, else H1, H2 and so on.

        Raises
        ------
        ScenarioError
            No heliostat whose mirror could be taken; a name that no heliostat may have, or twice; a bad file.

        Examples
        --------
        >>> import rfpose as rf
        >>> site = rf.load_scenario(rf.shipped_scenario("table2_100m.toml"))
        >>> site.with_field([[0.0, 40.0, 2.0], [10.0, 45.0, 2.0]]).heliostat_ids
        ('H1', 'H2')
        """
        if not self.heliostat:
            raise ScenarioError(
                f"scenario `{self.name}` has no heliostat whose mirror the field could have; add a [[heliostat]]"
            )
        source = f"field of {field}: " if isinstance(field, str | Path) else ""
        if isinstance(field, str | Path):
            found, pivot = read_positions(field)
        else:
            pivot = as_float_array("field", field, ("heliostat", 3))
            found = tuple(f"H{k + 1}" for k in range(len(pivot)))
        first = self.heliostat[0]
        like = first.model_dump(exclude_none=True, exclude={"normal_enu"})
        receiver = range(len(first.receiver_mirror_m))
        heliostats = [
            {**like, "id": name, "pivot_enu_m": place, "receiver_ids": [f"{name}_r{k}" for k in receiver]}
            for name, place in zip(found if ids is None else ids, pivot.tolist(), strict=True)
        ]
        try:
            return self.changed(heliostat=heliostats, simulation={"blocked": None, "dropped": None})
        except ScenarioError as error:
            raise ScenarioError(f"{source}{error}") from error

    def with_transmitters(self, transmitters: Sequence[Transmitter] | npt.ArrayLike) -> Scenario:
        """Return the scenario with other transmitters; blockages of those that are gone go with them.

        Parameters
        ----------
        transmitters : (transmitter, xyz)
            Records; or places, site ENU [m]. At places, names, carriers and amplitudes are the scenario's own while
            they last; more transmitters share the band evenly anew.

        Raises
        ------
        ScenarioError
            The band cannot hold so many carriers; the scenario contradicts itself.

        Examples
        --------
        >>> import rfpose as rf
        >>> site = rf.load_scenario(rf.shipped_scenario("table2_100m.toml"))
        >>> fewer = site.with_transmitters(site.transmitter_enu_m[:6] + [0.0, 0.0, 5.0])
        >>> fewer.transmitter_ids, fewer.transmitter[0].position_enu_m
        (('T1', 'T2', 'T3', 'T4', 'T5', 'T6'), (100.0, 0.0, 25.0))
        """
        given: Any = transmitters
        if isinstance(given, Sequence) and given and all(isinstance(one, Transmitter) for one in given):
            new = tuple(given)
        else:
            new = self._transmitters_at(as_float_array("transmitters", given, ("transmitter", 3)))
        left = {one.id for one in new}
        blocked = [one for one in self.simulation.blocked if one.transmitter in left]
        return self.changed(transmitter=new, simulation={"blocked": blocked or None})

    def _transmitters_at(self, place: FloatArray) -> tuple[Transmitter, ...]:
        names = [*self.transmitter_ids[: len(place)]]
        unused = (name for name in (f"T{k + 1}" for k in itertools.count()) if name not in names)
        names += list(itertools.islice(unused, len(place) - len(names)))
        radio = self.radio
        if len(place) <= len(self.transmitter):
            carrier = self.carrier_hz[: len(place)]
        else:
            half = 0.5 * radio.sample_rate_hz
            margin = radio.clock_search_ppm * 1e-6 * (radio.centre_frequency_hz + half)
            usable = half - margin - float(self.tone_hz.max())
            carrier = np.linspace(-1.0, 1.0, len(place)) * usable * len(place) / (len(place) + 1.0)
            # in round numbers, a thousandth of what lies between two
            carrier = np.round(carrier, -int(np.floor(np.log10(2e-3 * usable / len(place)))))
        amplitude = [*(t.amplitude for t in self.transmitter), *np.ones(len(place))]
        return tuple(
            Transmitter(id=name, position_enu_m=tuple(map(float, p)), carrier_hz=float(f), amplitude=float(a))
            for name, p, f, a in zip(names, place, carrier, amplitude, strict=False)
        )

    # -- for people and files ----------------------------------------------------------------------------

    def __repr__(self) -> str:
        parts = {"transmitter": self.transmitter, "tone": self.tone, "heliostat": self.heliostat}
        return f"<Scenario {self.name!r}: {', '.join(counted(len(all_), what) for what, all_ in parts.items())}>"

    def _repr_html_(self) -> str:
        rows = [
            ["radio frequency", f"{1e-6 * self.radio.centre_frequency_hz:g} MHz"],
            ["sample rate", f"{1e-6 * self.radio.sample_rate_hz:g} MHz"],
            ["tones", ", ".join(f"{1e-6 * f:g} MHz" for f in self.tone_hz)],
            ["transmitters", ", ".join(self.transmitter_ids)],
            ["heliostats", listed(self.heliostat_ids)],
            ["calibration receivers", listed([r.id for r in self.calibration_receiver])],
        ]
        return html_table(self.name, ["", ""], rows)

    def save(self, path: str | Path, *, force: bool = False) -> None:
        """Write the scenario as TOML.

        Parameters
        ----------
        path
            File to write.
        force
            Overwrite what exists.

        Raises
        ------
        RecordingError
            The file exists, or cannot be written.
        """
        write_atomically(path, self.to_toml().encode(), force=force)

    def to_toml(self) -> str:
        """Return the scenario as TOML that `parse_scenario` reads back to an equal record."""
        return tomli_w.dumps(self.model_dump(mode="json", exclude_none=True, exclude_defaults=True))

    # -- contradictions ----------------------------------------------------------------------------------

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        for check in CHECKS:
            check(self)
        return self


def check_scenario(data: Mapping[str, Any]) -> Scenario:
    """Return a scenario from plain values, as those of a file are.

    Raises
    ------
    ScenarioError
        They contradict themselves; in the same words as for a file.
    """
    try:
        return Scenario.model_validate(data)
    except ValidationError as error:
        raise ScenarioError(in_words(error)) from error
