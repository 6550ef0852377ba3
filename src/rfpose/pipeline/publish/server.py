"""Poses from an OPC UA server: one object a heliostat, signed and encrypted unless it is told otherwise."""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import logging
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rfpose.errors import InvalidInputError, PublishError, install_remedy
from rfpose.pipeline.publish.address import address_of
from rfpose.pipeline.publish.messages import LOOK_S, QUANTITIES, VOUCHED, messages

if TYPE_CHECKING:
    from rfpose.pipeline.formats.live_result import ResultFollower
    from rfpose.pipeline.formats.result import Result

__all__ = ["NAMESPACE", "PlantServer", "serve", "serve_as_they_come", "serving"]

NAMESPACE = "urn:rfpose:poses"

_VARIABLES = {
    "normal_enu": "Normal",
    "azimuth_deg": "Azimuth",
    "elevation_deg": "Elevation",
    "sigma_mrad": "Sigma",
    "protection_level_mrad": "ProtectionLevel",
}
_MAKE_ONE = (
    "make one: openssl req -x509 -newkey rsa:2048 -nodes -days 365 -keyout key.pem -out cert.pem -subj /CN=rfpose "
    f"-addext subjectAltName=URI:{NAMESPACE}:server"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class PlantServer:
    """How the plant gets at the poses.

    Attributes
    ----------
    url
        Where to listen, ``opc.tcp://HOST:PORT/PATH``.
    certificate, key
        PEM files by which clients know the server; Basic256Sha256.
    user, password
        Whom the server lets in.
    anonymous
        Let everybody in, unsigned and unencrypted; the others must be None.

    Raises
    ------
    InvalidInputError
        Another kind of address; neither certificate, key, user and password nor ``anonymous``, or both.
    """

    url: str
    certificate: Path | None = None
    key: Path | None = None
    user: str | None = None
    password: str | None = None
    anonymous: bool = False

    def __post_init__(self) -> None:
        address_of(self.url, ("opc.tcp",), "opc.tcp://HOST:PORT/PATH")
        given = [self.certificate, self.key, self.user, self.password]
        if self.anonymous and any(given):
            raise InvalidInputError("`anonymous=True` lets everybody in; give it without certificate, key and user")
        if not self.anonymous and not all(given):
            raise InvalidInputError(
                "a server needs `certificate=`, `key=`, `user=` and the user's password, or `anonymous=True` to let "
                f"everybody in; if there is no certificate yet, {_MAKE_ONE}"
            )


def serve(result: Result, to: PlantServer, *, on_ready: Callable[[str], None] | None = None) -> None:
    """Let clients read the last frame of a result, with its status and time, until interrupted.

    Parameters
    ----------
    result
        Of `rfpose.process`.
    to
        Where, and for whom.
    on_ready
        Called with the address when clients may come.

    Raises
    ------
    PublishError
        The extra is missing, the certificate cannot be read or has run out, or the port is taken.
    """

    async def run() -> None:
        async with serving(result, to):
            if on_ready is not None:
                on_ready(to.url)
            await asyncio.Event().wait()

    asyncio.run(run())


def serve_as_they_come(
    follower: ResultFollower, to: PlantServer, *, on_ready: Callable[[str], None] | None = None
) -> None:
    """Let clients read the newest frame of a result that is being made, until interrupted.

    Parameters
    ----------
    follower
        Says which frames are new; the server begins with the first.
    to, on_ready
        As for `serve`.

    Raises
    ------
    PublishError
        As `serve`.
    RecordingError
        The result is damaged, or another one stands in its place.
    """

    async def run() -> None:
        while (first := await asyncio.to_thread(follower.news)) is None:
            await asyncio.sleep(LOOK_S)
        async with serving(first, to) as show:
            if on_ready is not None:
                on_ready(to.url)
            while True:
                found = None if follower.complete else await asyncio.to_thread(follower.news)
                if found is not None:
                    await show(found)
                await asyncio.sleep(LOOK_S)

    asyncio.run(run())


@contextlib.asynccontextmanager
async def serving(result: Result, to: PlantServer) -> AsyncIterator[Callable[[Result], Awaitable[None]]]:
    """Serve as `serve` does, for a program with an event loop of its own, while the block lasts.

    What it yields shows the last frame of another result of the same mirrors.
    """
    try:
        import asyncua  # noqa: F401
    except ImportError as error:
        raise PublishError(f"OPC UA needs asyncua; {install_remedy('publish')}") from error
    logging.getLogger("asyncua").setLevel(logging.CRITICAL)
    async with _listening(to) as server:
        shown = _Shown()
        await shown.make(server, result)
        yield shown.show


@contextlib.asynccontextmanager
async def _listening(to: PlantServer) -> AsyncIterator[Any]:
    from asyncua import Server, ua
    from asyncua.crypto.permission_rules import SimpleRoleRuleset, User, UserRole

    class Gate:
        """Knows the one user."""

        def get_user(self, _server: Any, username: Any = None, password: Any = None, certificate: Any = None) -> Any:
            if to.anonymous:
                return User(role=UserRole.User)
            told = (str(username or ""), str(password or ""))
            known = (str(to.user), str(to.password))
            same = [hmac.compare_digest(one.encode(), other.encode()) for one, other in zip(told, known, strict=True)]
            return User(role=UserRole.User, name=to.user) if all(same) else None

    if to.certificate is not None:
        _check_certificate(to.certificate)
    server = Server(user_manager=Gate())
    await server.init()
    server.set_endpoint(to.url)
    server.set_server_name("rfpose")
    await server.set_application_uri(f"{NAMESPACE}:server")
    policy = ua.SecurityPolicyType
    if to.anonymous:
        server.set_security_policy([policy.NoSecurity], permission_ruleset=SimpleRoleRuleset())
        server.set_identity_tokens([ua.AnonymousIdentityToken])
    else:
        server.set_security_policy(
            [policy.Basic256Sha256_SignAndEncrypt, policy.Basic256Sha256_Sign], permission_ruleset=SimpleRoleRuleset()
        )
        server.set_identity_tokens([ua.UserNameIdentityToken])
        try:
            await server.load_certificate(to.certificate, "pem")
            await server.load_private_key(to.key, format="pem")
        except (OSError, ValueError, TypeError) as error:
            raise PublishError(f"{to.key}: no private key that can be read ({error}); give a PEM file") from error
    try:
        await server.start()
    except OSError as error:
        raise PublishError(f"{to.url}: cannot listen there ({error.strerror or error}); choose another port") from error
    try:
        yield server
    finally:
        await server.stop()


class _Shown:
    """An object for each heliostat, with variables that hold its last frame."""

    def __init__(self) -> None:
        self._nodes: dict[tuple[str, str], Any] = {}
        """By heliostat and key of a message."""

    async def make(self, server: Any, result: Result) -> None:
        """Make the objects, and fill them."""
        from asyncua import ua

        space = await server.register_namespace(NAMESPACE)
        field = await server.nodes.objects.add_folder(space, "Heliostats")
        for name in result.scenario.heliostat_ids:
            mirror = await field.add_object(ua.NodeId(name, space), ua.QualifiedName(name, space))
            for key, variable in _VARIABLES.items():
                unit, text = QUANTITIES[key]
                node = self._nodes[name, key] = await mirror.add_variable(
                    ua.NodeId(f"{name}.{variable}", space),
                    ua.QualifiedName(variable, space),
                    [0.0] * 3 if key == "normal_enu" else 0.0,
                    ua.VariantType.Double,
                )
                await node.write_attribute(ua.AttributeIds.Description, ua.DataValue(ua.LocalizedText(text)))
                await node.add_property(
                    ua.NodeId(f"{name}.{variable}.EngineeringUnits", space),
                    ua.QualifiedName("EngineeringUnits", 0),
                    ua.EUInformation(DisplayName=ua.LocalizedText(unit)),
                )
            for key, variable in (("status", "Status"), ("integrity", "Integrity")):
                self._nodes[name, key] = await mirror.add_variable(
                    ua.NodeId(f"{name}.{variable}", space), ua.QualifiedName(variable, space), "", ua.VariantType.String
                )
        await self.show(result)

    async def show(self, result: Result) -> None:
        """Fill the objects with a result's last frame."""
        from asyncua import ua

        for message in messages(result, len(result.frame_start_index) - 1):
            name = message["heliostat"]
            time = datetime.fromisoformat(message["time_utc"]).astimezone(UTC)
            for key in _VARIABLES:
                await self._nodes[name, key].write_value(_data_value(message, key, time))
            for key in ("status", "integrity"):
                value = ua.Variant(message[key] or "not tested", ua.VariantType.String)
                await self._nodes[name, key].write_value(ua.DataValue(value, SourceTimestamp=time))


def _data_value(message: Mapping[str, Any], key: str, time: datetime) -> Any:
    """Return a value with its status: bad where there is none, uncertain where the tests do not vouch for it."""
    from asyncua import ua

    if message[key] is None:
        return ua.DataValue(
            ua.Variant(None, ua.VariantType.Null), ua.StatusCode(ua.StatusCodes.BadNoData), SourceTimestamp=time
        )
    vouched = message["status"] == "solved" and message["integrity"] in (*VOUCHED, None)
    code = ua.StatusCodes.Good if vouched else ua.StatusCodes.UncertainSensorNotAccurate
    return ua.DataValue(ua.Variant(message[key], ua.VariantType.Double), ua.StatusCode(code), SourceTimestamp=time)


def _check_certificate(path: Path) -> None:
    """Refuse a certificate that clients would refuse, and say why."""
    from cryptography import x509

    try:
        found = x509.load_pem_x509_certificate(path.read_bytes())
    except (OSError, ValueError) as error:
        raise PublishError(f"{path}: no certificate that can be read ({error}); {_MAKE_ONE}") from error
    now = datetime.now(UTC)
    if found.not_valid_after_utc < now:
        raise PublishError(f"{path}: the certificate has run out on {found.not_valid_after_utc:%Y-%m-%d}; {_MAKE_ONE}")
    if found.not_valid_before_utc > now:
        raise PublishError(
            f"{path}: the certificate holds from {found.not_valid_before_utc:%Y-%m-%d} on; wait, or see the clock"
        )
