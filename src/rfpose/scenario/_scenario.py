"""The whole site: records, the arrays made of them, and scaling."""

from __future__ import annotations

import math
from functools import cached_property
from typing import Annotated, NamedTuple, Self

import numpy as np
import tomli_w
from pydantic import Field, model_validator

from rfpose import geometry
from rfpose.checks import FloatArray, read_only
from rfpose.errors import ScenarioError
from rfpose.scenario._consistency import CHECKS
from rfpose.scenario._scaling import scale_lengths
from rfpose.scenario.budget import Budget
from rfpose.scenario.estimation import Integrity, Motion, Reflection
from rfpose.scenario.records import CalibrationReceiver, Heliostat, Radio, Record, Site, Tone, Transmitter
from rfpose.scenario.simulation import Simulation
from rfpose.scenario.tracking import Tracking


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
        start = sum(len(h.receiver_ids) for h in self.heliostat[:i_heliostat])
        return slice(start, start + len(self.heliostat[i_heliostat].receiver_ids))

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

    def compares_carriers(self, heliostat: Heliostat) -> bool:
        """Whether the carriers' own phases are compared between a heliostat's receivers.

        Only on one oscillator do the receivers' phases cancel, and only at radio frequencies above zero is there a
        wavelength. Whoever needs to know whether the carrier takes part in a normal asks here.
        """
        return heliostat.oscillator == "shared" and heliostat.carrier_phase and self.has_rf_carriers

    @cached_property
    def simulated_sun_enu(self) -> FloatArray | None:
        """(xyz,) towards the simulated sun of the first frame; None where the scenario lacks it, or an aim point."""
        azimuth, elevation = self.simulation.sun_azimuth_deg, self.simulation.sun_elevation_deg
        if azimuth is None or elevation is None or self.site.aim_enu_m is None:
            return None
        first = [np.radians(np.ravel(angle)[0]) for angle in (azimuth, elevation)]
        return read_only(geometry.enu_from_azimuth_elevation(*first))

    @cached_property
    def posture_enu(self) -> FloatArray:
        """(heliostat, xyz) unit normals that the scenario gives its mirrors; NaN where it gives none.

        Each heliostat's own ``normal_enu``; else that which sends the simulated sun of the first frame to the aim
        point, as `rfpose simulate` begins. Whatever shows or studies "the scenario's posture" takes it from here.
        """
        out = np.full((len(self.heliostat), 3), np.nan)
        if self.simulated_sun_enu is not None and self.heliostat:
            out = geometry.bisector_enu(np.array(self.site.aim_enu_m) - self.pivot_enu_m, self.simulated_sun_enu)
        for i, heliostat in enumerate(self.heliostat):
            if heliostat.normal_enu is not None:
                out[i] = geometry.unit(heliostat.normal_enu)
        return read_only(out)

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

    def to_toml(self) -> str:
        """Return the scenario as TOML that `parse_scenario` reads back to an equal record."""
        return tomli_w.dumps(self.model_dump(mode="json", exclude_none=True, exclude_defaults=True))

    # -- contradictions ----------------------------------------------------------------------------------

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        for check in CHECKS:
            check(self)
        return self
