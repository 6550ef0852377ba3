"""From a scenario, and what the user chose, to what a solver sees: phases, their noise, what is known besides.

Whoever solves mirrors, bounds them or forecasts them takes it from here, so that a forecast is of the very problem that
`rfpose process` solves.
"""

from rfpose.measurement.estimator import SCENARIO, Estimator, estimator_of, estimators_of
from rfpose.measurement.noise import Noise, calibration_sigma_m, first_snr, noise_of, phase_sigma_rad
from rfpose.measurement.reflection import (
    GroundHandling,
    check_reflectors,
    ground_handling,
    reflectors_of,
    simulated_ground,
)
from rfpose.measurement.wavelengths import Wavelengths, clock_classes, wavelengths_of

__all__ = [
    "SCENARIO",
    "Estimator",
    "GroundHandling",
    "Noise",
    "Wavelengths",
    "calibration_sigma_m",
    "check_reflectors",
    "clock_classes",
    "estimator_of",
    "estimators_of",
    "first_snr",
    "ground_handling",
    "noise_of",
    "phase_sigma_rad",
    "reflectors_of",
    "simulated_ground",
    "wavelengths_of",
]
