"""What HDF5 takes to hand a frame of many receivers to a reader: one SWMR file, or a closed file a frame.

    python benchmarks/growing_files.py [--receivers 300] [--samples 100000]

Processor time of each side: what a recorder needs to make a frame visible, what a reader needs to find it and read it.
"""

from __future__ import annotations

import argparse
import multiprocessing
import tempfile
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import h5py
import numpy as np

SAMPLE = np.dtype([("r", "<i2"), ("i", "<i2")])


def timed(work: Callable[[], Any]) -> float:
    """Return the processor time of this process [ms]."""
    begun = time.process_time()
    work()
    return 1e3 * (time.process_time() - begun)


def swmr_recorder(path: Path, n_receiver: int, n_sample: int, told: Connection) -> None:
    """Append a frame whenever it is asked for: samples first, then the tables that say so."""
    samples = np.zeros(n_sample, SAMPLE)
    with h5py.File(path, "w", libver=("v110", "v110"), rdcc_nbytes=0) as file:
        iq, blocks = [], []
        for k in range(n_receiver):
            group = file.create_group(f"receivers/r{k}")
            iq.append(group.create_dataset("iq", (0,), SAMPLE, maxshape=(None,), chunks=(n_sample,)))
            blocks.append(group.create_dataset("blocks", (1, 3), "i8", maxshape=(None, 3), chunks=(64, 3)))
        file.swmr_mode = True
        told.send(0.0)
        n_frame = 0

        def append() -> None:
            for each in iq:
                each.resize(((n_frame + 1) * n_sample,))
                each.write_direct(samples, dest_sel=np.s_[n_frame * n_sample : (n_frame + 1) * n_sample])
            file.flush()
            for each in blocks:
                each[0] = (0, (n_frame + 1) * n_sample, 0)
            file.flush()

        while told.recv():
            told.send(timed(append))
            n_frame += 1


def closed_file(path: Path, n_receiver: int, n_sample: int) -> None:
    """Write a frame as a file of its own."""
    samples = np.zeros(n_sample, SAMPLE)
    with h5py.File(path, "w", libver=("v110", "v110")) as file:
        for k in range(n_receiver):
            file[f"receivers/r{k}/iq"] = samples
            file[f"receivers/r{k}/blocks"] = np.array([[0, n_sample, 0]])


def main() -> None:
    """Print medians over frames."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--receivers", type=int, default=300)
    parser.add_argument("--samples", type=int, default=100_000)
    parser.add_argument("--frames", type=int, default=8)
    asked = parser.parse_args()
    out = np.empty(asked.samples, SAMPLE)
    with tempfile.TemporaryDirectory() as folder:
        here, there = multiprocessing.Pipe()
        path = Path(folder) / "swmr.h5"
        recorder = multiprocessing.Process(
            target=swmr_recorder, args=(path, asked.receivers, asked.samples, there), daemon=True
        )
        recorder.start()
        here.recv()
        rows = []
        with h5py.File(path, "r", swmr=True, rdcc_nbytes=0) as file:
            iq = [file[f"receivers/r{k}/iq"] for k in range(asked.receivers)]
            blocks = [file[f"receivers/r{k}/blocks"] for k in range(asked.receivers)]
            for n in range(asked.frames):
                here.send(True)
                wrote = here.recv()

                def find() -> None:
                    for table, each in zip(blocks, iq, strict=True):
                        table.refresh()
                        table[-1]
                        each.refresh()

                def read(first: int = n * asked.samples) -> None:
                    for each in iq:
                        each.read_direct(out, np.s_[first : first + asked.samples])

                rows.append((wrote, timed(find), timed(read)))
            here.send(False)
        recorder.join()
        print("ms                 recorder  reader finds  reader reads")
        print("one SWMR file     {:9.0f}{:14.0f}{:14.0f}".format(*np.median(rows, axis=0)))
        rows = []
        for n in range(asked.frames):
            path = Path(folder) / f"frame-{n}.h5"
            wrote = timed(lambda at=path: closed_file(at, asked.receivers, asked.samples))
            opened: list[Any] = []

            def open_all(at: Path = path, into: list[Any] = opened) -> None:
                file = h5py.File(at, "r", rdcc_nbytes=0)
                group = file["receivers"].id
                for k in range(asked.receivers):
                    table = np.empty((1, 3), "i8")
                    h5py.h5d.open(group, f"r{k}/blocks".encode()).read(h5py.h5s.ALL, h5py.h5s.ALL, table)
                    into.append(h5py.Dataset(h5py.h5d.open(group, f"r{k}/iq".encode())))

            def read_all(of: list[Any] = opened) -> None:
                for each in of:
                    each.read_direct(out, np.s_[: asked.samples])

            rows.append((wrote, timed(open_all), timed(read_all)))
            path.unlink()
        print("a closed file each{:9.0f}{:14.0f}{:14.0f}".format(*np.median(rows, axis=0)))


if __name__ == "__main__":
    main()
