"""`[simulation] paths`: samples are the sum over a table's rays, and tables of other sites are refused."""

import contextlib
import re
import zipfile

import numpy as np
import pytest

import rfpose as rf
from raytables import image_table, save
from rfpose import geometry
from rfpose.errors import GeometryError, RecordingError, ScenarioError
from rfpose.scenario import parse_scenario
from rfpose.simulator import Simulator

SPEED = 299_792_458.0
SITE = """
name = "small"
[site]
aim_enu_m = [0.0, 0.0, 50.0]
[radio]
sample_rate_hz = 1e6
centre_frequency_hz = 100e6
frame_samples = 256
[[tone]]
frequency_hz = 20e3
modulation_index = 0.5
[[tone]]
frequency_hz = 70e3
modulation_index = 0.4
[[transmitter]]
id = "A"
position_enu_m = [100.0, 0.0, 20.0]
carrier_hz = -300e3
[[transmitter]]
id = "B"
position_enu_m = [-50.0, 86.6, 30.0]
carrier_hz = 50e3
amplitude = 0.5
[[calibration_receiver]]
id = "cal"
position_enu_m = [15.0, -20.0, 2.5]
[mirror]
receiver_mirror_m = [[1.0, 0.0, 0.1], [-0.5, 0.866, 0.1], [-0.5, -0.866, 0.1]]
[[heliostat]]
id = "H1"
pivot_enu_m = [20.0, 5.0, 3.0]
normal_enu = [0.2, 0.3, 1.0]
[[heliostat]]
id = "H2"
pivot_enu_m = [-20.0, 15.0, 3.0]
normal_enu = [-0.2, 0.3, 1.0]
"""
QUIET = {"tone_snr_db": 300.0, "sample_format": "complex64", "frame_count": 1, "start_unix_s": 0}


@pytest.fixture
def site():
    return parse_scenario(SITE).changed(simulation=QUIET)


def truth_of(site):
    return Simulator(site, seed=0).truth


def table_of(site, frame=0, **changed):
    truth = truth_of(site)
    names = list(site.receiver_ids)
    rf_hz = site.radio.centre_frequency_hz
    return image_table(names, truth.receiver_enu_m[frame], site.transmitter_enu_m, rf_hz) | changed


def samples_of(simulator, frame=0):
    """(receiver, sample) complex."""
    found = {}
    for chunk in simulator:
        found.setdefault(chunk.receiver_id, []).append(chunk.samples)
    rows = [np.concatenate(found[name]) for name in simulator.receiver_ids]
    n = len(rows[0]) // len(simulator.frame_start_index)
    return np.array([row[frame * n : (frame + 1) * n] @ [1.0, 1j] for row in rows])


def formula(site, simulator, table, gain):
    """The sum over rays of docs/simulation.md; ``gain`` (ray,) is what the antenna makes of each."""
    draws, radio = simulator.draws, site.radio
    out = np.zeros((len(site.receivers), radio.frame_samples), complex)
    unit = 4.0 * np.pi * site.simulation.reference_range_m * radio.centre_frequency_hz / SPEED
    for k in range(len(table["rx"])):
        r, i = int(table["rx"][k]), int(table["tx"][k])
        t = (np.arange(radio.frame_samples) + draws.sampling_phase[r]) / radio.sample_rate_hz
        tau = table["length_m"][k] / SPEED
        f = site.carrier_hz[i]
        envelope = 1.0
        for q, tone in enumerate(site.tone):
            angle = 2 * np.pi * site.tone_hz[q] * (t - tau) + draws.tone_phase_rad[0, i, q]
            envelope = envelope + tone.modulation_index * np.cos(angle)
        phase = draws.carrier_phase_rad[i] + draws.oscillator_phase_rad[r]
        turn = 2 * np.pi * (f * t - (radio.centre_frequency_hz + f) * tau)
        out[r] += unit * site.transmitter[i].amplitude * gain[k] * np.exp(1j * (phase + turn)) * envelope
    return out


def test_a_table_by_images_gives_what_geometry_gives(site, tmp_path):
    """Two ways to one signal: rays off a level ground from the scenario, and from a table of them."""
    file = save(tmp_path / "t.npz", table_of(site))
    ground = {"ground": {"coefficient": [-0.3, 0.1]}, "path_loss": "free_space"}
    expected = Simulator(site.changed(simulation=ground), seed=3)
    got = Simulator(site.changed(simulation={"paths": str(file)}), seed=3)
    np.testing.assert_allclose(samples_of(got), samples_of(expected), atol=3e-6)
    np.testing.assert_array_equal(got.truth.receiver_enu_m, expected.truth.receiver_enu_m)
    np.testing.assert_array_equal(got.truth.normal_enu, expected.truth.normal_enu)


def test_links_with_unequal_numbers_of_rays(site, tmp_path):
    table = table_of(site)
    keep = (table["rx"] + 2 * table["tx"]) % 3 != 0  # some links keep both rays, some lose both
    keep |= (table["code"] == "") & (table["rx"] < 3)
    for key in ("rx", "tx", "a_theta", "a_phi", "length_m", "theta_t", "theta_r", "phi_r", "code"):
        table[key] = table[key][keep][::-1]
    told = site.changed(simulation={"paths": str(save(tmp_path / "t.npz", table))})
    got = Simulator(told, seed=3)
    np.testing.assert_allclose(samples_of(got), formula(told, got, table, table["a_theta"]), atol=3e-6)


def test_a_dipole_gets_the_field_along_the_mirror(site, tmp_path):
    table = table_of(site)
    told = site.changed(simulation={"paths": str(save(tmp_path / "t.npz", table)), "path_antenna": "dipole_y"})
    got = Simulator(told, seed=3)
    rot = geometry.rot_enu_from_mirror(got.truth.normal_enu[0])
    axis = np.array([rot[r // 3, :, 1] if r < 6 else [0.0, 0.0, 1.0] for r in table["rx"]])
    theta, phi = table["theta_r"], table["phi_r"]
    down = np.stack([np.cos(theta) * np.cos(phi), np.cos(theta) * np.sin(phi), -np.sin(theta)], axis=1)
    aside = np.stack([-np.sin(phi), np.cos(phi), 0 * phi], axis=1)
    gain = -(table["a_theta"] * (down * axis).sum(1) + table["a_phi"] * (aside * axis).sum(1))
    np.testing.assert_allclose(samples_of(got), formula(told, got, table, gain), atol=3e-6)


def test_rays_are_left_out_by_what_they_met(site, tmp_path):
    table = table_of(site)
    table["code"] = np.array(["R:ground+D:tower" if k % 4 == 1 else c for k, c in enumerate(table["code"])])
    file = save(tmp_path / "t.npz", table)
    told = site.changed(simulation={"paths": str(file), "paths_without": ["*:tower"]})
    got = Simulator(told, seed=3)
    gain = np.where(np.arange(len(table["rx"])) % 4 == 1, 0.0, table["a_theta"])
    np.testing.assert_allclose(samples_of(got), formula(told, got, table, gain), atol=3e-6)


def test_receivers_are_found_by_name_and_place(site, tmp_path):
    """Names may have a group in front; of several groups the receiver that stands there is meant; order is free."""
    table = table_of(site)
    order = np.random.default_rng(1).permutation(7)
    names = [f"front:{n}" for n in site.receiver_ids]
    moved = image_table([f"beside:{n}" for n in site.receiver_ids], table["rx_enu_m"] + 0.3, table["tx_enu_m"], 100e6)
    both = {key: np.concatenate([moved[key], table[key]]) for key in table if key not in ("tx_enu_m", "frequency_hz")}
    both["rx"] = np.concatenate([moved["rx"], 7 + np.argsort(order)[table["rx"]]]).astype(np.int16)
    both["rx_names"] = np.concatenate([moved["rx_names"], np.array(names)[order]])
    both["rx_enu_m"] = np.concatenate([moved["rx_enu_m"], table["rx_enu_m"][order]])
    both |= {key: table[key] for key in ("tx_enu_m", "frequency_hz")}
    plain = Simulator(site.changed(simulation={"paths": str(save(tmp_path / "a.npz", table))}), seed=3)
    grouped = Simulator(site.changed(simulation={"paths": str(save(tmp_path / "b.npz", both))}), seed=3)
    np.testing.assert_array_equal(samples_of(grouped), samples_of(plain))


def test_one_table_a_frame(site, tmp_path):
    moving = {"frame_count": 2, "frame_interval_s": 60.0, "sun_azimuth_deg": (120.0, 240.0), "sun_elevation_deg": 40.0}
    site = site.changed(heliostat={"normal_enu": None}, simulation=moving)
    files = [str(save(tmp_path / f"{k}.npz", table_of(site, k))) for k in (0, 1)]
    got = Simulator(site.changed(simulation={"paths": files}), seed=3)
    ground = {"ground": {"coefficient": [-0.3, 0.1]}, "path_loss": "free_space"}
    expected = Simulator(site.changed(simulation=ground), seed=3)
    for frame in (0, 1):
        np.testing.assert_allclose(samples_of(got, frame), samples_of(expected, frame), atol=3e-6)
    with pytest.raises(ScenarioError, match=r"0\.npz: receiver `H1_r0` stands .* m from .* in frame 1; trace it"):
        Simulator(site.changed(simulation={"paths": files[0]}), seed=3)


def test_a_recording_does_not_need_its_tables(tmp_path, monkeypatch):
    """Names are looked for beside the scenario; what is made of tables holds the scenario and can do without them."""
    site = parse_scenario(SITE).changed(
        radio={"frame_samples": 40_000},
        simulation={"frame_count": 1, "paths": "rays.npz", "reference_range_m": 60.0},
    )
    bare = site.changed(simulation={"paths": None})
    folder = tmp_path / "site"
    folder.mkdir()
    save(folder / "rays.npz", table_of(bare))
    site.save(folder / "site.toml")
    monkeypatch.chdir(tmp_path)
    made = rf.simulate(folder / "site.toml", seed=1)
    assert folder / "rays.npz" in made.files()
    made.save("recording.h5")
    (folder / "rays.npz").unlink()
    with rf.open_recording("recording.h5") as recording:
        assert recording.scenario == site
        np.testing.assert_array_equal(recording.truth.receiver_enu_m, made.truth.receiver_enu_m)
    with pytest.raises(GeometryError, match="transmitter"):  # two of them locate nothing; the table is not missed
        rf.process("recording.h5")


def test_a_table_is_not_overwritten_by_what_is_made_of_it(site, tmp_path):
    file = save(tmp_path / "t.npz", table_of(site))
    before = file.read_bytes()
    made = rf.simulate(site.changed(simulation={"paths": str(file)}), seed=1)
    with pytest.raises(RecordingError):
        made.save(file, force=True)
    assert file.read_bytes() == before


# -- what is refused -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("simulation", "message"),
    [
        ({"paths": "t.npz", "ground": {"coefficient": [-0.3, 0.1]}}, "leave `simulation.ground` out"),
        ({"paths": "t.npz", "path_loss": "free_space"}, "leave `simulation.path_loss` out"),
        ({"paths": ["a.npz", "b.npz"], "frame_count": 3}, "got 2 files and `simulation.frame_count` = 3"),
        ({"path_antenna": "dipole_y"}, "`simulation.path_antenna` is about `simulation.paths`"),
        ({"paths_without": ["D:ground"]}, "`simulation.paths_without` is about `simulation.paths`"),
    ],
)
def test_contradictions_are_refused(site, simulation, message):
    with pytest.raises(ScenarioError, match=message):
        site.changed(simulation=simulation)


def refused(site, tmp_path, table, kind=RecordingError):
    file = save(tmp_path / "bad.npz", table)
    with pytest.raises(kind) as caught:
        Simulator(site.changed(simulation={"paths": str(file)}), seed=0)
    assert str(caught.value).startswith(str(file))
    return str(caught.value)


def with_row(table, name, row, value):
    array = table[name].copy()
    array[row] = value
    return table | {name: array}


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("length_m", np.nan, "`length_m` in row 5 is nan, not finite"),
        ("a_theta", np.inf, "`a_theta` in row 5 is .*inf.*, not finite"),
        ("a_phi", 1e30, "`a_phi` in row 5 is .*, beyond what a ray can have"),
        ("length_m", 0.0, "`length_m` in row 5 is 0.0, beyond"),
        ("length_m", 1e9, "`length_m` in row 5 is 1000000000.0, beyond"),
        ("rx", 7, "`rx` in row 5 is 7, none of the 7 there are"),
        ("rx", -1, "`rx` in row 5 is -1, none"),
        ("tx", 2, "`tx` in row 5 is 2, none of the 2 there are"),
    ],
)
def test_impossible_rows_are_named(site, tmp_path, name, value, message):
    assert re.search(message, refused(site, tmp_path, with_row(table_of(site), name, 5, value)))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"length_m": np.ones(3)}, "array `length_m` must have shape"),
        ({"a_theta": np.array(["x"] * 28)}, "array `a_theta` holds <U1"),
        ({"rx": np.zeros(28)}, "array `rx` holds float64"),
        ({"rx_enu_m": np.zeros((7, 2))}, "array `rx_enu_m` must have shape"),
        ({"frequency_hz": np.float64(-1.0)}, "`frequency_hz` must be above zero"),
        ({"code": np.array([None] * 28, object)}, "neither numbers nor text"),
        ({"phi_r": None}, "lacks the array `phi_r`"),
    ],
)
def test_what_is_no_table_is_refused(site, tmp_path, change, message):
    table = {key: value for key, value in (table_of(site) | change).items() if value is not None}
    assert message in refused(site, tmp_path, table)


def test_a_table_of_another_site_is_refused(site, tmp_path):
    table = table_of(site)
    names = table | {"rx_names": np.array([*site.receiver_ids[:-1], "other"])}
    assert "has no receiver `cal`; it has 'H1_r0'" in refused(site, tmp_path, names, ScenarioError)
    assert "receiver `H1_r2` stands 0.25 m from where the scenario has it in frame 0" in refused(
        site, tmp_path, with_row(table, "rx_enu_m", 2, table["rx_enu_m"][2] + [0, 0, 0.25]), ScenarioError
    )
    far = refused(site, tmp_path, with_row(table, "tx_enu_m", 1, table["tx_enu_m"][1] + [3, 0, 0]), ScenarioError)
    assert "has no transmitter where the scenario has `B`: the nearest is 3 m away" in far
    other_band = refused(site, tmp_path, table | {"frequency_hz": np.float64(433e6)}, ScenarioError)
    assert "traced at 4.33e+08 Hz, outside the recorded band" in other_band


def test_a_damaged_file_is_refused(site, tmp_path):
    """Whatever byte is wrong, the answer is a sentence; and nothing is unpickled."""
    whole = save(tmp_path / "t.npz", table_of(site)).read_bytes()
    told = site.changed(simulation={"paths": str(tmp_path / "bad.npz")})
    rng, accepted = np.random.default_rng(5), 0
    with pytest.raises(RecordingError, match="cannot be read: No such file"):
        Simulator(told, seed=0)
    for k in range(150):
        bad = bytearray(whole[: rng.integers(len(whole))] if k % 3 == 0 else whole)
        for _ in range(rng.integers(1, 6)):
            if bad:
                bad[rng.integers(len(bad))] = rng.integers(256)
        (tmp_path / "bad.npz").write_bytes(bad)
        # a byte between members is nobody's
        with contextlib.suppress(RecordingError, ScenarioError):
            Simulator(told, seed=0)
            accepted += 1
    assert accepted < 30


def test_a_header_that_lies_costs_no_memory(site, tmp_path):
    file = save(tmp_path / "bad.npz", table_of(site))
    header = "{'descr': '<f8', 'fortran_order': False, 'shape': (10000000000000,), }".ljust(117) + "\n"
    with zipfile.ZipFile(file) as good:
        members = {name: good.read(name) for name in good.namelist()}
    members["length_m.npy"] = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header.encode() + b"\0" * 80
    with zipfile.ZipFile(file, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    with pytest.raises(RecordingError, match=r"`length_m.npy` of shape .* takes more than"):
        Simulator(site.changed(simulation={"paths": str(file)}), seed=0)
