"""IQ of mirrors that follow the sun to normals filtered over frames, through an outage."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rfpose.errors import InvalidInputError, ScenarioError
from rfpose.multilat import FilterStatus
from rfpose.pipeline.choice import choose
from rfpose.pipeline.evaluate import evaluate
from rfpose.pipeline.formats.result import Result
from rfpose.pipeline.formats.result_file import open_result
from rfpose.pipeline.formats.result_summary import summarise
from rfpose.pipeline.inspect import inspect_file
from rfpose.pipeline.process import process
from rfpose.pipeline.simulate import simulate
from rfpose.scenario import Scenario, load_scenario

SHIPPED = Path(__file__).resolve().parents[2] / "data" / "table2_100m.toml"
N_FRAME = 40
FRAME_SAMPLES = 2000
LOST = slice(25, 31)
"""Frames in which the first mirror is not received."""
INTERVAL_S = 10.0


def site(motion: dict[str, Any]) -> Scenario:
    """Six mirrors of the shipped field, moved by a sun that moves as at noon; noise far above a frame's turn."""
    shipped = load_scenario(SHIPPED)
    mirror = {"pivot_sigma_m": 0.005, "carrier_phase": False}
    sun_deg = N_FRAME * INTERVAL_S * 360.0 / 86400.0
    simulation = {
        "frame_count": N_FRAME,
        "frame_interval_s": INTERVAL_S,
        "tone_snr_db": 75.0,
        "sun_azimuth_deg": (180.0 - sun_deg / 2.0, 180.0 + sun_deg / 2.0),
        "sun_elevation_deg": 60.0,
        "dropped": [
            {"receiver": name, "frame": f, "first_sample": 0, "sample_count": FRAME_SAMPLES}
            for name in shipped.heliostat[0].receiver_ids
            for f in range(N_FRAME)[LOST]
        ],
    }
    return shipped.changed(
        heliostat=[h.changed(**mirror) for h in shipped.heliostat[:6]],
        radio={"frame_samples": FRAME_SAMPLES, "clock_search_ppm": 2.0},
        simulation=simulation,
        motion=motion,
    )


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Result:
    directory = tmp_path_factory.mktemp("filter")
    (directory / "site.toml").write_text(
        site({"filtered": True, "rate_walk_radps_per_sqrt_s": 1e-7, "rate_sigma_radps": 1e-3}).to_toml()
    )
    simulate(directory / "site.toml", seed=2).save(directory / "rec.h5")
    process(directory / "rec.h5", directory / "r.h5", estimator="correlator")
    assert inspect_file(directory / "r.h5")["filtered"]["sigma_mrad"] is not None
    return open_result(directory / "r.h5")


def test_filtered_normals_are_better_and_say_by_how_much(result: Result) -> None:
    evaluation = evaluate(result)
    filtered = evaluation.filtered
    assert filtered is not None
    assert filtered.given == 6 * N_FRAME
    assert filtered.normal_error_mrad.rms < 0.6 * evaluation.normal_error_mrad.rms
    # errors of neighbouring frames are alike: some tens of independent ones
    assert 0.6 < filtered.nees < 1.5
    assert evaluation.as_dict()["filtered"]["predicted"] == filtered.predicted


def test_poses_of_single_frames_stay_as_they_are(result: Result) -> None:
    evaluation = evaluate(result)
    assert evaluation.ratio_to_bound == pytest.approx(1.0, abs=4.0 / np.sqrt(4.0 * 6 * N_FRAME))
    assert evaluation.failed == LOST.stop - LOST.start


def test_outages_are_bridged_with_a_growing_sigma(result: Result) -> None:
    table, truth = result.filtered, result.truth
    assert table is not None
    assert truth is not None
    assert np.all(table.status[0] == FilterStatus.STARTED)
    assert np.all(table.status[LOST, 0] == FilterStatus.COASTED)
    assert np.all(np.isnan(result.poses.sigma_rad[LOST, 0]))
    sigma = table.sigma_rad[LOST, 0]
    assert np.all(np.diff(sigma) > 0.0)
    off = np.linalg.norm(table.normal_enu[LOST, 0] - truth.normal_enu[LOST, 0], axis=-1)
    assert np.all(off < 4.0 * sigma)
    # the mirror has turned on meanwhile by more than the prediction is off
    turned = np.linalg.norm(truth.normal_enu[LOST.stop - 1, 0] - truth.normal_enu[LOST.start - 1, 0])
    assert turned > 3.0 * off[-1]
    summary = summarise(result)["filtered"]["reasons"]
    assert summary[FilterStatus.COASTED.reason] >= LOST.stop - LOST.start


def test_the_command_line_wins_over_the_scenario() -> None:
    assert choose(site({"filtered": True}), pose="rigid").filtered
    assert not choose(site({"filtered": True}), pose="rigid", filtered=False).filtered
    assert choose(site({}), pose="rigid", filtered=True).filtered
    assert not choose(site({"filtered": True}), pose="independent").filtered


def test_a_filter_is_refused_where_it_would_claim_too_much() -> None:
    with pytest.raises(InvalidInputError, match="`filter` is of pose `rigid`"):
        choose(site({}), pose="independent", filtered=True)
    plain = site({})
    heliostat = list(plain.heliostat)
    heliostat[2] = heliostat[2].changed(receiver_delay_drift_s_per_sqrt_min=1e-12)
    with pytest.raises(ScenarioError, match=r"H03.*common to the frames.*`filtered=False`"):
        choose(plain.changed(heliostat=heliostat), pose="rigid", filtered=True)
