"""Poses to an MQTT broker: QoS 1, nothing lost within a stated buffer while the broker is away, and losses counted."""

from __future__ import annotations

import contextlib
import json
import logging
import ssl
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import SplitResult

from rfpose.errors import InvalidInputError, PublishError, install_remedy
from rfpose.pipeline.publish.address import address_of
from rfpose.pipeline.publish.messages import SCHEMA

__all__ = ["Broker", "SentMessages", "send"]

_log = logging.getLogger(__name__)

_PORTS = {"mqtt": 1883, "mqtts": 8883}
_ANSWER_S = 15.0
"""How long a broker may take to accept or refuse."""
_LOOK_S = 0.02
_LONGEST_WAIT_S = 5
"""Most seconds between two attempts to reach a broker that is gone."""
_MOST_KEPT = 60_000
"""MQTT numbers messages with 16 bits."""
_AT_ONCE = 100
"""Messages on their way before the first of them is acknowledged."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Broker:
    """Where poses go.

    Attributes
    ----------
    url
        ``mqtt://host`` or, encrypted, ``mqtts://host``, with ``:port`` if it is not 1883 or 8883.
    prefix
        Begins the topics: ``PREFIX/pose/HELIOSTAT``, and ``PREFIX/schema``, which is retained.
    user, password
        None: the broker is not told who it is.
    ca
        PEM file of who signed the broker's certificate; None: who the system trusts.
    certificate, key
        PEM files by which the broker knows this client.
    buffer
        Messages kept while the broker is away.
    patience_s
        How long to wait for the broker, with a full buffer and at the end, before messages are given up [s].

    Raises
    ------
    InvalidInputError
        Another kind of address, a prefix with a wildcard, a password that would go over the network unencrypted, or
        numbers that are not greater than zero.
    """

    url: str
    prefix: str = "rfpose"
    user: str | None = None
    password: str | None = None
    ca: Path | None = None
    certificate: Path | None = None
    key: Path | None = None
    buffer: int = 10_000
    patience_s: float = 60.0

    def __post_init__(self) -> None:
        if self._parts.username is not None or self._parts.password is not None:
            raise InvalidInputError(
                "`url` must hold no password, which others could read; give `user=` and a file of it"
            )
        if _is_wild(self.prefix) or not self.prefix:
            raise InvalidInputError(f"`prefix` must be the beginning of a topic, without + and #, got {self.prefix!r}")
        if self.password is not None and not self.is_encrypted and not _is_loopback(self.host):
            raise InvalidInputError(
                f"`url` must begin with mqtts:// where a password goes over a network, got {self.url!r}"
            )
        if not 1 <= self.buffer <= _MOST_KEPT or self.patience_s <= 0.0:
            raise InvalidInputError(
                f"`buffer` must be from 1 to {_MOST_KEPT} messages, and `patience_s` greater than zero"
            )

    @property
    def _parts(self) -> SplitResult:
        return address_of(self.url, _PORTS, "mqtt://HOST[:PORT] or mqtts://HOST[:PORT]")

    @property
    def host(self) -> str:
        """Name or address."""
        return str(self._parts.hostname)

    @property
    def port(self) -> int:
        """Number of its port."""
        return int(self._parts.port or _PORTS[self._parts.scheme])

    @property
    def is_encrypted(self) -> bool:
        """Whether TLS is spoken."""
        return bool(self._parts.scheme == "mqtts")


@dataclass(frozen=True, slots=True, kw_only=True)
class SentMessages:
    """What became of messages.

    Attributes
    ----------
    acknowledged
        The broker has them.
    dropped
        Given up because the buffer was full for longer than the broker's ``patience_s``.
    unacknowledged
        Still on their way when the patience with the broker was over.
    reconnections
        Times that the broker was gone and back.
    """

    acknowledged: int
    dropped: int
    unacknowledged: int
    reconnections: int


def send(
    messages: Iterable[Mapping[str, Any]],
    broker: Broker,
    *,
    on_progress: Callable[[int, int], None] | None = None,
    n_message: int = 0,
) -> SentMessages:
    """Send messages to a broker, in their order, and wait until it has them.

    Parameters
    ----------
    messages
        As of `rfpose.pipeline.publish.messages`.
    broker
        Where to.
    on_progress
        Called with (messages handed over, ``n_message``).
    n_message
        How many there will be.

    Raises
    ------
    PublishError
        The extra is missing, nobody answers, the broker refuses, or its certificate is not to be trusted.
    InvalidInputError
        A heliostat whose name cannot stand in a topic.
    """
    with _connected(broker) as line:
        line.put(f"{broker.prefix}/schema", SCHEMA, retain=True)
        for k, message in enumerate(messages):
            name = str(message["heliostat"])
            if _is_wild(name) or "/" in name:
                raise InvalidInputError(f"heliostat {name!r} cannot stand in a topic of MQTT; rename it without + # /")
            line.put(f"{broker.prefix}/pose/{name}", message)
            if on_progress is not None:
                on_progress(k + 1, n_message)
        return line.finished()


class _Line:
    """A connection that comes back by itself, and what is on its way."""

    def __init__(self, client: Any, broker: Broker) -> None:
        self._client, self._broker = client, broker
        self._lock = threading.Lock()
        self._on_their_way: set[int] = set()
        self._early: set[int] = set()
        """Acknowledged before this thread knew their number."""
        self._acknowledged = self._dropped = 0
        self._is_full = False
        self.connections = 0
        self.refusal: str | None = None
        self.answered = threading.Event()
        client.on_connect, client.on_publish = self._on_connect, self._on_publish

    def _on_connect(self, _client: Any, _data: Any, _flags: Any, reason: Any, _properties: Any) -> None:
        self.refusal = str(reason) if reason.is_failure else None
        self.connections += not reason.is_failure
        self.answered.set()

    def _on_publish(self, _client: Any, _data: Any, number: int, _reason: Any, _properties: Any) -> None:
        with self._lock:
            if number in self._on_their_way:
                self._on_their_way.remove(number)
                self._acknowledged += 1
            else:
                self._early.add(number)

    def put(self, topic: str, message: Mapping[str, Any], *, retain: bool = False) -> None:
        """Hand a message over; with a full buffer, wait for the broker once, and drop messages until it is back."""
        if not self._has_room() and not self._is_full:
            self._is_full = not self._wait_for(self._has_room)
            if self._is_full:
                _log.warning("%s: is away and %d messages wait; dropping more", self._broker.url, self._broker.buffer)
        if not self._has_room():
            self._dropped += 1
            return
        self._is_full = False
        told = self._client.publish(topic, json.dumps(message, allow_nan=False), qos=1, retain=retain)
        with self._lock:
            if told.mid in self._early:
                self._early.remove(told.mid)
                self._acknowledged += 1
            else:
                self._on_their_way.add(told.mid)

    def finished(self) -> SentMessages:
        """Wait until the broker has all, or patience is over."""
        self._wait_for(lambda: not self._on_their_way)
        with self._lock:
            return SentMessages(
                acknowledged=self._acknowledged,
                dropped=self._dropped,
                unacknowledged=len(self._on_their_way),
                reconnections=max(0, self.connections - 1),
            )

    def _has_room(self) -> bool:
        return len(self._on_their_way) < self._broker.buffer

    def _wait_for(self, wanted: Callable[[], bool]) -> bool:
        """Wait for the broker; what it acknowledges renews the patience with it."""
        seen, since = self._acknowledged, time.monotonic()
        while not wanted():
            self.refuse()
            if self._acknowledged != seen:
                seen, since = self._acknowledged, time.monotonic()
            elif time.monotonic() - since > self._broker.patience_s:
                return False
            time.sleep(_LOOK_S)
        return True

    def refuse(self) -> None:
        """Raise if the broker has refused."""
        if self.refusal is not None:
            raise PublishError(
                f"{self._broker.url}: the broker refuses: {self.refusal}; check user, password and the client's "
                "certificate"
            )


@contextlib.contextmanager
def _connected(broker: Broker) -> Iterator[_Line]:
    try:
        from paho.mqtt import client as mqtt
        from paho.mqtt.enums import CallbackAPIVersion
    except ImportError as error:
        raise PublishError(f"MQTT needs paho-mqtt; {install_remedy('publish')}") from error
    client = mqtt.Client(CallbackAPIVersion.VERSION2)
    if broker.user is not None:
        client.username_pw_set(broker.user, broker.password)
    if broker.is_encrypted:
        client.tls_set_context(_tls(broker))
    client.max_inflight_messages_set(_AT_ONCE)
    client.max_queued_messages_set(0)  # the buffer is counted here, with what is on its way
    client.reconnect_delay_set(1, _LONGEST_WAIT_S)
    line = _Line(client, broker)
    try:
        client.connect(broker.host, broker.port, keepalive=15)
    except ssl.SSLCertVerificationError as error:
        raise PublishError(
            f"{broker.url}: the broker's certificate is not to be trusted: {error.verify_message}; give `ca=FILE` for "
            "one of its own, or have it renewed"
        ) from error
    except OSError as error:
        raise PublishError(f"{broker.url}: no broker answers there ({error}); check the address") from error
    client.loop_start()
    try:
        if not line.answered.wait(_ANSWER_S):
            raise PublishError(f"{broker.url}: answers, but not as an MQTT broker; check the port, and mqtt or mqtts")
        line.refuse()
        yield line
    finally:
        client.disconnect()
        client.loop_stop()


def _tls(broker: Broker) -> ssl.SSLContext:
    try:
        context = ssl.create_default_context(cafile=broker.ca)
        if broker.certificate is not None:
            context.load_cert_chain(broker.certificate, broker.key)
    except (OSError, ssl.SSLError) as error:
        named = ", ".join(str(path) for path in (broker.ca, broker.certificate, broker.key) if path is not None)
        raise PublishError(f"{named}: no certificate or key that can be read ({error}); give PEM files") from error
    return context


def _is_wild(topic: str) -> bool:
    return any(letter in topic for letter in "+#\0")


def _is_loopback(host: str) -> bool:
    return host in ("localhost", "::1") or host.startswith("127.")
