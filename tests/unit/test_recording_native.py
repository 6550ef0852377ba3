"""The rfpose-iq format: what is written comes back, and nothing else does."""

import math
from fractions import Fraction
from pathlib import Path

import h5py
import numpy as np
import psutil
import pytest

from rfpose.errors import InvalidInputError, RecordingError
from rfpose.recording import GapError, RecordingWriter, count_fill, frame_starts, open_recording, recorded_runs
from rfpose.recording.writer import COMPRESSIONS
from rfpose.scenario import load_scenario
from rfpose.truth import Truth

EPOCH = 71_600_000_000_000_000
SCENARIO = load_scenario(Path(__file__).resolve().parents[2] / "data" / "table2_100m.toml")


def writer(path, **changes):
    settings = {
        "scenario": None,
        "receiver_ids": ["b", "a"],
        "sample_rate": Fraction(40_000_000),
        "centre_frequency_hz": 100e6,
        "sample_format": "int16",
        "full_scale": 32767,
        "provenance": {"operator": "somebody"},
    }
    return RecordingWriter(path, **(settings | changes))


def counts(n, seed=0):
    return np.random.default_rng(seed).integers(-32767, 32768, size=(n, 2), dtype=np.int16)


@pytest.fixture
def gappy(tmp_path):
    """Receiver b: 1000 samples, 500 lost, 2000 more; receiver a: all 3500."""
    path, x = tmp_path / "gappy.h5", counts(3500)
    with writer(path) as w:
        w.write("b", EPOCH, x[:400])
        w.write("a", EPOCH, x)
        w.write("b", EPOCH + 400, x[400:1000])
        w.write("b", EPOCH + 1500, x[1500:])
    with open_recording(path) as recording:
        yield recording, x


def test_header_comes_back(tmp_path):
    with writer(tmp_path / "r.h5", sample_rate=Fraction(10**8, 3), scenario=SCENARIO, full_scale=2047):
        pass
    with open_recording(tmp_path / "r.h5") as r:
        assert r.format == "rfpose-iq"
        assert r.receiver_ids == ("b", "a")  # as given, not sorted
        assert r.sample_rate == Fraction(10**8, 3)
        assert r.centre_frequency_hz == 100e6
        assert r.sample_format == "int16"
        assert r.full_scale == 2047
        assert r.scenario is not None
        assert r.scenario.to_toml() == SCENARIO.to_toml()
        assert r.truth is None
        assert r.provenance["operator"] == "somebody"
        assert r.provenance["created_by"].startswith("rfpose ")
        assert r.blocks("a").shape == (0, 2)


def test_what_is_unknown_stays_unknown(tmp_path):
    with writer(tmp_path / "r.h5", centre_frequency_hz=None, full_scale=math.inf, sample_format="complex64"):
        pass
    with open_recording(tmp_path / "r.h5") as r:
        assert r.centre_frequency_hz is None
        assert r.scenario is None
        assert r.full_scale == math.inf


def test_scenario_of_the_caller_wins(tmp_path):
    other = SCENARIO.model_copy(update={"name": "another"})
    with writer(tmp_path / "r.h5", scenario=SCENARIO):
        pass
    with open_recording(tmp_path / "r.h5", scenario=other) as r:
        assert r.scenario is other


def test_blocks_join_what_touches_and_keep_gaps(gappy):
    recording, _ = gappy
    assert recording.blocks("b").tolist() == [[EPOCH, 1000], [EPOCH + 1500, 2000]]
    assert recording.blocks("a").tolist() == [[EPOCH, 3500]]
    assert not recording.blocks("b").flags.writeable


@pytest.mark.parametrize(
    ("start", "count", "covered"),
    [(0, 1000, True), (999, 1, True), (999, 2, False), (1000, 1, False), (1499, 2, False), (1500, 2000, True),
     (3499, 1, True), (3500, 1, False), (-1, 2, False), (0, 3500, False)],
)  # fmt: skip
def test_covers_and_read_agree(gappy, start, count, covered):
    recording, x = gappy
    assert recording.covers("b", EPOCH + start, count) is covered
    if covered:
        assert np.array_equal(recording.read("b", EPOCH + start, count), x[start : start + count])
    else:
        with pytest.raises(GapError, match=r"gappy\.h5: receiver `b` did not record sample"):
            recording.read("b", EPOCH + start, count)


def test_gap_error_names_the_first_lost_sample(gappy):
    with pytest.raises(GapError, match=f"sample {EPOCH + 1000} of the 600 from {EPOCH + 900}"):
        gappy[0].read("b", EPOCH + 900, 600)


def test_read_fills_the_callers_buffer(gappy):
    recording, x = gappy
    buffer = np.full((150, 2), 7, np.int16)
    got = recording.read("a", EPOCH + 10, 100, out=buffer)
    assert np.shares_memory(got, buffer)
    assert np.array_equal(got, x[10:110])
    assert np.all(buffer[100:] == 7)


@pytest.mark.parametrize(
    "out",
    [np.empty((99, 2), np.int16), np.empty((100, 2), np.float32), np.empty((100, 4), np.int16)[:, ::2],
     np.empty(200, np.int16)],
)  # fmt: skip
def test_unsuitable_buffer(gappy, out):
    with pytest.raises(InvalidInputError, match="`out` must be"):
        gappy[0].read("a", EPOCH, 100, out=out)


def test_reader_arguments(gappy):
    recording, _ = gappy
    with pytest.raises(InvalidInputError, match="must be one of b, a; got 'c'"):
        recording.blocks("c")
    with pytest.raises(InvalidInputError, match="`count` must be one or more, got 0"):
        recording.read("a", EPOCH, 0)
    with pytest.raises(InvalidInputError, match="`frame_samples` must be one or more"):
        frame_starts(recording, 0)


def test_float_recording_keeps_every_bit(tmp_path):
    x = np.random.default_rng(1).normal(size=(5000, 2)).astype(np.float32)
    x[7], x[9, 0], x[11, 1] = np.nan, np.inf, np.nan
    with writer(tmp_path / "r.h5", sample_format="complex64", full_scale=1.0) as w:
        w.write("a", 12345, x)
    with open_recording(tmp_path / "r.h5") as r:
        got = r.read("a", 12345, 5000)
        assert got.dtype == np.float32
        assert got.tobytes() == x.tobytes()
        assert math.isnan(r.fill_value)
        assert count_fill(got) == 1


def test_unwritten_samples_show_the_fill_value(tmp_path):
    path = tmp_path / "r.h5"
    with writer(path) as w:
        w.write("a", 0, counts(1000))
    with h5py.File(path, "r+") as file:  # as a recorder would that only knows that time went on
        file["receivers/a/iq"].resize((1200,))
        file["receivers/a/blocks"][0] = (0, 1200, 0)
    with open_recording(path) as r:
        got = r.read("a", 0, 1200)
        assert count_fill(got) == 200
        assert np.all(got[1000:] == r.fill_value)


def test_fill_needs_both_components():
    iq = np.array([[-32768, -32768], [-32768, 0], [0, -32768], [-32767, -32767]], np.int16)
    assert count_fill(iq) == 1


def test_truth_comes_back(tmp_path):
    rng = np.random.default_rng(3)
    truth = Truth(
        heliostat_ids=("H1",),
        receiver_ids=("b", "a"),
        transmitter_ids=("T1", "Tü"),
        normal_enu=rng.normal(size=(4, 1, 3)),
        receiver_enu_m=rng.normal(size=(4, 2, 3)),
        frame_start_index=np.arange(4, dtype=np.int64) + EPOCH,
        clock_ppm=rng.normal(size=2),
        tone_snr=rng.normal(size=(4, 2, 2, 1)),
    )
    with writer(tmp_path / "r.h5") as w:
        w.write_truth(truth)
    with open_recording(tmp_path / "r.h5") as r:
        got = r.truth
    assert got is not None
    assert (got.heliostat_ids, got.receiver_ids, got.transmitter_ids) == (("H1",), ("b", "a"), ("T1", "Tü"))
    for name in ("normal_enu", "receiver_enu_m", "frame_start_index", "clock_ppm", "tone_snr"):
        assert np.array_equal(getattr(got, name), getattr(truth, name)), name
    assert got.transmitter_phase_rad is None
    assert got.receiver_delay_s is None


def test_equal_input_gives_equal_bytes(tmp_path):
    def make(path):
        with writer(path, scenario=SCENARIO) as w:
            w.write("a", EPOCH, counts(300_000))
            w.write("b", EPOCH, counts(10, seed=1))
        return path.read_bytes()

    assert make(tmp_path / "one.h5") == make(tmp_path / "two.h5")


def test_a_frame_is_a_whole_number_of_chunks(tmp_path):
    with writer(tmp_path / "r.h5", scenario=SCENARIO):
        pass
    with h5py.File(tmp_path / "r.h5") as file:
        (chunk,) = file["receivers/a/iq"].chunks
    assert SCENARIO.radio.frame_samples % chunk == 0
    assert 2**19 <= 4 * chunk <= 2**20


# -- frames --------------------------------------------------------------------------------------------------


def test_frames_start_where_any_receiver_starts(tmp_path):
    path = tmp_path / "r.h5"
    with writer(path) as w:
        w.write("a", 1000, counts(250))  # 1000 … 1250
        w.write("a", 2000, counts(99))  # too short
        w.write("a", 5000, counts(100))
        w.write("b", 1100, counts(250))  # 1100 … 1350: lengthens the first stretch
        w.write("b", 5050, counts(200))  # 5050 … 5250
    with open_recording(path) as r:
        assert recorded_runs(r).tolist() == [[1000, 350], [2000, 99], [5000, 250]]
        assert frame_starts(r, 100).tolist() == [1000, 1100, 1200, 5000, 5100]
        assert frame_starts(r, 1000).tolist() == []
        assert frame_starts(r, 100).dtype == np.int64


@pytest.mark.parametrize(
    ("starts", "count", "grid"),
    [
        ((0, 3, 5), 1050, [5 + 100 * k for k in range(10)]),  # the overlap of all three
        ((0, 3, 3), 100, [3]),  # bursts of one frame: no overlap holds it; where most of them lie
        ((0, 40, 0), 1000, [100 * k for k in range(10)]),  # one that is late costs the others no frame
    ],
)
def test_frames_are_laid_where_receivers_that_start_apart_have_most(tmp_path, starts, count, grid):
    path, names = tmp_path / "r.h5", ["a", "b", "c"]
    with writer(path, receiver_ids=names) as w:
        for name, start in zip(names, starts, strict=True):
            w.write(name, EPOCH + start, counts(count))
    with open_recording(path) as r:
        assert (frame_starts(r, 100) - EPOCH).tolist() == grid


def test_a_receiver_has_its_own_frame_at_most_a_quarter_beside_the_common_one(tmp_path):
    with writer(tmp_path / "r.h5") as w:
        w.write("a", EPOCH, counts(100))
        w.write("b", EPOCH + 7, counts(120))
    with open_recording(tmp_path / "r.h5") as r:
        assert r.frame_at("a", EPOCH, 100) == EPOCH
        assert r.frame_at("a", EPOCH + 25, 100) == EPOCH
        assert r.frame_at("a", EPOCH + 26, 100) is None
        assert r.frame_at("b", EPOCH, 100) == EPOCH + 7
        assert r.frame_at("b", EPOCH + 10, 100) == EPOCH + 10
        assert r.frame_at("b", EPOCH + 30, 100) == EPOCH + 27
        assert r.frame_at("b", EPOCH, 121) is None


def test_what_is_left_of_a_stretch_is_logged(gappy, caplog):
    with caplog.at_level("INFO", logger="rfpose.recording.base"):
        assert len(frame_starts(gappy[0], 1000)) == 3
    assert "500 samples at the ends of 1 of 1 stretches" in caplog.text


def test_recording_without_samples_has_no_frames(tmp_path):
    with writer(tmp_path / "r.h5"):
        pass
    with open_recording(tmp_path / "r.h5") as r:
        assert frame_starts(r, 10).shape == (0,)


# -- the writer's own checks ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"receiver_ids": []}, "at least one receiver"),
        ({"receiver_ids": ["a", "a"]}, "none twice"),
        ({"receiver_ids": ["a/b"]}, "letters, digits"),
        ({"receiver_ids": [".."]}, "letters, digits"),
        ({"sample_rate": Fraction(0)}, "`sample_rate` must be greater than zero"),
        ({"sample_format": "int8"}, "must be int16 or complex64"),
        ({"full_scale": math.nan}, "`full_scale` must be greater than zero"),
    ],
)
def test_writer_arguments(tmp_path, changes, words):
    with pytest.raises(InvalidInputError, match=words):
        writer(tmp_path / "r.h5", **changes)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda w: w.write("a", 99, counts(1)), "must not go back: `a` is written up to 100, got 99"),
        (lambda w: w.write("b", -1, counts(1)), "must not go back"),
        (lambda w: w.write("c", 200, counts(1)), "must be one of b, a; got 'c'"),
        (lambda w: w.write("a", 200, counts(1).astype(np.int32)), "must be int16 of shape"),
        (lambda w: w.write("a", 200, counts(1).reshape(2)), "must be int16 of shape"),
    ],
)
def test_bad_write_leaves_nothing_behind(tmp_path, call, words):
    def write():
        with writer(tmp_path / "r.h5") as w:
            w.write("a", 0, counts(100))
            call(w)

    with pytest.raises(InvalidInputError, match=words):
        write()
    assert list(tmp_path.iterdir()) == []


def test_writer_outside_with(tmp_path):
    with pytest.raises(InvalidInputError, match="use it in a `with` statement"):
        writer(tmp_path / "r.h5").write("a", 0, counts(1))


def test_existing_file_is_refused_without_overwrite(tmp_path):
    path = tmp_path / "r.h5"
    path.write_text("mine")
    with pytest.raises(RecordingError, match=r"exists already.*`force=True`"):
        writer(path)
    assert path.read_text() == "mine"
    with writer(path, overwrite=True) as w:
        w.write("a", 0, counts(5))
    with open_recording(path) as r:
        assert r.covers("a", 0, 5)


def test_file_that_appears_meanwhile_is_kept(tmp_path):
    path = tmp_path / "r.h5"
    with pytest.raises(RecordingError, match="exists already"), writer(path):
        path.write_text("somebody else's")
    assert [p.name for p in tmp_path.iterdir()] == ["r.h5"]
    assert path.read_text() == "somebody else's"


def test_exception_keeps_the_old_file(tmp_path):
    path = tmp_path / "r.h5"
    path.write_text("old")

    def write():
        with writer(path, overwrite=True) as w:
            w.write("a", 0, counts(1000))
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        write()
    assert [p.name for p in tmp_path.iterdir()] == ["r.h5"]
    assert path.read_text() == "old"


def test_memory_stays_small_on_a_recording_of_many_gigabytes(tmp_path):
    path, n, take = tmp_path / "r.h5", 4 * 10**9, 400_000
    with writer(path, receiver_ids=["a"]) as w:
        w.write("a", EPOCH, counts(10))
    with h5py.File(path, "r+") as file:  # 16 GB, of which 16 MB take room; a file may not be hollower than that
        iq = file["receivers/a/iq"]
        iq.resize((n,))
        for k in range(16):
            iq[n // 16 * k + n // 32] = iq[0]
        file["receivers/a/blocks"][0] = (EPOCH, n, 0)
    process = psutil.Process()
    with open_recording(path) as r:
        starts = frame_starts(r, take)
        assert len(starts) == n // take
        buffer = np.empty((take, 2), np.int16)
        r.read("a", EPOCH, take, out=buffer)
        before = process.memory_info().rss
        for start in starts[:: len(starts) // 100]:
            r.read("a", int(start), take, out=buffer)
        r.read("a", int(starts[-2]), take, out=buffer)
        assert np.all(buffer == r.fill_value)
        assert process.memory_info().rss - before < 50e6


@pytest.mark.parametrize("compress", COMPRESSIONS)
def test_compressed_reads_the_same(tmp_path, compress):
    pytest.importorskip("hdf5plugin", reason="the hdf5plugin library is not installed")
    x = (np.random.default_rng(0).normal(size=(400_000, 2)) * 20).astype(np.int16)
    sizes = {}
    for name, how in (("plain", None), ("small", compress), ("again", compress)):
        with RecordingWriter(
            tmp_path / name, scenario=None, receiver_ids=["a"], sample_rate=Fraction(10**6), centre_frequency_hz=1e8,
            sample_format="int16", full_scale=32767, provenance={}, compress=how,
        ) as writer:  # fmt: skip
            writer.write("a", 1000, x[:250_000])
            writer.write("a", 300_000, x[250_000:])
        sizes[name] = (tmp_path / name).stat().st_size
    with open_recording(tmp_path / "small") as r:
        assert r.blocks("a").tolist() == [[1000, 250_000], [300_000, 150_000]]
        assert np.array_equal(r.read("a", 1000, 250_000), x[:250_000])
        assert np.array_equal(r.read("a", 300_123, 100_000), x[250_123:350_123])
    assert sizes["small"] < 0.6 * sizes["plain"]
    assert (tmp_path / "small").read_bytes() == (tmp_path / "again").read_bytes()


def test_compression_that_is_not_known(tmp_path):
    with pytest.raises(InvalidInputError, match="`compress` must be one of bitshuffle-zstd"):
        RecordingWriter(
            tmp_path / "x.h5", scenario=None, receiver_ids=["a"], sample_rate=Fraction(1), centre_frequency_hz=None,
            sample_format="int16", full_scale=1, provenance={}, compress="zip",
        )  # fmt: skip
