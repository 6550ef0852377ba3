"""Pose site from a recording of rays that a table holds: command line, result file, bad input."""

from __future__ import annotations

import json

import numpy as np
import pytest
from click.testing import CliRunner

import rfpose as rf
from raytables import image_table, save
from rfpose import geometry
from rfpose.cli.process import command
from rfpose.errors import InvalidInputError, ScenarioError
from rfpose.multilat import PoseStatus
from rfpose.simulator import Simulator

PERMITTIVITY, CONDUCTIVITY = 12.0, 0.01


def fresnel_vertical(sine: np.ndarray, rf_hz: float) -> np.ndarray:
    """Textbook reflection of a vertically polarised wave at a half-space."""
    eps = PERMITTIVITY - 1j * CONDUCTIVITY / (2.0 * np.pi * rf_hz * 8.8541878128e-12)
    root = np.sqrt(eps - (1.0 - sine**2))
    return np.asarray((eps * sine - root) / (eps * sine + root))


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Return a recording of four mirrors over a Fresnel ground, and the site as it is told."""
    folder = tmp_path_factory.mktemp("site")
    site = rf.load_scenario(rf.shipped_scenario("table2_100m.toml"))
    site = site.changed(
        heliostat=site.heliostat[:4],
        radio={"centre_frequency_hz": 433e6, "frame_samples": 40_000},
        simulation={"frame_count": 1, "tone_snr_db": 50.0, "sample_format": "complex64"},
    )
    truth = Simulator(site, seed=0).truth
    table = image_table(
        list(site.receiver_ids), truth.receiver_enu_m[0], site.transmitter_enu_m, site.radio.centre_frequency_hz
    )
    ground = table["code"] == "R:ground"
    sine = -np.cos(table["theta_r"][ground])
    free = np.abs(table["a_theta"][~ground][0]) * table["length_m"][~ground][0]
    table["a_theta"][ground] = free / table["length_m"][ground] * fresnel_vertical(sine, 433e6)
    site = site.changed(simulation={"paths": str(save(folder / "rays.npz", table))})
    rng = np.random.default_rng(5)
    aside = 0.015 * geometry.unit(np.cross(truth.normal_enu[0], rng.normal(size=(4, 3))))
    commanded = geometry.unit(truth.normal_enu[0] + aside)
    told = site.changed(
        heliostat=[
            h.changed(normal_enu=tuple(n), pivot_sigma_m=0.005)
            for h, n in zip(site.heliostat, commanded.tolist(), strict=True)
        ],
        reflection={"model": "fresnel", "permittivity": 15.0, "conductivity_s_per_m": 0.01},
    )
    rf.simulate(site, seed=3).save(folder / "night.h5")
    told.save(folder / "site.toml")
    return folder, told, truth


def test_the_command_solves_what_the_ground_would_spoil(recorded):
    folder, _, truth = recorded
    out = folder / "result.h5"
    args = [str(folder / "night.h5"), "--scenario", str(folder / "site.toml"), "-o", str(out), "--pose", "site"]
    run = CliRunner().invoke(command, [*args, "--json"])
    assert run.exit_code == 0, run.output
    assert json.loads(run.stdout)["pose"] == "site"
    result = rf.open_result(out)
    assert (result.poses.status == PoseStatus.OK).all()
    error = geometry.angle_between_rad(result.poses.normal_enu[0], truth.normal_enu[0])
    assert error.max() < 1e-4
    squared = (error / result.poses.sigma_rad[0]) ** 2
    assert squared.mean() < 3.0
    assert (error <= result.integrity.protection_level_rad[0]).all()
    # the ground is found to be what the table was made with, a fifth below what was told
    assert result.site.permittivity_change.real == pytest.approx(12.0 / 15.0 - 1.0, abs=0.02)
    report = rf.evaluate(result)
    assert report.solved == 4
    assert report.protection.exceeded == 0


def test_the_file_keeps_what_was_found(recorded, tmp_path):
    folder, told, _ = recorded
    result = rf.process(folder / "night.h5", scenario=told, pose="site")
    result.save(tmp_path / "again.h5")
    again = rf.open_result(tmp_path / "again.h5")
    for name in result.site.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(again.site, name), getattr(result.site, name))
    labelled = result.to_xarray("site")
    assert labelled["weight"].dims == ("frame", "receiver", "transmitter")
    assert list(labelled["ray_kind"].values)[:2] == ["direct", "ground"]


def test_without_the_ground_in_the_model_sigma_says_so(recorded):
    folder, told, truth = recorded
    blind = told.changed(reflection={"model": "none", "permittivity": None, "conductivity_s_per_m": None})
    result = rf.process(folder / "night.h5", scenario=blind, pose="site")
    error = geometry.angle_between_rad(result.poses.normal_enu[0], truth.normal_enu[0])
    solved = result.poses.status[0] == PoseStatus.OK
    assert solved.all()
    assert np.median(error) > 1e-3
    assert np.mean((error / result.poses.sigma_rad[0]) ** 2) < 3.0


def test_a_site_that_cannot_be_solved_so_is_refused_before_any_work(recorded):
    folder, told, _ = recorded
    loose = told.changed(heliostat={"pivot_sigma_m": None})
    with pytest.raises(ScenarioError, match="pivot_sigma_m"):
        rf.process(folder / "night.h5", scenario=loose, pose="site")
    apart = told.changed(heliostat={"oscillator": "separate"})
    with pytest.raises(ScenarioError, match="oscillator"):
        rf.process(folder / "night.h5", scenario=apart, pose="site")
    with pytest.raises(InvalidInputError, match="filter"):
        rf.process(folder / "night.h5", scenario=told, pose="site", filtered=True)


def test_a_pattern_of_another_mirror_is_refused(recorded):
    folder, told, _ = recorded
    shipped = rf.shipped_scenario("table2_100m.toml").parent / "antenna_front_433MHz.h5"
    moved = told.changed(
        heliostat={"receiver_mirror_m": ((1.0, 0.0, 0.1), (-0.5, 0.8, 0.1), (-0.5, -0.4, 0.1))},
        antenna={"pattern": str(shipped)},
    )
    with pytest.raises(ScenarioError, match="receivers"):
        rf.process(folder / "night.h5", scenario=moved, pose="site")
