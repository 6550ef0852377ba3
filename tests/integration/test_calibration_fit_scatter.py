"""What fits scatter by is what they say they scatter by."""

import numpy as np
import pytest

from rfpose.feedback.calibration import FitSettings, fit, fit_many, predict
from rfpose.feedback.measurements import Measurements
from rfpose.feedback.mount import Mount, posture

START = Mount(pivot_enu_m=np.array([20.0, 80.0, 3.0]))
TRUE = START.replace(pedestal_tilt_north_rad=4e-3, pedestal_tilt_east_rad=-6e-3, axis_1_zero_rad=0.02)
SIGMA = 5e-4
N_RUN = 400


def poses(rng, n, sigma=SIGMA):
    """Normals of postures all over the sky, as radio measures them, each component of the error of the same size."""
    count = np.column_stack([rng.uniform(1.5, 4.7, n), rng.uniform(0.1, 1.3, n)])
    normal = posture(TRUE, count).normal_enu
    error = sigma * rng.normal(size=(n, 3))
    error -= np.sum(error * normal, axis=1, keepdims=True) * normal
    return Measurements.from_normals(count, normal_enu=normal + error, sigma_rad=sigma)


@pytest.mark.parametrize(
    ("settings", "tolerance"),
    [
        (FitSettings(sigma_known=True, huber=np.inf), 0.0),
        (FitSettings(sigma_known=True, huber=1.0), 0.0),
        # the noise itself is estimated from forty residuals by their median
        (FitSettings(), 0.06),
    ],
    ids=["least-squares", "huber", "noise-estimated"],
)
def test_scatter_is_the_reported_covariance(settings, tolerance):
    rng = np.random.default_rng(1)
    made = [poses(rng, 40) for _ in range(N_RUN)]
    found = fit_many([START] * N_RUN, made, free="edwards-7", settings=settings)
    true = np.array([TRUE.parameters[name] for name in found.free])
    pull = (found.estimate - true) / found.sigma
    # the mean square of 400 pulls scatters by √(2/400) = 7 %; four sigma
    np.testing.assert_allclose(np.mean(pull**2, axis=0), 1.0, atol=4 * np.sqrt(2 / N_RUN) + 2 * tolerance)
    # all parameters together, correlations included: mean 7, standard deviation √(14/400)
    delta = found.estimate - true
    chi = np.einsum("nf,nfg,ng->n", delta, np.linalg.inv(found.covariance), delta)
    assert chi.mean() == pytest.approx(7.0, abs=4 * np.sqrt(14 / N_RUN) + 14 * tolerance)


def test_predicted_residual_is_the_achieved_one():
    # radio poses spread over postures: prediction within 10 % of what new postures show, over many fits
    rng = np.random.default_rng(2)
    ahead = poses(rng, 60, sigma=1e-12)
    ratio = []
    for _ in range(60):
        found = fit(START, poses(rng, 20), free="edwards-7", settings=FitSettings(sigma_known=True, huber=np.inf))
        told = predict(found, ahead)
        ratio.append([np.mean(told.error_rad**2), np.mean(told.sigma_rad**2)])
    achieved, predicted = np.sqrt(np.mean(ratio, axis=0))
    # seven parameters a fit, sixty fits: √(2/420)/2 = 3.5 % of the RMS
    assert achieved / predicted == pytest.approx(1.0, abs=0.1)


def test_more_poses_help_by_their_root():
    rng = np.random.default_rng(3)
    spread = []
    for n in (20, 80):
        made = [poses(rng, n) for _ in range(100)]
        found = fit_many([START] * 100, made, free="edwards-4", settings=FitSettings(sigma_known=True, huber=np.inf))
        spread.append(np.sqrt(np.mean(found.sigma**2, axis=0)))
    # postures are drawn anew each time
    np.testing.assert_allclose(spread[0] / spread[1], 2.0, rtol=0.15)
