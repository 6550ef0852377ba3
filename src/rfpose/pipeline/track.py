"""A scenario in, a tracking run out: into a file resumable, the same bytes for the same seed."""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rfpose import __version__
from rfpose.engine import is_elsewhere, one_thread_of_blas, team_of
from rfpose.errors import InvalidInputError, ScenarioError
from rfpose.files import claim
from rfpose.pipeline.formats.checkpoint import Checkpoint
from rfpose.scenario import Scenario, naming, scenario_of

if TYPE_CHECKING:
    from rfpose.feedback.tracking import Portion, TrackingSimulation
    from rfpose.feedback.tracking.engine import Arrays
    from rfpose.pipeline.formats.track_file import Track

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
_STATE_LAYOUT = "3"
"""Told apart from unfinished work that was kept with other arrays, which cannot be gone on from."""
_KEEPING = 0.02
"""Of the time of others, so much may go into keeping what each result adds: it is a day, which took them long."""


def track(
    scenario: Scenario | str | Path,
    output: str | Path | None = None,
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
    """Track a scenario's field in simulation, by several methods on the same sun, wind and hidden errors.

    With an `rfpose.engine.Engine` of other processes these simulate days and methods side by side; the track is the
    same.

    Parameters
    ----------
    scenario
        The site, or its TOML file; its ``[tracking]`` table says what mounts, drives, wind, radio and cameras are like.
    output
        File to write, format ``rfpose-tracking``; None: none, see `Track.save`. While the run lasts its state is kept
        beside it; a killed run goes on from there and gives the same bytes.
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

    Examples
    --------
    >>> import rfpose as rf
    >>> site = rf.load_scenario(rf.shipped_scenario("tracking_100m.toml"))
    >>> short = site.changed(tracking={"first_hour": 11.5, "last_hour": 12.5, "field_control": None, "event": None})
    >>> day = rf.track(short, methods=["open-loop"], heliostats=2)
    >>> day
    <Track 'Tracking, 100 m field': 2 mirrors, 1 day, best open-loop>
    """
    place = None if output is None else Path(output).with_name(f".{Path(output).name}.state")
    given = None if isinstance(scenario, Scenario) else scenario
    with claim(output, inputs=[given, place], force=force) as job, contextlib.ExitStack() as held:
        base = scenario_of(scenario)
        with naming(scenario):
            site = _with(base, changes)
        records = {"wind": site.tracking.wind.record, "beam": site.tracking.beam_record}
        with claim(inputs=records.values()):  # none of the outputs may be one of them
            pass
        # compiled code, which none of the refusals above should wait for
        from rfpose.feedback.tracking import TrackingSimulation
        from rfpose.pipeline.formats.track_file import track_of, write_track
        from rfpose.pipeline.track_iq import check_with_iq

        # its matrices are too small to share: a second thread would take another program's core to wait on
        held.enter_context(one_thread_of_blas(scipy=True))
        with naming(scenario):
            simulation = TrackingSimulation(site, methods=methods, count=heliostats, seed=seed)
        settings = {
            "version": __version__,
            "seed": str(seed),
            "methods": " ".join(m.name for m in simulation.methods),
            "heliostats": str(len(simulation.field)),
        }
        digests = {name: _digest(path) for name, path in records.items() if path is not None}
        scenario_digest = hashlib.sha256(site.to_toml().encode()).hexdigest()
        key = settings | digests | {"layout of the state": _STATE_LAYOUT, "scenario": scenario_digest}
        checkpoint = None if place is None else Checkpoint(place, key, restart=force, interval_s=checkpoint_s)
        state = None if checkpoint is None else checkpoint.read()
        with naming(scenario):
            iq = check_with_iq(site, check_iq, seed=seed)
        if state is not None:
            simulation.restore(state)
        run = (
            _run_elsewhere(simulation, _Job.of(site, heliostats, seed, digests)) if is_elsewhere() else _run(simulation)
        )
        for done, total in run:
            if checkpoint is not None:
                checkpoint.write(simulation.state(), share=_KEEPING if is_elsewhere() else 0.0)
            if on_progress is not None:
                on_progress(done, total)
        found = track_of(simulation, settings, iq=iq)
        if output is not None:
            write_track(found, output)
        if checkpoint is not None:
            job.afterwards(checkpoint.remove)
        return found


def _run(simulation: TrackingSimulation) -> Iterator[tuple[int, int]]:
    """Simulate here; yield (stretches done, stretches in all)."""
    while simulation.done < simulation.n_segment:
        simulation.advance()
        yield simulation.done, simulation.n_segment


# -- by others -----------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class _Job:
    """What a worker needs to know to simulate some of it."""

    scenario: Scenario
    heliostats: int | None
    seed: int
    digests: Mapping[str, str]
    """Of the records that the scenario names."""

    @classmethod
    def of(cls, site: Scenario, heliostats: int | None, seed: int, digests: Mapping[str, str]) -> _Job:
        """Return the job for workers whose working directory is another."""
        table: dict[str, Any] = {}
        if site.tracking.wind.record is not None:
            table["wind"] = {"record": str(Path(site.tracking.wind.record).absolute())}
        if site.tracking.beam_record is not None:
            table["beam_record"] = str(Path(site.tracking.beam_record).absolute())
        return cls(scenario=site.changed(tracking=table), heliostats=heliostats, seed=seed, digests=digests)


def _run_elsewhere(simulation: TrackingSimulation, job: _Job) -> Iterator[tuple[int, int]]:
    """Let others simulate; yield (stretches done, stretches in all), each method's counted."""
    total = simulation.n_segment * len(simulation.methods)
    with team_of() as team:
        waiting = simulation.portions(team.n_at_once)
        given: list[tuple[Portion, Mapping[str, Arrays]]] = []
        under_way: set[Portion] = set()

        def give_out() -> None:
            # while a method learns, no more than runs side by side: its next day would have to wait for all of them
            learns = any(portion.learns for portion in (*waiting, *under_way))
            n = max(team.n_at_once - len(under_way), 0) if learns else len(waiting)
            given.extend((portion, simulation.learned(portion)) for portion in waiting[:n])
            under_way.update(waiting[:n])
            del waiting[:n]

        give_out()
        for i, found in team.map(_simulate_there, given, job):
            portion, _ = given[i]
            given[i] = portion, {}
            simulation.take(portion, found)
            under_way.remove(portion)
            waiting[:0] = simulation.following(portion)
            give_out()
            yield simulation.n_over, total


def _simulate_there(job: _Job, given: tuple[Portion, Mapping[str, Arrays]]) -> Any:
    """Simulate a portion on a worker, which goes on from what its methods have learned."""
    portion, learned = given
    from rfpose.feedback.tracking import TrackingSimulation

    tracking = job.scenario.tracking
    for name, path in (("wind", tracking.wind.record), ("beam", tracking.beam_record)):
        if path is not None and _digest(path) != job.digests[name]:
            raise InvalidInputError(
                f"{path}: is another file here than where the job was started; give a path that leads to the same one "
                "everywhere"
            )
    simulation = TrackingSimulation(job.scenario, methods=portion.methods, count=job.heliostats, seed=job.seed)
    return simulation.go_through(portion, learned)


def _digest(path: str) -> str:
    try:
        return hashlib.sha256(Path(path).read_bytes()).hexdigest()
    except OSError as error:
        raise InvalidInputError(f"{path}: cannot read: {error.strerror or error}") from error


def _with(scenario: Scenario, changes: TrackChanges) -> Scenario:
    """Return the scenario with some keys of ``[tracking]`` changed."""
    keys = {"days": changes.days, "day_interval": changes.day_interval, "sky": changes.sky}
    table: dict[str, Any] = {name: value for name, value in keys.items() if value is not None}
    if changes.sky in ("clear", "bursts"):
        table["beam_record"] = None
    if changes.without_field_control:
        if changes.events:
            raise ScenarioError("events need field control to act on; leave out one or the other")
        table |= {"field_control": None, "event": None}
    elif changes.events:
        table["event"] = (*scenario.tracking.event, *changes.events)
    return scenario.changed(tracking=table)
