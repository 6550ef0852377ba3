"""P6: from a Digital RF recording made by independent code to the mirror normal."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from rfpose.cli._app import app
from rfpose.pipeline.evaluate import evaluate, read_truth
from rfpose.pipeline.formats.result_file import open_result
from rfpose.pipeline.process import process

pytest.importorskip("digital_rf", reason="the digital_rf library is not installed")

ROOT = Path(__file__).resolve().parents[2]
SOURCE = ROOT.parent / "shared" / "data" / "recordings" / "table2_x100"
SITE = ROOT / "data" / "table2_x100.toml"

pytestmark = pytest.mark.skipif(not (SOURCE / "drf").is_dir(), reason=f"no recording in {SOURCE}")


def test_scenario_says_what_the_description_says() -> None:
    from rfpose.scenario import load_scenario

    told = json.loads((SOURCE / "description.json").read_text())
    scenario = load_scenario(SITE)
    assert scenario.radio.sample_rate_hz == told["sample_rate_hz"]
    assert scenario.radio.centre_frequency_hz == told["centre_frequency_hz"]
    assert scenario.radio.frame_samples == told["samples"]
    assert scenario.tone_hz.tolist() == told["tones_hz"]
    assert scenario.tone[0].modulation_index == told["modulation_index_per_tone"]
    for ours, theirs in zip(scenario.transmitter, told["transmitters"], strict=True):
        assert (ours.id, list(ours.position_enu_m)) == (theirs["id"], theirs["position_enu_m"])
        assert ours.carrier_hz == theirs["carrier_hz"]
    for cal, theirs in zip(scenario.calibration_receiver, told["calibration_receivers"], strict=True):
        assert (cal.id, list(cal.position_enu_m)) == (theirs["id"], theirs["position_enu_m"])
    for heliostat, theirs in zip(scenario.heliostat, told["heliostats"], strict=True):
        assert list(heliostat.receiver_ids) == theirs["receivers"]
        assert list(heliostat.pivot_enu_m) == theirs["approximate_centre_enu_m"]
        assert (heliostat.oscillator == "shared") == theirs["shared_oscillator"]
        place = np.array(heliostat.receiver_mirror_m)
        side = np.linalg.norm(place - np.roll(place, 1, axis=0), axis=1)
        np.testing.assert_allclose(side, theirs["receiver_spacing_m"], atol=1e-4)


@pytest.mark.parametrize("estimator", ["hilbert", "correlator"])
def test_positions_and_normal_from_digital_rf(tmp_path: Path, estimator: str, figure: Callable[..., None]) -> None:
    result = tmp_path / "result.h5"
    arguments = [str(SOURCE / "drf"), "--scenario", str(SITE), "-o", str(result), "--estimator", estimator]
    arguments += ["--pose", "independent", "--json"]
    processed = CliRunner().invoke(app, ["process", *arguments])
    assert processed.exit_code == 0, processed.stderr
    assert json.loads(processed.stdout)["poses"] == {"solved": 1, "failed": 0, "reasons": {}}

    shown = CliRunner().invoke(app, ["evaluate", str(result), "--truth", str(SOURCE / "truth.json"), "--json"])
    assert shown.exit_code == 0, shown.stderr
    found = json.loads(shown.stdout)
    # range noise 1.0 mm a transmitter at the bound, and as much from calibration: positions good to a few mm
    figure(f"P6 three fits and cross product, {estimator}: normal", found["normal_error_mrad"]["rms"], "mrad")
    figure(f"P6 three fits, {estimator}: worst receiver", 1e3 * found["position_error_m"]["max"], "mm")
    assert found["bound_m"]["rms"] == pytest.approx(2.2e-3, rel=0.1)
    assert found["position_error_m"]["max"] < 5e-3
    # three fits and a cross product, recomputed independently: 1.48 mrad on this recording, 1 to 3 over such ones;
    # the estimators' own noise (the Hilbert filters lose a few per cent of the samples) moves it a little
    assert found["normal_error_mrad"]["rms"] == pytest.approx(1.48, abs=0.05)
    assert found["bound_source"] == "result"


@pytest.mark.parametrize(
    ("mirror", "expected_mrad", "tolerance_mrad"),
    [
        # recomputed independently on this recording; the carrier between receivers is asked to reach 0.02
        ("carrier_phase = false", 1.30, 0.05),
        ("carrier_phase = false\nreceiver_delay_sigma_s = 0.0", 0.16, 0.03),
        ("receiver_delay_sigma_s = 0.0", 0.0, 0.02),
        ("", 0.0, 0.02),
    ],
    ids=["three clocks", "one clock", "one clock and carrier", "three clocks and carrier"],
)
def test_rigid_normal_from_digital_rf(
    tmp_path: Path,
    mirror: str,
    expected_mrad: float,
    tolerance_mrad: float,
    figure: Callable[..., None],
    request: pytest.FixtureRequest,
) -> None:
    site = tmp_path / "site.toml"
    text = SITE.read_text()
    assert "[[heliostat]]\n" in text
    site.write_text(text.replace("[[heliostat]]\n", f"[[heliostat]]\n{mirror}\n"))
    result = tmp_path / "result.h5"
    process(SOURCE / "drf", result, scenario=site, estimator="correlator", pose="rigid")
    found = evaluate(open_result(result), read_truth(SOURCE / "truth.json", open_result(result).scenario))
    figure(f"P6 rigid, {request.node.callspec.id}: normal", found.normal_error_mrad.rms, "mrad")
    assert found.normal_error_mrad.rms == pytest.approx(expected_mrad, abs=tolerance_mrad)
    assert found.normal_error_mrad.rms < 4 * found.sigma_mrad
