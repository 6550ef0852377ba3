"""Wind on mirrors: gusts and their spectrum, loads, deflection, measured records, stow."""

from rfpose.feedback.wind.gusts import GustProcess, gust_process
from rfpose.feedback.wind.load import WindLoad, wind_bend
from rfpose.feedback.wind.record import WindRecord, read_wind_csv, stow_mask
from rfpose.feedback.wind.spectrum import (
    admittance,
    gust_spectrum,
    perfect_servo,
    rigidity_gain,
    sunshine_deflection,
    wind_deflection,
)

__all__ = [
    "GustProcess",
    "WindLoad",
    "WindRecord",
    "admittance",
    "gust_process",
    "gust_spectrum",
    "perfect_servo",
    "read_wind_csv",
    "rigidity_gain",
    "stow_mask",
    "sunshine_deflection",
    "wind_bend",
    "wind_deflection",
]
