"""Sound files of every format, small: what the fuzzer starts from."""

from __future__ import annotations

import json
import struct
import tarfile
import zipfile
from collections.abc import Iterable
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
from targets import SAMPLES

from rfpose.antenna import AntennaPattern
from rfpose.pipeline.calibrate import calibrate
from rfpose.pipeline.formats.antenna_file import read_pattern, write_pattern
from rfpose.pipeline.formats.antenna_text import text_of_pattern
from rfpose.pipeline.process import process
from rfpose.pipeline.samples.paint import write_paint
from rfpose.pipeline.simulate import simulate
from rfpose.pipeline.survey import survey
from rfpose.pipeline.track import track
from rfpose.recording import RecordingWriter, convert, open_recording
from rfpose.scenario import Scenario, check_scenario, load_scenario

__all__ = ["make"]

DATA = Path(__file__).resolve().parents[2] / "data"
_PLACES = ",".join(f"{what}_{axis}_m" for what in ("drone", "target") for axis in ("east", "north", "up"))
FLIGHT = f"time_utc,heliostat,axis_1,axis_2,{_PLACES}\n" + (
    "2026-06-21T08:00:00Z,A,0.1,0.3,5.0,20.5,60.0,0.0,0.0,20.0\n" * 3
)
MOTORS = "time_utc,heliostat,axis_1,axis_2\n" + "1970-01-01T00:00:00Z,H01,0.1,0.3\n" * 3
PARTS = """format = "rfpose-recording"
scenario = "site.toml"
[[part]]
files = ["a.h5", "b*.h5"]
receivers = { H01_r0 = "x", H01_r1 = "y" }
offset_s = -18
[[part]]
files = "a.raw"
type = "raw"
sample_type = "ci16_le"
sample_rate_hz = 1e6
centre_frequency_hz = 1e8
start = 2026-09-21T14:00:00Z
receivers = ["r", "s"]
[[part]]
files = "*.wav"
start = "2026-09-21T14:00:00.123Z"
offset_s = "find"
"""


def _small(name: str, **changes: Any) -> Scenario:
    data = load_scenario(DATA / name).model_dump(exclude_none=True)
    data["heliostat"] = [data["heliostat"][0] | {"pivot_sigma_m": 0.02}]
    for table, values in changes.items():
        data[table] = data.get(table, {}) | values
    return check_scenario(data)


def _chunk(name: bytes, body: bytes) -> bytes:
    return name + struct.pack("<I", len(body)) + body + b"\0" * (len(body) % 2)


def _riff(*chunks: bytes, magic: bytes = b"RIFF") -> bytes:
    body = b"WAVE" + b"".join(chunks)
    return magic + struct.pack("<I", len(body)) + body


def wavs() -> Iterable[bytes]:
    """Yield WAV files with every chunk that is known."""

    def form(bits: int, code: int = 1, n: int = 2) -> bytes:
        return _chunk(b"fmt ", struct.pack("<HHIIHH", code, n, 12000, 12000 * n * bits // 8, n * bits // 8, bits))

    auxi = struct.pack("<16H", 2026, 9, 1, 21, 14, 13, 20, 250, 2026, 9, 1, 21, 14, 13, 20, 255)
    auxi += struct.pack("<IIIIIIIII", 10**8, 10**6, 0, 10**6, 0, 0, 0, 0, 0)
    data = _chunk(b"data", SAMPLES[:96])
    kiwi = b"".join(
        _chunk(b"kiwi", struct.pack("<BBII", 1, 0, 136_800 + k, 5_000_000 * k)) + _chunk(b"data", SAMPLES[:96])
        for k in range(4)
    )
    size = struct.pack("<QQQI", 200, 96, 24, 0)
    extensible = _chunk(b"fmt ", struct.pack("<HHIIHHHHIH14x", 0xFFFE, 2, 12000, 72000, 6, 24, 22, 24, 3, 1))
    yield from (b"\0" + _riff(form(bits, code), data) for bits, code in ((8, 1), (16, 1), (24, 1), (32, 1), (32, 3)))
    yield b"\0" + _riff(form(16), _chunk(b"auxi", auxi), data)
    yield b"\1" + _riff(form(16), kiwi)
    yield b"\2" + _riff(form(16), kiwi)
    yield b"\0" + _riff(_chunk(b"ds64", size), form(16, 1, 4), b"data\xff\xff\xff\xff" + SAMPLES[:96], magic=b"RF64")
    yield b"\0" + _riff(extensible, data)


def _pmt(value: Any) -> bytes:
    """Serialise as GNU Radio does."""
    if isinstance(value, bool):
        return b"\0" if value else b"\1"
    if isinstance(value, str):
        return b"\2" + struct.pack(">H", len(value)) + value.encode()
    if isinstance(value, int):
        return b"\x0b" + struct.pack(">Q", value) if value >= 2**31 else b"\3" + struct.pack(">i", value)
    if isinstance(value, float):
        return b"\4" + struct.pack(">d", value)
    if isinstance(value, tuple):
        return b"\x0c" + struct.pack(">I", len(value)) + b"".join(map(_pmt, value))
    entries = b"".join(b"\x09\x07" + _pmt(key) + _pmt(item) for key, item in value.items())
    return entries + b"\6"


def gnuradio_headers() -> Iterable[bytes]:
    """Yield detached headers of one and of two segments, with and without what is added to them."""
    head = {"version": 0, "rx_rate": 1e6, "rx_time": (1_790_000_000, 0.25), "size": 4, "type": 1, "cplx": True}
    for n in (1, 2):
        yield b"".join(
            _pmt(head | {"strt": 171, "bytes": 2048, "rx_time": (1_790_000_000, 0.25 + k * 512e-6)})
            + _pmt({"rx_freq": 1e8})
            for k in range(n)
        )
    yield _pmt(head | {"strt": 149, "bytes": 4096}) + b"\6"


def _zip(members: dict[str, bytes]) -> bytes:
    out = BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return out.getvalue()


def _archive(members: dict[str, bytes], packing: str = "") -> bytes:
    out = BytesIO()
    with tarfile.open(fileobj=out, mode=f"w:{packing}", format=tarfile.USTAR_FORMAT) as archive:
        for name, content in members.items():
            info = tarfile.TarInfo(name)
            info.size = len(content)
            archive.addfile(info, BytesIO(content))
    return out.getvalue()


def _metas() -> list[dict[str, Any]]:
    general = {"core:datatype": "ci16_le", "core:sample_rate": 1e6, "core:version": "1.2.5", "core:num_channels": 1}
    first = {"core:sample_start": 0, "core:datetime": "2026-09-21T14:00:00.123Z", "core:frequency": 1e8}
    second = {"core:sample_start": 300, "core:datetime": "2026-09-21T14:00:01.123456789Z", "core:frequency": 1e8}
    index = {"core:sample_start": 0, "core:global_index": 1790000000000000}
    more = {"core:num_channels": 2, "core:offset": 5, "core:trailing_bytes": 8, "core:dataset": "a.sigmf-data"}
    return [
        {"global": general, "captures": [first], "annotations": []},
        {"global": general, "captures": [first, second], "annotations": []},
        {"global": general | {"core:recorder": "x"}, "captures": [index | {"core:header_bytes": 16}]},
        {"global": general | more | {"core:datatype": "cf32_be"}, "captures": [{"core:sample_start": 5}]},
    ]


def make(folder: Path) -> dict[str, list[bytes]]:
    """Return the seeds of each target; files that they need lie in ``folder``."""
    folder.mkdir(parents=True, exist_ok=True)
    site = _small(
        "table2_100m.toml",
        radio={"frame_samples": 1000},
        simulation={"frame_count": 2, "ground": {"coefficient": [-0.1, 0.05]}},
        reflection={"model": "known", "coefficient": [-0.1, 0.05]},
        motion={"filtered": True},
    )
    (folder / "site.toml").write_text(site.to_toml())
    simulate(site, seed=1).save(folder / "a.h5", force=True)
    process(folder / "a.h5", folder / "result.h5", estimator="correlator", force=True)
    day = _small(
        "tracking_100m.toml",
        tracking={
            "first_hour": 11.0,
            "last_hour": 11.1,
            "settle_s": 60.0,
            "event": [{"hour": 11.05, "what": "emergency"}],
        },
    )
    (folder / "day.toml").write_text(day.to_toml())
    track(folder / "day.toml", folder / "run.h5", methods=("radio", "open-loop"), force=True)
    found = {
        name: [(folder / f"{file}.h5").read_bytes()]
        for name, file in (("native", "a"), ("result", "result"), ("track", "run"))
    }
    survey([folder / "a.h5"], folder / "survey.h5", force=True)
    found["survey"] = [(folder / "survey.h5").read_bytes()]
    found["native"].insert(0, _short(folder, site))
    found |= _digital_rf(folder)
    found |= _antennas(folder)
    found |= _paint(folder)
    metas = [json.dumps(meta).encode() for meta in _metas()]
    pair = {"a.sigmf-meta": metas[0], "a.sigmf-data": SAMPLES[:64]}
    found |= {
        "scenario": [(folder / f"{name}.toml").read_bytes() for name in ("site", "day")]
        + [path.read_bytes() for path in DATA.glob("*.toml") if path.stat().st_size < 20_000]
        + [b'name = "x"\n[heliostats]\ncsv = "field.csv"\nunit = "ft"\npivot_height_m = 3\ncolumns = {id = "a"}\n'],
        "field": [
            b"id,east_m,north_m,up_m\nA,1.5,2,3\nB,-4,5e1,6\n",
            b"Pos-x [m],Pos-y [m],Pos-z [m]\n1,2,3\n4,5,6\n",
            b"name,east,north,up\n,ft,ft,ft\nA,1,2,3\n",
        ],
        "series": [
            b"unix_s,speed_mps\n0,1\n1,2\n3,4\n",
            b"time,speed_kmh\n2026-06-21T08:00:00Z,1\n2026-06-21T08:00:01Z,2\n",
        ],
        "postures": [
            b"id,time,azimuth_deg,elevation_deg\nH01,2026-06-21T08:00:00Z,170,30\nH01,2026-06-21T08:01:00Z,171,30\n",
            b"id,frame,normal_e,normal_n,normal_u\nH01,0,0,0.6,0.8\nH01,1,0,0,1\n",
        ],
        "wav": list(wavs()),
        "gnuradio": list(gnuradio_headers()),
        "sigmf": metas,
        "sigmf-archive": [
            *(_archive(pair, packing) for packing in ("gz", "xz", "")),
            _zip(pair),
            _archive({"x/b.sigmf-meta": metas[2], "x/b.sigmf-data": SAMPLES[:64], "x/b.sigmf-collection": b"{}"}),
        ],
        "sigmf-collection": [
            b'{"collection": {"core:version": "1.2.5", "core:streams": [{"name": "a", "hash": "00"}, "b"]}}'
        ],
        "manifest": [PARTS.encode()],
        "declared": [
            b"ci16_le|1e6|2026-09-21T14:00:00.123Z|1e8|a b",
            b"cf32_be|10000000/3|1790000000.5||",
            b"cu8|5||0|r",
        ],
        "numbers": [b"1e6", b"10000000/3", b"-.5e-3", b"2026-09-21T14:00:00.123456789Z"],
        "truth": [
            b'{"heliostats": [{"id": "H01", "normal_enu": [0, 0, 1], "receivers_enu_m": [[0,0,1],[1,0,1],[0,1,1]]}]}'
        ],
        "drone": [FLIGHT.encode()],
        "motors": [MOTORS.encode()],
        "board": [
            tomli_w.dumps(
                {
                    "centre_enu_m": [0.0, 0.0, 12.0],
                    "normal_enu": [0.0, 1.0, 0.0],
                    "mm_per_px": 2.0,
                    "spot_sigma_m": 0.002,
                }
            ).encode()
        ],
        "packet": [bytes.fromhex("01002a55a20000000000000022"), bytes(12), bytes(range(12))],
        "address": [b"mqtt://host:1883", b"opc.tcp://[::1]:4840/rfpose", b"mqtts://user:pass@host"],
        "rays": _rays(folder),
        "kinds": [b"format = 'rfpose-mount'\n", b'{"heliostats": []}', b"\x89HDF\r\n\x1a\n", b"RIFF\0\0\0\0WAVE"],
    }
    (folder / "seeds.done").touch()
    return found


def _short(folder: Path, site: Scenario) -> bytes:
    """Return a recording of few samples, most of whose bytes say what they are."""
    settings: dict[str, Any] = {
        "sample_rate": site.radio.sample_rate,
        "centre_frequency_hz": 1e8,
        "provenance": {"a": "b"},
    }
    names, samples = ["H01_r0", "H01_r1"], np.frombuffer(SAMPLES[:400], np.int16).reshape(-1, 2)
    with RecordingWriter(
        folder / "short.h5", scenario=site, receiver_ids=names, sample_format="int16", full_scale=32767, **settings
    ) as writer:
        for k, name in enumerate(names):
            writer.write(name, 1_790_000_000 * 10**6, samples)
            writer.write(name, 1_790_000_001 * 10**6 + k, samples)
    return (folder / "short.h5").read_bytes()


def _digital_rf(folder: Path) -> dict[str, list[bytes]]:
    with open_recording(folder / "a.h5") as recording:
        convert(recording, folder / "drf", format="digital-rf", overwrite=True)
    channel = next(path.parent for path in sorted((folder / "drf").glob("*/drf_properties.h5")))
    for other in sorted((folder / "drf").iterdir()):  # one channel is enough
        if other.is_dir() and other != channel:
            for path in sorted(other.rglob("*"), reverse=True):
                path.rmdir() if path.is_dir() else path.unlink()
            other.rmdir()
    metadata = sorted((channel / "metadata").rglob("metadata@*.h5"))
    return {
        "drf-properties": [(channel / "drf_properties.h5").read_bytes()],
        "drf-samples": [sorted(channel.rglob("rf@*.h5"))[0].read_bytes()],
        "drf-metadata": [metadata[0].read_bytes()] if metadata else [],
    }


def _antennas(folder: Path) -> dict[str, list[bytes]]:
    pattern = read_pattern(DATA / "antenna_front_433MHz.h5").pattern
    step = (pattern.response.shape[2] - 1) // 3
    coarse = AntennaPattern(
        frequency_hz=pattern.frequency_hz,
        receiver_mirror_m=pattern.receiver_mirror_m[:1],
        axis_mirror=pattern.axis_mirror[:1],
        response=pattern.response[:, :1, ::step, ::step],
        sigma=pattern.sigma[:, :1, ::step, ::step],
    )
    write_pattern(folder / "pattern.h5", coarse, settings={"made": "x"}, force=True)
    text = text_of_pattern(coarse, {"format": "rfpose-antenna", "version": 1, "made_by": {"by": "x"}})
    return {"antenna": [(folder / "pattern.h5").read_bytes()], "antenna-text": [text.encode()]}


def _paint(folder: Path) -> dict[str, list[bytes]]:
    paint = write_paint(folder / "paint", {"AA11": (20.0, 80.0, 1.5)}, n_record=3)
    calibrate(paint, parameters="offsets").save(folder / "model.json", force=True)
    model = (folder / "model.json").read_bytes()
    by_kind = {f"paint-{k}": [path.read_bytes()] for k, path in enumerate(sorted(paint.rglob("*.json"))[:6])}
    toml = b'format = "rfpose-mount"\nversion = 1\n[heliostat.H1]\npivot_enu_m = [1.0, 2.0, 3.0]\n'
    return by_kind | {"mounts": [b"{" + model[1:], b"[" + toml]}


def _rays(folder: Path) -> list[bytes]:
    n = 4
    table = {
        "rx": np.array([0, 0, 1, 1], np.int16), "tx": np.array([0, 1, 0, 1], np.int16),
        "a_theta": np.full(n, 0.1 + 0.1j), "a_phi": np.full(n, 0.1j), "length_m": np.full(n, 30.0),
        "theta_t": np.zeros(n, np.float32), "theta_r": np.ones(n), "phi_r": np.ones(n),
        "code": np.array(["", "R:ground", "", "D"]), "rx_names": np.array(["a", "b"]), "rx_enu_m": np.ones((2, 3)),
        "tx_enu_m": np.ones((2, 3)), "frequency_hz": np.float64(4e8),
    }  # fmt: skip
    found = []
    for save in (np.savez, np.savez_compressed):
        out = BytesIO()
        save(out, **table)
        found.append(out.getvalue())
    return found
