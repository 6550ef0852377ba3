"""Which figures there are of which file: what `rfpose plot`, `rfpose view --save` and reports draw."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rfpose.errors import InvalidInputError, RfposeError
from rfpose.kinds import kind_of
from rfpose.scenario import Scenario, load_scenario

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from rfpose.pipeline.evaluate import Evaluation
    from rfpose.pipeline.formats.result import Result
    from rfpose.pipeline.pictures.track_view import TrackPicture
    from rfpose.recording import Recording

__all__ = ["FIGURES", "FigureChoice", "OpenedFile", "draw", "opened_file"]


@dataclass(frozen=True, slots=True, kw_only=True)
class FigureChoice:
    """What a figure shows; None: as the figure has it by itself.

    Attributes
    ----------
    frame
        Of a result or recording, or instant of a run, from 0.
    heliostat, receiver, method
        By name.
    colour
        One of `rfpose.pipeline.pictures.results.COLOURS`.
    """

    frame: int | None = None
    heliostat: str | None = None
    receiver: str | None = None
    method: str | None = None
    colour: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class OpenedFile:
    """A file that figures are drawn of: of one kind, with the site that belongs to it."""

    path: Path
    kind: str
    scenario: Scenario | None
    result: Result | None = None
    evaluation: Evaluation | None = None
    track: TrackPicture | None = None
    recording: Recording | None = None

    @property
    def heliostat_ids(self) -> tuple[str, ...]:
        """Mirrors that can be chosen."""
        if self.track is not None:
            return self.track.ids
        return () if self.scenario is None else self.scenario.heliostat_ids


@contextlib.contextmanager
def opened_file(
    path: str | Path,
    *,
    truth: str | Path | None = None,
    scenario: str | Path | None = None,
    follow_links: bool = False,
) -> Iterator[OpenedFile]:
    """Open a result, tracking run, recording or scenario for the block.

    Parameters
    ----------
    truth
        Of a result, as for `rfpose.evaluate`; None: what the result carries.
    scenario
        Site of a recording that brings none.
    follow_links
        As for `rfpose.recording.open_recording`.

    Raises
    ------
    RfposeError
        Missing, damaged, or no such file; a truth that cannot be compared.
    """
    path = Path(path)
    kind = kind_of(path)
    if kind == "result":
        from rfpose.pipeline.formats.result_file import open_result

        result = open_result(path)
        yield OpenedFile(
            path=path, kind=kind, scenario=result.scenario, result=result,
            evaluation=_evaluation(result, truth, follow_links=follow_links),
        )  # fmt: skip
    elif kind == "track":
        from rfpose.pipeline.formats.track_file import open_track
        from rfpose.pipeline.pictures.track_view import picture_of_track, site_of_run

        picture = picture_of_track(open_track(path))
        yield OpenedFile(path=path, kind=kind, scenario=site_of_run(picture.track), track=picture)
    elif kind == "scenario" or (kind is None and path.suffix == ".toml"):
        yield OpenedFile(path=path, kind="scenario", scenario=load_scenario(path))
    else:
        from rfpose.recording import open_recording

        given = None if scenario is None else load_scenario(scenario)
        with open_recording(path, scenario=given, follow_links=follow_links) as recording:
            yield OpenedFile(path=path, kind="recording", scenario=recording.scenario, recording=recording)


def _evaluation(result: Result, truth: str | Path | None, *, follow_links: bool) -> Evaluation | None:
    from rfpose.pipeline.evaluate import evaluate

    if truth is not None:
        return evaluate(result, truth, follow_links=follow_links)
    try:
        return evaluate(result)
    except RfposeError:  # no truth, or one that cannot be compared
        return None


def draw(file: OpenedFile, what: str | None = None, choice: FigureChoice | None = None) -> Figure:
    """Draw a figure of a file, by default the first that there is of its kind.

    Raises
    ------
    InvalidInputError
        There is no such figure of this kind of file, or it cannot show what is chosen.
    """
    choice = choice or FigureChoice()
    known = FIGURES[file.kind]
    name = what or next(iter(known))
    if name not in known:
        raise InvalidInputError(f"`what` must be one of {', '.join(known)} for a {file.kind}, got {name!r}")
    takes, drawer = known[name]
    for each in fields(choice):
        if getattr(choice, each.name) is not None and each.name not in takes:
            raise InvalidInputError(f"`{each.name}` says nothing of figure {name}; leave it out")
    return drawer(file, choice)


def _heliostat(file: OpenedFile, choice: FigureChoice) -> int | None:
    if choice.heliostat is None:
        return None
    ids = file.heliostat_ids
    if choice.heliostat not in ids:
        known = ", ".join(ids[:8]) + (", …" if len(ids) > 8 else "")
        raise InvalidInputError(f"there is no heliostat `{choice.heliostat}`; choose one of {known}")
    return ids.index(choice.heliostat)


def _map(file: OpenedFile, choice: FigureChoice) -> Figure:
    from rfpose.pipeline.pictures.results import draw_field_map

    assert file.result is not None
    colour: Any = choice.colour
    return draw_field_map(
        file.result, evaluation=file.evaluation, frame=choice.frame, colour=colour, heliostat=_heliostat(file, choice)
    )


def _errors(file: OpenedFile, _: FigureChoice) -> Figure:
    from rfpose.pipeline.pictures.results import draw_errors

    assert file.result is not None
    return draw_errors(file.result, evaluation=file.evaluation)


def _links(file: OpenedFile, _: FigureChoice) -> Figure:
    from rfpose.pipeline.pictures.results import draw_links

    assert file.result is not None
    return draw_links(file.result)


def _mirror(file: OpenedFile, choice: FigureChoice) -> Figure:
    from rfpose.pipeline.pictures.results import draw_mirror

    assert file.result is not None
    return draw_mirror(file.result, _heliostat(file, choice) or 0, frame=choice.frame)


def _budget(file: OpenedFile, _: FigureChoice) -> Figure:
    from rfpose.pipeline.layout import budget

    assert file.scenario is not None
    pose = "rigid" if file.result is None else file.result.choice.pose
    if pose == "site":
        raise InvalidInputError("pose `site` has no error budget; draw `map` or `errors`")
    return budget(file.scenario, pose=pose, n_draw=0).plot()


def _layout(file: OpenedFile, _: FigureChoice) -> Figure:
    from rfpose.pipeline.layout import layout_map

    if file.scenario is None:
        raise InvalidInputError(f"{file.path}: brings no scenario; give `scenario=FILE`")
    return layout_map(file.scenario, estimators=[_estimator(file.result)]).plot()


def _estimator(result: Result | None) -> str:
    """Return the estimator of `rfpose layout map` that a result was made with."""
    if result is None:
        return "scenario"
    if result.choice.pose == "rigid":
        return "reflection" if result.choice.reflection == "estimate" else "scenario"
    return result.choice.pose


def _course(file: OpenedFile, _: FigureChoice) -> Figure:
    assert file.track is not None
    return file.track.track.plot()


def _methods(file: OpenedFile, _: FigureChoice) -> Figure:
    from rfpose.pipeline.pictures.tracking import draw_methods

    assert file.track is not None
    return draw_methods(file.track.track)


def _instant(file: OpenedFile, choice: FigureChoice) -> Figure:
    from rfpose.pipeline.pictures.tracking import draw_instant

    assert file.track is not None
    return draw_instant(file.track, method=choice.method, instant=choice.frame, chosen=_heliostat(file, choice))


def _mirror_course(file: OpenedFile, choice: FigureChoice) -> Figure:
    from rfpose.pipeline.pictures.tracking import draw_mirror_course

    assert file.track is not None
    return draw_mirror_course(file.track, _heliostat(file, choice) or 0)


def _spectrum(file: OpenedFile, choice: FigureChoice) -> Figure:
    from rfpose.pipeline.pictures.recordings import draw_band

    assert file.recording is not None
    return draw_band(file.recording, receiver_id=choice.receiver, frame=choice.frame or 0)


def _waterfall(file: OpenedFile, choice: FigureChoice) -> Figure:
    from rfpose.pipeline.pictures.recordings import draw_waterfall

    assert file.recording is not None
    return draw_waterfall(file.recording, receiver_id=choice.receiver)


_Drawer = Callable[[OpenedFile, FigureChoice], "Figure"]

FIGURES: Mapping[str, Mapping[str, tuple[tuple[str, ...], _Drawer]]] = {
    "result": {
        "map": (("frame", "heliostat", "colour"), _map),
        "errors": ((), _errors),
        "links": ((), _links),
        "mirror": (("frame", "heliostat"), _mirror),
        "budget": ((), _budget),
        "layout": ((), _layout),
    },
    "track": {
        "course": ((), _course),
        "methods": ((), _methods),
        "instant": (("frame", "heliostat", "method"), _instant),
        "mirror": (("heliostat",), _mirror_course),
        "layout": ((), _layout),
    },
    "recording": {
        "spectrum": (("frame", "receiver"), _spectrum),
        "waterfall": (("receiver",), _waterfall),
        "layout": ((), _layout),
    },
    "scenario": {"layout": ((), _layout), "budget": ((), _budget)},
}
"""By kind of file and name: what of a `FigureChoice` a figure takes, and what draws it."""
