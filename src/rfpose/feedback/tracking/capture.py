"""What part of its light a mirror brings into the aperture, by how far it points beside: as a table for the kernels."""

from __future__ import annotations

import numpy as np

from rfpose.checks import FloatArray
from rfpose.feedback.energy import dish_capture_at, dish_efficiency
from rfpose.feedback.optics import intercept_ratio
from rfpose.scenario import Scenario

__all__ = ["N_CAPTURE", "TOP_RAD", "capture_table"]

N_CAPTURE = 2049
TOP_RAD = 64e-3
"""Beyond this error nothing is caught."""


def capture_table(scenario: Scenario) -> FloatArray:
    """Return what is caught at errors of the normal from zero to `TOP_RAD` in even steps (error,).

    Heliostats: overlap of image and aperture (Malan 3.3), one at no error if the aperture is large enough. Dishes:
    what the cavity captures (Edwards 4.12, before its average over errors), below one even at no error.
    """
    plan = scenario.tracking
    error = np.linspace(0.0, TOP_RAD, N_CAPTURE)
    aperture = plan.aperture
    if plan.collector == "heliostat":
        table = intercept_ratio(
            error, slope_error_rad=1e-3 * plan.slope_error_mrad, aperture_ratio=aperture.image_ratio
        )
    else:
        rim = float(np.deg2rad(aperture.rim_deg))
        ratio = aperture.area_ratio
        if ratio is None:
            best = dish_efficiency(h_per_deg=aperture.h_per_deg, loss_w_m2=aperture.loss_w_per_m2, rim_rad=rim)
            ratio = float(best[1])
        table = dish_capture_at(error, ratio, h_per_deg=aperture.h_per_deg, rim_rad=rim)
    table[-1] = 0.0
    return table
