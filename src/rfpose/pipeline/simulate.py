"""A scenario in, a synthetic recording out."""

from __future__ import annotations

import dataclasses
import logging
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from rfpose import __version__
from rfpose.errors import InvalidInputError
from rfpose.files import claim, make_directory
from rfpose.recording import Recording, RecordingWriter
from rfpose.recording.base import IqArray
from rfpose.scenario import Scenario, scenario_of
from rfpose.truth import Truth

if TYPE_CHECKING:
    from rfpose.simulator import Simulator

__all__ = ["SimulatedRecording", "simulate"]

_log = logging.getLogger(__name__)


def simulate(scenario: Scenario | str | Path, *, seed: int = 0) -> SimulatedRecording:
    """Return the recording that a site would make, with the truth behind it.

    Parameters
    ----------
    scenario
        The site, or its TOML file; its ``[simulation]`` table says what happens.
    seed
        Same scenario and seed, same recording.

    Raises
    ------
    ScenarioError
        The scenario is malformed or cannot be simulated.
    RecordingError
        A ray table (``simulation.paths``) is missing or damaged.

    Examples
    --------
    >>> import rfpose as rf
    >>> site = rf.load_scenario(rf.shipped_scenario("table2_100m.toml"))
    >>> recording = rf.simulate(site.changed(heliostat=site.heliostat[:2], simulation={"frame_count": 1}), seed=1)
    >>> recording
    <SimulatedRecording 'Table 2, 100 m field': 7 receivers, seed 1>
    >>> recording.truth.normal_enu.shape
    (1, 2, 3)
    """
    site = scenario_of(scenario)
    if site.impossible_sun:
        _log.warning("%s; leave both angles out, and the sun follows from the site and `start`", site.impossible_sun)
    from rfpose.simulator import Simulator  # compiled code, which no refusal should wait for

    file = None if isinstance(scenario, Scenario) else Path(scenario)
    simulator = Simulator(site, seed=seed, folder=None if file is None else file.parent)
    return SimulatedRecording(
        simulator, site, seed=seed, made_from=simulator.files if file is None else (file, *simulator.files)
    )


class SimulatedRecording(Recording):
    """A recording whose samples are made when they are read; `simulate` returns one.

    It takes no memory, and gives the same samples each time. `save` writes them once and for all.
    """

    def __init__(self, simulator: Simulator, scenario: Scenario, *, seed: int, made_from: Sequence[Path] = ()) -> None:
        super().__init__(
            Path("simulated"),
            format="rfpose-iq",
            receiver_ids=simulator.receiver_ids,
            sample_rate=scenario.radio.sample_rate,
            centre_frequency_hz=scenario.radio.centre_frequency_hz,
            sample_format=simulator.sample_format,
            full_scale=simulator.full_scale,
            scenario=scenario,
            truth=simulator.truth,
            provenance={"made_by": f"rfpose simulate {__version__}", "seed": str(seed)},
        )
        self._simulator = simulator
        self._site = scenario
        self._made_from = list(made_from)

    def __repr__(self) -> str:
        seed = self.provenance["seed"]
        return f"<SimulatedRecording {self._site.name!r}: {len(self.receiver_ids)} receivers, seed {seed}>"

    def files(self) -> list[Path]:
        """Return what it is made from: the scenario's file, if it came from one, and ray tables."""
        return self._made_from

    def save(
        self,
        path: str | Path,
        *,
        format: str = "rfpose-iq",
        force: bool = False,
        compress: str | None = None,
        on_progress: Callable[[int, int], None] | None = None,
    ) -> None:
        """Write the recording, with scenario and truth; see `Recording.save`."""
        if format != "rfpose-iq":
            super().save(path, format=format, force=force, compress=compress, on_progress=on_progress)
            return
        path, done = Path(path), 0
        with (
            claim(path, inputs=self._made_from, force=force),
            RecordingWriter.like(path, self, overwrite=True, compress=compress) as writer,
        ):
            for chunk in self._simulator:
                writer.write(chunk.receiver_id, chunk.start_index, chunk.samples)
                done += len(chunk.samples)
                if on_progress is not None:
                    on_progress(done, self._simulator.total_samples)
            writer.write_truth(self._simulator.truth)

    def record(
        self,
        directory: str | Path,
        *,
        pace: float | None = 1.0,
        force: bool = False,
        on_progress: Callable[[int, int], None] | None = None,
    ) -> None:
        """Write the recording as a recorder would: one closed file a frame, when the frame is over.

        Parameters
        ----------
        directory
            Made if absent.
        pace
            Seconds of the recording in a second; None: as fast as frames come.
        force
            Overwrite files of the same names.
        on_progress
            Called with (frames done, frames).

        Raises
        ------
        InvalidInputError
            A pace that is not greater than zero.
        RecordingError
            A file exists, or cannot be written.
        """
        if pace is not None and not pace > 0.0:
            raise InvalidInputError(f"`pace` must be greater than zero, got {pace}")
        directory = make_directory(Path(directory))
        starts = self._simulator.frame_start_index
        n_sample = self._site.radio.frame_samples
        began = time.monotonic()
        for k, start in enumerate(starts.tolist()):
            due_s = 0.0 if pace is None else float((start + n_sample - int(starts[0])) / self.sample_rate) / pace
            if k == 0 and pace is not None:
                began -= due_s  # the first frame has just been recorded
            time.sleep(max(0.0, began + due_s - time.monotonic()))
            with RecordingWriter.like(directory / f"frame-{k:06d}.h5", self, overwrite=force) as writer:
                for name in self.receiver_ids:
                    for first, count in self._segments_of(name).tolist():
                        at, end = max(first, start), min(first + count, start + n_sample)
                        if at < end:
                            writer.write(name, at, self.read(name, at, end - at))
                writer.write_truth(_truth_of_frame(self._simulator.truth, k))
            if on_progress is not None:
                on_progress(k + 1, len(starts))

    def as_dict(self) -> dict[str, Any]:
        """Return what was simulated, with stable keys."""
        return {
            "scenario": self._site.name,
            "seed": int(self.provenance["seed"]),
            "frames": len(self._simulator.frame_start_index),
            "frame_samples": self._site.radio.frame_samples,
            "receivers": len(self.receiver_ids),
            "samples": self._simulator.total_samples,
        }

    def _load_segments(self, receiver_id: str) -> npt.NDArray[np.int64]:
        return self._simulator.stretches(receiver_id)

    def _read_segment(self, receiver_id: str, i_segment: int, skip: int, out: IqArray) -> None:
        start = int(self._segments_of(receiver_id)[i_segment, 0]) + skip
        with ThreadPoolExecutor(thread_name_prefix="rfpose-simulate") as pool:
            for at, samples in pool.map(lambda piece: piece(), self._simulator.pieces(receiver_id, start, len(out))):
                out[at : at + len(samples)] = samples


def _truth_of_frame(truth: Truth, k: int) -> Truth:
    """Return the truth of one frame."""
    always = {"heliostat_ids", "receiver_ids", "transmitter_ids", "clock_ppm"}
    values = {field.name: getattr(truth, field.name) for field in dataclasses.fields(truth)}
    return Truth(**{name: v if v is None or name in always else v[k : k + 1] for name, v in values.items()})
