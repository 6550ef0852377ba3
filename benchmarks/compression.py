"""What each compression of rfpose-iq saves and costs, by seconds of processor, in turn on the same samples.

    python benchmarks/compression.py [RECORDING]

Without a recording: eight frames of the shipped scenario table2_100m.toml, as simulated.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import rfpose as rf
from rfpose.recording import Recording, convert, open_recording
from rfpose.recording.writer import COMPRESSIONS

TIMES = 3


def seconds(work: Callable[[], object]) -> float:
    """Return the processor's time of the quickest of some runs."""
    found = []
    for _ in range(TIMES):
        began = time.process_time()
        work()
        found.append(time.process_time() - began)
    return min(found)


def read_all(recording: Recording) -> None:
    """Read as `rfpose process` does: frame by frame, where there is a scenario to tell how long one is."""
    step = 2**20 if recording.scenario is None else recording.scenario.radio.frame_samples
    for name in recording.receiver_ids:
        for start, count in recording.blocks(name).tolist():
            for at in range(start, start + count, step):
                recording.read(name, at, min(step, start + count - at))


def main() -> None:
    """Print a table."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if len(sys.argv) > 1:
            source = Path(sys.argv[1])
        else:
            site = rf.load_scenario(rf.shipped_scenario("table2_100m.toml"))
            source = folder / "simulated.h5"
            short = site.changed(heliostat=site.heliostat[:2], simulation={"frame_count": 8})
            rf.simulate(short, seed=1).save(source)
        rows: dict[str | None, tuple[int, float, float]] = {}
        path = folder / "out.h5"
        with open_recording(source) as recording:
            for compress in (None, *COMPRESSIONS):

                def write(compress: str | None = compress) -> None:
                    convert(recording, path, format="rfpose-iq", overwrite=True, compress=compress, verify=False)

                writing = seconds(write)
                with open_recording(path) as written:
                    rows[compress] = path.stat().st_size, writing, seconds(lambda: read_all(written))
        size, writing, reading = rows[None]
        print(f"{source.name}: {size / 1e6:.1f} MB, written in {writing:.3f} s, read in {reading:.3f} s of processor")
        print(f"{'':16} {'size':>6} {'write':>7} {'read':>7}   of plain")
        for compress, row in rows.items():
            print(f"{compress or 'plain':16} {row[0] / size:6.2f} {row[1] / writing:7.1f} {row[2] / reading:7.1f}")


if __name__ == "__main__":
    main()
