"""The whole way on a simulated field: the first thing a user runs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

from rfpose.errors import RecordingError
from rfpose.pipeline.evaluate import Evaluation, evaluate
from rfpose.pipeline.files import make_directory, refuse_existing
from rfpose.pipeline.pictures import draw_field_map, draw_spectrum
from rfpose.pipeline.process import process
from rfpose.pipeline.result_summary import write_poses_csv
from rfpose.pipeline.simulate import simulate_recording
from rfpose.pipeline.solve import solve
from rfpose.recording import open_recording

__all__ = ["STAGES", "DemoOutcome", "run_demo", "shipped_scenario"]

STAGES = ("Simulating", "Measuring", "Drawing")

_FILES = {
    "recording": "recording.h5",
    "result": "result.h5",
    "poses": "poses.csv",
    "field_map": "field_map.png",
    "spectrum": "spectrum.png",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class DemoOutcome:
    """What the demo found and where it left its files, by what they are."""

    evaluation: Evaluation
    independent: Evaluation
    """The same phases with each receiver located on its own, as published."""
    files: dict[str, Path]


def shipped_scenario(name: str) -> Path:
    """Return the path of a scenario that comes with rfpose, from a wheel or from a checkout."""
    installed = Path(str(resources.files("rfpose"))) / "data" / name
    checkout = Path(__file__).resolve().parents[3] / "data" / name
    for path in (installed, checkout):
        if path.is_file():
            return path
    raise RecordingError(f"{installed}: missing from this installation of rfpose; install it again")


def run_demo(
    directory: str | Path,
    *,
    seed: int = 1,
    force: bool = False,
    on_progress: Callable[[int, int], None] | None = None,
    on_stage: Callable[[str], None] | None = None,
    scenario_path: str | Path | None = None,
) -> DemoOutcome:
    """Simulate 12 heliostats on Table 2's layout, process the recording, evaluate the result and draw it.

    Parameters
    ----------
    directory
        Made if absent; holds recording, result, table and pictures afterwards.
    seed
        Same seed, same recording.
    force
        Overwrite what an earlier demo left there.
    on_progress
        Called with (done, total) of the running stage.
    on_stage
        Called with the name of each stage, one of `STAGES`, as it begins.
    scenario_path
        Another site than the shipped one.

    Raises
    ------
    RecordingError
        Files are there already, or cannot be written.
    """
    directory = make_directory(directory)
    files = {what: directory / name for what, name in _FILES.items()}
    for path in files.values():
        refuse_existing(path, force=force)
    tell = on_stage or (lambda _text: None)

    tell(STAGES[0])
    scenario_path = scenario_path or shipped_scenario("table2_100m.toml")
    simulate_recording(scenario_path, files["recording"], seed=seed, force=force, on_progress=on_progress)
    tell(STAGES[1])
    result = process(files["recording"], files["result"], force=force, on_progress=on_progress)
    tell(STAGES[2])
    evaluation = evaluate(result)
    settings = {**result.settings, "pose": "independent"}
    independent = evaluate(solve(result.tones, result.scenario, settings=settings, truth=result.truth))
    write_poses_csv(result, files["poses"])
    draw_field_map(result, files["field_map"], evaluation=evaluation)
    with open_recording(files["recording"]) as recording:
        draw_spectrum(recording, files["spectrum"])
    return DemoOutcome(evaluation=evaluation, independent=independent, files=files)
