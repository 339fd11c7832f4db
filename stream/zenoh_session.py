"""Zenoh: a session, and how it is configured.

Notes
-----
Observed of zenoh 1.10, and minded here:

- A transport whose far end does not read for `wait_before_close`, 5 s by default, is closed and its queue lost.
  Here it is a minute.
- Closing a session drops what it still has to send (up to 70 % of a burst of 1,220, in 3 % of them, reported by
  nobody). A query passes through the same queue, and ends when its router has read it: one is waited for.
"""

import re
import socket
import time
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Literal, Self

import msgspec
import zenoh

from core.errors import SettingsError

LOOPBACK: Final = "tcp/127.0.0.1:7447"
"""Where the embedded router listens unless told otherwise."""
STALL_US: Final = 60_000_000
"""How long a far end may stop reading before it is given up. [us]"""
LINGER_S: Final = 0.5
"""How long who is served without a router between is given to read; no query tells when they have. [s]"""
_BARRIER: Final = "socast/barrier"
"""What nobody answers to: a question put to the router after all else has been read when it comes back."""

_OURS: Final[tuple[tuple[str, Any, Any], ...]] = (  # where Zenoh's own default stands, ours takes its place
    ("scouting/multicast/enabled", None, False),
    ("scouting/gossip/enabled", None, False),
    ("timestamping/enabled", None, {"router": False, "peer": False, "client": False}),
    ("transport/link/tx/queue/congestion_control/block/wait_before_close", 5_000_000, STALL_US),
    ("transport/unicast/max_sessions", 1000, 1_000_000),
)

Mode = Literal["client", "peer", "router"]


@dataclass(frozen=True)
class Connection:
    """How to reach other Zenoh nodes, or be reached.

    Parameters
    ----------
    connect : tuple of str
        Endpoints such as `tcp/router.example:7447` or `tls/...`.
    listen : tuple of str
        Endpoints to be reached at; port 0 is replaced by a free one. By default a router or peer listens on loopback
        only.
    mode : str, optional
        `client`, `peer` or `router`; by default a client where there is something to connect to, else a router.
    prefix : str
        Key chunks before `fleet` and `weather`, such as `montreal`; only what is under it is subscribed to.
    config : Path, optional
        Zenoh's own JSON5 configuration, for TLS and the rest. What is given above goes before what the file says.
    recovery : bool
        Ask advanced publishers for what was missed.
    """

    connect: tuple[str, ...] = ()
    listen: tuple[str, ...] = ()
    mode: Mode | None = None
    prefix: str = ""
    config: Path | None = None
    recovery: bool = True


class Node:
    """An open Zenoh session; a context manager.

    Parameters
    ----------
    connection : Connection

    Attributes
    ----------
    endpoints : list of str
        Where the node listens.

    Raises
    ------
    SettingsError
        Where an endpoint, a mode, a prefix or the file is not understood, where no connection can be made, or where an
        endpoint cannot be listened at.
    """

    def __init__(self, connection: Connection = Connection()) -> None:
        self.connection = connection
        self.prefix = parse_prefix(connection.prefix)
        config = _config(connection)
        self.endpoints: list[str] = _endpoints(config)
        try:
            self.session = zenoh.open(config)
        except zenoh.ZError as error:
            if _only_listening_fails(config):
                raise SettingsError(
                    f"cannot listen at {', '.join(self.endpoints)}: {format_zenoh_error(error)}; choose another endpoint with "
                    "--listen, or join the router that has it with --connect"
                ) from error
            raise SettingsError(
                f"Zenoh cannot be joined: {format_zenoh_error(error)}; is a router listening there?"
            ) from error

    def close(self) -> None:
        """Close the session."""
        if not self.session.is_closed():
            self.session.close()  # type: ignore[no-untyped-call]

    def flush(self) -> None:
        """Wait until what was published has left, as long as the far end reads."""
        if self.session.is_closed():
            return
        for _ in self.session.get(_BARRIER, timeout=STALL_US / 1e6):
            pass  # nobody answers
        if self.endpoints:
            time.sleep(LINGER_S)

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close."""
        self.close()


def parse_prefix(text: str) -> str:
    """Return key chunks that come before others, with a slash at the end; nothing for no chunks.

    Raises
    ------
    SettingsError
        Where they are no plain chunks.

    Examples
    --------
    >>> key_prefix("/quebec/montreal/"), key_prefix("")
    ('quebec/montreal/', '')
    """
    chunks = text.strip("/")
    if not chunks:
        return ""
    try:
        zenoh.KeyExpr(chunks)
        format_zenoh_error = "*" not in chunks and chunks.isprintable()
    except zenoh.ZError:
        format_zenoh_error = False
    if not format_zenoh_error:
        raise SettingsError(
            f"prefix is {text!r}; give plain chunks such as montreal or quebec/montreal, "
            "without wildcards, empty chunks or any of * $ ? #"
        )
    return f"{chunks}/"


def find_free_port() -> int:
    """Return a TCP port on loopback that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def format_zenoh_error(error: Exception) -> str:
    """Return what an error of Zenoh says, on one line and without the places in Zenoh's source."""
    text = re.sub(r"\s+at /\S+?:\d+\.?", "", str(error)).replace("\n", " ")
    inner = re.search(r'msg: "(.*?)"', text)
    return (inner.group(1) if inner else text).strip(" .!")


def _config(connection: Connection) -> zenoh.Config:
    """Return Zenoh's configuration; raise `SettingsError` where it cannot be had."""
    file = connection.config
    try:
        config = zenoh.Config.from_file(file) if file else zenoh.Config()
    except (zenoh.ZError, OSError) as error:
        raise SettingsError(f"{file} is not a Zenoh configuration: {format_zenoh_error(error)}") from error
    mode = connection.mode or _told(config, "mode") or ("client" if connection.connect else "router")
    _insert(config, "mode", mode)
    if connection.connect:
        _insert(config, "connect/endpoints", list(connection.connect))
    if connection.listen:
        _insert(config, "listen/endpoints", [_with_port(end) for end in connection.listen])
    elif _told(config, "listen/endpoints") == _told(zenoh.Config(), "listen/endpoints"):
        ends = {"router": [LOOPBACK], "peer": [_with_port("tcp/127.0.0.1:0")]}.get(mode, [])
        _insert(config, "listen/endpoints", ends)
    for name, unset, value in _OURS:
        if _told(config, name) == unset:
            _insert(config, name, value)
    return config


def _only_listening_fails(config: zenoh.Config) -> bool:
    """Return whether a session that could not be opened could be, if it listened nowhere."""
    if _told(config, "mode") == "client" or not _endpoints(config):
        return False
    _insert(config, "listen/endpoints", [])
    try:
        zenoh.open(config).close()  # type: ignore[no-untyped-call]
    except zenoh.ZError:
        return False
    return True


def _with_port(endpoint: str) -> str:
    """Return an endpoint with a free port in place of port 0."""
    return f"{endpoint[:-1]}{find_free_port()}" if endpoint.endswith(":0") else endpoint


def _told(config: zenoh.Config, name: str) -> Any:
    """Return what a configuration says of a name."""
    return msgspec.json.decode(config.get_json(name))


def _endpoints(config: zenoh.Config) -> list[str]:
    """Return where a configuration listens."""
    told = _told(config, "listen/endpoints") or []
    return [str(end) for end in (told.get(_told(config, "mode"), []) if isinstance(told, dict) else told)]


def _insert(config: zenoh.Config, name: str, value: Any) -> None:
    """Set a name; raise `SettingsError` where Zenoh refuses the value."""
    text = msgspec.json.encode(value).decode()
    try:
        config.insert_json5(name, text)
    except zenoh.ZError as error:
        raise SettingsError(f"Zenoh setting {name} cannot be {text}: {format_zenoh_error(error)}") from error
