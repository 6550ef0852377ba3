"""Malan's prototype heliostat, tracked on the days after its calibration (rows M3-M5 of the reference numbers).

Table 6.1's coefficients, §6.3's place, full motor steps (§6.2), a calibration target at 37.3 m, half-hourly looks on
2 September 2012, tracking on 6 September. What the thesis does not tell: the amplitude of the worm's error (its
Fig. 6.7 is lost), the camera's noise and the wind. The amplitude is chosen here so that the corrected day comes out as
measured; what is tested is that all else together is too small for it, and that the worm's term takes the excess away.
"""

import datetime
from pathlib import Path

import pytest

from rfpose.feedback.tracking import TrackingSimulation, score
from rfpose.scenario import load_scenario

DATA = Path(__file__).resolve().parents[2] / "data" / "tracking_100m.toml"
WORM_RAD = 1.15e-3
TABLE_6_1 = {
    "location_up_m": 0.11, "location_east_m": 1.02, "location_north_m": -0.53,
    "pedestal_tilt_north_rad": -13.27e-3, "pedestal_tilt_east_rad": -4.56e-3, "nonorthogonality_rad": -1.92e-3,
    "axis_1_zero_rad": -3.79e-3, "axis_2_zero_rad": 1.12e-3,
    "canting_up_rad": 0.0, "canting_right_rad": 0.0, "gravity_sag_rad": 0.0,
    "worm_1_sin_rad": 0.0, "worm_1_cos_rad": 0.0,
}  # fmt: skip


def malan(*, worm_rad=0.0, fit_worm=False):
    base = load_scenario(DATA)
    return base.changed(
        site={"aim_enu_m": (0.0, 0.0, 13.0)},
        heliostat=[base.heliostat[0].changed(pivot_enu_m=(19.2, -30.8, 1.2), arm_m=0.0)],
        tracking={
            "date": datetime.date(2012, 9, 6),
            "mount_errors": {
                "thermal_sigma_mrad": 0.0,
                "creep_sigma_mrad_per_month": 0.0,
                "fixed": {**TABLE_6_1, "worm_2_sin_rad": worm_rad, "worm_2_cos_rad": 0.0},
            },
            "drive": {"microsteps": 8},
            "field_control": None,
            "event": None,
            "camera": {"interval_days": 8.0, "points_per_day": 20, "spot_sigma_mm": 10.0, "worm": fit_worm},
        },
    )


def rms_mrad(scenario, method):
    simulation = TrackingSimulation(scenario, methods=(method,), seed=3)
    while simulation.done < simulation.n_segment:
        simulation.advance()
    return score(simulation.sums(method)).as_dict()


def test_malans_corrected_day(figure):
    without = rms_mrad(malan(), "camera-model")["normal_mrad"]["rms"]
    found = rms_mrad(malan(worm_rad=WORM_RAD), "camera-model")
    with_term = rms_mrad(malan(worm_rad=WORM_RAD, fit_worm=True), "camera-model")["normal_mrad"]["rms"]
    uncorrected = rms_mrad(malan(worm_rad=WORM_RAD), "open-loop")["normal_mrad"]["rms"]
    figure("Malan's day, worm absent", without, "mrad")
    figure("Malan's day, worm unmodelled", found["normal_mrad"]["rms"], "mrad")
    figure("Malan's day, worm in the model", with_term, "mrad")
    # M4: 0.97 mrad of the normal, 1.94 on the target
    assert found["normal_mrad"]["rms"] == pytest.approx(0.97, abs=0.15)
    assert found["beam_mrad"]["rms"] == pytest.approx(1.94, abs=0.35)
    assert without < 0.8
    # Fig. 6.7: the periodic term explains the residual
    assert with_term < 1.1 * without
    assert uncorrected > 8.0
