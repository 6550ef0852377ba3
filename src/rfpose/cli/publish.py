"""``rfpose publish``: poses for the plant, by MQTT or OPC UA."""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click

from rfpose.cli._support import (
    CommonOptions,
    check_there,
    common_options,
    emit_json,
    examples,
    gathered,
    progress,
    say,
    wants_json,
)
from rfpose.errors import InvalidInputError, PublishError

if TYPE_CHECKING:
    from rfpose.pipeline.formats.live_result import ResultFollower
    from rfpose.pipeline.publish import PlantServer

__all__ = ["PASSWORD_VARIABLE", "command"]

PASSWORD_VARIABLE = "RFPOSE_PASSWORD"


@dataclass(frozen=True, slots=True, kw_only=True)
class _Keys:
    """By what the two ends know each other."""

    ca: Path | None
    certificate: Path | None
    key: Path | None


@dataclass(frozen=True, slots=True, kw_only=True)
class _ToBroker:
    """What goes with MQTT alone."""

    prefix: str
    buffer: int
    patience_s: float


@click.command(
    name="publish",
    epilog=examples(
        "rfpose publish result.h5 --mqtt mqtts://broker.plant --user rfpose --password-file secret",
        "rfpose publish result.h5 --mqtt mqtt://localhost --prefix plant/field",
        "rfpose publish result.h5 --opcua opc.tcp://0.0.0.0:4840 --certificate cert.pem --key key.pem --user scada",
        "rfpose publish result.h5 --opcua opc.tcp://127.0.0.1:4840 --anonymous",
        "rfpose publish result.h5 --follow --mqtt mqtt://localhost",
    ),
)
@click.argument("result", type=click.Path(path_type=Path))
@click.option(
    "--mqtt", metavar="URL", help="Send to this broker: mqtt://HOST[:PORT], or encrypted mqtts://HOST[:PORT]."
)
@click.option("--opcua", metavar="URL", help="Be an OPC UA server there until interrupted: opc.tcp://HOST:PORT.")
@click.option("--follow", is_flag=True, help="RESULT is being made by `rfpose process --follow`: hand on each frame.")
@click.option("--new", "only_new", is_flag=True, help="With --follow: leave out the frames that are there already.")
@click.option("--prefix", default="rfpose", show_default=True, help="Of MQTT topics: PREFIX/pose/HELIOSTAT.")
@click.option("--user", help="Who we are for the broker; whom the server lets in.")
@click.option(
    "--password-file",
    type=click.Path(path_type=Path),
    help=f"Holds the password in its first line. [default: the variable {PASSWORD_VARIABLE}]",
)
@click.option("--ca", type=click.Path(path_type=Path), help="PEM: who signed the broker's certificate.")
@click.option("--certificate", type=click.Path(path_type=Path), help="PEM: the server's, or ours for the broker.")
@click.option("--key", type=click.Path(path_type=Path), help="PEM: the key of --certificate.")
@click.option("--anonymous", is_flag=True, help="OPC UA for everybody, unencrypted.")
@click.option("--buffer", type=click.IntRange(1, 60_000), default=10_000, show_default=True,
              help="Messages kept while the broker is away.")  # fmt: skip
@click.option("--patience", "patience_s", type=click.FloatRange(min=0.0, min_open=True), default=60.0,
              show_default=True, help="Wait so long for a broker that is away [s], then drop.")  # fmt: skip
@common_options
@gathered("keys", _Keys)
@gathered("to_broker", _ToBroker)
@click.pass_obj
def command(
    session: CommonOptions,
    result: Path,
    mqtt: str | None,
    opcua: str | None,
    follow: bool,
    only_new: bool,
    user: str | None,
    password_file: Path | None,
    anonymous: bool,
    keys: _Keys,
    to_broker: _ToBroker,
) -> None:
    """Hand the poses of RESULT to the plant.

    By MQTT every frame's poses, QoS 1, as JSON whose schema is in PREFIX/schema; the command ends when the broker has
    all of them. By OPC UA the last frame's, until interrupted. With --follow RESULT may still be made: frames are
    handed on as they come, until it is complete.
    """
    if (mqtt is None) == (opcua is None):
        raise click.UsageError("give one of --mqtt and --opcua")
    # what the library calls by one name
    session.options = dict(session.options, url=session.options["opcua" if mqtt is None else "mqtt"])
    if only_new and not follow:
        raise click.UsageError("--new goes with --follow")
    check_there(None if follow else result, password_file, keys.ca, keys.certificate, keys.key)
    password = _password(password_file) if user is not None else None
    if opcua is not None:
        session.when_interrupted = "interrupted; the server has ended"
        if keys.ca is not None:
            raise click.UsageError("--ca goes with --mqtt")
        from rfpose.pipeline.publish import PlantServer

        to = PlantServer(
            url=opcua,
            certificate=keys.certificate,
            key=keys.key,
            user=user,
            password=password,
            anonymous=anonymous,
        )
        _serve(result, to, follower=_follower(result, only_new=only_new) if follow else None)
        return
    if anonymous:
        raise click.UsageError("--anonymous goes with --opcua")
    session.when_interrupted = "interrupted; part of the messages may have been sent"
    from rfpose.pipeline.publish import Broker, publish

    broker = Broker(url=str(mqtt), user=user, password=password, **asdict(keys), **asdict(to_broker))
    if follow:
        sent = publish(_follower(result, only_new=only_new), broker)
    else:
        with progress("Sending") as on_progress:
            sent = publish(result, broker, on_progress=on_progress)
    told = {
        "broker": mqtt,
        "acknowledged": sent.acknowledged,
        "dropped": sent.dropped,
        "unacknowledged": sent.unacknowledged,
        "reconnections": sent.reconnections,
    }
    if sent.dropped or sent.unacknowledged:
        raise PublishError(
            f"{mqtt}: {sent.dropped} messages dropped, {sent.unacknowledged} never acknowledged, {sent.acknowledged} "
            "arrived; send again when the broker is back"
        )
    if wants_json():
        emit_json(told)
        return
    say(f"{mqtt}: {sent.acknowledged} messages arrived, the schema among them")


def _follower(result: Path, *, only_new: bool) -> ResultFollower:
    """Return who sees the frames of a result as they come."""
    from rfpose.kinds import is_live
    from rfpose.pipeline.formats.journal import partial_of
    from rfpose.pipeline.formats.live_result import ResultFollower

    if not result.exists() and not is_live(partial_of(result)):
        click.echo(f"rfpose: note: {result}: not begun yet; waiting for its first frame", err=True)
    return ResultFollower(result, first_frame=None if only_new else 0)


def _serve(result: Path, to: PlantServer, *, follower: ResultFollower | None) -> None:
    from rfpose.pipeline.publish import publish

    def on_ready(address: str) -> None:
        if wants_json():
            emit_json({"server": address, "result": result})
        else:
            say(f"{address}: serving the last frame of {result}; Ctrl-C ends it")

    publish(result if follower is None else follower, to, on_ready=on_ready)


def _password(file: Path | None) -> str:
    """Return it from a file or the environment; on a command line others would see it."""
    if file is not None:
        from rfpose.foreign import read_text

        lines = read_text(file, limit=2**16).splitlines()
        password = lines[0] if lines else ""
    else:
        password = os.environ.get(PASSWORD_VARIABLE, "")
    if not password:
        raise InvalidInputError(f"`user` needs a password: give `password_file=FILE`, or set {PASSWORD_VARIABLE}")
    return password
