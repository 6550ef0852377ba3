"""A scenario in, a synthetic recording out."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from rfpose import __version__
from rfpose.files import claim
from rfpose.recording import RecordingWriter
from rfpose.scenario import Scenario, load_scenario

__all__ = ["simulate_recording"]


def simulate_recording(
    scenario_path: str | Path,
    recording_path: str | Path,
    *,
    seed: int,
    force: bool = False,
    on_progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Write the recording that a site would make, with the truth behind it.

    Parameters
    ----------
    scenario_path
        TOML; its ``[simulation]`` table says what happens.
    recording_path
        File to write, format ``rfpose-iq``.
    seed
        Same scenario and seed, same recording.
    force
        Overwrite an existing file.
    on_progress
        Called with (samples written, samples in all).

    Returns
    -------
    dict
        What was written: ``recording``, ``scenario``, ``seed``, ``frames``, ``frame_samples``, ``receivers``,
        ``samples``, ``bytes``.

    Raises
    ------
    ScenarioError
        The scenario is malformed or cannot be simulated.
    RecordingError
        The file exists already, is the scenario, or cannot be written; nothing is left under its name.
    """
    recording_path = Path(recording_path)
    with claim(recording_path, inputs=[scenario_path], force=force):
        return _simulate(load_scenario(scenario_path), recording_path, seed=seed, on_progress=on_progress)


def _simulate(
    scenario: Scenario, recording_path: Path, *, seed: int, on_progress: Callable[[int, int], None] | None
) -> dict[str, Any]:
    from rfpose.simulate import Simulator  # compiled code, which no refusal should wait for

    simulator = Simulator(scenario, seed=seed)
    writer = RecordingWriter(
        recording_path,
        scenario=scenario,
        receiver_ids=simulator.receiver_ids,
        sample_rate=scenario.radio.sample_rate,
        centre_frequency_hz=scenario.radio.centre_frequency_hz,
        sample_format=simulator.sample_format,
        full_scale=simulator.full_scale,
        provenance={"made_by": f"rfpose simulate {__version__}", "seed": str(seed)},
    )
    done = 0
    with writer:
        for chunk in simulator:
            writer.write(chunk.receiver_id, chunk.start_index, chunk.samples)
            done += len(chunk.samples)
            if on_progress is not None:
                on_progress(done, simulator.total_samples)
        writer.write_truth(simulator.truth)
    return {
        "recording": recording_path,
        "scenario": scenario.name,
        "seed": seed,
        "frames": len(simulator.frame_start_index),
        "frame_samples": scenario.radio.frame_samples,
        "receivers": len(simulator.receiver_ids),
        "samples": done,
        "bytes": writer.n_byte,
    }
