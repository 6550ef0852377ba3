"""IQ to tone phases: line bank, estimators, calibration, bounds."""

from rfpose.dsp.calibration import CalibrationStatus, PhaseCalibration, calibrate
from rfpose.dsp.extractor import ESTIMATORS, ToneExtractor
from rfpose.dsp.plan import LinePlan
from rfpose.dsp.tones import FrameTones, LineStatus, TonePhases

__all__ = [
    "ESTIMATORS",
    "CalibrationStatus",
    "FrameTones",
    "LinePlan",
    "LineStatus",
    "PhaseCalibration",
    "ToneExtractor",
    "TonePhases",
    "calibrate",
]
