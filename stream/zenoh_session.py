"""The Zenoh session and its configuration.

Notes
-----
The module allows for this observed behaviour of zenoh 1.10:

- Zenoh closes a transport whose remote end does not read for `wait_before_close`, and its queue is lost. Zenoh's
  default is 5 s; this module sets 60 s.
- Closing a session drops the messages that it still has to send, without an error. In 3 % of the bursts of 1,220
  messages, up to 70 % of the messages were lost. A query passes through the same queue and ends when its router has
  read it, so `Node.flush` waits for a query.
"""

import ipaddress
import logging
import re
import resource
import secrets
import socket
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import msgspec
import numpy as np
import zenoh

from socast.core.errors import SettingsError, read_input
from socast.core.files import UNREADABLE
from socast.core.wire.shard import Shard
from socast.stream.closeable import Closeable
from socast.stream.link_check import explain_failure

LOOPBACK: Final = "tcp/127.0.0.1:7447"
"""Default endpoint at which the embedded router listens."""
STALL_US: Final = 60_000_000
"""Time for which a remote end may stop reading before Zenoh closes its transport. [us]"""
LINGER_S: Final = 0.5
"""Time given to directly connected nodes to read; no query shows when they have read. [s]"""
FILES, SPACE = 24, 2 << 30
"""Number of free file descriptors, and address space [B], that a session needs; with less, Zenoh aborts the process."""
DEEPEST: Final = 100
"""Deepest nesting of a configuration; Zenoh's reader crashes at some thousands."""
_PORTS: Final = range(16_000, 32_000)  # of services; Linux gives connections those from 32,768, others from 49,152
_CHECKED: Final = 3  # endpoints that are checked after a failure
_BARRIER: Final = "socast/barrier"
"""Key of a query that no consumer answers; when the query ends, the router has read everything sent before it."""

_OURS: Final[tuple[tuple[str, Any, Any], ...]] = (  # each value replaces Zenoh's default, but not another value
    ("scouting/multicast/enabled", None, False),
    ("scouting/gossip/enabled", None, False),
    ("timestamping/enabled", None, {"router": False, "peer": False, "client": True}),
    ("transport/link/tx/queue/congestion_control/block/wait_before_close", 5_000_000, STALL_US),
    ("transport/unicast/max_sessions", 1000, 1_000_000),
)

_OPTIONS: Final = {"connect/endpoints": "--connect", "listen/endpoints": "--listen", "mode": "--mode"}
"""Setting of Zenoh -> option that sets it."""

Mode = Literal["client", "peer", "router"]

_log = logging.getLogger("socast.zenoh")


@dataclass(frozen=True)
class Connection:
    """Describe how to reach other Zenoh nodes and how to be reached by them.

    Parameters
    ----------
    connect : tuple of str
        Endpoints to connect to, such as `tcp/router.example:7447` or `tls/...`. A client without any, here and in the
        file, connects to loopback.
    listen : tuple of str
        Endpoints to listen at; a free port replaces port 0. By default a router or peer listens on loopback only.
    mode : str, optional
        `client`, `peer` or `router`. The default is a client if `connect` is given, and otherwise a router.
    prefix : str
        Key chunks before `fleet` and `weather`, such as `montreal`. The node subscribes only to keys under the prefix.
    config : Path, optional
        File with Zenoh's JSON5 configuration, for TLS and other settings. The parameters above override the file.
    recovery : bool
        Whether to request missed samples from advanced publishers.
    lease_s : float, optional
        Time without a sign of life after which remote ends take this node for lost. [s] The default is that of the
        file, or Zenoh's, 10 s.
    largest_bytes : float, optional
        Size of a payload above which the session drops it on arrival, uncounted, unless the file limits sizes. [B]
    shard : Shard, optional
        Share of the fleet to subscribe to; all of it without a shard.
    """

    connect: tuple[str, ...] = ()
    listen: tuple[str, ...] = ()
    mode: Mode | None = None
    prefix: str = ""
    config: Path | None = None
    recovery: bool = True
    lease_s: float | None = None
    largest_bytes: float | None = None
    shard: Shard | None = None


class Node(Closeable):
    """Hold an open Zenoh session.

    Parameters
    ----------
    connection : Connection
        Endpoints, mode, prefix and configuration of the session.
    """

    def __init__(self, connection: Connection = Connection()) -> None:
        self.connection = connection
        self.prefix = parse_prefix(connection.prefix)
        config = _make_config(connection)
        self.endpoints: list[str] = _list_endpoints(config)
        self.routers: list[str] = _list_endpoints(config, "connect")
        _check_limits()
        try:
            self.session = zenoh.open(config)
        except zenoh.ZError as error:
            if _only_listening_fails(config):
                raise SettingsError(
                    f"cannot listen at {', '.join(self.endpoints)}: {format_zenoh_error(error)}; {_help_listen(error)}"
                ) from error
            raise SettingsError(f"Zenoh cannot be joined: {_explain(config, connection, error)}") from error
        self._is_abandoned = False
        _warn_if_open(config)

    def list_cars(self) -> list[str]:
        """Return the key expressions of the cars to subscribe to, such as `montreal/fleet/*`; they do not overlap."""
        shard = self.connection.shard
        if shard is None:
            return [f"{self.prefix}fleet/*"]
        return [
            f"{self.prefix}fleet/{end}" if shard.by == "name" else f"{self.prefix}{end}/fleet/*"
            for end in shard.list_ends()
        ]

    def list_answered(self) -> list[str]:
        """Return the key expressions of the cars to answer for; of all cars where chunks divide the fleet."""
        shard = self.connection.shard
        return [f"{self.prefix}fleet/*"] if shard is None or shard.by == "chunk" else self.list_cars()

    def abandon(self) -> None:
        """Leave the session open until the process ends: closing would wait for a link that takes nothing."""
        self._is_abandoned = True

    def close(self) -> None:
        """Close the session."""
        if not self._is_abandoned and not self.session.is_closed():
            with suppress(zenoh.ZError):  # with very many endpoints it gives up after 10 s
                self.session.close()  # type: ignore[no-untyped-call]

    def flush(self) -> None:
        """Wait until all published messages have left, as long as the remote end reads."""
        if self.session.is_closed():
            return
        for _ in self.session.get(_BARRIER, timeout=STALL_US / 1e6):
            pass  # no consumer answers
        if self.endpoints:
            time.sleep(LINGER_S)


def parse_prefix(text: str) -> str:
    """Return a key prefix with one slash at its end; an empty text for an empty prefix.

    Examples
    --------
    >>> parse_prefix("/quebec/montreal/"), parse_prefix("")
    ('quebec/montreal/', '')
    """
    chunks = text.strip("/")
    if not chunks:
        return ""
    try:
        zenoh.KeyExpr(chunks)
        is_plain = "*" not in chunks and chunks.isprintable()
    except zenoh.ZError:
        is_plain = False
    if not is_plain:
        raise SettingsError(
            f"--prefix is {text!r}; give plain chunks such as montreal or quebec/montreal, "
            "without wildcards, empty chunks or any of * $ ? #"
        )
    return f"{chunks}/"


def limit_sizes(largest_bytes: float) -> dict[str, Any]:
    """Return the item of Zenoh's setting `low_pass_filter` that drops larger payloads on arrival.

    Units: largest_bytes [B].
    """
    return {
        "id": "largest payload",
        "flows": ["ingress"],
        "messages": ["put", "query", "reply"],
        "key_exprs": ["**"],
        "size_limit": round(largest_bytes),
    }


def find_free_port() -> int:
    """Return a free TCP port on loopback, none of those that systems give to connections by themselves."""
    while True:
        with socket.socket() as probe, suppress(OSError):
            port = secrets.randbelow(_PORTS.stop - _PORTS.start) + _PORTS.start
            probe.bind(("127.0.0.1", port))
            return port


def format_zenoh_error(error: Exception) -> str:
    """Return the message of a Zenoh error on one line, without locations in Zenoh's source."""
    text = re.sub(r"\s+at /\S+?:\d+\.?", "", str(error)).replace("\n", " ")
    inner = re.search(r'msg: "(.*?)"', text)
    return (inner.group(1) if inner else text).strip(" .!")


def _check_limits() -> None:
    """Refuse a session that would find too few file descriptors or too small an address space."""
    if 0 <= (space := resource.getrlimit(resource.RLIMIT_AS)[0]) < SPACE:  # negative for no limit
        raise SettingsError(f"address space is limited to {space >> 20} MiB: raise it with `ulimit -v {SPACE >> 10}`")
    most, used = resource.getrlimit(resource.RLIMIT_NOFILE)[0], len(list(Path("/dev/fd").iterdir()))
    if 0 <= most < used + FILES:  # negative for no limit
        raise SettingsError(
            f"{used} files are open of at most {most}, and Zenoh needs {FILES} more: raise it with `ulimit -n 256`"
        )


def _read_config(file: Path) -> zenoh.Config:
    """Return the configuration of a file."""
    try:
        content = read_input(file)  # Zenoh itself would read a file of any size, and a pipe again
        characters = np.frombuffer(content, np.uint8)
        opened = np.isin(characters, list(b"[{")).astype(np.int64) - np.isin(characters, list(b"]}"))
        if np.cumsum(opened).max(initial=0) > DEEPEST:
            raise SettingsError(f"--config {file} is nested in more than {DEEPEST} levels, which no configuration is")
        return zenoh.Config.from_file(file) if file.is_file() else zenoh.Config.from_json5(content.decode())
    except FileNotFoundError as error:
        raise SettingsError(f"--config {file} does not exist; `socast secure init` makes one") from error
    except OSError as error:
        raise SettingsError(f"--config {file} cannot be read: {error.strerror}") from error
    except (zenoh.ZError, UnicodeDecodeError) as error:
        raise SettingsError(f"--config {file} is not a Zenoh configuration: {_find_line(error)}") from error


def _find_line(error: Exception) -> str:
    """Return what is wrong with JSON5, with the line and the column, which Zenoh draws below each other."""
    words = format_zenoh_error(error)
    drawn = re.search(r"--> (\d+):(\d+).*?\^-* *(?:\| *)*=? *(.*)", words)
    return f"line {drawn[1]}, column {drawn[2]}: {drawn[3]}" if drawn else words


def _make_config(connection: Connection) -> zenoh.Config:
    """Return Zenoh's configuration; raise `SettingsError` if the file or a value is invalid."""
    file = connection.config
    config = _read_config(file) if file else zenoh.Config()
    mode = connection.mode or _read(config, "mode") or ("client" if connection.connect else "router")
    _insert(config, "mode", mode)
    if connection.connect:
        _insert(config, "connect/endpoints", list(connection.connect))
    elif mode == "client" and not _read(config, "connect/endpoints"):
        _insert(config, "connect/endpoints", [LOOPBACK])
    if connection.listen:
        _insert(config, "listen/endpoints", [_fill_port(end) for end in connection.listen])
    elif _read(config, "listen/endpoints") == _read(zenoh.Config(), "listen/endpoints"):
        ends = {"router": [LOOPBACK], "peer": [_fill_port("tcp/127.0.0.1:0")]}.get(mode, [])
        _insert(config, "listen/endpoints", ends)
    for name, unset, value in _OURS:
        _insert_unset(config, name, unset, value)
    if mode == "router" and not (_read(config, "connect/endpoints") or _read(config, "scouting/multicast/enabled")):
        _insert_unset(config, "scouting/delay", None, 0)  # else Zenoh waits half a second for nodes that none looks for
    _insert_limits(config, connection)
    _refuse_protocols(config, connection)
    return config


def _insert_unset(config: zenoh.Config, name: str, unset: Any, value: Any) -> None:
    """Insert a value unless the file gives another than Zenoh's default, `unset`."""
    if _read(config, name) == unset:
        _insert(config, name, value)


def _insert_limits(config: zenoh.Config, connection: Connection) -> None:
    """Insert the limits of the connection in time and in size."""
    if connection.lease_s is not None:
        _insert(config, "transport/link/tx/lease", round(connection.lease_s * 1000))
    if connection.largest_bytes is not None and not _read(config, "low_pass_filter"):
        _insert(config, "low_pass_filter", [limit_sizes(connection.largest_bytes)])


def _warn_if_open(config: zenoh.Config) -> None:
    """Log one warning if nodes elsewhere can join without a certificate, or say whatever they like."""
    open_ends = [end for end in _list_endpoints(config) if not _is_local(end)]
    has_rules = _read(config, "access_control/enabled") and _read(config, "access_control/default_permission") == "deny"
    is_mutual = _read(config, "transport/link/tls/enable_mtls") and all(
        end.partition("/")[0] in {"tls", "quic"} for end in open_ends
    )
    if open_ends and not (has_rules and is_mutual):
        _log.warning(
            "anybody who reaches %s can read and publish everything: "
            "make certificates and access control with `socast secure init`, or listen on loopback",
            ", ".join(open_ends),
        )


def _help_listen(error: Exception) -> str:
    """Return the remedy where a node cannot listen."""
    if "TLS" in str(error):
        return "give certificates with --config; `socast secure init` makes them"
    return "choose another endpoint with --listen, or join the router that has it with --connect"


def _explain(config: zenoh.Config, connection: Connection, error: Exception) -> str:
    """Return why no router can be joined, as a check of its endpoints finds it; else what Zenoh says."""
    tls: dict[str, Any] = _read(config, "transport/link/tls") or {}
    if connection.config:
        tls |= _read_certificates(connection.config)
    found = (explain_failure(endpoint, tls) for endpoint in _list_endpoints(config, "connect")[:_CHECKED])
    words = next(filter(None, found), "")
    return words or f"{format_zenoh_error(error)}; is a router listening there?"


def _read_certificates(file: Path) -> dict[str, Any]:
    """Return the TLS setting of a file in JSON; Zenoh shows no keys that a configuration holds."""
    try:
        return dict(msgspec.json.decode(file.read_bytes())["transport"]["link"]["tls"])
    except (*UNREADABLE, OSError, KeyError, TypeError, ValueError):
        return {}


def _refuse_protocols(config: zenoh.Config, connection: Connection) -> None:
    """Refuse an endpoint whose protocol the configuration does not allow, such as plain TCP beside certificates."""
    allowed: list[str] = _read(config, "transport/link/protocols") or []
    for option, endpoints in (("--connect", connection.connect), ("--listen", connection.listen)):
        for endpoint in endpoints:
            protocol, _, address = endpoint.partition("/")
            if allowed and protocol not in allowed:
                raise SettingsError(
                    f"{option} is {endpoint}, and {connection.config} allows only {', '.join(allowed)}: "
                    f"give {allowed[0]}/{address}, or leave {option} out"
                )


def _is_local(endpoint: str) -> bool:
    """Return whether only programs on this computer reach an endpoint."""
    protocol, _, address = endpoint.partition("/")
    host = re.split(r"[?#]", address)[0].rpartition(":")[0].strip("[]")
    if protocol.startswith("unix") or host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _only_listening_fails(config: zenoh.Config) -> bool:
    """Return whether a session that failed to open can be opened without listening."""
    if _read(config, "mode") == "client" or not _list_endpoints(config):
        return False
    _insert(config, "listen/endpoints", [])
    try:
        zenoh.open(config).close()  # type: ignore[no-untyped-call]
    except zenoh.ZError:
        return False
    return True


def _fill_port(endpoint: str) -> str:
    """Return an endpoint with port 0 replaced by a free port."""
    return f"{endpoint[:-1]}{find_free_port()}" if endpoint.endswith(":0") else endpoint


def _read(config: zenoh.Config, name: str) -> Any:
    """Return the value of a setting in a configuration."""
    return msgspec.json.decode(config.get_json(name))


def _list_endpoints(config: zenoh.Config, side: Literal["listen", "connect"] = "listen") -> list[str]:
    """Return the endpoints at which a configuration listens, or those to which it connects."""
    endpoints = _read(config, f"{side}/endpoints") or []
    return [
        str(end) for end in (endpoints.get(_read(config, "mode"), []) if isinstance(endpoints, dict) else endpoints)
    ]


def _insert(config: zenoh.Config, name: str, value: Any) -> None:
    """Change a setting; raise `SettingsError` if Zenoh refuses the value."""
    text = msgspec.json.encode(value).decode()
    try:
        config.insert_json5(name, text)
    except zenoh.ZError as error:
        option = _OPTIONS.get(name, f"Zenoh setting {name}")
        raise SettingsError(f"{option} cannot be {text}: {format_zenoh_error(error)}") from error
