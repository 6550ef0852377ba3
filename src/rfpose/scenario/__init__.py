"""A site as data: transmitters, tones, heliostats, receivers, and how to simulate them.

A scenario is a TOML file; `load_scenario` turns it into frozen records and refuses unknown keys and
contradictions. Every length is metres in the site ENU frame unless a name says otherwise.
"""

from __future__ import annotations

from rfpose.scenario._reading import load_scenario, naming, parse_scenario, scenario_of
from rfpose.scenario._scenario import Receiver, Scenario, check_scenario
from rfpose.scenario.budget import Budget
from rfpose.scenario.estimation import Integrity, Motion, Plane, Reflection
from rfpose.scenario.multipath import Antenna, Multipath
from rfpose.scenario.positions import Columns, PositionForm, check_form, read_positions
from rfpose.scenario.records import (
    ID_PATTERN,
    MAX_FRAME_SAMPLES,
    MAX_ID_LENGTH,
    MAX_SAMPLE_INDEX,
    MIN_FRAME_SAMPLES,
    SPEED_OF_LIGHT_MPS,
    CalibrationReceiver,
    Heliostat,
    Mirror,
    Radio,
    Tone,
    Transmitter,
)
from rfpose.scenario.simulation import Blockage, Dropout, Ground, Simulation
from rfpose.scenario.site import Box, Posture, Site, StructurePlate, Structures

__all__ = [
    "ID_PATTERN",
    "MAX_FRAME_SAMPLES",
    "MAX_ID_LENGTH",
    "MAX_SAMPLE_INDEX",
    "MIN_FRAME_SAMPLES",
    "SPEED_OF_LIGHT_MPS",
    "Antenna",
    "Blockage",
    "Box",
    "Budget",
    "CalibrationReceiver",
    "Columns",
    "Dropout",
    "Ground",
    "Heliostat",
    "Integrity",
    "Mirror",
    "Motion",
    "Multipath",
    "Plane",
    "PositionForm",
    "Posture",
    "Radio",
    "Receiver",
    "Reflection",
    "Scenario",
    "Simulation",
    "Site",
    "StructurePlate",
    "Structures",
    "Tone",
    "Transmitter",
    "check_form",
    "check_scenario",
    "load_scenario",
    "naming",
    "parse_scenario",
    "read_positions",
    "scenario_of",
]
