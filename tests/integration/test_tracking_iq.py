"""Samples through the whole chain and the measurement-level model of the tracking tell the same errors."""

from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from rfpose import geometry
from rfpose.errors import InvalidInputError
from rfpose.feedback.tracking.timeline import days
from rfpose.pipeline.track_iq import compare_with_iq
from rfpose.scenario import load_scenario

DATA = Path(__file__).resolve().parents[2] / "data" / "tracking_100m.toml"
N_POSTURE = 16


def short_frames(**simulation):
    """The shipped scenario with frames of 2400 samples, the SNR raised so that the carrier is found as before."""
    dry = "ground" in simulation and simulation["ground"] is None
    site = load_scenario(DATA).changed(radio={"frame_samples": 2400}, **({"reflection": None} if dry else {}))
    return site.changed(simulation={"tone_snr_db": 55.0, **simulation}, reflection={"model": "none"} if dry else {})


def courses(scenario, heliostat):
    """A mirror's normals in the course of the day."""
    sun = days(scenario)[0].sun_enu
    sun = sun[np.linspace(0, len(sun) - 1, N_POSTURE).astype(int)]
    pivot = scenario.pivot_enu_m[scenario.heliostat_ids.index(heliostat)]
    return geometry.bisector_enu(np.array(scenario.site.aim_enu_m) - pivot, sun)


@pytest.mark.parametrize("ground", [None, {"coefficient": (-0.3, 0.1)}], ids=["direct", "reflection estimated"])
def test_iq_and_model_agree(ground, figure):
    scenario = short_frames(ground=ground)
    found = [
        compare_with_iq(scenario, heliostat=name, normal_enu=courses(scenario, name), seed=seed)
        for seed, name in enumerate(("H05", "H08"))
    ]
    assert all(f.solved.all() for f in found)
    total = sum(f.chi2.sum() for f in found)
    n = 2 * 2 * N_POSTURE
    figure("squared errors of normals from IQ over the tracking model's variance", total / n)
    # poses of one frame share the calibration's noise; 1e-4 on either side of independent ones, and half as much again
    assert chi2.ppf(1e-4, n) / 1.5 < total < 1.5 * chi2.ppf(1.0 - 1e-4, n)


def test_an_unknown_mirror_is_refused():
    scenario = load_scenario(DATA)
    with pytest.raises(InvalidInputError, match="one of the scenario's, got 'H99'"):
        compare_with_iq(scenario, heliostat="H99", normal_enu=np.array([[0.0, 0.0, 1.0]]), seed=0)
