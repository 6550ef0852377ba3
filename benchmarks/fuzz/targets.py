"""What is fuzzed: each reader of what somebody else wrote, given bytes as a file or a text of its kind.

A target loads its reader when it is set up: the fuzzer watches every module that is loaded, which takes time.
"""

from __future__ import annotations

import contextlib
import json
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from io import BytesIO
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from rfpose.errors import RfposeError

__all__ = ["HDF5", "Field", "targets"]

START_S = 1_782_028_800.0
SAMPLES = np.random.default_rng(1).integers(-9000, 9000, 2048, np.int16).tobytes()
_KIWI = ("a.wav", "20260901T140000Z_10000000_SITE_iq.wav", "20261399T990000Z_1_iq.wav", "é.wav")
HDF5 = ("native", "result", "track", "survey", "antenna", "drf-properties", "drf-samples", "drf-metadata")
"""Targets whose file is HDF5: its values are changed, too, which bytes alone seldom reach."""


@dataclass(frozen=True, slots=True)
class Field:
    """Where files are put, and what lies beside them."""

    folder: Path
    sound: Path

    def file(self, name: str, content: bytes) -> Path:
        """Write a file and return its path."""
        path = self.folder / name
        path.write_bytes(content)
        return path

    def beside(self, name: str, source: str | None = None) -> None:
        """Put a copy of a sound file there."""
        (self.folder / name).write_bytes((self.sound / (source or name)).read_bytes())


def _read_all(path: Any, **how: Any) -> None:
    from rfpose.recording import describe, open_recording

    with open_recording(path, **how) as recording:
        json.dumps(describe(recording), allow_nan=False)
        for name in recording.receiver_ids:
            with contextlib.suppress(RfposeError):  # `describe` has told
                for start, count in recording.blocks(name)[:8].tolist():
                    recording.read(name, start, min(count, 4096))


def _told(path: Path) -> None:
    from rfpose.pipeline.inspect import inspect_file

    json.dumps(inspect_file(path), allow_nan=False)


def _wav(field: Field) -> Callable[[bytes], None]:
    def run(data: bytes) -> None:
        _read_all(field.file(_KIWI[data[0] % len(_KIWI)] if data else _KIWI[0], data[1:]))

    return run


def _sigmf(field: Field) -> Callable[[bytes], None]:
    field.file("a.sigmf-data", SAMPLES)
    return lambda data: _read_all(field.file("a.sigmf-meta", data))


def _packing(data: bytes) -> str:
    """Return the ending of an archive that begins so."""
    return {b"\x1f\x8b": ".gz", b"\xfd7": ".xz", b"PK": ".zip"}.get(data[:2], "")


def _collection(field: Field) -> Callable[[bytes], None]:
    field.file("a.sigmf-data", SAMPLES)
    field.file(
        "a.sigmf-meta", b'{"global": {"core:datatype": "ci16_le", "core:sample_rate": 1e6, "core:version": "1"}}'
    )
    return lambda data: _read_all(field.file("a.sigmf-collection", data))


def _gnuradio(field: Field) -> Callable[[bytes], None]:
    field.file("a.bin", SAMPLES)
    return lambda data: _read_all(field.file("a.bin.hdr", data))


def _manifest(field: Field) -> Callable[[bytes], None]:
    field.beside("site.toml")
    field.file("a.raw", SAMPLES)
    field.file("b.wav", SAMPLES)
    field.beside("a.h5")
    return lambda data: _read_all(field.file("recording.toml", data))


def _declared(field: Field) -> Callable[[bytes], None]:
    from rfpose.foreign import exact_number, exact_rate
    from rfpose.recording import Declared
    from rfpose.recording.declared import seconds_of

    path = field.file("a.raw", SAMPLES)

    def run(data: bytes) -> None:
        kind, rate, start, centre, names = (data.decode("utf-8", "replace").split("|") + [""] * 5)[:5]
        declared = Declared(
            sample_type=kind or None,
            sample_rate=exact_rate("rate", exact_number("rate", rate)) if rate else None,
            start_s=seconds_of(start, "`start`") if start else None,
            centre_frequency_hz=float(exact_number("centre", centre)) if centre else None,
            receiver_ids=tuple(names.split()),
        )
        _read_all(path, declared=declared)

    return run


def _numbers(_: Field) -> Callable[[bytes], None]:
    from rfpose.foreign import exact_number, exact_rate
    from rfpose.recording.declared import seconds_of

    def run(data: bytes) -> None:
        text = data.decode("utf-8", "replace")
        for read in (exact_number, exact_rate, lambda name, text: seconds_of(text, name)):
            with contextlib.suppress(RfposeError):
                read("x", text)

    return run


def _drf(name: str) -> Callable[[Field], Callable[[bytes], None]]:
    def made(field: Field) -> Callable[[bytes], None]:
        shutil.copytree(field.sound / "drf", field.folder / "drf")
        pattern = {"properties": "*/drf_properties.h5", "samples": "*/*/rf@*.h5", "metadata": "*/metadata/*/metadata@*"}
        path = sorted((field.folder / "drf").glob(pattern[name]))[0]

        def run(data: bytes) -> None:
            path.write_bytes(data)
            _read_all(field.folder / "drf")

        return run

    return made


def _paint(k: int) -> Callable[[Field], Callable[[bytes], None]]:
    def made(field: Field) -> Callable[[bytes], None]:
        from rfpose.feedback.paint import read_heliostat

        shutil.copytree(field.sound / "paint", field.folder / "paint")
        path = sorted((field.folder / "paint").rglob("*.json"))[k]

        def run(data: bytes) -> None:
            path.write_bytes(data)
            read_heliostat(field.folder / "paint", "AA11", algorithm="any")

        return run

    return made


def _scenario(field: Field) -> Callable[[bytes], None]:
    from rfpose.scenario import load_scenario

    field.file("field.csv", b"id,east_m,north_m,up_m\nA,1.5,2,3\nB,-4,5e1,6\n")

    def run(data: bytes) -> None:
        path = field.file("site.toml", data)
        load_scenario(path).to_toml()
        _told(path)

    return run


def _field_table(field: Field) -> Callable[[bytes], None]:
    from rfpose.scenario import read_positions
    from rfpose.scenario.positions import PositionForm

    forms = (None, PositionForm(pivot_height_m=3.0), PositionForm(unit="ft"))

    def run(data: bytes) -> None:
        read_positions(field.file("field.csv", data), forms[len(data) % 3])

    return run


def _mounts(field: Field) -> Callable[[bytes], None]:
    def run(data: bytes) -> None:
        _told(field.file("m.toml", data[1:]) if data[:1] == b"[" else field.file("m.json", b"{" + data[1:]))

    return run


def _truth(field: Field) -> Callable[[bytes], None]:
    from rfpose.pipeline.evaluate import read_truth
    from rfpose.scenario import load_scenario

    site = load_scenario(field.sound / "site.toml")
    return lambda data: void(read_truth(field.file("t.json", data), site))


def _motors(field: Field) -> Callable[[bytes], None]:
    from rfpose.pipeline.calibration_sources import read_radio
    from rfpose.pipeline.formats.result_file import open_result

    result = open_result(field.sound / "result.h5")
    return lambda data: void(read_radio([result], field.file("motors.csv", data)))


def _packet(_: Field) -> Callable[[bytes], None]:
    from rfpose.feedback.fieldcontrol import packets

    def run(data: bytes) -> None:
        raw = np.frombuffer(data, np.uint8)
        packets.examine(raw)
        packets.examine(raw[: len(raw) // 12 * 12].reshape(-1, 12))
        body = data[:11]
        for row in (data, body + bytes([sum(body) % 256])):  # a checksum that fits, which chance seldom finds
            with contextlib.suppress(RfposeError):
                found = packets.decode(row)
                assert packets.encode(found) == row
                packets.sun_from_payload(found.payload)
                packets.step_counts_from_payload(found.payload)
                packets.offset_from_payload(found.payload)

    return run


def _address(_: Field) -> Callable[[bytes], None]:
    from rfpose.pipeline.publish.address import address_of

    def run(data: bytes) -> None:
        text = data.decode("utf-8", "replace")
        for schemes in (("mqtt", "mqtts"), ("opc.tcp",)):
            with contextlib.suppress(RfposeError):
                parts = address_of(text, schemes, "x")
                assert parts.hostname
                assert parts.port is None or 0 < parts.port < 65536

    return run


def _kinds(field: Field) -> Callable[[bytes], None]:
    from rfpose.kinds import kind_of

    def run(data: bytes) -> None:
        for name in ("a.h5", "a.toml", "a"):
            kind_of(field.file(name, data))
        _told(field.folder / "a")

    return run


def void(_: object) -> None:
    """Return nothing."""


def _of(name: str, module: str, *calls: str) -> Callable[[Field], Callable[[bytes], None]]:
    """Return a target that gives a file to functions of a module, and what it is to `rfpose info`."""

    def made(field: Field) -> Callable[[bytes], None]:
        home = import_module(f"rfpose.{module}")
        readers = [getattr(home, call) for call in calls]

        def run(data: bytes) -> None:
            path = field.file(name, data)
            for read in readers:
                read(path)
            if path.suffix == ".h5":
                _told(path)

        return run

    return made


def _series(field: Field) -> Callable[[bytes], None]:
    from rfpose.feedback.series import Quantity, read_series_csv

    wind = Quantity(name="speed", units={"mps": 1.0, "kmh": 1 / 3.6}, unit="m/s", most=100.0, beyond="any wind")
    return lambda data: void(read_series_csv(field.file("s.csv", data), wind, interval_s=1.0, longest_gap_s=10.0))


def _postures(field: Field) -> Callable[[bytes], None]:
    from rfpose.pipeline.postures import read_postures

    times = [START_S, START_S + 30.0, np.nan]
    return lambda data: void(read_postures(field.file("p.csv", data), ["H01"], times))


def _drone(field: Field) -> Callable[[bytes], None]:
    from rfpose.feedback.mount import Mount
    from rfpose.pipeline.calibration_sources import read_drone

    mounts = {"A": Mount(pivot_enu_m=np.array([0.0, 80.0, 3.0]))}
    return lambda data: void(read_drone(field.file("d.csv", data), mounts))


def targets() -> Mapping[str, Callable[[Field], Callable[[bytes], None]]]:
    """Return how each target is set up, by name; what that returns is called with bytes."""
    return {
        "native": lambda field: lambda data: _read_all(field.file("a.h5", data)),
        "sigmf-archive": lambda field: lambda data: _read_all(field.file(f"a.sigmf{_packing(data)}", data)),
        "result": _of("r.h5", "pipeline.formats.result_file", "open_result"),
        "track": _of("t.h5", "pipeline.formats.track_file", "open_track"),
        "survey": _of("s.h5", "pipeline.formats.survey_file", "read_survey"),
        "antenna": _of("p.h5", "pipeline.formats.antenna_file", "read_pattern"),
        "antenna-text": _of("p.toml", "pipeline.formats.antenna_file", "read_pattern"),
        "board": _of("board.toml", "pipeline.calibration_sources", "_board"),
        "rays": _of("rays.npz", "simulator._tables", "read_table"),
        "series": _series,
        "postures": _postures,
        "drone": _drone,
        "wav": _wav,
        "sigmf": _sigmf,
        "sigmf-collection": _collection,
        "gnuradio": _gnuradio,
        "manifest": _manifest,
        "declared": _declared,
        "numbers": _numbers,
        **{f"drf-{name}": _drf(name) for name in ("properties", "samples", "metadata")},
        **{f"paint-{k}": _paint(k) for k in range(6)},
        "scenario": _scenario,
        "field": _field_table,
        "mounts": _mounts,
        "truth": _truth,
        "motors": _motors,
        "packet": _packet,
        "address": _address,
        "kinds": _kinds,
    }


# -- HDF5 by its values --------------------------------------------------------------------------------------

_TEXTS = ("", "x", "0", "1e999999999", "1/0", "nan", "é\x07", "{}", "[1]", "null", "9" * 400, "int16", "\ud800")
_NUMBERS = (np.nan, np.inf, -np.inf, -1.0, 0.0, 1e300, -1e300, 1e-300, 2.0**31, 2.0**53, 2.0**63, 0.5)
_INTEGERS = (-1, 0, 1, 2, 127, 255, -(2**62), 2**62, 2**63 - 1, -(2**63))
_MOST_VALUES = 2**24


def edited(sound: bytes, choose: Any) -> bytes:
    """Return an HDF5 file with one to three values changed, as ``choose`` (atheris' FuzzedDataProvider) says."""
    image = BytesIO(sound)
    with h5py.File(image, "r+") as file, np.errstate(all="ignore"):
        for _ in range(choose.ConsumeIntInRange(1, 3)):
            places = _places(file)
            if not places:
                break
            name, key = places[choose.ConsumeIntInRange(0, len(places) - 1)]
            with contextlib.suppress(ValueError, TypeError, OverflowError, OSError, KeyError, UnicodeEncodeError):
                if key is not None:
                    _edit_attribute(file[name].attrs, key, choose)
                elif isinstance(file[name], h5py.Dataset):
                    _edit_dataset(file, name, choose)
                else:
                    del file[name]
    return image.getvalue()


def _places(file: h5py.File) -> list[tuple[str, str | None]]:
    """Return everything that a file holds: items, and attributes of items."""
    places: list[tuple[str, str | None]] = [("/", key) for key in file.attrs]
    file.visititems(lambda name, item: places.extend([(name, None), *((name, key) for key in item.attrs)]))
    return places


def _edit_attribute(attrs: h5py.AttributeManager, key: str, choose: Any) -> None:
    how = choose.ConsumeIntInRange(0, 5)
    if how == 0:
        del attrs[key]
    elif how == 1:
        attrs[key] = choose.PickValueInList(list(_TEXTS))
    elif how == 2:
        attrs[key] = choose.PickValueInList(list(_INTEGERS))
    elif how == 3:
        attrs[key] = choose.PickValueInList(list(_NUMBERS))
    elif how == 4:
        attrs[key] = np.bytes_(choose.ConsumeBytes(8))
    else:
        attrs[key] = np.arange(float(choose.ConsumeIntInRange(0, 4)))


def _edit_dataset(file: h5py.File, name: str, choose: Any) -> None:
    item, how = file[name], choose.ConsumeIntInRange(0, 7)
    if how == 0:
        del file[name]
        return
    if how == 1:
        del file[name]
        file[name] = choose.PickValueInList([5, "text", 0.5, b"\xcb\xff", True])
        return
    if how == 2:
        kind, shape = item.dtype, [choose.PickValueInList([0, 1, 2, n, n + 1, 2**40]) for n in item.shape]
        del file[name]
        file.create_dataset(name, shape=shape, dtype=kind, chunks=True if shape and all(shape) else None)
        return
    if item.size > _MOST_VALUES:  # made so by a change before this one
        return
    values = item[()]
    if h5py.check_string_dtype(item.dtype) is not None:
        text = bytearray(np.ravel(values)[0] if np.size(values) else b"")
        if how < 5 or not text:
            new: Any = choose.PickValueInList(list(_TEXTS))
        else:
            at = choose.ConsumeIntInRange(0, len(text) - 1)
            text[at : at + choose.ConsumeIntInRange(0, 8)] = choose.ConsumeBytes(choose.ConsumeIntInRange(0, 8))
            new = np.bytes_(bytes(text))
        del file[name]
        file[name] = new if np.ndim(values) == 0 else [new] * len(values)
        return
    if how == 3:
        kind = choose.PickValueInList(["<i1", ">i4", "<u8", "<f4", ">f8", "<c8"])
        del file[name]
        file[name] = (values if kind == "<c8" else np.real(values)).astype(kind)
        return
    flat = np.array(values).reshape(-1)
    at = choose.ConsumeIntInRange(0, max(flat.size - 1, 0))
    one = choose.PickValueInList(list(_INTEGERS if flat.dtype.kind in "iub" else _NUMBERS))
    with np.errstate(all="ignore"):
        flat[at if how < 6 else slice(at, None)] = np.array(one).astype(flat.dtype)
    item[...] = flat.reshape(np.shape(values))


def by_values(sound: bytes, read: Callable[[bytes], None], provider: Any) -> Callable[[bytes], None]:
    """Return what reads a sound file of which the fuzzer's bytes change values."""
    return lambda data: read(edited(sound, provider(data)))
