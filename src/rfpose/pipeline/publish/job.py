"""A result's poses to the plant, by what the plant has."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import overload

from rfpose.pipeline.formats.live_result import ResultFollower
from rfpose.pipeline.formats.result import Result
from rfpose.pipeline.formats.result_file import open_result
from rfpose.pipeline.publish.broker import Broker, SentMessages, send
from rfpose.pipeline.publish.messages import messages, messages_as_they_come
from rfpose.pipeline.publish.server import PlantServer, serve, serve_as_they_come

__all__ = ["publish"]


@overload
def publish(
    result: Result | ResultFollower | str | Path,
    to: Broker,
    *,
    on_progress: Callable[[int, int], None] | None = None,
) -> SentMessages: ...


@overload
def publish(
    result: Result | ResultFollower | str | Path,
    to: PlantServer,
    *,
    on_ready: Callable[[str], None] | None = None,
) -> None: ...


def publish(
    result: Result | ResultFollower | str | Path,
    to: Broker | PlantServer,
    *,
    on_progress: Callable[[int, int], None] | None = None,
    on_ready: Callable[[str], None] | None = None,
) -> SentMessages | None:
    """Hand a result's poses to the plant: every frame's to an MQTT broker, or the last one's from an OPC UA server.

    Parameters
    ----------
    result
        In memory, or its file; or a `ResultFollower` of one that is being made, whose frames are handed on as they
        come, until it is complete.
    to
        A broker, which this waits for until it has all messages; or a server, which this is until interrupted.
    on_progress
        With a broker and a result that is complete: called with (messages handed over, in all).
    on_ready
        With a server: called with its address when clients can come.

    Returns
    -------
    SentMessages or None
        What became of the messages; None: it was a server.

    Raises
    ------
    PublishError
        The extra is missing, nobody answers, the broker refuses, a certificate is not to be trusted, or the server
        cannot listen.
    RecordingError
        The file is missing, or no result.
    InvalidInputError
        A heliostat whose name cannot stand in a topic.

    Examples
    --------
    >>> import rfpose as rf
    >>> from rfpose.pipeline.publish import Broker
    >>> broker = Broker(url="mqtts://broker.plant", prefix="plant/field")
    >>> rf.publish("result.h5", broker)  # doctest: +SKIP
    SentMessages(acknowledged=601, dropped=0, unacknowledged=0, reconnections=0)
    """
    found = result if isinstance(result, Result | ResultFollower) else open_result(result)
    if isinstance(to, PlantServer):
        if isinstance(found, Result):
            serve(found, to, on_ready=on_ready)
        else:
            serve_as_they_come(found, to, on_ready=on_ready)
        return None
    if isinstance(found, Result):
        return send(messages(found), to, on_progress=on_progress, n_message=found.poses.status.size)
    return send(messages_as_they_come(found), to)
