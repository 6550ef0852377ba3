"""Raw samples, WAV and GNU Radio's files, made byte by byte from what describes them."""

import os
import struct
from fractions import Fraction

import numpy as np
import pytest

from rfpose.errors import InvalidInputError, RecordingError
from rfpose.recording import Declared, describe, open_recording
from rfpose.recording.flat import SAMPLE_TYPES, sample_type

RATE = 192_000
START_S = 1_790_000_000  # 2026-09-21T14:13:20Z, a Monday


def values(n, n_receiver=1, seed=0):
    return np.random.default_rng(seed).integers(-100, 100, size=(n, n_receiver, 2))


def stored_as(x, name):
    """Return the bytes of numbers as a sample type, without rfpose."""
    kind = sample_type(name)
    if not name.startswith("ci24"):
        return (x + kind.zero).astype(kind.component).tobytes()
    order = "big" if name.endswith("be") else "little"
    return b"".join(int(value).to_bytes(3, order, signed=True) for value in x.ravel())


# -- raw -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SAMPLE_TYPES)
def test_raw_samples_of_every_type(tmp_path, name):
    x = values(500, 2)
    if "24" in name:  # all of the bits, which floats hold exactly
        x[:4, 0] = [[2**23 - 1, -(2**23)], [-1, 1], [256, -256], [65536, -65537]]
    (tmp_path / "x.iq").write_bytes(stored_as(x, name))
    declared = Declared(
        sample_type=name, sample_rate=Fraction(10**6, 3), start_s=Fraction(START_S) + Fraction(1, 4),
        centre_frequency_hz=1e8, receiver_ids=("a", "b"),
    )  # fmt: skip
    first = round((START_S + Fraction(1, 4)) * Fraction(10**6, 3))
    with open_recording(tmp_path / "x.iq", declared=declared) as r:
        assert (r.format, r.receiver_ids, r.centre_frequency_hz) == ("raw", ("a", "b"), 1e8)
        assert r.sample_rate == Fraction(10**6, 3)
        for k, receiver in enumerate("ab"):
            assert r.blocks(receiver).tolist() == [[first, 500]]
            assert np.array_equal(r.read(receiver, first, 407), x[:407, k])
            assert np.array_equal(r.read(receiver, first + 7, 400), x[7:407, k])


def test_raw_samples_that_are_not_declared_well(tmp_path):
    (tmp_path / "x y.iq").write_bytes(bytes(4001))
    with pytest.raises(InvalidInputError, match="`sample_type` must be given"):
        Declared(sample_rate=Fraction(1000))
    with pytest.raises(InvalidInputError, match="`sample_type` must be one of"):
        Declared(sample_type="ri16_le", sample_rate=Fraction(1000))
    declared = Declared(sample_type="ci16_le", sample_rate=Fraction(1000))
    with pytest.raises(RecordingError, match="integer number of samples of ci16_le of 1 receivers: 1 bytes are left"):
        open_recording(tmp_path / "x y.iq", declared=declared)
    (tmp_path / "x y.iq").write_bytes(bytes(4000))
    with open_recording(tmp_path / "x y.iq", declared=declared) as r:
        assert r.receiver_ids == ("x_y",)
        assert not r.time_known
        assert any("nothing says when it was recorded" in line for line in describe(r)["problems"])


def test_raw_samples_that_begin_as_another_format_does(tmp_path):
    declared = Declared(sample_type="ci16_le", sample_rate=Fraction(1000), start_s=Fraction(5))
    for head, name in ((b"RIFF\0\0\0\0WAVEfmt ", "WAV"), (b"\x89HDF\r\n\x1a\n" + bytes(8), "HDF5")):
        (tmp_path / "a.iq").write_bytes(head + bytes(4000))
        with open_recording(tmp_path / "a.iq", declared=declared) as r:
            assert r.doubts["a"] == [f"it begins as a file of {name} does, whose header is taken for samples"]


def test_a_manifest_declares_raw_samples_beside_others(tmp_path):
    x = values(400)
    for k in range(2):
        (tmp_path / f"{k}.iq").write_bytes(x[200 * k : 200 * k + 200].astype("<i2").tobytes())
    (tmp_path / "recording.toml").write_text(
        """format = "rfpose-recording"
        [[part]]
        files = "0.iq"
        type = "raw"
        sample_type = "ci16_le"
        sample_rate_hz = 1000
        start = "2026-09-21T14:13:20.000Z"
        receivers = ["r0"]
        [[part]]
        files = "1.iq"
        type = "raw"
        sample_type = "ci16_le"
        sample_rate_hz = 1000.0
        start = 2026-09-21T14:13:20.2Z
        receivers = ["r0"]
        """
    )
    with open_recording(tmp_path) as r:
        assert r.blocks("r0").tolist() == [[START_S * 1000, 400]]
        assert np.array_equal(r.read("r0", START_S * 1000, 400), x[:, 0])


# -- WAV -----------------------------------------------------------------------------------------------------


def chunk(name, body):
    return name + struct.pack("<I", len(body)) + body + bytes(len(body) % 2)


def fmt(n_channel=2, rate=RATE, bits=16, code=1):
    width = n_channel * bits // 8
    return chunk(b"fmt ", struct.pack("<HHIIHH", code, n_channel, rate, rate * width, width, bits))


def auxi(start=(2026, 9, 1, 21, 14, 13, 20, 250), stop=(2026, 9, 1, 21, 14, 13, 20, 255), centre=100_000_000):
    return chunk(b"auxi", struct.pack("<8H8H9I", *start, *stop, centre, *[0] * 8) + bytes(96))


def wav(*chunks, magic=b"RIFF", size=None):
    body = b"WAVE" + b"".join(chunks)
    return magic + struct.pack("<I", len(body) if size is None else size) + body


@pytest.mark.parametrize(
    ("code", "bits", "name"),
    [(1, 8, "cu8"), (1, 16, "ci16_le"), (1, 24, "ci24_le"), (1, 32, "ci32_le"), (3, 32, "cf32_le")],
)
@pytest.mark.parametrize("n_receiver", [1, 2])
def test_wav_of_every_type_with_auxi(tmp_path, code, bits, name, n_receiver):
    x = values(1001, n_receiver)
    path = tmp_path / "HDSDR.wav"
    path.write_bytes(wav(fmt(2 * n_receiver, bits=bits, code=code), auxi(), chunk(b"data", stored_as(x, name))))
    first = START_S * RATE + RATE // 4
    with open_recording(path) as r:
        assert (r.format, r.centre_frequency_hz, r.sample_rate) == ("wav", 1e8, RATE)
        assert r.receiver_ids == (("HDSDR",) if n_receiver == 1 else ("HDSDR_r0", "HDSDR_r1"))
        for k, receiver in enumerate(r.receiver_ids):
            assert r.blocks(receiver).tolist() == [[first, 1001]]
            assert np.array_equal(r.read(receiver, first, 1001), x[:, k])
        assert r.full_scale == (np.inf if code == 3 else 2 ** (bits - 1) - 1)
        assert not r.doubts


def test_wav_whose_times_do_not_fit_its_samples(tmp_path):
    x = values(1000).astype("<i2").tobytes()
    path = tmp_path / "a.wav"
    path.write_bytes(wav(fmt(), auxi(stop=(2026, 9, 1, 21, 14, 14, 0, 0)), chunk(b"data", x)))
    with open_recording(path) as r:
        assert "its header says that it recorded for 39.75 s, its samples last 0.00520833 s" in r.doubts["a"][0]
    path.write_bytes(wav(fmt(), auxi(start=(2026, 2, 1, 30, 0, 0, 0, 0)), chunk(b"data", x)))
    with open_recording(path) as r:
        assert r.doubts["a"][0] == "its chunk `auxi` holds no time of a calendar"
        assert not r.time_known
    declared = Declared(format="wav", start_s=Fraction(START_S), receiver_ids=("H01_r0",), centre_frequency_hz=2e8)
    with open_recording(path, declared=declared) as r:
        assert r.time_known
        assert r.centre_frequency_hz == 2e8
        assert r.blocks("H01_r0").tolist() == [[START_S * RATE, 1000]]


def test_wav_that_is_said_to_be_otherwise_than_its_header_says(tmp_path):
    path = tmp_path / "a.wav"
    path.write_bytes(wav(fmt(), auxi(), chunk(b"data", values(1000).astype("<i2").tobytes())))
    declared = Declared(
        format="wav", start_s=Fraction(START_S + 9), sample_rate=Fraction(96_000), centre_frequency_hz=2e8
    )
    with open_recording(path, declared=declared) as r:
        assert (r.sample_rate, r.centre_frequency_hz) == (96_000, 2e8)
        assert r.doubts["a"][:3] == [
            "its header says 192000 samples/s; 96000 was given, and is taken",
            "its header says that it was tuned to 100000000 Hz; 200000000 was given, and is taken",
            "its header says that it began 8.75 s earlier than was given, which is taken",
        ]
    declared = Declared(format="wav", start_s=Fraction(START_S), sample_rate=Fraction(RATE), centre_frequency_hz=1e8)
    with open_recording(path, declared=declared) as r:
        assert not r.doubts
    declared = Declared(format="wav", receiver_ids=("a", "b"))
    with pytest.raises(RecordingError, match=r"has 1 receiver, but 2 are named; name as many as it has$"):
        open_recording(path, declared=declared)
    path.write_bytes(wav(fmt(rate=0), chunk(b"data", bytes(400))))
    with pytest.raises(RecordingError, match=r"its header gives no rate: .*got 0; give it as `sample_rate=RATE`"):
        open_recording(path)
    with open_recording(path, declared=Declared(format="wav", sample_rate=Fraction(1000))) as r:
        assert r.sample_rate == 1000


def sparse(path, head, n_byte, tail=b""):
    """Write a file of samples that are zero but for the last, without their bytes on the disk."""
    with path.open("wb") as file:
        file.write(head)
        file.seek(len(head) + n_byte - 4)
        file.write(struct.pack("<hh", 5, -6) + tail)
    if os.stat(path).st_blocks * 512 > 2**24:
        pytest.skip("the file system knows no sparse files")


@pytest.mark.parametrize("way", ["rf64", "wrapped", "open", "wrapped with a chunk behind"])
def test_wav_above_four_gigabytes(tmp_path, way):
    n_byte = 2**32 + 4000
    path = tmp_path / "big.wav"
    if way == "rf64":
        ds64 = chunk(b"ds64", struct.pack("<QQQI", n_byte + 100, n_byte, n_byte // 4, 0))
        head = wav(ds64, fmt(), b"data" + struct.pack("<I", 2**32 - 1), magic=b"RF64", size=2**32 - 1)
    else:
        head = wav(fmt(), b"data" + struct.pack("<I", 0 if way == "open" else n_byte % 2**32), size=0)
    sparse(path, head, n_byte, tail=chunk(b"LIST", bytes(10)) if way.endswith("behind") else b"")
    declared = Declared(format="wav", start_s=Fraction(START_S))
    with open_recording(path, declared=declared) as r:
        ((start, count),) = r.blocks("big").tolist()
        assert count == n_byte // 4
        assert r.read("big", start + count - 2, 2).tolist() == [[0, 0], [5, -6]]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (wav(), "no chunk `fmt `"),
        (wav(fmt(1), chunk(b"data", bytes(8))), "has 1 channel; IQ needs two"),
        (wav(fmt(bits=20), chunk(b"data", bytes(12))), "samples of 20 bits"),
        (wav(fmt()), "no chunk `data`"),
        (wav(fmt(), b"auxi" + struct.pack("<I", 5000) + bytes(20)), "chunk b'auxi' at byte 36 says that it has 5000"),
        (wav(fmt(), magic=b"RF64"), "RF64 without its chunk `ds64`"),
        (wav(fmt(rate=0), chunk(b"data", bytes(8))), "must be a rate from"),
    ],
)
def test_wav_that_cannot_be_read(tmp_path, content, words):
    (tmp_path / "x.wav").write_bytes(content)
    with pytest.raises(RecordingError, match=words) as caught:
        open_recording(tmp_path / "x.wav")
    assert "x.wav" in str(caught.value)


def test_wav_with_a_chunk_of_odd_length(tmp_path):
    x = values(100).astype("<i2")
    path = tmp_path / "x.wav"
    path.write_bytes(wav(fmt(), chunk(b"note", b"abc"), auxi(), chunk(b"data", x.tobytes())))
    with open_recording(path) as r:
        ((start, count),) = r.blocks("x").tolist()
        assert np.array_equal(r.read("x", start, count), x[:, 0])


def test_wav_that_was_cut_is_read_to_its_end(tmp_path):
    x = values(1000).astype("<i2")
    (tmp_path / "x.wav").write_bytes(wav(fmt(), auxi(), chunk(b"data", x.tobytes()))[:-403])
    with open_recording(tmp_path / "x.wav") as r:
        ((start, count),) = r.blocks("x").tolist()
        assert count == 899
        assert np.array_equal(r.read("x", start, count), x[:899, 0])
        assert "403 of its bytes are missing" in r.doubts["x"][0]


# -- KiwiSDR -------------------------------------------------------------------------------------------------

KIWI = "20260921T141320Z_77500_DCF77_iq.wav"
OF_WEEK = 1 * 86400 + 14 * 3600 + 13 * 60 + 20 + 18
"""GPS second of the week at START_S: a week begins on Sunday, and GPS is 18 s ahead of UTC."""


def kiwi(path, n_buffer=60, rate=12_000, true_rate=12_000, change=None):
    """Write buffers of 512 samples with a stamp each, as kiwirecorder does."""
    x = values(512 * n_buffer)[:, 0].astype("<i2")
    parts = [fmt(rate=rate)]
    for k in range(n_buffer):
        seconds = OF_WEEK + Fraction(512 * k, true_rate)
        age, seconds = (change or (lambda _, seconds: (1, seconds)))(k, seconds)
        seconds %= 604_800
        whole = int(seconds)
        parts.append(chunk(b"kiwi", struct.pack("<BBII", age, 0, whole, int((seconds - whole) * 10**9))))
        parts.append(chunk(b"data", x[512 * k : 512 * k + 512].tobytes()))
    path.write_bytes(wav(*parts))
    return x


def test_kiwi_stamps(tmp_path):
    x = kiwi(tmp_path / KIWI)
    with open_recording(tmp_path / KIWI) as r:
        assert r.receiver_ids == ("DCF77",)
        assert r.centre_frequency_hz == 77_500
        assert r.blocks("DCF77").tolist() == [[START_S * 12_000, len(x)]]
        assert np.array_equal(r.read("DCF77", START_S * 12_000 + 100, 5000), x[100:5100])
        assert not r.doubts


def test_kiwi_over_the_end_of_the_week(tmp_path):
    name = "20260926T235941Z_77500_A_iq.wav"  # Saturday; the week ends at 23:59:42 UTC
    kiwi(tmp_path / name, change=lambda k, seconds: (1, seconds - OF_WEEK + 604_799))
    with open_recording(tmp_path / name) as r:
        assert len(r.blocks("A")) == 1
        assert not r.doubts


def test_kiwi_whose_first_stamps_are_stale_and_one_of_weeks(tmp_path):
    x = kiwi(tmp_path / KIWI, change=lambda k, s: (255 if k < 5 else 1, s))
    with open_recording(tmp_path / KIWI) as r:
        assert r.blocks("DCF77").tolist() == [[START_S * 12_000, len(x)]]
    kiwi(tmp_path / KIWI, n_buffer=4, change=lambda k, s: (1, s + k * 3 * 86_400))
    with open_recording(tmp_path / KIWI) as r:
        apart = np.diff(r.blocks("DCF77")[:, 0]) - 512
        assert apart.tolist() == [3 * 86_400 * 12_000] * 3


@pytest.mark.parametrize(
    ("true_rate", "change", "words"),
    [
        (12_001, None, "its clock runs 83.3 ppm fast"),
        (12_000, lambda k, s: (255 if k < 5 else 1, s), "5 of its 60 GNSS stamps are stale and not used"),
        (12_000, lambda k, s: (1, s if k % 2 == 0 else s - Fraction(512, 12_000)), "30 of its 60 GNSS stamps repeat"),
        (
            12_000,
            lambda k, s: (1, s - 3 if k == 20 else s),
            "time stamp of capture 20 lies 36000 samples too early, al",
        ),
        (12_000, lambda k, s: (1, s - 18), "stamps begin -18.000 s from the time in its name"),
        (12_000, lambda k, s: (255, s), "it does not say when it was recorded"),
    ],
)
def test_kiwi_stamps_that_are_stale_jump_or_drift_are_told(tmp_path, true_rate, change, words):
    x = kiwi(tmp_path / KIWI, true_rate=true_rate, change=change)
    with open_recording(tmp_path / KIWI) as r:
        ((_, count),) = r.blocks("DCF77").tolist()
        assert count == len(x)
        assert any(words in doubt for doubt in r.doubts["DCF77"])


def test_kiwi_that_lost_buffers_and_one_whose_stamps_tell_nothing(tmp_path):
    kiwi(tmp_path / KIWI, change=lambda k, s: (1, s if k < 30 else s + Fraction(512, 12_000)))
    with open_recording(tmp_path / KIWI) as r:
        assert r.blocks("DCF77")[:, 1].tolist() == [30 * 512, 30 * 512]
    rng = np.random.default_rng(0)
    kiwi(tmp_path / KIWI, change=lambda k, s: (1, s + Fraction(int(rng.integers(0, 10**6)), 10**6)))
    with pytest.raises(RecordingError, match=r"stamps scatter|samples before capture"):
        open_recording(tmp_path / KIWI)


# -- GNU Radio -----------------------------------------------------------------------------------------------


def pmt(value):
    """Serialise as GNU Radio does: big-endian, a tag first."""
    if isinstance(value, bool):
        return b"\x00" if value else b"\x01"
    if isinstance(value, str):
        return b"\x02" + struct.pack(">H", len(value)) + value.encode()
    if isinstance(value, int):
        return b"\x03" + struct.pack(">i", value) if value < 2**31 else b"\x0b" + struct.pack(">Q", value)
    if isinstance(value, float):
        return b"\x04" + struct.pack(">d", value)
    if isinstance(value, tuple):
        return b"\x0c" + struct.pack(">I", len(value)) + b"".join(map(pmt, value))
    assert isinstance(value, dict)
    return b"".join(b"\x09\x07" + pmt(key) + pmt(item) for key, item in value.items()) + b"\x06"


def gnuradio_header(n_byte, seconds, fraction=0.0, **changes):
    head = {
        "version": 0, "size": 8, "type": 5, "cplx": True, "rx_time": (seconds, fraction), "rx_rate": 1e6,
        "strt": 149, "bytes": n_byte,
    } | changes  # fmt: skip
    return pmt(head) + pmt({"rx_freq": 1e8})


def test_gnuradio_with_detached_header(tmp_path):
    x = np.random.default_rng(0).normal(size=(1000, 2)).astype("<f4")
    (tmp_path / "mirror1").write_bytes(x.tobytes())
    (tmp_path / "mirror1.hdr").write_bytes(
        gnuradio_header(400 * 8, START_S) + gnuradio_header(600 * 8, START_S, 0.0005)
    )
    for given in ("mirror1", "mirror1.hdr"):
        with open_recording(tmp_path / given) as r:
            assert (r.format, r.receiver_ids, r.centre_frequency_hz) == ("gnuradio", ("mirror1",), 1e8)
            assert r.blocks("mirror1").tolist() == [[START_S * 10**6, 400], [START_S * 10**6 + 500, 600]]
            assert np.array_equal(r.read("mirror1", START_S * 10**6 + 510, 500), x[410:910])
            assert not r.doubts
    (tmp_path / "mirror1").write_bytes(x[:900].tobytes())
    with open_recording(tmp_path) as r:
        assert r.receiver_ids == ("mirror1",)
        assert "its header counts 1000 samples, its file holds 900" in r.doubts["mirror1"][0]


FROM_GNURADIO = bytes.fromhex(
    "0907020004737472740b00000000000000ab090702000562797465730b0000000000002ee0090702000772785f7261746504412e848000000000"
    "090702000772785f74696d650c000000020b000000006ab13b80043fd0000000000000090702000463706c780009070200047479706503000000"
    "01090702000473697a650300000004090702000776657273696f6e030000000006090702000772785f66726571044197d7840000000006"
    "0907020004737472740b00000000000000bd090702000562797465730b0000000000001f40090702000772785f7261746504412e848000000000"
    "090702000772785f74696d650c000000020b000000006ab13b80043fd0000000000000090702000463706c780009070200047479706503000000"
    "01090702000473697a650300000004090702000776657273696f6e03000000000609070200046761696e04403e00000000000009070200077278"
    "5f66726571044197d7840000000006"
)
"""What File Meta Sink of GNU Radio 3.10.5.1 wrote of 5000 complex shorts: time, rate and tuning at 0, gain at 3000."""


def test_gnuradios_own_headers(tmp_path):
    x = values(5000).astype("<i2")
    first = 1_790_000_000_250_000
    (tmp_path / "m.iq").write_bytes(x.tobytes())
    (tmp_path / "m.iq.hdr").write_bytes(FROM_GNURADIO)
    with open_recording(tmp_path / "m.iq") as r:
        assert (r.sample_rate, r.centre_frequency_hz) == (10**6, 1e8)
        assert r.blocks("m").tolist() == [[first, 5000]]  # the second header repeats the first one's time
        assert np.array_equal(r.read("m", first, 5000), x[:, 0])
        assert not r.doubts
    # with segments of at most 700, a gap before 3000 and a gain at 4000, whose header is a segment late
    lasts = [700, 700, 700, 700, 200, 700, 300, 700, 300]
    said = [0.25, 0.2507, 0.2514, 0.2521, 0.2528, 0.26, 0.2607, 0.2607, 0.2614]
    headers = [gnuradio_header(4 * n, 1_790_000_000, at, size=4, type=1) for n, at in zip(lasts, said, strict=True)]
    (tmp_path / "m.iq.hdr").write_bytes(b"".join(headers))
    with open_recording(tmp_path / "m.iq") as r:
        assert r.blocks("m").tolist() == [[first, 3000], [first + 10_000, 2000]]
        assert not r.doubts


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (gnuradio_header(8000, START_S, type=6), "complex samples of type 6; rfpose reads"),
        (gnuradio_header(8000, START_S, cplx=False), "real samples of type 5"),
        (gnuradio_header(8000, START_S, size=64), "vectors of samples are not read"),
        (gnuradio_header(8000, START_S)[:80], "ends within a value at byte"),
        (gnuradio_header(8000, START_S) + gnuradio_header(0, START_S, rx_rate=2e6), "`rx_rate` is 2000000.0, it was"),
        (gnuradio_header(8000, START_S, rx_rate=0.0), "must be a rate"),
        (b"\x07\x07\x02\x00\x07version" + b"\x0c\x00\x00\x00\x01" * 5000, "nested deeper than 32"),
    ],
)
def test_gnuradio_that_cannot_be_read(tmp_path, content, words):
    (tmp_path / "x").write_bytes(bytes(8000))
    (tmp_path / "x.hdr").write_bytes(content)
    with pytest.raises(RecordingError, match=words) as caught:
        open_recording(tmp_path / "x.hdr")
    assert "x.hdr" in str(caught.value)


# -- damaged bytes -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("what", ["wav", "kiwi", "gnuradio", "manifest", "archive"])
def test_damaged_bytes_are_read_or_named(tmp_path, what):
    """Whatever byte is changed, cut or put in: the file is read, or one line names it."""
    import io
    import tarfile
    import warnings

    from rfpose.errors import RfposeError

    folder = tmp_path / "a"
    folder.mkdir()
    name = {"wav": "x.wav", "kiwi": KIWI, "gnuradio": "x.hdr", "manifest": "recording.toml", "archive": "x.sigmf"}[what]
    path = folder / name
    if what == "wav":
        path.write_bytes(wav(fmt(), auxi(), chunk(b"data", values(50).astype("<i2").tobytes())))
    elif what == "kiwi":
        kiwi(path, n_buffer=4)
    elif what == "gnuradio":
        (folder / "x").write_bytes(bytes(8000))
        path.write_bytes(gnuradio_header(4000, START_S) + gnuradio_header(4000, START_S, 0.0005))
    elif what == "manifest":
        (folder / "x.iq").write_bytes(bytes(400))
        path.write_text(
            'format = "rfpose-recording"\n[[part]]\nfiles = "*.iq"\ntype = "raw"\nsample_type = "ci16_le"\n'
            'sample_rate_hz = 1e6\nstart = "2026-09-21T14:00:00Z"\nreceivers = ["a"]\n'
        )
    else:
        pytest.importorskip("sigmf", reason="the sigmf library is not installed")
        meta = (
            b'{"global": {"core:datatype": "ci8", "core:sample_rate": 1e6, "core:version": "1.2.0"}, "captures": [], '
            b'"annotations": []}'
        )
        with tarfile.open(path, "w") as archive:
            for member, body in (("x/x.sigmf-meta", meta), ("x/x.sigmf-data", bytes(200))):
                info = tarfile.TarInfo(member)
                info.size = len(body)
                archive.addfile(info, io.BytesIO(body))
    sound = path.read_bytes()
    rng = np.random.default_rng(1)
    refused = 0
    letters = np.frombuffer(sound if what == "manifest" else bytes(range(256)), np.uint8)
    n_run = 60 if what == "archive" else 250
    for _ in range(n_run):
        content = bytearray(sound)
        how = rng.integers(4)
        at = int(rng.integers(min(len(content), 2000)))
        if how == 0:
            content = content[:at]
        elif how == 1:
            content[at:at] = rng.choice(letters, int(rng.integers(1, 9))).tobytes()
        else:
            for place in rng.integers(min(len(content), 2000), size=int(rng.integers(1, 5))):
                content[place] = int(rng.choice(letters))
        path.write_bytes(content)
        told = ""
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            try:
                with open_recording(path) as r:
                    describe(r)
                continue
            except RfposeError as error:
                told = str(error)
        refused += 1
        assert str(folder) in told
        assert len(told.encode()) < 1000
    assert 0 < refused < n_run
