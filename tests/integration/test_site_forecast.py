"""What a map forecasts of pose site is what pose site states of carriers that hold rays, stray fields and noise."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

import rfpose as rf
from rfpose import geometry
from rfpose.dsp import TonePhases
from rfpose.errors import InvalidInputError
from rfpose.multilat import PoseStatus
from rfpose.multilat.site import Common, WorldErrors
from rfpose.pipeline.choice import choose
from rfpose.pipeline.layout import Rules, layout_map
from rfpose.pipeline.mirrors import mirror_groups
from rfpose.pipeline.site import SiteField, antenna_of, foreseen_mirrors, stray_ranges
from rfpose.pipeline.solve import solve
from rfpose.propagation import RayKind
from rfpose.scenario import Scenario

N_MIRROR, N_SAMPLE, TAIL = 12, 40_000, 8.0
GROUND = {"model": "fresnel", "permittivity": 12.0, "conductivity_s_per_m": 0.01}
FACTORS = {RayKind.GROUND: (0.05, 0.05), RayKind.SPECULAR: (0.1, 0.3), RayKind.DIFFRACTED: (0.1, 0.3)}


def site(*, ground: bool, plate: bool, snr_db: float = 45.0, floor: float = 0.03) -> Scenario:
    """Return mirrors among Table 2's transmitters, each with a metal plate beside it if asked for."""
    rng = np.random.default_rng(3)
    table2 = rf.load_scenario(rf.shipped_scenario("table2_100m.toml"))
    normal = geometry.unit(rng.normal(size=(N_MIRROR, 3)) * 0.3 + [0.0, 0.0, 1.0])
    pivot = np.array([[12.0 * (k % 6) - 30.0, 12.0 * (k // 6) - 18.0, 3.0] for k in range(N_MIRROR)])
    square = [(x, y, 0.05) for x in (1.1, -1.1) for y in (0.8, -0.8)]
    heliostats = [
        {
            "id": f"H{k}", "pivot_enu_m": tuple(pivot[k]), "receiver_mirror_m": square, "pivot_sigma_m": 0.005,
            "receiver_ids": [f"H{k}.{r}" for r in range(4)], "normal_enu": tuple(normal[k]), "oscillator": "shared",
            "carrier_phase": True, "receiver_delay_sigma_s": 1e-12,
        }
        for k in range(N_MIRROR)
    ]  # fmt: skip
    plates = [
        {"id": f"P{k}", "pivot_enu_m": tuple(pivot[k] + [6.0, 0.0, 0.0]), "width_m": 3.0, "height_m": 2.0,
         "normal_enu": (-1.0, 0.2, 0.3)}
        for k in range(N_MIRROR)
    ]  # fmt: skip
    return table2.changed(
        heliostat=heliostats,
        calibration_receiver=[],
        radio={"centre_frequency_hz": 433e6, "frame_samples": N_SAMPLE},
        simulation={"tone_snr_db": snr_db, "path_loss": "free_space", "reference_range_m": 100.0},
        multipath={"floor": floor, "tail": TAIL, "reach_m": 8.0, "rounds": 1},
        **({"reflection": GROUND} if ground else {}),
        **({"site": {"structures": {"plate": plates}}} if plate else {}),
    )


def measured(scenario: Scenario, seed: int) -> TonePhases:
    """Return carriers of one frame: foreseen rays with factors as wrong as is said, stray fields, the radio's noise."""
    rng = np.random.default_rng(seed)
    floor, snr_db = scenario.multipath.floor, scenario.simulation.tone_snr_db
    assert floor is not None
    (group,) = mirror_groups(scenario)
    rot = geometry.rot_enu_from_mirror(np.array([m.normal_enu for m in scenario.mirrors]))
    common = Common(floor=floor, tail=TAIL, factor_scale=np.ones(5), soil_change=0j, soil_sigma=(0.3, 0.1))
    mine = rot[:N_MIRROR]
    heard = SiteField(scenario, group, rot[None], antenna_of(scenario))(group.pivot_enu_m, mine, common)
    shape = (*group.rows.shape, len(scenario.transmitter))
    link = np.repeat(np.arange(len(heard.rays.first) - 1), np.diff(heard.rays.first))
    mirror, _, transmitter = np.unravel_index(link, shape)
    k = 2.0 * np.pi * scenario.carrier_rf_hz / scenario.radio.propagation_speed_mps
    at = group.pivot_enu_m[mirror] + np.einsum("kab,kb->ka", mine[mirror], heard.rays.place_mirror_m)
    path = np.linalg.norm(heard.rays.source_enu_m - at, axis=1) + heard.rays.extra_m
    ground = heard.rays.kind == RayKind.GROUND
    shared = np.stack(
        [mirror, heard.rays.kind, np.where(ground, 0, heard.rays.thing), np.where(ground, 0, transmitter)]
    )
    _, alike = np.unique(shared, axis=1, return_inverse=True)
    draw = rng.normal(size=(2, alike.max() + 1))[:, alike.ravel()]
    sigma = np.array([FACTORS.get(kind, (0.0, 0.0)) for kind in RayKind])[heard.rays.kind].T
    voltage = heard.voltage * (1.0 + sigma[0] * draw[0] + 1j * sigma[1] * draw[1])
    carrier = np.zeros(int(np.prod(shape)), complex)
    np.add.at(carrier, link, voltage * np.exp(-1j * k[transmitter] * path))
    direct = 1.0 / np.linalg.norm(scenario.transmitter_enu_m - group.pivot_enu_m[:, None], axis=-1)[:, None]
    normal = rng.normal(size=(2, *shape)) / np.sqrt(rng.chisquare(TAIL, shape) / TAIL)
    stray = floor * direct * (normal[0] + 1j * normal[1])
    index = scenario.tone[0].modulation_index
    # the tone's amplitude is a·m, and a = 1 at 100 m
    noise = index / np.sqrt(2.0 * N_SAMPLE * 10.0 ** (snr_db / 10.0)) / 100.0
    normal = rng.normal(size=(2, *shape))
    seen = carrier.reshape(shape) + stray + noise * (normal[0] + 1j * normal[1])
    tones = TonePhases.empty(
        receiver_ids=scenario.receiver_ids, transmitter_ids=scenario.transmitter_ids, tone_hz=scenario.tone_hz,
        frame_start_index=np.zeros(1, np.int64),
    )  # fmt: skip
    tones.carrier[0, group.rows], tones.carrier_sigma[0, group.rows] = seen, noise
    tones.phase_rad[0, group.rows], tones.sigma_rad[0, group.rows] = 0.0, 0.1
    tones.status[:] = 0
    return tones


CASES = [
    (False, False, 45.0, 0.03),
    (True, False, 45.0, 0.03),
    (False, True, 45.0, 0.03),
    (True, True, 45.0, 0.03),
    (True, True, -26.0, 1e-4),
]
"""The last is of noise alone."""


@pytest.mark.parametrize(("ground", "plate", "snr_db", "floor"), CASES)
def test_the_forecast_is_what_pose_site_states(ground: bool, plate: bool, snr_db: float, floor: float) -> None:
    scenario = site(ground=ground, plate=plate, snr_db=snr_db, floor=floor)
    found = layout_map(scenario, estimators=["site"])
    assert found.unsolved == ("",) * N_MIRROR
    how = {"sample_rate": Fraction(64_000_000), "settings": {"estimator": "correlator"}}
    chosen = choose(scenario, pose="site")
    poses = [solve(measured(scenario, seed), scenario, chosen, **how).poses for seed in range(3)]
    assert (np.array([p.status for p in poses]) == PoseStatus.OK).all()
    ratio = 1e3 * np.array([p.sigma_rad[0] for p in poses]) / found.rms_mrad["site"]
    # a mirror's own residuals, some twenty degrees of freedom with heavy tails, make its sigma 0.15 smaller or larger
    assert np.sqrt(np.mean(ratio**2)) == pytest.approx(1.0, abs=0.1)
    assert np.abs(np.log(np.sqrt(np.mean(ratio**2, axis=0)))).max() < 4.0 * 0.15 / np.sqrt(3.0)


def test_mirrors_learn_the_ground_together() -> None:
    many = site(ground=True, plate=False)
    alone = many.changed(heliostat=many.heliostat[:1])
    sigma = [layout_map(s, estimators=["site"]).rms_mrad["site"][0] for s in (many, alone)]
    assert 0.9 < sigma[0] / sigma[1] < 0.97


RECKONED = {
    "thermal noise", "what nothing foresees", "the ground's permittivity", "roughness of the ground",
    "reflections of neighbours and tower", "diffraction at edges", "pivot survey", "commanded posture", "mount",
    "clock",
}  # fmt: skip


@pytest.mark.parametrize(("ground", "plate", "snr_db", "floor"), [CASES[0], CASES[3], CASES[4]])
def test_the_budgets_lines_add_up_to_the_forecast(ground: bool, plate: bool, snr_db: float, floor: float) -> None:
    scenario = site(ground=ground, plate=plate, snr_db=snr_db, floor=floor)
    lines = {line["source"]: line for line in rf.budget(scenario, pose="site", n_draw=0).as_dict()["lines"]}
    whole = np.sqrt(np.mean(layout_map(scenario, estimators=["site"]).rms_mrad["site"] ** 2))
    reckoned = [line["normal_mrad"] ** 2 for name, line in lines.items() if name in RECKONED]
    assert np.sqrt(sum(reckoned)) == pytest.approx(whole, rel=1e-3)
    assert ("the ground's permittivity" in lines) == ground
    assert ("reflections of neighbours and tower" in lines) == plate
    assert lines["receiver plane to glass"]["normal_mrad"] == pytest.approx(0.5 * np.sqrt(2.0))


def test_the_budget_is_what_draws_through_the_fit_show() -> None:
    found = rf.budget(site(ground=True, plate=True), pose="site", n_draw=40).as_dict()
    assert found["solutions_failed"] == 0
    lines = {line["source"]: line for line in found["lines"]}
    for name in ("what nothing foresees", "receiver places", "receiver plane to glass", "clock"):
        # 12 mirrors, 40 draws, two angles each
        ratio = lines[name]["monte_carlo_mrad"] / lines[name]["normal_mrad"]
        assert ratio == pytest.approx(1.0, abs=0.1), name
    # of some forty phases, 24 are left to tell stray fields by: their tails cost more than with many
    assert found["sum"]["normal_mrad"] / found["monte_carlo"]["normal_mrad"] == pytest.approx(0.95, abs=0.06)


def test_receivers_that_are_turned_turn_the_normal() -> None:
    """What a turn of the receivers against the plate does is exactly known: the pose turns back."""
    scenario = site(ground=False, plate=False, floor=1e-5)
    rot = geometry.rot_enu_from_mirror(np.array([m.normal_enu for m in scenario.mirrors]))
    ((_, foreseen),) = foreseen_mirrors(scenario, rot)
    turn = np.array([3e-5, -2e-5, 1e-5])
    place = np.cross(turn, foreseen.knowledge.receiver_mirror_m)
    found = foreseen.normal_change(WorldErrors(place_m=place), linear=True)
    expected = np.einsum("mab,b->ma", rot[:N_MIRROR], np.cross(turn, [0.0, 0.0, 1.0]))
    np.testing.assert_allclose(found, expected, atol=1e-3 * np.linalg.norm(turn))


def test_a_shift_of_all_transmitters_turns_mirrors_only_where_pivots_are_held() -> None:
    """All transmitters moved are all mirrors moved the other way: exact where nothing is known of pivots."""
    scenario = site(ground=False, plate=False, floor=1e-5)
    free = scenario.changed(heliostat={"pivot_sigma_m": 10.0})
    rot = geometry.rot_enu_from_mirror(np.array([m.normal_enu for m in scenario.mirrors]))
    shift = np.tile([1e-4, -2e-4, 1e-4], (len(scenario.transmitter), 1))
    change = {}
    for name, told in (("held", scenario), ("free", free)):
        ((_, foreseen),) = foreseen_mirrors(told, rot)
        change[name] = np.abs(foreseen.normal_change(WorldErrors(transmitter_m=shift), linear=True)).max()
    assert change["free"] < 1e-8
    assert change["held"] > 20.0 * change["free"]


def test_a_budget_of_pose_site_refuses_what_it_does_not_have() -> None:
    with pytest.raises(InvalidInputError, match=r"\[reflection\]"):
        rf.budget(site(ground=True, plate=False), pose="site", ground="known")


def test_moved_transmitters_are_received_as_if_foreseen_anew() -> None:
    scenario = site(ground=True, plate=False)
    rot = geometry.rot_enu_from_mirror(np.array([m.normal_enu for m in scenario.mirrors]))
    shift = 1e-3 * np.random.default_rng(2).normal(size=(len(scenario.transmitter), 3))
    moved = scenario.with_transmitters(scenario.transmitter_enu_m + shift)
    ((_, before),), ((_, after),) = foreseen_mirrors(scenario, rot), foreseen_mirrors(moved, rot)
    ratio = before.received(WorldErrors(transmitter_m=shift)) / after.received()
    change = before.received() / after.received()
    assert np.abs(change - 1.0).max() > 5e-3
    assert np.abs(ratio - 1.0).max() < 2e-4


def test_a_wall_shifts_ranges_as_its_image_says() -> None:
    """A metal wall that reaches everywhere turns vertical waves as a second transmitter behind it, upside down."""
    rng = np.random.default_rng(5)
    table2 = rf.load_scenario(rf.shipped_scenario("table2_100m.toml"))
    wall_m = 8.0
    transmitter = [
        t.changed(position_enu_m=(-20.0 - 8.0 * i, *rng.uniform([-30, 5], [30, 20])))
        for i, t in enumerate(table2.transmitter)
    ]
    scenario = table2.changed(
        heliostat=[
            h.changed(pivot_enu_m=(0.0, 6.0 * i, 4.0), normal_enu=(0.0, 0.0, 1.0))
            for i, h in enumerate(table2.heliostat[:3])
        ],
        transmitter=transmitter,
        calibration_receiver=[{"id": "cal", "position_enu_m": (-3.0, 2.0, 5.0)}],
        site={"structures": {"plate": [
            {"id": "wall", "pivot_enu_m": (wall_m, 0.0, 0.0), "width_m": 500.0, "height_m": 500.0,
             "normal_enu": (-1.0, 0.0, 0.0)}
        ]}},
        radio={"centre_frequency_hz": 433e6},
        multipath={"foresee": ("specular",), "reach_m": 1000.0},
    )  # fmt: skip
    rot = geometry.rot_enu_from_mirror(np.array([m.normal_enu for m in scenario.mirrors]))
    tone_hz = np.array([750e3, 7.5e6, 0.0])
    mirrors, calibration = stray_ranges(scenario, rot, tone_hz)
    at = np.array([h.pivot_enu_m for h in scenario.heliostat])[:, None] + np.einsum(
        "mab,mrb->mra", rot[:3], np.array([h.receiver_mirror_m for h in scenario.heliostat])
    )
    for found, place in ((mirrors, at), (calibration[:, :, None], scenario.calibration_enu_m[:, None])):
        way = np.linalg.norm(scenario.transmitter_enu_m - place[:, :, None], axis=-1)
        image = scenario.transmitter_enu_m * [-1.0, 1.0, 1.0] + [2.0 * wall_m, 0.0, 0.0]
        detour = np.linalg.norm(image - place[:, :, None], axis=-1)
        k = 2.0 * np.pi * scenario.carrier_rf_hz / scenario.radio.propagation_speed_mps

        def line(hz: float, way: np.ndarray = way, detour: np.ndarray = detour, k: np.ndarray = k) -> np.ndarray:
            q = k + 2.0 * np.pi * hz / scenario.radio.propagation_speed_mps
            return np.asarray(1.0 / way - np.exp(-1j * q * (detour - way)) / detour)

        np.testing.assert_allclose(found[:, 2], -np.angle(line(0.0)) / k, atol=1e-4)
        for group, hz in enumerate(tone_hz[:2]):
            kappa = 2.0 * np.pi * hz / scenario.radio.propagation_speed_mps
            beat = line(hz) * line(0.0).conj() + line(-hz).conj() * line(0.0)
            np.testing.assert_allclose(found[:, group], -np.angle(beat) / kappa, atol=1e-3)


def test_what_a_wall_does_is_in_the_budget_of_straight_rays() -> None:
    plain, walled = site(ground=False, plate=False), site(ground=False, plate=True)
    told = {name: rf.budget(s, n_draw=10).as_dict() for name, s in (("plain", plain), ("walled", walled))}
    names = {name: [line["source"] for line in found["lines"]] for name, found in told.items()}
    assert "reflections of the site" not in names["plain"]
    line = next(x for x in told["walled"]["lines"] if x["source"] == "reflections of the site")
    assert line["monte_carlo_mrad"] == pytest.approx(line["normal_mrad"], rel=0.05)
    assert "pose `site`" in line["remedy"]


def test_transmitters_placed_for_pose_site_are_what_its_map_says() -> None:
    many = site(ground=False, plate=True)
    few = many.changed(heliostat=many.heliostat[:3])
    found = rf.optimise(few, criterion="site", starts=2, rules=Rules(keep=8))
    before, after = (
        np.sqrt(np.mean(layout_map(s, estimators=["site"]).rms_mrad["site"] ** 2)) for s in (few, found.scenario)
    )
    told = found.as_dict()
    assert told["criterion"] == "site"
    assert told["unit"] == "mrad"
    assert told["before"] == pytest.approx(before, rel=1e-9)
    assert told["value"] == pytest.approx(after, rel=1e-9)
    assert told["value"] < told["before"]
    assert told["without_worst"] > told["value"]
    np.testing.assert_array_equal(found.scenario.transmitter_enu_m[:8], few.transmitter_enu_m[:8])


def test_a_second_carrier_of_an_antenna_tells_nothing_new_of_reflections_at_the_same_frequency() -> None:
    """At another antenna it does."""
    one = site(ground=False, plate=True)
    rot = geometry.rot_enu_from_mirror(np.array([m.normal_enu for m in one.mirrors]))

    def told(scenario: Scenario) -> tuple[float, float]:
        ((_, foreseen),) = foreseen_mirrors(scenario, rot)
        of_rays = [np.trace(foreseen.share(kind), axis1=1, axis2=2).sum() for kind in ("specular", "diffracted")]
        return float(np.trace(foreseen.poses().normal_cov, axis1=1, axis2=2).sum()), float(sum(of_rays))

    found: dict[str, tuple[float, float]] = {"one": told(one)}
    for name, place, mast in (("same", 0.0, True), ("other", 1e-4, False)):
        more = [
            t.changed(
                id=f"{t.id}b",
                carrier_hz=t.carrier_hz + 30e3,
                position_enu_m=np.add(t.position_enu_m, (place, 0.0, 0.0)),
                mast=t.id if mast else None,
            )
            for t in one.transmitter
        ]
        found[name] = told(one.changed(transmitter=[*one.transmitter, *more]))
    assert found["same"] == pytest.approx(found["one"], rel=0.02)
    assert found["other"][0] < 0.7 * found["one"][0]
    assert found["other"][1] < 0.7 * found["one"][1]


def test_carriers_far_apart_are_witnesses_of_their_own() -> None:
    one = site(ground=False, plate=False)
    wide = one.changed(radio={"sample_rate_hz": 1.2e9, "frame_samples": 1_000_000})
    more = [t.changed(id=f"{t.id}b", mast=t.id, carrier_hz=t.carrier_hz + 500e6) for t in wide.transmitter]
    told = [
        np.sqrt(np.mean(layout_map(s, estimators=["site"]).rms_mrad["site"] ** 2))
        for s in (wide, wide.changed(transmitter=[*wide.transmitter, *more]))
    ]
    # 500 MHz are ten times what a detour of a metre needs, and at the higher frequency a phase is worth less length
    assert told[1] < 0.7 * told[0]
