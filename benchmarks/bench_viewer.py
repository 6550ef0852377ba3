"""Viewer: frames a second while a transmitter is dragged, time to the first picture of a large recording, memory.

    python benchmarks/bench_viewer.py

Draws without a screen, with the same widgets. The recording is sparse: 10 GB of samples that were never written.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import threading
import time
from pathlib import Path

os.environ["QT_QPA_PLATFORM"] = "offscreen"

import h5py
import numpy as np
import psutil
from PySide6.QtCore import QEvent, QObject

from rfpose.layout.fields import radial_staggered
from rfpose.pipeline.demo import shipped_scenario
from rfpose.recording import RecordingWriter
from rfpose.scenario import load_scenario
from rfpose.viewer.export import open_window, settle

_GIVE_UP_S = 60.0


class Peak:
    """Largest resident memory while it lasts."""

    def __enter__(self) -> Peak:
        self.bytes, self._stop = 0, threading.Event()
        self._thread = threading.Thread(target=self._watch)
        self._thread.start()
        return self

    def _watch(self) -> None:
        process = psutil.Process()
        while not self._stop.wait(0.01):
            self.bytes = max(self.bytes, process.memory_info().rss)

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()


def large_recording(folder: Path, gigabytes: float) -> Path:
    """One receiver of a heliostat with so many samples, none of which stands on the disk."""
    site = load_scenario(shipped_scenario("table2_100m.toml"))
    path = folder / "large.h5"
    with RecordingWriter(
        path,
        scenario=site,
        receiver_ids=site.receiver_ids,
        sample_rate=site.radio.sample_rate,
        centre_frequency_hz=site.radio.centre_frequency_hz,
        sample_format="int16",
        full_scale=32767.0,
        provenance={"made_by": "bench_viewer"},
    ) as writer:
        rng = np.random.default_rng(1)
        for name in site.receiver_ids:
            writer.write(name, 0, rng.integers(-2000, 2000, (site.radio.frame_samples, 2)).astype(np.int16))
    count = int(gigabytes * 1e9 / 4)
    name = site.receiver_ids[0]
    with h5py.File(path, "r+") as file:
        first = file[f"receivers/{name}/iq"][()]
        del file[f"receivers/{name}/iq"]
        plan = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        plan.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
        space = h5py.h5s.create_simple((count,))
        kind = h5py.h5t.py_create(first.dtype)
        iq = h5py.Dataset(h5py.h5d.create(file[f"receivers/{name}"].id, b"iq", kind, space, plan))
        iq[: len(first)] = first
        iq[count - 1 :] = first[:1]
        file[f"receivers/{name}/blocks"][0] = (0, count, 0)
    return path


def open_large(gigabytes: float) -> None:
    """Open a large recording in a running viewer and wait for each picture."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        path = large_recording(folder, gigabytes)
        size, on_disk = path.stat().st_size, 512 * path.stat().st_blocks
        app, window = open_window(shipped_scenario("table2_100m.toml"))  # a viewer that is up and running
        view = window.views["recording"]
        with Peak() as peak:
            start, own = time.perf_counter(), time.process_time()
            window.open_path(path)
            seen: dict[str, float] = {}
            first = float("nan")
            while len(seen) < 4 and time.perf_counter() - start < _GIVE_UP_S:
                app.processEvents()
                time.sleep(0.002)  # as the event loop of a real window does, which waits
                for what in ("spectrum", "waterfall", "track", "_summary"):
                    if what not in seen and getattr(view, what, None) is not None:
                        view.grab()
                        seen[what] = time.perf_counter() - start
                        first = time.process_time() - own if len(seen) == 1 else first
            settle(app, window)
        if window.session.message is not None:
            print(f"message: {window.session.message.text}")
        print(f"recording of {size / 1e9:.1f} GB ({on_disk / 1e6:.0f} MB on the disk)")
        for what, text in (
            ("spectrum", "first picture (spectrum with every carrier)"),
            ("waterfall", "waterfall over all frames"),
            ("track", "phases over 100 frames"),
            ("_summary", "levels of all receivers"),
        ):
            print(f"  {text}: {seen.get(what, float('nan')):.2f} s")
        print(f"  processor time to the first picture: {first:.2f} s")
        print(f"  peak memory of the whole viewer: {peak.bytes / 1e6:.0f} MB")
        window.close()


class Paints(QObject):
    """Counts how often a widget is drawn."""

    count = 0

    def eventFilter(self, _: QObject, event: QEvent) -> bool:  # noqa: N802
        """Look at an event, and let it pass."""
        self.count += event.type() == QEvent.Type.Paint
        return False


def drag(n_heliostat: int, n_step: int) -> None:
    """Drag a transmitter around a circle, as fast as pictures come."""
    places = radial_staggered(n_heliostat, first_radius_m=12.0, diagonal_m=3.0, height_m=2.0)
    site = load_scenario(shipped_scenario("table2_100m.toml")).with_field(places)
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "field.toml"
        site.save(path)
        app, window = open_window(path)
    view, edit = window.views["layout"], window.session.layout
    paints = Paints()
    view.graphs.viewport().installEventFilter(paints)
    for estimator in ("rigid", "shared-clock", "independent", "carrier"):
        edit.choose(estimator=estimator)
        settle(app, window)
        maps = worst = 0.0
        edit.begin_drag()
        start = last = time.perf_counter()
        own = time.process_time()
        for k in range(n_step):
            angle = 2.0 * np.pi * (k + 0.5) / n_step  # never where it stands already
            shown = view.map
            edit.move("T1", east=100.0 * np.cos(angle), north=100.0 * np.sin(angle))
            while view.map is shown:
                app.processEvents()
                time.sleep(0.0005)
            drawn = paints.count
            while paints.count == drawn:
                app.processEvents()
            now = time.perf_counter()
            worst, last, maps = max(worst, now - last), now, maps + 1
        edit.end_drag()
        rate = maps / (last - start)
        own = 1e3 * (time.process_time() - own) / n_step
        print(
            f"drag, {n_heliostat} mirrors, {estimator}: {rate:.1f} pictures/s, longest {1e3 * worst:.0f} ms, "
            f"processor time {own:.0f} ms a picture"
        )
    window.close()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--gigabytes", type=float, default=10.0)
    parser.add_argument("--mirrors", type=int, default=2000)
    parser.add_argument("--steps", type=int, default=100)
    options = parser.parse_args()
    open_large(options.gigabytes)
    drag(options.mirrors, options.steps)
