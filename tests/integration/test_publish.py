"""Poses to the plant: through a real broker, and to a real OPC UA client."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import shutil
import socket
import subprocess
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

import rfpose as rf
from rfpose.cli._app import app
from rfpose.errors import InvalidInputError, PublishError
from rfpose.multilat import PoseStatus
from rfpose.pipeline.formats.journal import partial_of
from rfpose.pipeline.formats.live_result import LiveResult
from rfpose.pipeline.formats.result import Result
from rfpose.pipeline.formats.result_file import columns_of, result_of
from rfpose.pipeline.publish import SCHEMA, Broker, PlantServer, SentMessages, messages, send, serving

BROKER = shutil.which("mosquitto") or shutil.which("mosquitto", path="/usr/sbin:/usr/local/sbin")
needs_broker = pytest.mark.skipif(BROKER is None, reason="needs the broker mosquitto (Debian: apt install mosquitto)")
SECRET = "open sesame"


@pytest.fixture(scope="module")
def result() -> Result:
    """Two mirrors, three frames; of one, one frame is not solved."""
    site = rf.load_scenario(rf.shipped_scenario("table2_100m.toml"))
    short = site.changed(heliostat=site.heliostat[:2], radio={"frame_samples": 40_000}, simulation={"frame_count": 3})
    found = rf.process(rf.simulate(short, seed=1))
    poses = {name: getattr(found.poses, name).copy() for name in found.poses.__dataclass_fields__}
    for name in ("normal_enu", "azimuth_rad", "elevation_rad", "sigma_rad"):
        poses[name][2, 1] = np.nan
    poses["status"][2, 1] = PoseStatus.COLLINEAR
    assert found.integrity is not None
    level = found.integrity.protection_level_rad.copy()
    level[2, 1], level[1, 0] = np.nan, np.inf
    return replace(
        found, poses=replace(found.poses, **poses), integrity=replace(found.integrity, protection_level_rad=level)
    )


def _free_port() -> int:
    """Return one below those that systems give to connections, so that nobody has it while a broker is away."""
    for port in np.random.default_rng().integers(15_000, 32_000, 100).tolist():
        with socket.socket() as free, contextlib.suppress(OSError):
            free.bind(("127.0.0.1", port))
            return int(port)
    raise AssertionError("no port is free")


def _certificate(folder: Path, name: str, *, days: int = 1) -> tuple[Path, Path]:
    """Make a certificate for 127.0.0.1, signed by itself; with negative ``days`` it has run out."""
    x509 = pytest.importorskip("cryptography.x509", reason="needs the extra `publish`")
    import ipaddress

    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import rsa

    key = rsa.generate_private_key(public_exponent=65537, key_size=2048)
    named = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, name)])
    others = [
        x509.UniformResourceIdentifier("urn:rfpose:poses:server"),
        x509.IPAddress(ipaddress.ip_address("127.0.0.1")),
    ]
    now = datetime.now(UTC)
    made = (
        x509.CertificateBuilder()
        .subject_name(named)
        .issuer_name(named)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - timedelta(days=30))
        .not_valid_after(now + timedelta(days=days))
        .add_extension(x509.SubjectAlternativeName(others), critical=False)
        .add_extension(x509.BasicConstraints(ca=True, path_length=None), critical=True)
        .sign(key, hashes.SHA256())
    )
    paths = folder / f"{name}.pem", folder / f"{name}-key.pem"
    paths[0].write_bytes(made.public_bytes(serialization.Encoding.PEM))
    paths[1].write_bytes(
        key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    )
    return paths


# -- messages ------------------------------------------------------------------------------------------------


def test_messages_say_what_the_result_says_and_why_a_number_is_missing(result: Result) -> None:
    told = list(messages(result))
    assert [(m["frame"], m["heliostat"]) for m in told] == [(f, h) for f in range(3) for h in ("H01", "H02")]
    for m in told:
        json.dumps(m, allow_nan=False)
        assert set(m) == set(SCHEMA["properties"]) == set(SCHEMA["required"])
        assert {key for key, value in m.items() if value is None} == set(m["why_null"])
    first, unprotected, failed = told[0], told[2], told[5]
    assert first["status"] == "solved"
    np.testing.assert_array_equal(first["normal_enu"], result.poses.normal_enu[0, 0])
    assert first["sigma_mrad"] == pytest.approx(1e3 * result.poses.sigma_rad[0, 0])
    azimuth, elevation = np.radians([first["azimuth_deg"], first["elevation_deg"]])
    pointing = [np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), np.sin(elevation)]
    np.testing.assert_allclose(first["normal_enu"], pointing, atol=1e-12)
    assert unprotected["why_null"] == {"protection_level_mrad": "nothing protects the pose"}
    assert failed["status"] == PoseStatus.COLLINEAR.reason
    assert failed["normal_enu"] is None
    assert failed["why_null"]["sigma_mrad"] == PoseStatus.COLLINEAR.reason
    assert [m["frame"] for m in messages(result, 2)] == [2, 2]


# -- MQTT ----------------------------------------------------------------------------------------------------


class _Mosquitto:
    """A broker on the loopback, which keeps what its clients have not got when it is stopped."""

    def __init__(self, folder: Path, *lines: str) -> None:
        self.port = _free_port()
        self._config = folder / "mosquitto.conf"
        self._config.write_text(
            "\n".join(
                [
                    f"listener {self.port} 127.0.0.1",
                    "persistence true",
                    f"persistence_location {folder}/",
                    "user root" if os.geteuid() == 0 else "",
                    "max_queued_messages 0",
                    *lines,
                    "",
                ]
            )
        )
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        for _ in range(100):
            if self._process is None or self._process.poll() is not None:  # the port was not free yet
                self._process = subprocess.Popen([str(BROKER), "-c", self._config], stderr=subprocess.DEVNULL)
            with socket.socket() as asked:
                if not asked.connect_ex(("127.0.0.1", self.port)):
                    return
            time.sleep(0.05)
        raise AssertionError("the broker does not start")

    def stop(self) -> None:
        if self._process is not None:
            self._process.terminate()
            self._process.wait()
            self._process = None


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[_Mosquitto]:
    made = _Mosquitto(tmp_path, "allow_anonymous true")
    made.start()
    yield made
    made.stop()


class _Listener:
    """A client whose session the broker keeps."""

    def __init__(self, port: int) -> None:
        mqtt = pytest.importorskip("paho.mqtt.client", reason="needs the extra `publish`")
        self.heard: list[tuple[str, dict[str, Any], bool]] = []
        self._client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2, client_id="plant", clean_session=False)
        subscribed = threading.Event()
        self._client.on_connect = lambda client, *_: client.subscribe("#", qos=1)
        self._client.on_subscribe = lambda *_: subscribed.set()
        self._client.on_message = self._on_message
        self._client.reconnect_delay_set(1, 1)
        self._client.connect("127.0.0.1", port)
        self._client.loop_start()
        assert subscribed.wait(10)

    def _on_message(self, _client: Any, _data: Any, message: Any) -> None:
        self.heard.append((message.topic, json.loads(message.payload), message.qos == 1))

    def wait_for(self, wanted: int) -> None:
        for _ in range(200):
            if len({json.dumps(m) for _, m, _ in self.heard}) >= wanted:
                return
            time.sleep(0.05)

    def close(self) -> None:
        self._client.disconnect()
        self._client.loop_stop()


@needs_broker
def test_a_broker_gets_every_pose_and_the_schema(result: Result, broker: _Mosquitto, tmp_path: Path) -> None:
    listener = _Listener(broker.port)
    result.save(tmp_path / "r.h5")
    words = ["publish", str(tmp_path / "r.h5"), "--mqtt", f"mqtt://127.0.0.1:{broker.port}", "--prefix", "a/b"]
    done = CliRunner().invoke(app, [*words, "--json"])
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)
    assert list(told) == ["broker", "acknowledged", "dropped", "unacknowledged", "reconnections"]
    assert list(told.values()) == [words[3], 7, 0, 0, 0]
    listener.wait_for(7)
    listener.close()
    assert [m for topic, m, _ in listener.heard if topic == "a/b/schema"] == [SCHEMA]
    assert [m for topic, m, _ in listener.heard if topic == "a/b/pose/H02"] == list(messages(result))[1::2]
    assert all(once for _, _, once in listener.heard)
    url = f"mqtt://127.0.0.1:{broker.port}"
    for given in (result, tmp_path / "r.h5"):
        assert rf.publish(given, Broker(url=url)) == SentMessages(
            acknowledged=7, dropped=0, unacknowledged=0, reconnections=0
        )


@needs_broker
def test_a_broker_that_is_gone_and_back_misses_nothing_within_the_buffer(result: Result, broker: _Mosquitto) -> None:
    listener = _Listener(broker.port)
    wanted = list(messages(result)) * 4
    told = [{**m, "frame": k} for k, m in enumerate(wanted)]

    def interrupted() -> Iterator[dict[str, Any]]:
        for k, m in enumerate(told):
            if k == 6:
                broker.stop()
            if k == 20:
                threading.Timer(0.5, broker.start).start()
            yield m

    sent = send(interrupted(), Broker(url=f"mqtt://127.0.0.1:{broker.port}", buffer=100, patience_s=30.0))
    listener.wait_for(len(told) + 1)
    listener.close()
    assert (sent.acknowledged, sent.dropped, sent.unacknowledged) == (len(told) + 1, 0, 0)
    assert sent.reconnections == 1
    assert {m["frame"] for topic, m, _ in listener.heard if "/pose/" in topic} == set(range(len(told)))


@needs_broker
def test_who_follows_a_result_loses_nothing_while_the_broker_is_restarted(
    result: Result, broker: _Mosquitto, tmp_path: Path
) -> None:
    output = tmp_path / "r.h5"
    listener = _Listener(broker.port)
    live = LiveResult(partial_of(output), result.scenario, result.settings, probe="", restart=False)

    def solve() -> None:
        live.append(_frame(result, 0))
        listener.wait_for(3)  # the schema and two mirrors
        broker.stop()
        live.append(_frame(result, 1))
        time.sleep(0.5)  # it is seen and cannot be sent
        broker.start()
        live.append(_frame(result, 2))
        result.save(output)
        live.remove()

    solving = threading.Thread(target=solve)
    solving.start()
    words = ["publish", str(output), "--follow", "--mqtt", f"mqtt://127.0.0.1:{broker.port}", "--json"]
    done = CliRunner().invoke(app, words)
    solving.join()
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)
    assert [told[name] for name in ("acknowledged", "dropped", "unacknowledged", "reconnections")] == [7, 0, 0, 1]
    listener.wait_for(7)
    listener.close()
    heard = {(m["frame"], m["heliostat"]) for topic, m, _ in listener.heard if "/pose/" in topic}
    assert heard == {(frame, name) for frame in range(3) for name in ("H01", "H02")}


def _frame(result: Result, i: int) -> Result:
    columns = {
        path: values[i : i + 1] if column.dims[0] == "frame" else values
        for path, (column, values) in columns_of(result).items()
        if not path.startswith("truth/")
    }
    return result_of(result.scenario, result.settings, columns)


@needs_broker
def test_what_a_full_buffer_drops_is_counted(result: Result, broker: _Mosquitto) -> None:
    told = list(messages(result)) * 4

    def lost() -> Iterator[dict[str, Any]]:
        for k, m in enumerate(told):
            if k == 6:
                broker.stop()
            yield m

    sent = send(lost(), Broker(url=f"mqtt://127.0.0.1:{broker.port}", buffer=10, patience_s=0.5))
    assert sent.acknowledged + sent.unacknowledged + sent.dropped == len(told) + 1
    assert sent.unacknowledged == 10
    assert sent.dropped >= len(told) - 6 - 10


@needs_broker
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # paho leaves a refused socket open
def test_a_broker_that_refuses_or_is_not_trusted_is_named(result: Result, tmp_path: Path) -> None:
    certificate, key = _certificate(tmp_path, "good")
    users = tmp_path / "users"
    subprocess.run(["mosquitto_passwd", "-b", "-c", users, "rfpose", SECRET], check=True, capture_output=True)
    os.chmod(users, 0o600)
    tls = [f"cafile {certificate}", f"certfile {certificate}", f"keyfile {key}"]
    closed = _Mosquitto(tmp_path, "allow_anonymous false", f"password_file {users}", *tls)
    closed.start()
    url = f"mqtts://127.0.0.1:{closed.port}"
    try:
        known = {"url": url, "ca": certificate, "user": "rfpose"}
        assert send(messages(result), Broker(**known, password=SECRET)).acknowledged == 7
        with pytest.raises(PublishError, match=f"{url}: the broker refuses: Not authorized"):
            send(messages(result), Broker(**known, password="guess"))
        with pytest.raises(PublishError, match=f"{url}: the broker's certificate is not to be trusted: self"):
            send(messages(result), Broker(url=url))
        with pytest.raises(PublishError, match="no certificate or key that can be read"):
            send(messages(result), Broker(url=url, ca=users))
    finally:
        closed.stop()
    old, old_key = _certificate(tmp_path, "old", days=-1)
    expired = _Mosquitto(tmp_path, "allow_anonymous true", f"certfile {old}", f"keyfile {old_key}")
    expired.start()
    try:
        with pytest.raises(PublishError, match="not to be trusted: certificate has expired"):
            send(messages(result), Broker(url=f"mqtts://127.0.0.1:{expired.port}", ca=old))
    finally:
        expired.stop()


def test_nobody_there_is_exit_3_and_one_line(result: Result, tmp_path: Path) -> None:
    pytest.importorskip("paho.mqtt", reason="needs the extra `publish`")
    result.save(tmp_path / "r.h5")
    done = CliRunner().invoke(app, ["publish", str(tmp_path / "r.h5"), "--mqtt", "mqtt://127.0.0.1:9"])
    assert done.exit_code == 3
    assert done.stderr.startswith("rfpose: mqtt://127.0.0.1:9: no broker answers there")
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("settings", "why"),
    [
        ({"url": "http://host"}, "mqtt://HOST"),
        ({"url": "mqtt://host:port"}, "mqtt://HOST"),
        ({"url": "mqtt://[::1"}, "mqtt://HOST"),
        ({"url": "mqtt://me:pw@host"}, "must hold no password"),
        ({"url": "mqtt://host", "prefix": "a/#"}, "without . and #"),
        ({"url": "mqtt://host", "user": "u", "password": "p"}, "must begin with mqtts"),
        ({"url": "mqtt://host", "buffer": 0}, "from 1 to"),
    ],
)
def test_wrong_brokers_are_refused(settings: dict[str, Any], why: str) -> None:
    with pytest.raises(InvalidInputError, match=why):
        Broker(**settings)


@pytest.mark.parametrize("url", ["http://host", "opc.tcp://host:port", "opc.tcp://host:99999", "opc.tcp://"])
def test_wrong_addresses_of_a_server_are_refused(url: str) -> None:
    with pytest.raises(InvalidInputError, match=r"must be opc\.tcp://HOST:PORT/PATH"):
        PlantServer(url=url, anonymous=True)


# -- OPC UA --------------------------------------------------------------------------------------------------


async def _read(client: Any) -> dict[str, Any]:
    async with client:
        space = await client.get_namespace_index("urn:rfpose:poses")
        out = {}
        for name in ("H01", "H02"):
            for variable in ("Normal", "Sigma", "ProtectionLevel", "Status"):
                node = client.get_node(f"ns={space};s={name}.{variable}")
                out[name, variable] = await node.read_data_value(raise_on_bad_status=False)
        unit = client.get_node(f"ns={space};s=H01.Sigma.EngineeringUnits")
        out["unit"] = (await unit.read_value()).DisplayName.Text
        return out


def test_a_client_reads_the_last_frame_with_status_and_time(result: Result) -> None:
    asyncua = pytest.importorskip("asyncua", reason="needs the extra `publish`")
    url = f"opc.tcp://127.0.0.1:{_free_port()}"

    async def ask() -> dict[str, Any]:
        columns = {
            path: values[:1] if c.dims[0] == "frame" else values for path, (c, values) in columns_of(result).items()
        }
        first = result_of(result.scenario, result.settings, columns)
        async with serving(first, PlantServer(url=url, anonymous=True)) as show:
            before = await _read(asyncua.Client(url))
            np.testing.assert_array_equal(before["H02", "Normal"].Value.Value, result.poses.normal_enu[0, 1])
            await show(result)  # as a result that is followed goes on
            return await _read(asyncua.Client(url))

    read = asyncio.run(ask())
    good, bad = read["H01", "Normal"], read["H02", "Normal"]
    np.testing.assert_array_equal(good.Value.Value, result.poses.normal_enu[2, 0])
    assert good.StatusCode.is_good()
    at = datetime.fromisoformat(list(messages(result))[-1]["time_utc"])
    assert {good.SourceTimestamp.replace(tzinfo=UTC), bad.SourceTimestamp.replace(tzinfo=UTC)} == {at}
    assert read["H01", "Sigma"].Value.Value == pytest.approx(1e3 * result.poses.sigma_rad[2, 0])
    assert read["unit"] == "mrad"
    assert bad.Value.Value is None
    assert bad.StatusCode.name == "BadNoData"
    assert read["H02", "Status"].Value.Value == PoseStatus.COLLINEAR.reason


def test_only_the_user_gets_in_and_only_encrypted(result: Result, tmp_path: Path) -> None:
    asyncua = pytest.importorskip("asyncua", reason="needs the extra `publish`")
    from asyncua.crypto.security_policies import SecurityPolicyBasic256Sha256

    certificate, key = _certificate(tmp_path, "server")
    mine, my_key = _certificate(tmp_path, "client")
    url = f"opc.tcp://127.0.0.1:{_free_port()}"
    to = PlantServer(url=url, certificate=certificate, key=key, user="scada", password=SECRET)

    async def ask(*, user: str | None, password: str, secure: bool = True) -> dict[str, Any]:
        client = asyncua.Client(url)
        client.application_uri = "urn:rfpose:poses:server"
        if secure:
            await client.set_security(
                SecurityPolicyBasic256Sha256,
                str(mine),
                str(my_key),
                server_certificate=str(certificate),
            )
        if user is not None:
            client.set_user(user)
            client.set_password(password)
        return await _read(client)

    async def everybody() -> None:
        async with serving(result, to):
            assert (await ask(user="scada", password=SECRET))["H01", "Normal"].StatusCode.is_good()
            for user, password, secure in (("scada", "guess", True), (None, "", True), ("scada", SECRET, False)):
                with pytest.raises((asyncua.ua.UaError, ConnectionError, TimeoutError)):
                    await ask(user=user, password=password, secure=secure)

    asyncio.run(everybody())


def test_a_certificate_that_has_run_out_is_named(result: Result, tmp_path: Path) -> None:
    pytest.importorskip("asyncua", reason="needs the extra `publish`")
    certificate, key = _certificate(tmp_path, "old", days=-1)
    result.save(tmp_path / "r.h5")
    words = ["publish", str(tmp_path / "r.h5"), "--opcua", "opc.tcp://127.0.0.1:4899", "--user", "scada"]
    (tmp_path / "secret").write_text(SECRET)
    words += ["--certificate", str(certificate), "--key", str(key), "--password-file", str(tmp_path / "secret")]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 3
    assert f"rfpose: {certificate}: the certificate has run out on " in done.stderr
    assert "openssl req" in done.stderr


def test_a_server_without_keys_is_anonymous_only_if_told(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match="or `anonymous=True`"):
        PlantServer(url="opc.tcp://127.0.0.1:4840")
    with pytest.raises(InvalidInputError, match="without certificate"):
        PlantServer(url="opc.tcp://127.0.0.1:4840", user="u", anonymous=True)
