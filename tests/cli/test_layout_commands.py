"""`rfpose layout`: the commands, their JSON, and what they refuse."""

import csv
import json
import math
from datetime import date
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from rfpose.cli._support import CommonOptions
from rfpose.cli.layout import command
from rfpose.errors import GeometryError, ScenarioError
from rfpose.geometry import enu_from_azimuth_elevation, unit
from rfpose.layout import maps
from rfpose.layout.maps import ESTIMATORS
from rfpose.layout.sight import Plates, visible
from rfpose.measurement import noise_of
from rfpose.multilat import PoseStatus
from rfpose.pipeline.evaluate import evaluate
from rfpose.pipeline.formats.result_summary import summarise as summarise_result
from rfpose.pipeline.layout import Rules, budget, layout_map, optimise
from rfpose.pipeline.layout.mapping import _reasons
from rfpose.pipeline.layout.site import Postures, Sight, postures_of
from rfpose.pipeline.process import process
from rfpose.pipeline.simulate import simulate
from rfpose.scenario import load_scenario

SITE = Path(__file__).resolve().parents[2] / "data" / "table2_100m.toml"


def run(*arguments):
    result = CliRunner().invoke(command, [str(a) for a in arguments], obj=CommonOptions())
    assert result.exit_code == 0, result.output
    return result.stdout


def test_map_writes_json_csv_and_picture(tmp_path):
    table, picture = tmp_path / "map.csv", tmp_path / "map.png"
    found = json.loads(
        run("map", SITE, "--json", "--csv", table, "--picture", picture, "--sun", 120, 30, "--sun", 180, 60)
    )
    assert found["heliostats"] == 12
    assert found["postures"] == 2
    assert set(found["normal_mrad"]) == {"scenario", *ESTIMATORS}
    assert found["normal_mrad"]["shared-clock"]["rms"] < found["normal_mrad"]["rigid"]["rms"]
    lost = found["normal_without_transmitter_mrad"]["rigid"]
    assert min(lost.values()) > found["normal_mrad"]["rigid"]["rms"]
    with table.open() as file:
        rows = list(csv.DictReader(file))
    assert [row["id"] for row in rows] == list(load_scenario(SITE).heliostat_ids)
    rms = np.sqrt(np.mean([float(row["normal_rigid_rms_mrad"]) ** 2 for row in rows]))
    assert rms == pytest.approx(found["normal_mrad"]["rigid"]["rms"], rel=1e-4)
    assert picture.read_bytes().startswith(b"\x89PNG")


def short_site(tmp_path, **changes):
    """Table 2's field in short frames; ``changes`` by table."""
    site = tmp_path / "site.toml"
    load_scenario(SITE).changed(radio={"frame_samples": 8000}).changed(**changes).save(site, force=True)
    return site


def test_the_scenarios_own_estimator_is_that_of_process(tmp_path):
    """Map and evaluation of one scenario, frames standing still: the same bound, by two independent ways."""
    for mirror in ({}, {"pivot_sigma_m": 0.005, "receiver_delay_sigma_s": 2e-12}, {"oscillator": "separate"}):
        heliostats = [h.changed(**mirror) for h in load_scenario(SITE).heliostat[:3]]
        still = {"frame_count": 2, "frame_interval_s": 1.0, "sun_azimuth_deg": 170.0, "sample_format": "complex64"}
        tones = [{"frequency_hz": 750e3, "modulation_index": 0.4}, {"frequency_hz": 1e6, "modulation_index": 0.3}]
        site = short_site(tmp_path, heliostat=heliostats, simulation=still, tone=tones)
        recording, result = tmp_path / "rec.h5", tmp_path / "result.h5"
        simulate(site, seed=1).save(recording, force=True)
        bound = evaluate(process(recording, result, estimator="correlator", force=True)).bound_mrad
        found = layout_map(site)
        assert found.posture_names == ("simulated sun",)
        assert found.as_dict()["normal_mrad"]["scenario"]["rms"] == pytest.approx(bound, rel=1e-3)


def test_a_site_about_frequency_zero_has_no_carriers_to_compare(tmp_path):
    site = short_site(tmp_path, radio={"centre_frequency_hz": 0.0})
    found = json.loads(run("map", site, "--json"))["normal_mrad"]
    assert set(found) == {"scenario", "independent", "rigid", "shared-clock", "pivot"}
    assert found["scenario"]["rms"] == pytest.approx(found["rigid"]["rms"])
    with pytest.raises(ScenarioError, match=r"site\.toml: estimator `carrier` .* set `radio.centre_frequency_hz`"):
        layout_map(site, estimators=["carrier"])
    with pytest.raises(ScenarioError, match=r"site\.toml: estimator `reflection` needs a ground"):
        layout_map(site, estimators=["reflection"])
    recording, result = tmp_path / "rec.h5", tmp_path / "result.h5"
    simulate(site, seed=1).save(recording)
    measured = process(recording, result, estimator="correlator")
    assert measured.poses.n_wavelength.max() == 1
    assert list(summarise_result(measured)["integers"]) == ["0.75 MHz"]
    assert evaluate(measured).ratio_to_bound == pytest.approx(1.0, abs=0.3)


def test_mirrors_that_differ_have_each_its_own_estimator(tmp_path):
    one, other = load_scenario(SITE).heliostat[:2]
    heliostats = [one, other.changed(oscillator="separate")]
    both = layout_map(short_site(tmp_path, heliostat=heliostats), sensitivity=True)
    each = [layout_map(short_site(tmp_path, heliostat=[h])).rms_mrad["scenario"][0] for h in heliostats]
    np.testing.assert_allclose(both.rms_mrad["scenario"], each)
    assert each[1] > 10.0 * each[0]


def test_map_of_a_field_from_csv(tmp_path):
    field = tmp_path / "field.csv"
    field.write_text("east_m,north_m,up_m\n20,0,2\n0,25,2\n")
    found = json.loads(run("map", SITE, "--field", field, "--json", "--estimator", "rigid"))
    assert found["heliostats"] == 2
    own = layout_map(SITE, estimators=["rigid"])
    expected = np.sqrt(np.mean(own.rms_mrad["rigid"][:2] ** 2))
    assert found["normal_mrad"]["rigid"]["rms"] == pytest.approx(expected)


def test_optimise_writes_a_scenario(tmp_path):
    better = tmp_path / "better.toml"
    found = json.loads(
        run("optimise", SITE, "-o", better, "--json", "--starts", 2, "--minimise", "rigid", "--keep", 1, "-n", 11)
    )
    assert found["value"] < found["before"]
    scenario = load_scenario(better)
    assert len(scenario.transmitter) == 11
    assert scenario.transmitter[0].position_enu_m == load_scenario(SITE).transmitter[0].position_enu_m
    measured = layout_map(better, estimators=["rigid"]).as_dict()["pdop"]["rms"]
    assert measured == pytest.approx(found["pdop_rms"], rel=1e-9)


def placed(tmp_path):
    """Table 2's field, somewhere on Earth."""
    return broken(tmp_path, "[site]\n", "[site]\nlatitude_deg = -33.9\nlongitude_deg = 18.9\n")


def test_map_over_a_day_by_posture(tmp_path):
    site = placed(tmp_path)
    found = json.loads(run("map", site, "--json", "--estimator", "rigid", "--day", "2026-06-21", "--stow"))
    by_posture = found["normal_by_posture_mrad"]["rigid"]
    names = list(by_posture)
    assert names[-1] == "stow"
    # winter solstice at 33.9° S: from 9:05 to 16:40 local solar time the sun is above 5° and more
    assert names[0] < "2026-06-21 07:00Z"
    assert names[-2] > "2026-06-21 14:00Z"
    assert len(names) == found["postures"]
    together = np.sqrt(np.mean(np.square(list(by_posture.values()))))
    assert found["normal_mrad"]["rigid"]["rms"] == pytest.approx(together)
    year = json.loads(run("map", site, "--json", "--estimator", "rigid", "--year", 2026))
    assert {name[:7] for name in year["normal_by_posture_mrad"]["rigid"]} == {f"2026-{m:02d}" for m in range(1, 13)}
    with pytest.raises(ScenarioError, match="latitude_deg"):
        layout_map(SITE, postures=Postures(day=date(2026, 6, 21)))


def test_map_with_line_of_sight_keeps_what_is_seen(tmp_path):
    table = tmp_path / "map.csv"
    plate = ("--line-of-sight", 4, 4, "--sun", 170, 40, "--estimator", "shared-clock")
    found = json.loads(run("map", SITE, "--json", "--csv", table, *plate))
    scenario = load_scenario(SITE)
    sun = enu_from_azimuth_elevation(np.radians(170.0), np.radians(40.0))
    mirrors = maps.mirrors_of(scenario, sun_enu=sun)
    seen = visible(scenario.transmitter_enu_m, mirrors, Plates(width_m=4.0, height_m=4.0))
    bound = maps.normal_map(
        scenario.transmitter_enu_m, mirrors, noise_of(scenario), ESTIMATORS["shared-clock"], visible=seen
    )
    assert 0 < (~seen).sum() < seen.size
    sight = found["line_of_sight"]
    assert sight["seen_mean"] == pytest.approx(seen.sum(axis=2).mean())
    assert sight["seen_least"] == seen.sum(axis=2).min()
    assert found["normal_mrad"]["shared-clock"]["undetermined"] == pytest.approx(np.isnan(bound).mean())
    assert found["normal_mrad"]["shared-clock"]["rms"] == pytest.approx(1e3 * np.sqrt(np.nanmean(bound**2)))
    masked = seen.copy()
    masked[..., 3] = False
    without = maps.normal_map(
        scenario.transmitter_enu_m, mirrors, noise_of(scenario), ESTIMATORS["shared-clock"], visible=masked
    )
    lost = found["normal_without_transmitter_mrad"]["shared-clock"][scenario.transmitter_ids[3]]
    assert lost == pytest.approx(1e3 * np.sqrt(np.nanmean(without**2)), rel=1e-6)
    with table.open() as file:
        assert [float(row["seen_least"]) for row in csv.DictReader(file)] == seen.sum(axis=2).min(axis=1).tolist()
    behind = json.loads(run("map", SITE, "--json", "--behind", *plate))["line_of_sight"]
    # front and back share the sky
    assert behind["seen_mean"] + sight["seen_mean"] == pytest.approx(10.0, abs=0.5)


def test_map_with_the_reflection_estimated(tmp_path):
    ground = "ground = { coefficient = [-0.3, 0.1] }\n"
    site = broken(tmp_path, "[simulation]\n", "[simulation]\n" + ground)
    found = json.loads(run("map", site, "--json", "--estimator", "reflection", "--estimator", "delays"))["normal_mrad"]
    lines = budget(site, ground="estimated", n_draw=0).as_dict()["lines"]
    noise = ("thermal noise", "quantisation", "calibration noise")
    total = np.sqrt(sum(line["normal_mrad"] ** 2 for line in lines if line["source"] in noise))
    # the calibration's noise is common to mirrors, and what the solver states takes it for each one's own
    assert found["reflection"]["rms"] == pytest.approx(total, rel=3e-3)
    # the ground is one more unknown and one more look at the mirror: of the same order as without it
    assert 0.3 < found["reflection"]["rms"] / found["delays"]["rms"] < 30.0


def test_map_says_what_each_transmitter_means():
    found = json.loads(run("map", SITE, "--json", "--estimator", "rigid", "--sensitivity"))
    one = found["sensitivity"]["rigid"]
    assert set(one) == set(load_scenario(SITE).transmitter_ids)
    for name, lost in found["normal_without_transmitter_mrad"]["rigid"].items():
        assert one[name]["lost_mrad"] == pytest.approx(lost)
        assert all(x > 0.0 for x in one[name]["survey_mrad_per_mm"])


def test_budget_writes_json_csv_and_picture(tmp_path):
    table, picture = tmp_path / "budget.csv", tmp_path / "budget.svg"
    found = json.loads(run("budget", SITE, "--json", "-o", table, "--picture", picture, "--draws", 40))
    shares = [line["share"] for line in found["lines"]]
    assert shares == sorted(shares, reverse=True)
    assert sum(shares) == pytest.approx(1.0)
    assert found["sum_over_monte_carlo"] == pytest.approx(1.0, abs=0.2)
    assert all(line["remedy"] and line["assumed"] for line in found["lines"])
    with table.open() as file:
        rows = list(csv.DictReader(file))
    own = [row for row in rows if row["source"] == found["lines"][0]["source"]]
    assert [row["heliostat"] for row in own] == ["field", *load_scenario(SITE).heliostat_ids]
    each = [float(row["target_m"]) for row in own]
    assert each[0] == pytest.approx(np.sqrt(np.mean(np.square(each[1:]))), rel=1e-4)
    assert b"error budget" in picture.read_bytes() or picture.read_bytes().startswith(b"<?xml")


def test_budget_without_draws_and_over_postures():
    one = json.loads(run("budget", SITE, "--json", "--draws", 0, "--sun", 120, 40))
    assert one["monte_carlo"]["normal_mrad"] is None
    two = json.loads(run("budget", SITE, "--json", "--draws", 0, "--sun", 120, 40, "--sun", 200, 60))
    other = json.loads(run("budget", SITE, "--json", "--draws", 0, "--sun", 200, 60))
    mean = np.sqrt(0.5 * (one["sum"]["normal_mrad"] ** 2 + other["sum"]["normal_mrad"] ** 2))
    assert two["sum"]["normal_mrad"] == pytest.approx(mean)


def test_budget_says_what_is_beyond_first_order(tmp_path):
    site = broken(tmp_path, "[simulation]\n", "[simulation]\nground = { coefficient = [-0.3, 0.1] }\n")
    text = " ".join(run("budget", site, "--draws", 200).split())
    assert "ground reflection: drawn and first order differ" in text
    assert "receiver places: drawn" not in text


def test_curve_over_numbers_of_transmitters(tmp_path):
    table, picture = tmp_path / "curve.csv", tmp_path / "curve.png"
    wanted = ("--pareto", "6..8", "--starts", 1, "--cost", 5, 0.1, 0.01, "--csv", table, "--picture", picture)
    found = json.loads(run("optimise", SITE, "--json", *wanted))
    rows = found["placements"]
    assert [row["transmitters"] for row in rows] == [6, 7, 8]
    assert all(row["without_worst"] is None or row["without_worst"] > row["value"] for row in rows)
    assert np.diff([row["cost"] for row in rows]).min() > 0.0
    with table.open() as file:
        got = [float(row["pdop_rms"]) for row in csv.DictReader(file)]
    assert got == pytest.approx([row["value"] for row in rows], rel=1e-5)
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_ground_by_outline_and_circles(tmp_path):
    outline = tmp_path / "ground.csv"
    outline.write_text("east_m,north_m\n0,-120\n120,-120\n120,120\n0,120\n")
    found = json.loads(
        run("optimise", SITE, "--json", "--starts", 1, "-n", 6, "--outline", outline, "--exclude", 60, 0, 40)
    )
    place = np.array(list(found["transmitters"].values()))
    # to a centimetre, but not over the line
    assert place[:, 0].min() >= -1e-9
    assert np.hypot(place[:, 0] - 60.0, place[:, 1]).min() >= 40.0 - 1e-9
    apart = np.linalg.norm(place[:, None, :2] - place[:, :2], axis=2) + 1e9 * np.eye(6)
    # towers keep a twentieth of the radius from each other by default
    assert apart.min() >= 5.0 - 1e-9


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("optimise", SITE, "--pareto", "8..6"), "6..12"),
        (("optimise", SITE, "--csv", "x.csv"), "goes with --pareto"),
        (("optimise", SITE, "--pareto", "6..7", "-n", 8), "give -o and -n without it"),
        (("map", SITE, "--tower", 2, 40), "--line-of-sight"),
    ],
)
def test_options_that_contradict_are_refused(arguments, text):
    result = CliRunner().invoke(command, [str(a) for a in arguments], obj=CommonOptions())
    assert result.exit_code == 2
    assert text in result.output


def test_undetermined_poses_have_no_budget(tmp_path):
    text = SITE.read_text()
    begin, end = text.index("[[calibration_receiver]]"), text.index("[mirror]")
    path = tmp_path / "site.toml"
    path.write_text(text[:begin] + text[end:])
    with pytest.raises(ScenarioError, match="calibration receiver, or a surveyed pivot"):
        budget(path, pose="independent", n_draw=0)


def test_a_person_gets_tables():
    assert "PDOP" in run("map", SITE, "--estimator", "rigid")
    assert "receiver places" in run("budget", SITE, "--draws", 5)


def broken(tmp_path, old, new):
    text = SITE.read_text()
    assert old in text
    path = tmp_path / "site.toml"
    path.write_text(text.replace(old, new))
    return path


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("frequency_hz = 750e3", "frequency_hz = 1.9e6", "wider than the longest tone"),
        ("pivot_enu_m = [0.0, 25.0, 2.0]", "pivot_enu_m = [20.0, 0.0, 2.0]", "`H01` and `H02` stand at the same place"),
        ("pivot_enu_m = [0.0, 25.0, 2.0]", "pivot_enu_m = [0.0, 0.0, 50.0]", "`H02` and transmitter `T10`"),
    ],
)
def test_bad_sites_are_refused(tmp_path, old, new, message):
    path = broken(tmp_path, old, new)
    with pytest.raises(ScenarioError, match=message) as caught:
        layout_map(path)
    assert str(path) in str(caught.value)


def test_level_transmitters_are_refused(tmp_path):
    text = SITE.read_text()
    for height in ("20.0", "30.0", "40.0", "50.0"):
        text = text.replace(f", {height}]\ncarrier", ", 25.0]\ncarrier")
    path = tmp_path / "level.toml"
    path.write_text(text)
    with pytest.raises(ScenarioError, match=r"one plane.*0\.000, 0\.000, 1\.000.*different heights"):
        layout_map(path)


def test_constraints_that_cannot_be_met_are_refused():
    with pytest.raises((ScenarioError, GeometryError), match="no room"):
        optimise(SITE, rules=Rules(separation_m=150.0), starts=1)


def surveyed(tmp_path, **changes):
    """Save Table 2's site with surveyed pivots at 433 MHz."""
    heliostats = [h.changed(pivot_sigma_m=0.005) for h in load_scenario(SITE).heliostat[:3]]
    return short_site(tmp_path, heliostat=heliostats, radio={"centre_frequency_hz": 433e6}, **changes)


def test_map_of_pose_site_says_which_mirrors_it_cannot_solve(tmp_path):
    site = surveyed(tmp_path, multipath={"foresee": ["ground"]})
    assert "site" not in json.loads(run("map", site, "--json"))["normal_mrad"]
    found = json.loads(run("map", site, "--json", "--estimator", "site"))
    assert 0.5 < found["normal_mrad"]["site"]["worst"] < 20.0
    assert "site_unsolved" not in found
    east, north, up = load_scenario(site).heliostat[1].pivot_enu_m
    walls = [
        {"id": f"W{k}", "base_enu_m": (east + x, north + y, up - 5.0), "size_m": size}
        for k, (x, y, size) in enumerate(
            [(4, 0, (1, 9, 90)), (-4, 0, (1, 9, 90)), (0, 4, (9, 1, 90)), (0, -4, (9, 1, 90))]
        )
    ]
    site = surveyed(tmp_path, multipath={"foresee": ["ground"]}, site={"structures": {"box": walls}})
    out = tmp_path / "map.csv"
    text = run("map", site, "--estimator", "site", "--csv", str(out))
    assert "site: 1 heliostat not solved in every posture: fewer measurements than unknowns" in text
    with out.open() as file:
        rows = list(csv.DictReader(file))
    assert [row["site_unsolved"][:18] for row in rows] == ["", "fewer measurements", ""]
    assert [math.isnan(float(row["normal_site_rms_mrad"] or "nan")) for row in rows] == [False, True, False]


def test_the_reason_is_of_the_first_posture_that_is_not_solved():
    unknowns = PoseStatus.UNKNOWNS
    reasons = _reasons(np.array([[0, unknowns, 0], [0, PoseStatus.UNCERTAIN, unknowns]]))
    assert reasons == ("", unknowns.reason, unknowns.reason)


def test_map_of_pose_site_refuses_what_pose_site_does(tmp_path):
    with pytest.raises(ScenarioError, match=r"site\.toml: pose `site` .* not surveyed; give `pivot_sigma_m`"):
        layout_map(short_site(tmp_path), estimators=["site"])
    with pytest.raises(ScenarioError, match=r"site\.toml: pose `site` compares carriers .* `H01` does not"):
        layout_map(short_site(tmp_path, heliostat={"oscillator": "separate"}), estimators=["site"])
    site = surveyed(tmp_path)
    sight = Sight(plates=Plates(width_m=3.2, height_m=2.6))
    with pytest.raises(ScenarioError, match=r"estimator `site` foresees for itself"):
        layout_map(site, estimators=["site"], sight=sight)


def test_plates_take_the_posture_of_the_field(tmp_path):
    plates = [
        {"id": "P0", "pivot_enu_m": (10.0, 5.0, 3.0), "width_m": 3.0, "height_m": 2.0},
        {"id": "P1", "pivot_enu_m": (20.0, 5.0, 3.0), "width_m": 3.0, "height_m": 2.0, "normal_enu": (0.0, -1.0, 1.0)},
    ]
    site = load_scenario(surveyed(tmp_path, site={"structures": {"plate": plates}}))
    sun, stow = postures_of(site, Postures(suns_deg=[(120.0, 30.0)], stow=True))
    (own,) = postures_of(site, Postures())
    ray = enu_from_azimuth_elevation(*np.radians([120.0, 30.0]))
    for place, normal in zip(((10.0, 5.0, 3.0), (20.0, 5.0, 3.0)), sun.plate_rot[:, :, 2], strict=True):
        to_aim = unit(np.array(site.site.aim_enu_m) - place)
        np.testing.assert_allclose(2.0 * (normal @ ray) * normal - ray, to_aim, atol=1e-12)
    np.testing.assert_allclose(stow.plate_rot[:, :, 2], [[0.0, 0.0, 1.0]] * 2, atol=1e-12)
    np.testing.assert_allclose(own.plate_rot[1, :, 2], np.array([0.0, -1.0, 1.0]) / np.sqrt(2.0), atol=1e-12)


@pytest.mark.parametrize("n", [9, 11])
def test_optimise_keeps_what_the_file_says(tmp_path, n):
    """Names, comments, [mirror], how numbers are written, a scale; only the transmitters are others."""
    text = SITE.read_text().replace('id = "T3"', 'id = "hill"  # on the hill', 1)
    text = text.replace("carrier_hz = -18e6", "carrier_hz = -18.00e6", 1)
    text = text.replace('name = "Table 2', 'scale = 0.5  # half of it\nname = "Table 2', 1)
    text += '\n[[simulation.blocked]]\ntransmitter = "T10"\nreceivers = ["H01"]\n'
    site, better, picture = (tmp_path / name for name in ("site.toml", "better.toml", "both.svg"))
    site.write_text(text)
    options = ("-n", n, "--starts", 1, "--separation", 10, "--sun", 180, 60, "--picture", picture)
    found = json.loads(run("optimise", site, "-o", better, "--json", *options))
    now, then = better.read_text(), load_scenario(better)
    assert "# on the hill" in now
    assert "# half of it" in now
    assert "frame_samples = 400_000" in now
    assert ("carrier_hz = -18.00e6" in now) == (n == 9)  # eleven share the band anew
    assert then.transmitter_ids[:4] == ("T1", "T2", "hill", "T4")
    assert len(then.transmitter) == n
    assert then.heliostat == load_scenario(site).heliostat
    assert (len(then.simulation.blocked) == 1) == (n == 11)
    for each in then.transmitter:  # to a centimetre, and what was found
        assert each.position_enu_m == pytest.approx(found["transmitters"][each.id], abs=1e-9)
        assert each.position_enu_m == pytest.approx(np.round(each.position_enu_m, 2), abs=1e-9)
    assert found["sight_lines_crossed"] == 0
    assert found["mirror_suns"] == 12
    assert found["value"] >= 0.999 * found["without_sight_lines"]
    assert "before: RMS" in picture.read_text()


def test_compare_tells_of_each_layout_what_map_does(tmp_path):
    other, picture, csv_path = tmp_path / "other.toml", tmp_path / "both.svg", tmp_path / "both.csv"
    site = load_scenario(SITE)
    higher = site.transmitter_enu_m[:8] + np.array([0.0, 0.0, 5.0])
    site.with_transmitters(higher).save(other)
    wanted = ("--estimator", "rigid", "--estimator", "scenario", "--sun", 180, 60)
    written = ("--picture", picture, "--csv", csv_path, "--cost", 10, 1, 0)
    found = json.loads(run("compare", SITE, other, *wanted, *written, "--json"))["layouts"]
    assert [each["name"] for each in found] == [SITE.name, "other.toml"]
    for each, path in zip(found, (SITE, other), strict=True):
        mapped = json.loads(run("map", path, *wanted, "--json"))
        assert each["pdop"] == mapped["pdop"]
        assert each["normal_mrad"] == mapped["normal_mrad"]
        lost = mapped["normal_without_transmitter_mrad"]["rigid"]
        assert each["without_worst_mrad"]["rigid"] == max(lost.values())
    assert found[0]["cost"] == 100.0 + site.transmitter_enu_m[:, 2].sum()
    with csv_path.open() as file:
        rows = list(csv.DictReader(file))
    assert float(rows[1]["normal_rigid_rms_mrad"]) == pytest.approx(found[1]["normal_mrad"]["rigid"]["rms"], rel=1e-5)
    assert "other.toml" in picture.read_text()
