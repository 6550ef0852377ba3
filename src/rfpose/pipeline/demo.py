"""The whole way on a simulated field: the first thing a user runs."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING

from rfpose.errors import RecordingError
from rfpose.files import claim, make_directory, remove

if TYPE_CHECKING:
    from rfpose.pipeline.evaluate import Evaluation

__all__ = ["STAGES", "DemoOutcome", "run_demo", "shipped_file", "shipped_files", "shipped_scenario"]

STAGES = ("Simulating", "Measuring", "Drawing", "Writing the report")

_FILES = {
    "recording": "recording.h5",
    "result": "result.h5",
    "poses": "poses.csv",
    "field_map": "field_map.png",
    "spectrum": "spectrum.png",
}
_REPORT = "report.html"
_SCRATCH = ".demo.part"


@dataclass(frozen=True, slots=True, kw_only=True)
class DemoOutcome:
    """What the demo found and where it left its files, by what they are."""

    evaluation: Evaluation
    independent: Evaluation
    """The same phases with each receiver located on its own, as published."""
    files: dict[str, Path]


def shipped_scenario(name: str) -> Path:
    """Return the path of a scenario that comes with rfpose, from a wheel or from a checkout."""
    return shipped_file(name)


def shipped_file(name: str) -> Path:
    """Return the path of a file that comes with rfpose.

    Raises
    ------
    RecordingError
        None is called so, or it is missing from this installation.
    """
    known = shipped_files()
    if name not in known:
        raise RecordingError(
            f"{name}: comes not with rfpose, or is missing from this installation; known are "
            f"{', '.join(known) or 'none: install it again'}"
        )
    return known[name]


def shipped_files() -> dict[str, Path]:
    """Return the paths of all files that come with rfpose, by name; from a wheel or from a checkout."""
    installed = Path(str(resources.files("rfpose"))) / "data"
    folder = installed if installed.is_dir() else Path(__file__).resolve().parents[3] / "data"
    return {path.name: path for path in sorted(folder.glob("*")) if path.suffix in (".toml", ".h5")}


def run_demo(
    directory: str | Path,
    *,
    seed: int = 1,
    force: bool = False,
    on_progress: Callable[[int, int], None] | None = None,
    on_stage: Callable[[str], None] | None = None,
    scenario_path: str | Path | None = None,
    report: Callable[[Path, Path], object] | None = None,
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
        Called with the name of each stage, one of `STAGES`, as it begins; the last only with ``report``.
    scenario_path
        Another site than the shipped one.
    report
        Called with the result and the name of a report to write; it may leave that out.

    Raises
    ------
    RecordingError
        Files are there already, or cannot be written.
    """
    scenario_path = scenario_path or shipped_scenario("table2_100m.toml")
    names = _FILES if report is None else {**_FILES, "report": _REPORT}
    is_new = not Path(directory).exists()
    directory = make_directory(directory)
    files = {what: directory / name for what, name in names.items()}
    # each stage reads what the one before wrote: all stay aside until the last is done
    scratch = directory / _SCRATCH
    try:
        with claim(*files.values(), inputs=[scenario_path], force=force) as job:
            try:
                remove(scratch)
                scratch.mkdir()
                tell = on_stage or (lambda _text: None)
                evaluations = _run(scratch, scenario_path, seed, on_progress, tell)
                if report is not None:
                    tell(STAGES[3])
                    report(scratch / _FILES["result"], scratch / _REPORT)
                made = {what: path for what, path in files.items() if (scratch / path.name).exists()}
                for path in made.values():
                    (scratch / path.name).replace(job.part(path))
                    job.complete(path)
            finally:
                remove(scratch)
    finally:
        if is_new:
            with contextlib.suppress(OSError):  # it is not empty: all is well
                directory.rmdir()
    return DemoOutcome(evaluation=evaluations[0], independent=evaluations[1], files=made)


def _run(
    place: Path,
    scenario_path: str | Path,
    seed: int,
    on_progress: Callable[[int, int], None] | None,
    tell: Callable[[str], None],
) -> tuple[Evaluation, Evaluation]:
    """Make all but the report; return the evaluations of all phases at once and of each receiver alone."""
    from rfpose.drawing import save_figure
    from rfpose.pipeline.choice import choose
    from rfpose.pipeline.evaluate import evaluate
    from rfpose.pipeline.formats.result_summary import write_poses_csv
    from rfpose.pipeline.process import process
    from rfpose.pipeline.simulate import simulate
    from rfpose.pipeline.solve import solve
    from rfpose.recording import open_recording

    files = {what: place / name for what, name in _FILES.items()}
    tell(STAGES[0])
    simulate(scenario_path, seed=seed).save(files["recording"], on_progress=on_progress)
    tell(STAGES[1])
    result = process(files["recording"], files["result"], on_progress=on_progress)
    tell(STAGES[2])
    evaluation = evaluate(result)
    again = solve(
        result.tones,
        result.scenario,
        choose(result.scenario, pose="independent"),
        sample_rate=result.sample_rate,
        settings=result.settings,
        truth=result.truth,
    )
    independent = evaluate(again)
    write_poses_csv(result, files["poses"])
    save_figure(result.plot(evaluation=evaluation), files["field_map"])
    with open_recording(files["recording"]) as recording:
        save_figure(recording.plot(), files["spectrum"])
    return evaluation, independent
