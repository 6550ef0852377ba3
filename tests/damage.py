"""Files made wrong on purpose: one random thing at a time, by a seed."""

import json
import shutil
from pathlib import Path

import h5py
import numpy as np

_NUMBERS = (float("nan"), float("inf"), -1.0, 0.0, 1e300, -1e300)
_INTEGERS = (-1, 0, 1, 99, 127, -(2**62), 2**62, 2**63 - 1)
_VALUES = (
    *(None, True, "", "x", "é" * 300, -1, 0, 2**63, 10**400, 1e300, -1e300, float("nan"), float("inf")),
    *([], {}, [[]], {"a": 1}, [1, 2], "2026-02-30"),
)
_TEXTS = ("", "x", "0", "1e999999999", "1/0", "nan", "é\x07", "[" * 400, "{}", "[1]", "null", "9" * 400)


def damage_hdf5(path: Path, rng: np.random.Generator) -> str:
    """Change one dataset or attribute of an HDF5 file, and say which and how."""
    with h5py.File(path, "r+") as file:
        places: list[tuple[str, str | None]] = [("/", name) for name in file.attrs]

        def visit(name: str, item: h5py.Group | h5py.Dataset) -> None:
            places.append((name, None))
            if isinstance(item, h5py.Group):
                places.extend((name, key) for key in item.attrs)

        file.visititems(visit)
        name, key = places[rng.integers(len(places))]
        if key is not None:
            return f"{name}@{key}: {_damage_attribute(file[name].attrs, key, rng)}"
        return f"{name}: {_damage_item(file, name, rng)}"


def _damage_attribute(attrs: h5py.AttributeManager, key: str, rng: np.random.Generator) -> str:
    how = rng.integers(3)
    if how == 0:
        del attrs[key]
        return "deleted"
    value = (
        _TEXTS[rng.integers(len(_TEXTS))] if how == 1 else [5, np.bytes_(b"\xcb\xff"), np.arange(3.0)][rng.integers(3)]
    )
    attrs[key] = value
    return repr(value)[:40]


def _damage_item(file: h5py.File, name: str, rng: np.random.Generator) -> str:
    item = file[name]
    how = rng.integers(5)
    if how == 0 or isinstance(item, h5py.Group):
        del file[name]
        return "deleted"
    values = item[()]
    if how == 1:
        del file[name]
        file[name] = [5, "text", np.arange(6.0).reshape(2, 3), np.bytes_(b"\xcb\xff")][rng.integers(4)]
        return "another kind"
    if how == 2:
        del file[name]
        shape = (2**40, *np.shape(values)[1:])
        file.create_dataset(name, shape=shape, dtype=item.dtype, chunks=True) if np.ndim(values) else None
        return "larger than any memory"
    if h5py.check_string_dtype(item.dtype) is not None:
        text = _TEXTS[rng.integers(len(_TEXTS))]
        raw = np.ravel(values)[0] if np.size(values) else b""
        if how == 3 and len(raw) > 2:
            at = int(rng.integers(len(raw)))
            new = np.bytes_(raw[:at] + bytes([int(rng.integers(256))]) + raw[at + 1 :])
        else:
            new = text
        del file[name]
        file[name] = new if np.ndim(values) == 0 else [new] * len(values)
        return f"text {new!r:.40}"
    if not np.size(values):
        return "nothing to change"
    flat = np.array(values).reshape(-1)
    at = int(rng.integers(flat.size))
    one = (_NUMBERS if flat.dtype.kind in "fc" else _INTEGERS)[rng.integers(6)]
    with np.errstate(all="ignore"):
        flat[at] = np.array(one).astype(flat.dtype)
        if how == 4:
            flat[:] = flat[at]
    item[...] = flat.reshape(np.shape(values))
    return f"{one} at {at}{' and everywhere' if how == 4 else ''}"


def damage_bytes(path: Path, rng: np.random.Generator) -> str:
    """Cut a file, or flip some of its bits."""
    content = bytearray(path.read_bytes())
    if rng.integers(4) == 0:
        end = int(rng.integers(len(content)))
        path.write_bytes(content[:end])
        return f"cut at {end}"
    places = rng.integers(len(content), size=int(rng.integers(1, 6)))
    for at in places:
        content[at] ^= 1 << int(rng.integers(8))
    path.write_bytes(bytes(content))
    return f"bits at {places.tolist()}"


def damage_values(data: object, rng: np.random.Generator) -> str:
    """Change one value of nested dicts and lists in place, and say where."""
    places: list[tuple[object, object, str]] = []

    def visit(node: object, text: str) -> None:
        items = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
        for key, value in items:
            places.append((node, key, f"{text}.{key}"))
            visit(value, f"{text}.{key}")

    visit(data, "")
    node, key, text = places[rng.integers(len(places))]
    new = _VALUES[rng.integers(len(_VALUES))]
    if rng.integers(5) == 0:
        if isinstance(node, dict):
            del node[key]
            node[str(key) + "_"] = new
        return f"{text} renamed"
    node[key] = new
    return f"{text} = {new!r:.40}"


def copied(source: Path, folder: Path) -> Path:
    """Return a copy of a file to damage."""
    target = folder / f"damaged{source.suffix}"
    shutil.copy(source, target)
    return target


def as_json(data: object) -> str:
    """Return JSON, with Python's NaN and Infinity where there are some."""
    return json.dumps(data)
