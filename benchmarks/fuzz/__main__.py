"""Coverage-guided fuzzing of every reader; see docs/fuzzing.md. Run it as `scripts/fuzz`."""

from __future__ import annotations

import argparse
import atexit
import contextlib
import hashlib
import logging
import pickle
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).resolve().parent
BUILD = HERE.parents[1] / "build" / "fuzz"
SLOW_S, RSS_MB, ADDRESS_SPACE = 60, 3000, 2**34

WATCHED = tuple(
    f"rfpose.{name}"
    for name in (
        "recording", "scenario", "foreign", "kinds", "paint", "truth", "checks", "tables", "geometry", "sun", "antenna",
        "feedback.paint", "feedback.series", "feedback.mount", "feedback.drone", "feedback.measurements",
        "feedback.fieldcontrol.packets", "pipeline.formats", "pipeline.calibration_sources", "pipeline.evaluate",
        "pipeline.postures", "pipeline.inspect", "pipeline.publish.address", "simulator._tables",
    )
)  # fmt: skip
"""Modules that read."""


def main() -> None:
    """Fuzz, fuzz one target in this process, or read one input again."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("targets", nargs="*", help="which; none: all, in turn")
    parser.add_argument("--seconds", type=float, default=30.0, help="for each target in each turn")
    parser.add_argument("--turns", type=int, default=1, help="how often each target has its turn; 0: until stopped")
    parser.add_argument("--again", type=Path, help="read one input again and show what is raised")
    parser.add_argument("--one", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    sys.path.insert(0, str(HERE))
    sys.path.insert(0, str(BUILD / "lib"))
    if given.one:
        _fuzz(given.targets[0], given.seconds)
    elif given.again is not None:
        _show(given.targets[0], given.again.read_bytes())
    else:
        _turns(given.targets, given.seconds, given.turns)


# -- turns ---------------------------------------------------------------------------------------------------


def _turns(names: list[str], seconds: float, turns: int) -> None:
    found = _seeds()
    known = [name for name in found if found[name]]
    known += [f"{name}-values" for name in _hdf5() if name in known]
    names = names or known
    done = 0
    while not turns or done < turns:
        for name in names:
            _one(name, seconds)
        done += 1
        print(report(), flush=True)


def _one(name: str, seconds: float) -> None:
    """Fuzz one target in a process of its own, which may die; what it prints is kept."""
    work = BUILD / "work" / name
    work.mkdir(parents=True, exist_ok=True)
    began = time.monotonic()
    with (work / "log").open("w") as log:
        command = [sys.executable, str(HERE), name, "--one", "--seconds", str(seconds)]
        done = subprocess.run(command, check=False, stdout=log, stderr=log)
    if done.returncode:
        print(f"{name}: ended with {done.returncode} after {time.monotonic() - began:.0f} s; see {work / 'log'}")


def report() -> str:
    """Return the table of what was run and what was found."""
    rows = []
    total = 0
    for path in sorted(BUILD.glob("work/*/count")):
        n, crash = int(np.fromfile(path, np.int64)[0]), sorted(path.parent.glob("found-*.txt"))
        rows.append(f"{path.parent.name:22} {n:>12,} {len(crash):>4}")
        total += n
    return "\n".join([f"{'target':22} {'executions':>12} {'found':>4}", *rows, f"{'all':22} {total:>12,}"])


def _hdf5() -> tuple[str, ...]:
    import targets

    return targets.HDF5


def _seeds() -> dict[str, list[bytes]]:
    kept = BUILD / "seeds.pickle"
    if not kept.is_file():
        import seeds

        (BUILD / "sound").mkdir(parents=True, exist_ok=True)
        kept.write_bytes(pickle.dumps(seeds.make(BUILD / "sound")))
    found: dict[str, list[bytes]] = pickle.loads(kept.read_bytes())  # our own file
    return found


# -- one target ----------------------------------------------------------------------------------------------


def _fuzz(name: str, seconds: float) -> None:
    """Feed one target until its time is over; libFuzzer ends the process."""
    import atheris

    # left open: modules that are loaded when they are first needed count, too
    atheris.instrument_imports(include=["rfpose", "tomllib", "tarfile"], exclude=_unwatched()).__enter__()
    work = BUILD / "work" / name
    corpus = work / "corpus"
    corpus.mkdir(parents=True, exist_ok=True)
    seeds = _seeds()[name.removesuffix("-values")]
    run = _prepared(name, atheris.FuzzedDataProvider)
    changed = name.endswith("-values")
    for seed in [bytes(range(64))] if changed else seeds:
        (corpus / hashlib.sha1(seed, usedforsecurity=False).hexdigest()).write_bytes(seed)
    words = work / "words"
    words.write_text(_dictionary([] if changed else seeds))
    resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_SPACE, ADDRESS_SPACE))
    options = {
        "max_total_time": int(seconds), "max_len": 128 if changed else max(max(map(len, seeds)) * 5 // 4, 64),
        "timeout": SLOW_S, "rss_limit_mb": RSS_MB, "dict": words, "artifact_prefix": f"{work}/found-", "reload": 0,
        "verbosity": 0,
    }  # fmt: skip
    with contextlib.suppress(Exception):
        run(
            b"" if changed else seeds[0]
        )  # loads what is loaded when it is first needed, which takes longer than an input may
    atheris.Setup([name, *(f"-{key}={value}" for key, value in options.items()), str(corpus)], _counted(run, work))
    atheris.Fuzz()


def _unwatched() -> list[str]:
    """Return modules that read nothing from outside; numba, besides, compiles kernels from their own bytecode."""
    source = HERE.parents[1] / "src"
    names = [".".join(path.relative_to(source).with_suffix("").parts) for path in source.rglob("*.py")]
    return [name.removesuffix(".__init__") for name in names if not name.startswith(WATCHED) or "_kernels" in name]


def _prepared(name: str, provider: Any) -> Callable[[bytes], None]:
    """Return what reads bytes as the target does, in a folder in memory."""
    import targets

    logging.disable(logging.CRITICAL)
    warnings.simplefilter("error")
    plain = name.removesuffix("-values")
    folder = Path(
        tempfile.mkdtemp(prefix=f"rfpose-fuzz-{name}-", dir="/dev/shm" if Path("/dev/shm").is_dir() else None)
    )
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    run = targets.targets()[plain](targets.Field(folder, BUILD / "sound"))
    return run if plain == name else targets.by_values(_seeds()[plain][0], run, provider)


def _counted(run: Callable[[bytes], None], work: Path) -> Callable[[bytes], None]:
    """Count executions, and keep what raises anything but our own errors, once for each place in our code."""
    if not (work / "count").is_file():
        np.zeros(1, np.int64).tofile(work / "count")
    count = np.memmap(work / "count", np.int64, "r+")
    known = {path.stem for path in work.glob("found-*.txt")}

    def fed(data: bytes) -> None:
        count[0] += 1
        try:
            _strict(run, data)
        except Exception as error:  # noqa: BLE001
            place = _place(error)
            if place not in known:
                known.add(place)
                (work / f"{place}.txt").write_text("".join(traceback.format_exception(error)), "utf-8", "replace")
                (work / f"{place}.input").write_bytes(data)

    return fed


def _strict(run: Callable[[bytes], None], data: bytes) -> None:
    """Run, with warnings as errors as in the tests; our own errors are fine if they are one line of bounded length."""
    from rfpose.errors import RfposeError

    try:
        run(data)
    except RfposeError as error:
        text = str(error)
        text.encode()
        if len(text) > 2000 or not text.strip():
            raise AssertionError(f"a message of {len(text)} characters") from error


def _place(error: Exception) -> str:
    """Name a finding by its kind and the innermost line of ours."""
    frames = [f for f in traceback.extract_tb(error.__traceback__) if "/rfpose/" in f.filename]
    inner = frames[-1] if frames else traceback.extract_tb(error.__traceback__)[-1]
    return f"found-{type(error).__name__}-{Path(inner.filename).stem}-{inner.lineno}"


def _dictionary(seeds: list[bytes]) -> str:
    """Return libFuzzer's dictionary: the words of sound files, and what is odd."""
    words = {word for seed in seeds for word in re.findall(rb"[A-Za-z_][\w:.-]{1,40}", seed[:50_000])}
    odd = (
        b"nan",
        b"inf",
        b"1e999",
        b"-1",
        b"null",
        b"[]",
        b"{}",
        b"\xff\xff\xff\xff",
        b"9223372036854775808",
        b"\xc3\xa9",
    )
    lines = ["".join(f"\\x{byte:02x}" for byte in word) for word in sorted(words)[:2000] + list(odd)]
    return "".join(f'"{line}"\n' for line in lines)


def _show(name: str, data: bytes) -> None:
    """Read one input again."""
    import atheris

    _strict(_prepared(name, atheris.FuzzedDataProvider), data)


if __name__ == "__main__":
    main()
