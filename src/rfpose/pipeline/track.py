"""A scenario in, a tracking run out: resumable, the same bytes for the same seed."""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rfpose import __version__
from rfpose.errors import GeometryError, InvalidInputError, ScenarioError
from rfpose.files import claim
from rfpose.pipeline._checkpoint import Checkpoint
from rfpose.scenario import Scenario, check_scenario, load_scenario

if TYPE_CHECKING:
    from rfpose.pipeline.track_file import Track

__all__ = ["TrackChanges", "track"]


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackChanges:
    """What a run takes instead of what stands in a scenario's ``[tracking]``; None: that.

    Attributes
    ----------
    days, day_interval, sky
        As the keys; ``sky`` is clear or bursts.
    events
        Happenings besides those of ``[[tracking.event]]``, with the same keys.
    without_field_control
        Track from the first second, without modes, messages and events.
    """

    days: int | None = None
    day_interval: int | None = None
    sky: str | None = None
    events: Sequence[Mapping[str, Any]] = ()
    without_field_control: bool = False


_AS_IT_STANDS = TrackChanges()


def track(
    scenario_path: str | Path,
    result_path: str | Path,
    *,
    methods: Sequence[str] = (),
    changes: TrackChanges = _AS_IT_STANDS,
    heliostats: int | None = None,
    check_iq: Sequence[str] = (),
    seed: int = 0,
    force: bool = False,
    checkpoint_s: float = 20.0,
    on_progress: Callable[[int, int], None] | None = None,
) -> Track:
    """Track a scenario's field by several methods and write what came of it.

    Parameters
    ----------
    scenario_path
        TOML.
    result_path
        File to write, format ``rfpose-tracking``. While the run lasts its state is kept beside it; a killed run goes on
        from there and gives the same bytes.
    methods
        Names; none: all that can steer the collector.
    changes
        What differs from the scenario's ``[tracking]``.
    heliostats
        How many mirrors; see `rfpose.feedback.tracking.hidden.field_positions`.
    check_iq
        Names of mirrors of which samples are made and processed, to see that the radio model holds.
    seed
        Same scenario and seed, same result.
    force
        Overwrite an existing file, and discard unfinished work.
    checkpoint_s
        Least time between two states kept [s].
    on_progress
        Called with (stretches of time done, stretches in all).

    Raises
    ------
    ScenarioError
        The scenario is malformed or cannot be tracked; the message begins with the file.
    RecordingError
        The file exists already, is one that is read, or cannot be written; unfinished work of another job is in the
        way.
    """
    result_path = Path(result_path)
    place = result_path.with_name(f".{result_path.name}.state")
    with claim(result_path, inputs=[scenario_path, place], force=force) as job:
        base = load_scenario(scenario_path)
        with _naming(scenario_path):
            scenario = _with(base, changes)
        records = {"wind": scenario.tracking.wind.record, "beam": scenario.tracking.beam_record}
        with claim(inputs=records.values()):  # none of the outputs may be one of them
            pass
        # compiled code, which none of the refusals above should wait for
        from rfpose.feedback.tracking import Simulation
        from rfpose.pipeline.track_file import track_of, write_track
        from rfpose.pipeline.track_iq import check_with_iq

        with _naming(scenario_path):
            simulation = Simulation(scenario, methods=methods, count=heliostats, seed=seed)
        settings = {
            "version": __version__,
            "seed": str(seed),
            "methods": " ".join(m.name for m in simulation.methods),
            "heliostats": str(len(simulation.field)),
        }
        key = settings | {"scenario": hashlib.sha256(scenario.to_toml().encode()).hexdigest()}
        for name, path in records.items():
            if path is not None:
                key[name] = hashlib.sha256(Path(path).read_bytes()).hexdigest()
        checkpoint = Checkpoint(place, key, restart=force, interval_s=checkpoint_s)
        state = checkpoint.read()
        with _naming(scenario_path):
            iq = check_with_iq(scenario, check_iq, seed=seed)
        if state is not None:
            simulation.restore(state)
        while simulation.done < simulation.n_segment:
            simulation.advance()
            checkpoint.write(simulation.state())
            if on_progress is not None:
                on_progress(simulation.done, simulation.n_segment)
        found = track_of(simulation, settings, iq=iq)
        write_track(found, result_path)
        job.afterwards(checkpoint.remove)
        return found


@contextlib.contextmanager
def _naming(scenario_path: str | Path) -> Iterator[None]:
    """Name the scenario's file in what is wrong with it."""
    try:
        yield
    except (ScenarioError, GeometryError, InvalidInputError) as error:
        raise ScenarioError(f"{scenario_path}: {error}") from error


def _with(scenario: Scenario, changes: TrackChanges) -> Scenario:
    """Return the scenario with some keys of ``[tracking]`` changed."""
    keys = {"days": changes.days, "day_interval": changes.day_interval, "sky": changes.sky}
    values = {name: value for name, value in keys.items() if value is not None}
    data = scenario.model_dump(exclude_none=True)
    table = {**data["tracking"], **values}
    if values.get("sky") in ("clear", "bursts"):
        table.pop("beam_record", None)
    if changes.without_field_control:
        if changes.events:
            raise ScenarioError("events need field control to act on; leave out one or the other")
        table.pop("field_control", None)
        table["event"] = ()
    elif changes.events:
        table["event"] = [*table.get("event", ()), *changes.events]
    return check_scenario({**data, "tracking": table})
