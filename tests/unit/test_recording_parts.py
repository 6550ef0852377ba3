"""Recordings of many parts: the same as the whole, whatever they were cut into; what does not fit is named."""

import contextlib
import json
import os
import struct
from fractions import Fraction
from pathlib import Path

import h5py
import numpy as np
import pytest

import rfpose as rf
from rfpose.errors import RecordingError, ScenarioError
from rfpose.recording import GapError, RecordingWriter, convert, describe, open_recording
from rfpose.scenario import load_scenario
from rfpose.truth import Truth

SCENARIO = load_scenario(Path(__file__).resolve().parents[2] / "data" / "table2_100m.toml")
RATE = Fraction(10**7, 3)
START = 1_790_000_000 * RATE.numerator // RATE.denominator


def counts(n, seed=0):
    return np.random.default_rng(seed).integers(-9000, 9000, size=(n, 2), dtype=np.int16)


def write(path, pieces, **changes):
    """Write a native file of pieces [(receiver, start after START, samples)]."""
    settings = {
        "scenario": None, "sample_rate": RATE, "centre_frequency_hz": 1e8, "sample_format": "int16",
        "full_scale": 32767, "provenance": {},
    } | changes  # fmt: skip
    names = list(dict.fromkeys(name for name, _, _ in pieces))
    with RecordingWriter(path, receiver_ids=names, **settings) as writer:
        for name, start, samples in pieces:
            writer.write(name, START + start, samples)
    return path


def part_of(source, path, receivers, start, end):
    """Cut receivers and a stretch of time out of a recording, into a native file."""
    with RecordingWriter(
        path, scenario=source.scenario, receiver_ids=receivers, sample_rate=source.sample_rate,
        centre_frequency_hz=source.centre_frequency_hz, sample_format=source.sample_format,
        full_scale=source.full_scale, provenance={},
    ) as writer:  # fmt: skip
        for name in receivers:
            for begin, count in source.blocks(name).tolist():
                first, last = max(begin, start), min(begin + count, end)
                if last > first:
                    writer.write(name, first, source.read(name, first, last - first))
        writer.write_truth(source.truth)
    return path


# -- the same poses as from the whole file -------------------------------------------------------------------


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A simulated recording of two mirrors in four bursts, and its result."""
    site = SCENARIO.changed(
        heliostat=SCENARIO.heliostat[:2], radio={"frame_samples": 8000},
        simulation={"frame_count": 4, "frame_interval_s": 1.0, "sun_azimuth_deg": 170.0},
    )  # fmt: skip
    path = tmp_path_factory.mktemp("whole") / "whole.h5"
    rf.simulate(site, seed=3).save(path)
    return path, rf.process(path)


def cut(path, folder, ways):
    """Cut a recording by receiver (rows of ways) and time (columns), each piece into the format that stands there."""
    given = []
    with open_recording(path) as source:
        names = np.array_split(np.array(source.receiver_ids), len(ways))
        runs = source.blocks(source.receiver_ids[0])
        for i, (row, formats) in enumerate(zip(names, ways, strict=True)):
            # through the middle of a frame, as a recorder's clock happens to fall
            edges = [int(runs[k * len(runs) // len(formats)].sum()) - 3000 for k in range(1, len(formats))]
            edges = [0, *edges, 2**62]
            for k, form in enumerate(formats):
                piece = part_of(source, folder / f"p{i}_{k}.h5", row.tolist(), edges[k], edges[k + 1])
                if form != "rfpose-iq":
                    with open_recording(piece) as one:
                        convert(one, folder / f"p{i}_{k}", format=form)
                    piece = folder / f"p{i}_{k}"
                given.append(piece)
    return given


@pytest.mark.parametrize(
    "ways",
    [
        [["rfpose-iq"], ["rfpose-iq"], ["rfpose-iq"]],
        [["rfpose-iq", "rfpose-iq", "rfpose-iq"]],
        [["rfpose-iq", "rfpose-iq"], ["rfpose-iq"], ["rfpose-iq", "rfpose-iq", "rfpose-iq"]],
        [["digital-rf", "sigmf"], ["rfpose-iq", "digital-rf"], ["sigmf"]],
    ],
    ids=["by receiver", "by time", "by both", "formats mixed"],
)
def test_the_same_result_comes_out_of_parts(whole, tmp_path, ways):
    if any("rfpose-iq" not in form for row in ways for form in row):
        pytest.importorskip("digital_rf", reason="the digital_rf library is not installed")
        pytest.importorskip("sigmf", reason="the sigmf library is not installed")
    path, wanted = whole
    given = cut(path, tmp_path, ways)
    assert len(given) == sum(map(len, ways))
    with open_recording(path) as one, open_recording(given) as many:
        assert set(many.receiver_ids) == set(one.receiver_ids)
        for name in one.receiver_ids:
            assert np.array_equal(many.blocks(name), one.blocks(name))
            for start, count in one.blocks(name).tolist():
                assert np.array_equal(many.read(name, start, count), one.read(name, start, count))
        found = rf.process(many)
    for table in ("poses", "fixes", "tones"):
        mine, theirs = getattr(wanted, table), getattr(found, table)
        for field in type(mine).__dataclass_fields__:
            a, b = getattr(mine, field), getattr(theirs, field)
            if isinstance(a, np.ndarray):
                assert a.dtype == b.dtype
                assert a.tobytes() == b.tobytes(), f"{table}.{field}"
    assert found.truth is not None
    assert found.truth.normal_enu.tobytes() == wanted.truth.normal_enu.tobytes()


# -- what does not fit ---------------------------------------------------------------------------------------


def test_parts_of_other_rates_and_tunings_are_refused_with_both_numbers(tmp_path):
    a = write(tmp_path / "a.h5", [("r0", 0, counts(100))])
    b = write(tmp_path / "b.h5", [("r1", 0, counts(100))], sample_rate=Fraction(2_000_000))
    with pytest.raises(RecordingError, match=r"b.h5 was recorded at 2000000 samples/s, but a.h5 at 3333333.33333 \(1"):
        open_recording([a, b])
    c = write(tmp_path / "c.h5", [("r0", 500, counts(100))], centre_frequency_hz=1.2e8)
    with pytest.raises(RecordingError, match=r"`r0` is tuned to 120000000 Hz in c.h5, but to 100000000 Hz in a.h5"):
        open_recording([a, c])


def test_receivers_that_are_tuned_apart_give_the_same_poses(tmp_path):
    """A recorder that is tuned 200 kHz beside the others has every line 200 kHz lower, and the same phases."""
    radio = SCENARIO.radio
    site = SCENARIO.changed(
        heliostat=SCENARIO.heliostat[:2], radio={"frame_samples": 8000},
        simulation={"frame_count": 2, "sun_azimuth_deg": 170.0, "frame_interval_s": 1.0},
    )  # fmt: skip
    beside_hz = 200e3
    other = site.changed(
        radio={"frame_samples": 8000, "centre_frequency_hz": radio.centre_frequency_hz + beside_hz},
        transmitter=[
            {**t.model_dump(exclude_none=True), "carrier_hz": t.carrier_hz - beside_hz} for t in site.transmitter
        ],
    )
    simulated, elsewhere = rf.simulate(site, seed=3), rf.simulate(other, seed=3)
    wanted = rf.process(simulated)
    names = list(site.receiver_ids)
    mine = part_of(simulated, tmp_path / "a.h5", names[:3], 0, 2**62)
    theirs = part_of(elsewhere, tmp_path / "b.h5", names[3:], 0, 2**62)
    for given in ([mine, theirs], [theirs, mine]):
        with open_recording(given, scenario=site) as r:
            assert r.tuning_of(names[0]) == radio.centre_frequency_hz
            assert r.tuning_of(names[-1]) == radio.centre_frequency_hz + beside_hz
            assert any("sought where that puts them" in note for note in r.notes)
            found = rf.process(r, scenario=site)
            with pytest.raises(RecordingError, match="one file has one tuning; convert the parts apart"):
                convert(r, tmp_path / "c.h5", format="rfpose-iq")
        apart = np.linalg.norm(found.poses.normal_enu - wanted.poses.normal_enu, axis=-1)
        assert np.all(apart < 5.0 * np.hypot(found.poses.sigma_rad, wanted.poses.sigma_rad))
        assert not np.array_equal(found.poses.normal_enu, wanted.poses.normal_enu)
    far = part_of(elsewhere, tmp_path / "d.h5", names[3:], 0, 2**62)
    with h5py.File(far, "r+") as file:
        file.attrs["centre_frequency_hz"] = radio.centre_frequency_hz + 1e9
    with (
        open_recording([mine, far], scenario=site) as r,
        pytest.raises(ScenarioError, match=r"is tuned to 1.*Hz, but the scenario .* lies outside its band of"),
    ):
        rf.process(r, scenario=site)
    split = part_of(simulated, tmp_path / "e.h5", names[:2], 0, 2**62)
    rest = part_of(elsewhere, tmp_path / "f.h5", names[2:], 0, 2**62)
    with (
        open_recording([split, rest], scenario=site) as r,
        pytest.raises(ScenarioError, match=r"receivers of heliostat `H01` are tuned apart \(`H01_r0` 100000000 Hz"),
    ):
        rf.process(r, scenario=site)
    with pytest.raises(ScenarioError, match=r"tuned to .* Hz, but the scenario says `radio.centre_frequency_hz`"):
        rf.process(theirs, scenario=site)


def test_parts_of_two_sites_are_refused(tmp_path):
    other = SCENARIO.changed(transmitter=[*SCENARIO.transmitter[1:], SCENARIO.transmitter[0]])
    a = write(tmp_path / "a.h5", [("r0", 0, counts(100))], scenario=SCENARIO)
    b = write(tmp_path / "b.h5", [("r1", 0, counts(100))], scenario=other)
    c = write(tmp_path / "c.h5", [("r2", 0, counts(100))])
    with pytest.raises(RecordingError, match=r"a.h5 and b.h5 are of two sites: .* differ in `transmitter`"):
        open_recording([a, b])
    with open_recording([c, a]) as r:
        assert r.scenario == SCENARIO
    with open_recording([a, b], scenario=other) as r:
        assert r.scenario == other


def test_two_parts_that_claim_the_same_receiver_and_time(tmp_path):
    x = counts(1000)
    a = write(tmp_path / "a.h5", [("r0", 0, x)])
    b = write(tmp_path / "b.h5", [("r0", 900, counts(500, seed=1))])
    with pytest.raises(
        RecordingError, match=r"a.h5 and b.h5 both claim to be receiver `r0` in 100 samples from .*2026"
    ):
        open_recording([a, b])
    # a recorder whose files overlap says the same twice
    c = write(tmp_path / "c.h5", [("r0", 900, np.concatenate([x[900:], counts(400, seed=2)]))])
    with open_recording([a, c]) as r:
        assert r.blocks("r0").tolist() == [[START, 1400]]
        assert np.array_equal(r.read("r0", START, 1000), x)
        assert "a.h5 and c.h5 both hold 100 samples from" in describe(r)["problems"][0]


def test_a_part_that_is_missing_or_damaged_is_named_and_the_rest_goes_on(tmp_path):
    x = counts(1000)
    a = write(tmp_path / "a.h5", [("r0", 0, x)])
    b = write(tmp_path / "b.h5", [("r1", 0, x)])
    b.write_bytes(b.read_bytes()[:700])
    with open_recording([a, b, tmp_path / "c.h5"]) as r:
        assert r.receiver_ids == ("r0",)
        assert np.array_equal(r.read("r0", START, 1000), x)
        problems = describe(r)["problems"]
    assert any("left out: " in line and "b.h5: the HDF5 file is truncated" in line for line in problems)
    assert any("left out: " in line and "c.h5: no such file" in line for line in problems)
    with pytest.raises(RecordingError, match=r"none of its 2 parts can be read: left out: .*b.h5"):
        open_recording([b, tmp_path / "c.h5"])


def test_a_gap_between_parts_is_told_where_others_recorded(tmp_path):
    a = write(tmp_path / "a.h5", [("r0", 0, counts(1000)), ("r1", 0, counts(3000))])
    b = write(tmp_path / "b.h5", [("r0", 1500, counts(1500)), ("r0", 9000, counts(100)), ("r1", 9000, counts(100))])
    with open_recording([a, b]) as r:
        (problem,) = (line for line in describe(r)["problems"] if "missing between" in line)
    assert problem.startswith("r0: 500 samples (0.00015 s) are missing between a.h5 and b.h5")


def test_parts_of_other_types_are_read_as_floats(tmp_path):
    x = counts(300)
    x[7] = -(2**15)
    a = write(tmp_path / "a.h5", [("r0", 0, x)])
    z = np.random.default_rng(1).normal(size=(300, 2)).astype(np.float32)
    b = write(tmp_path / "b.h5", [("r0", 300, z)], sample_format="complex64", full_scale=np.inf)
    with open_recording([a, b]) as r:
        got = r.read("r0", START, 600)
    assert got.dtype == np.float32
    assert np.isnan(got[7]).all()
    got[7] = x[7]
    assert np.array_equal(got[:300], x)
    assert np.array_equal(got[300:], z)


def test_an_overlap_is_compared_at_both_ends(tmp_path, monkeypatch):
    monkeypatch.setattr("rfpose.recording.parts._COMPARED_SAMPLES", 16)
    x = counts(1000)
    y = x.copy()
    y[-1] += 1
    given = [write(tmp_path / "a.h5", [("r0", 0, x)]), write(tmp_path / "b.h5", [("r0", 0, y)])]
    with pytest.raises(RecordingError, match="both claim to be receiver `r0` in 1000 samples"):
        open_recording(given)


def test_parts_may_be_given_in_any_order_and_gaps_within_one_are_its_own(tmp_path):
    x = counts(900)
    a = write(tmp_path / "a.h5", [("r0", 0, x[:300]), ("r0", 400, x[300:500]), ("r1", 0, counts(3000))])
    b = write(tmp_path / "b.h5", [("r0", 600, x[500:])])
    with open_recording([b, a]) as r:
        assert r.blocks("r0").tolist() == [[START, 300], [START + 400, 600]]
        assert np.array_equal(r.read("r0", START + 400, 600), x[300:])
        assert not [line for line in describe(r)["problems"] if "missing between" in line]
    # a receiver alone has nobody to compare with: its gaps count
    c = write(tmp_path / "c.h5", [("r0", 0, x[:300])])
    d = write(tmp_path / "d.h5", [("r0", 900, x[:300])])
    with open_recording([c, d]) as r:
        assert "600 samples (0.00018 s) are missing between c.h5 and d.h5" in r.doubts["r0"][0]


def test_what_parts_say_of_themselves_is_told(tmp_path):
    silent = write(tmp_path / "a.h5", [("r0", 0, counts(100))], centre_frequency_hz=None)
    coarse = write(tmp_path / "b.h5", [("r1", 0, counts(100))], full_scale=2047)
    with open_recording([silent, coarse]) as r:
        assert r.centre_frequency_hz == 1e8
        assert r.full_scale == 32767
        assert "a.h5 does not say to what it was tuned, other parts do" in r.notes
        assert "parts have full scales from 2047 to 32767; samples that reach 32767 count as clipped" in r.notes
    floats = write(
        tmp_path / "f.h5", [("r2", 0, counts(9).astype(np.float32))], sample_format="complex64", full_scale=np.inf
    )
    with open_recording([coarse, floats]) as r:
        assert "parts have full scales from 2047 to none; no sample counts as clipped" in r.notes
    # a WAV file that was cut, and a collection that lacks a stream
    samples = struct.pack("<4h", 1, 2, 3, 4)
    form = struct.pack("<HHIIHH", 1, 2, 1000, 4000, 4, 16)
    wav = b"RIFF\0\0\0\0WAVEfmt " + struct.pack("<I", 16) + form + b"data" + struct.pack("<I", 100) + samples
    (tmp_path / "c.wav").write_bytes(wav)
    (tmp_path / "d.sigmf-data").write_bytes(samples)
    (tmp_path / "d.sigmf-meta").write_text(
        '{"global": {"core:datatype": "ci16_le", "core:sample_rate": 1000, "core:version": "1.2.0"}, "captures": '
        '[{"core:sample_start": 0, "core:datetime": "2026-09-21T14:13:20.000Z"}], "annotations": []}'
    )
    (tmp_path / "d.sigmf-collection").write_text(
        '{"collection": {"core:version": "1.2.0", "core:streams": ["d", "gone"]}}'
    )
    wav_part = '[[part]]\nfiles = "c.wav"\n'
    text = '[[part]]\nfiles = "d.sigmf-collection"\n' + wav_part
    with open_recording(manifest(tmp_path, text)) as r:
        assert r.receiver_ids == ("d",)
        assert any("c.wav: when it was recorded is not known; say so with `start`" in note for note in r.notes)
        assert any("d.sigmf-collection: `d.sigmf-collection` names `gone.sigmf-meta`" in note for note in r.notes)
    with open_recording(manifest(tmp_path, text + 'start = "2026-09-21T14:13:20.5Z"')) as r:
        assert r.blocks("c").tolist() == [[1_790_000_000_500, 2]]
        assert any("92 of its bytes are missing" in doubt and "(c.wav)" in doubt for doubt in r.doubts["c"])
    (tmp_path / "e.iq").write_bytes(samples)
    declared = 'type = "raw"\nsample_type = "ci16_le"\nsample_rate_hz = 1000\nstart = 5\noffset_s = -6'
    with pytest.raises(RecordingError, match=r"e.iq would begin before 1970; correct its offset"):
        open_recording(manifest(tmp_path, f'[[part]]\nfiles = "e.iq"\n{declared}'))


def truth_of(starts, turn=0.0, clock_ppm=1.0):
    normal = np.tile([np.sin(turn), 0.0, np.cos(turn)], (len(starts), 1, 1))
    return Truth(
        heliostat_ids=("H01",), receiver_ids=("r0",), transmitter_ids=("T1",), normal_enu=normal,
        receiver_enu_m=normal.copy(), frame_start_index=np.array(starts), clock_ppm=np.array([clock_ppm]),
    )  # fmt: skip


def test_truths_of_parts_that_follow_each_other_are_joined(tmp_path):
    def part(name, start, truth):
        with RecordingWriter(
            tmp_path / name, receiver_ids=["r0"], scenario=None, sample_rate=RATE, centre_frequency_hz=1e8,
            sample_format="int16", full_scale=32767, provenance={},
        ) as writer:  # fmt: skip
            writer.write("r0", START + start, counts(100))
            writer.write_truth(truth)
        return tmp_path / name

    a = part("a.h5", 0, truth_of([START, START + 50]))
    b = part("b.h5", 200, truth_of([START + 200], turn=0.3))
    with open_recording([b, a]) as r:
        assert r.truth.frame_start_index.tolist() == [START, START + 50, START + 200]
        assert r.truth.normal_enu[:, 0, 0] == pytest.approx([0.0, 0.0, np.sin(0.3)])
        assert r.truth.clock_ppm.tolist() == [1.0]
    for name, truth, words in (
        ("c.h5", truth_of([START + 20], turn=0.3), "they overlap in time"),
        ("d.h5", truth_of([START + 200], clock_ppm=2.0), "`clock_ppm` differ"),
    ):
        with open_recording([a, part(name, 200, truth)]) as r:
            assert r.truth is None
            assert any(f"do not fit together ({words}) and are left out" in note for note in r.notes)


def test_a_part_that_is_damaged_while_it_is_read_is_a_gap(tmp_path):
    text = ""
    for name in ("r0", "r1"):
        (tmp_path / f"{name}.iq").write_bytes(counts(100).tobytes())
        text += f'[[part]]\nfiles = "{name}.iq"\ntype = "raw"\nsample_type = "ci16_le"\nsample_rate_hz = 1000\n'
        text += f'start = 1790000000\nreceivers = ["{name}"]\n'
    with open_recording(manifest(tmp_path, text)) as r:
        os.truncate(tmp_path / "r0.iq", 100)
        for _ in range(2):
            with pytest.raises(GapError, match=r"r0\.iq: the file became shorter"):
                r.read("r0", 1_790_000_000_000, 100)
        assert np.array_equal(r.read("r1", 1_790_000_000_000, 100), counts(100))
        assert [note for note in r.notes if "r0.iq is damaged" in note] == [r.notes[-1]]


def test_more_parts_than_may_be_open(tmp_path, monkeypatch):
    monkeypatch.setattr("rfpose.recording.parts._OPEN_PARTS", 2)
    x = counts(500)
    given = [write(tmp_path / f"{k}.h5", [("r0", 100 * k, x[100 * k : 100 * k + 100])]) for k in range(5)]
    with open_recording(given) as r:
        assert np.array_equal(r.read("r0", START, 500), x)
        assert np.array_equal(r.read("r0", START + 50, 400), x[50:450])
        assert len(r._opened) == 2


# -- directories and manifests -------------------------------------------------------------------------------


def test_a_directory_of_parts(tmp_path):
    x = counts(200)
    write(tmp_path / "a.h5", [("r0", 0, x[:100])])
    write(tmp_path / "b.h5", [("r0", 100, x[100:])])
    (tmp_path / "notes.txt").write_text("x")
    (tmp_path / "broken.h5").write_bytes(b"x")
    with open_recording(tmp_path) as r:
        assert r.path == tmp_path
        assert np.array_equal(r.read("r0", START, 200), x)
        assert r.notes == []  # what is no recording is passed over
        summary = describe(r)
    assert summary["format"] == "parts"
    assert list(summary["parts"]) == ["a.h5", "b.h5"]
    assert summary["parts"]["b.h5"]["samples"] == 100
    assert summary["parts"]["b.h5"]["receivers"] == ["r0"]


def test_a_recording_in_a_directory_that_is_cut_off_or_empty_is_named(tmp_path):
    write(tmp_path / "a.h5", [("r0", 0, counts(1000))])
    cut = write(tmp_path / "b.h5", [("r1", 0, counts(1000))])
    cut.write_bytes(cut.read_bytes()[:700])
    (tmp_path / "c.h5").write_bytes(b"")
    with h5py.File(tmp_path / "foreign.h5", "w") as file:
        file["x"] = 1
    with open_recording(tmp_path) as r:
        assert r.receiver_ids == ("r0",)
        assert [note.split(":")[0] for note in r.notes] == ["left out"] * 2
        assert "b.h5: the HDF5 file is truncated" in r.notes[0]
        assert "c.h5: the file is empty" in r.notes[1]


def sigmf_file(folder, name, samples, datatype="ci16_le", centre_hz=1e8):
    (folder / f"{name}.sigmf-data").write_bytes(samples.tobytes())
    meta = {
        "global": {"core:datatype": datatype, "core:sample_rate": 1000, "core:version": "1.2.0"},
        "captures": [
            {"core:sample_start": 0, "core:datetime": "2026-09-21T14:13:20.000Z", "core:frequency": centre_hz}
        ],
        "annotations": [],
    }
    (folder / f"{name}.sigmf-meta").write_text(json.dumps(meta))


@pytest.mark.parametrize("kind", ["sigmf", "digital-rf", "parts"])
def test_the_directory_in_which_one_stands(tmp_path, monkeypatch, kind):
    x = counts(100)
    one = write(tmp_path / "one.h5", [("r0", 1_790_000_000_000 - START, x)], sample_rate=Fraction(1000))
    folder = tmp_path / "night"
    if kind == "parts":
        folder.mkdir()
        write(folder / "a.h5", [("r0", 1_790_000_000_000 - START, x)], sample_rate=Fraction(1000))
    else:
        if kind == "digital-rf":
            pytest.importorskip("digital_rf")
        convert(open_recording(one), folder, format=kind)
    monkeypatch.chdir(folder)
    two = write(tmp_path / "two.h5", [("r1", 1_790_000_000_000 - START, x)], sample_rate=Fraction(1000))
    for given, receivers in ((".", ["r0"]), ([".", two], ["r0", "r1"]), (Path("../night"), ["r0"])):
        with open_recording(given) as r:
            assert r.format == (kind if len(receivers) == 1 else "parts")
            assert list(r.receiver_ids) == receivers
            assert all(np.array_equal(r.read(name, 1_790_000_000_000, 100), x) for name in receivers)
            assert all(r.names)
            assert [name for name in describe(r).get("parts", {}) if not name.strip("./")] == []


def test_sigmf_recordings_of_other_types_in_one_directory(tmp_path):
    x = counts(100)
    sigmf_file(tmp_path, "r0", x)
    sigmf_file(tmp_path, "r1", x.astype("<f4"), datatype="cf32_le")
    sigmf_file(tmp_path, "r2", x, centre_hz=1.1e8)
    with open_recording(tmp_path) as r:
        assert r.receiver_ids == ("r0", "r1", "r2")
        for name in r.receiver_ids:
            assert np.array_equal(r.read(name, 1_790_000_000_000, 100), x)
        assert r.tuning_of("r2") == 1.1e8
    # beside others, and in a directory of its own among those that are given
    alone = write(tmp_path / "a.h5", [("r3", 0, x)], sample_rate=Fraction(1000))
    for given in (tmp_path, [tmp_path], [alone, tmp_path]):
        with open_recording(given) as r:
            assert set(r.receiver_ids) == {"r0", "r1", "r2", "r3"}


def test_a_damaged_sigmf_recording_of_a_directory_in_a_set_is_named_and_the_rest_goes_on(tmp_path):
    for name in ("r0", "r1", "r2"):
        sigmf_file(tmp_path, name, counts(100))
    (tmp_path / "r1.sigmf-meta").write_text("{")
    (tmp_path / "r2.sigmf-data").unlink()
    with pytest.raises(RecordingError, match=r"r1.sigmf-meta: not valid JSON"):  # alone it is refused
        open_recording(tmp_path)
    write(tmp_path / "a.h5", [("r3", 0, counts(100))], sample_rate=Fraction(1000))
    with open_recording(tmp_path) as r:
        assert set(r.receiver_ids) == {"r0", "r3"}
        assert [note.split(":")[0] for note in r.notes] == ["left out"] * 2
        assert "r1.sigmf-meta: not valid JSON" in r.notes[0]
        assert "missing: `r2.sigmf-data`" in r.notes[1]


def test_sigmf_recordings_beside_channels_of_digital_rf(tmp_path):
    pytest.importorskip("digital_rf")
    x = counts(100)
    one = write(tmp_path / "one.h5", [("r0", 1_790_000_000_000 - START, x)], sample_rate=Fraction(1000))
    convert(open_recording(one), tmp_path / "night", format="digital-rf")
    sigmf_file(tmp_path / "night", "r1", x)
    with open_recording(tmp_path / "night") as r:
        assert r.receiver_ids == ("r0", "r1")
        assert list(describe(r)["parts"]) == ["night/", "r1.sigmf-meta"]
        assert r.notes == []
        for name in r.receiver_ids:
            assert np.array_equal(r.read(name, 1_790_000_000_000, 100), x)


def manifest(folder, text):
    (folder / "recording.toml").write_text('format = "rfpose-recording"\n' + text)
    return folder / "recording.toml"


def test_a_manifest_names_receivers_and_offsets(tmp_path):
    x = counts(300)
    write(tmp_path / "a.h5", [("rx", 0, x)])
    write(tmp_path / "b.h5", [("rx", 0, x)])
    write(tmp_path / "c.h5", [("rx", 0, x), ("ry", 0, x)])
    (tmp_path / "site.toml").write_text(SCENARIO.to_toml())
    path = manifest(
        tmp_path,
        """scenario = "site.toml"
        [[part]]
        files = "a.h5"
        receivers = ["H01_r0"]
        [[part]]
        files = ["b*.h5", "none*.h5"]
        receivers = { rx = "H01_r1" }
        offset_s = -18
        [[part]]
        files = "c.h5"
        receivers = { ry = "H01_r2", rz = "H01_r3" }
        offset_s = 1e-3
        """,
    )
    for given in (path, tmp_path):
        with open_recording(given) as r:
            assert r.receiver_ids == ("H01_r0", "H01_r1", "H01_r2")
            assert r.scenario is not None
            assert r.blocks("H01_r0").tolist() == [[START, 300]]
            assert r.blocks("H01_r1").tolist() == [[START - 18 * 10**7 // 3, 300]]
            assert r.blocks("H01_r2").tolist() == [[START + 3333, 300]]
            assert np.array_equal(r.read("H01_r1", START - 60_000_000 + 5, 100), x[5:105])
            assert any("`none*.h5` of recording.toml is missing" in note for note in r.notes)
            assert any("c.h5 has no receiver `rz`" in note for note in r.notes)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "`part` must be one or more tables"),
        ("[[part]]\nfile = 'a.h5'", r"unknown key `file` in part\[0\]; known: files"),
        ("[[part]]\nfiles = []", r"part\[0\]: `files` must be names"),
        ("[[part]]\nfiles = 'a.h5'\noffset_s = 'soon'", "`part.0.: offset_s` must be a number"),
        ("[[part]]\nfiles = 'a.h5'\noffset_s = 1e12", "offset_s` must lie within"),
        ("[[part]]\nfiles = 'a.h5'\nstart = '2026-02-30T00:00:00Z'", r"part\[0\]: `start`: .*no time of Unix"),
        ("[[part]]\nfiles = 'a.h5'\nreceivers = ['a/b']", "`receivers` may hold letters"),
        ("[[part]]\nfiles = 'a.h5'\nreceivers = ['a', 'a']", "`receivers` names one twice"),
        ("[[part]]\nfiles = '../a.h5'", "outside the recording's folder"),
        ("scenario = '../site.toml'\n[[part]]\nfiles = 'a.h5'", "outside the recording's folder"),
        ("scenarios = 5\n[[part]]\nfiles = 'a.h5'", "unknown key `scenarios`; known: format, part, scenario"),
        ("scenario = 5\n[[part]]\nfiles = 'a.h5'", "`scenario` must be the name of a file"),
        ("[[part]]\nfiles = 'nothing.h5'", "none of its no parts can be read: `nothing.h5`"),
    ],
)
def test_manifests_that_are_wrong(tmp_path, text, words):
    inner = tmp_path / "inner"
    inner.mkdir()
    for folder in (tmp_path, inner):
        write(folder / "a.h5", [("rx", 0, counts(10))])
    (tmp_path / "site.toml").write_text(SCENARIO.to_toml())
    with pytest.raises(RecordingError, match=words) as caught:
        open_recording(manifest(inner, text))
    assert "recording.toml" in str(caught.value)


def test_paths_of_one_name_given_twice_and_within_each_other(tmp_path):
    x = counts(300)
    for k, folder in enumerate(("p", "q")):
        (tmp_path / folder).mkdir()
        write(tmp_path / folder / "a.h5", [(f"r{k}", 0, x)])
    (tmp_path / "q" / "deep").mkdir()
    (tmp_path / "q" / "deep" / "s.sigmf-data").write_bytes(x.tobytes())
    (tmp_path / "q" / "deep" / "s.sigmf-meta").write_text(
        '{"global": {"core:datatype": "ci16_le", "core:sample_rate": 3333333.3333333335, "core:version": "1.2.0"}, '
        '"captures": [{"core:sample_start": 0, "core:global_index": ' + str(START) + "}]}"
    )
    given = [tmp_path / "p" / "a.h5", tmp_path / "q"]
    with open_recording([*given, given[0]]) as r:
        assert r.receiver_ids == ("r0", "r1", "s")
        assert list(describe(r)["parts"]) == [str(given[0]), str(tmp_path / "q" / "a.h5"), "deep"]
        assert not r.doubts  # what is given twice is no overlap
    path = manifest(tmp_path / "p", "[[part]]\nfiles = 'a.h5'\nreceivers = ['A', 'B']")
    with open_recording(path) as r:
        assert r.receiver_ids == ("A",)
        assert "a.h5 has 1 receivers (r0), the manifest names 2" in r.notes
    with pytest.raises(RecordingError, match=r"recording.toml: a manifest stands for a whole recording; give it alone"):
        open_recording([path, tmp_path / "q"])
    path.write_text(path.read_text().replace("rfpose-recording", "rfpose-iq"))
    with pytest.raises(RecordingError, match="`format` must be 'rfpose-recording', got 'rfpose-iq'"):
        open_recording(path)


def test_times_in_a_manifest_are_as_written_and_not_the_nearest_binary_numbers(tmp_path):
    (tmp_path / "a.iq").write_bytes(counts(10).tobytes())
    text = '[[part]]\nfiles = "a.iq"\ntype = "raw"\nsample_type = "ci16_le"\nsample_rate_hz = 1e9\n'
    with open_recording(manifest(tmp_path, text + "start = 1790000000.1\noffset_s = -900000000.2")) as r:
        assert r.blocks("a").tolist() == [[889_999_999_900_000_000, 10]]


def test_the_command_line_takes_parts(whole, tmp_path):
    from click.testing import CliRunner

    from rfpose.cli._app import app

    path, wanted = whole
    given = [str(one) for one in cut(path, tmp_path, [["rfpose-iq", "rfpose-iq"], ["rfpose-iq"]])]

    def run(*words):
        with contextlib.suppress(SystemExit):
            found = CliRunner().invoke(app, list(words), catch_exceptions=False)
        assert found.exit_code == 0, found.output
        return found.stdout

    told = json.loads(run("info", *given, "--json", "--picture", str(tmp_path / "c.svg")))
    assert list(told["parts"]) == ["p0_0.h5", "p0_1.h5", "p1_0.h5"]
    assert told["sound"]
    drawn = (tmp_path / "c.svg").read_text()
    assert all(name in drawn for name in told["receivers"])
    assert "p1_0.h5" in run("info", *given)
    run("convert", *given, "-o", str(tmp_path / "again.h5"))
    with open_recording(path) as one, open_recording(tmp_path / "again.h5") as again:
        for name in one.receiver_ids:
            assert np.array_equal(again.blocks(name), one.blocks(name))
    run("process", *given, "-o", str(tmp_path / "r.h5"))
    found = rf.open_result(tmp_path / "r.h5")
    assert found.poses.normal_enu.tobytes() == wanted.poses.normal_enu.tobytes()
    assert found.settings["command"].startswith("rfpose process p0_0.h5 p0_1.h5 p1_0.h5 --estimator")


def test_short_bursts_are_seen_in_the_picture(tmp_path):
    """A plant's frames last milliseconds, and hours lie between the first and the last."""
    pieces = [("A", 0, counts(200)), ("A", 3600 * RATE, counts(200))]
    with open_recording(write(tmp_path / "rec.h5", pieces)) as recording:
        axes = recording.plot_coverage().axes[0]
    (bars,) = axes.collections
    width_s = [path.get_extents().width for path in bars.get_paths()]
    assert len(width_s) == 2
    assert min(width_s) > 0.003 * 3600
