"""An MQTT subscriber with a persistent session, whose messages are acknowledged one by one.

The broker keeps what was published while the subscriber was away, and sends every message again that was not
acknowledged before a connection ended. It keeps so only messages that were published with QoS 1 or 2.

Notes
-----
A packet identifier is valid for one connection. After a reconnection the broker may give it to another message, so an
acknowledgement that comes too late is left out; the broker sends the message again.
"""

import logging
import ssl
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from queue import Empty, Queue
from threading import Event
from typing import Any, Final, NamedTuple
from urllib.parse import urlsplit

from socast.core.errors import SettingsError
from socast.stream.closeable import Closeable
from socast.stream.structured_log import event_fields

PORTS: Final = {"mqtt": 1883, "mqtts": 8883}
"""Scheme of an address -> its usual port."""
CONNECT_S: Final = 15.0
"""Longest wait for the first connection. [s]"""
BACKOFF_S: Final = 1, 60
"""First and longest wait before a reconnection. [s]"""
KEEP_ALIVE_S: Final = 30
"""Time without a packet after which either side asks whether the other is there. [s]"""
MOST_WAITING: Final = 1 << 16
"""Largest number of messages that wait to be taken; with more, the connection is not read."""
MOST_TAKEN: Final = 1 << 12
"""Largest number of messages that are taken at once."""
_log = logging.getLogger("socast.mqtt")


@dataclass(frozen=True)
class Broker:
    """Describe how to reach an MQTT broker.

    Parameters
    ----------
    url : str
        Such as `mqtt://127.0.0.1:1883`, or `mqtts://broker.example` with TLS.
    client_id : str
        Name of the session at the broker. A second client with the same name ends the connection of the first.
    authority : Path, optional
        PEM file of the certificate authority; by default those of the system.
    certificate, key : Path, optional
        PEM files of the client's certificate and its private key.
    """

    url: str
    client_id: str = "socast-bridge"
    user: str | None = None
    password: str | None = None
    authority: Path | None = None
    certificate: Path | None = None
    key: Path | None = None


class Ticket(NamedTuple):
    """Name a message that is to be acknowledged: its packet identifier, and the number of the connection."""

    packet: int
    connection: int


class MqttMessage(NamedTuple):
    """Hold a message of a broker.

    Parameters
    ----------
    received_s : float
        Unix time of receipt. [s]
    is_retained : bool
        Whether the broker had kept it for new subscribers, so that its age is unknown.
    connection : int
        Number of the connection over which it came.
    ticket : Ticket or None
        What `acknowledge` takes; None for a message with QoS 0, which needs no acknowledgement.
    """

    topic: str
    payload: bytes
    received_s: float
    is_retained: bool
    connection: int
    ticket: Ticket | None


class MqttSource(Closeable):
    """Subscribe to topics of a broker with QoS 1, in a session that outlasts connections.

    Attributes
    ----------
    counts : Counter of str
        `messages`, `again` (sent again by the broker), `retained`, `acknowledged`, `too_late` (acknowledgements that
        were left out because the connection had ended), `connections`, `disconnections` and `invalid_topic`.
    """

    def __init__(self, broker: Broker, topics: Sequence[str]) -> None:
        self.counts: Counter[str] = Counter()
        self._broker, self._topics = broker, topics
        self._waiting: Queue[MqttMessage] = Queue(MOST_WAITING)
        self._open: Counter[int] = Counter()
        self._connection = 0
        self._session_kept = False
        self._answered, self._closing = Event(), Event()
        self._refusal = ""
        self._client = self._make_client()
        _, host, port = parse_broker(broker.url)
        if (context := check_broker(broker)) is not None:
            self._client.tls_set_context(context)
        try:
            self._client.connect(host, port, KEEP_ALIVE_S)
        except (OSError, ValueError) as error:
            words = getattr(error, "strerror", None) or str(error)
            raise SettingsError(
                f"no broker answers at {broker.url}: {words.lower()}; start it, or correct --broker"
            ) from error
        self._client.loop_start()
        if not self._answered.wait(CONNECT_S) or self._refusal:
            words = self._refusal or f"no answer within {CONNECT_S:g} s"
            self.close()
            raise SettingsError(
                f"the broker at {broker.url} refuses the connection: {words}; check user, password and certificates"
            )

    @property
    def unacknowledged(self) -> int:
        """Return the number of messages of this connection that were taken and not acknowledged."""
        return self._open[self._connection]

    def take(self, wait_s: float) -> list[MqttMessage]:
        """Return the messages that have come, after a wait for the first one."""
        taken: list[MqttMessage] = []
        try:
            taken.append(self._waiting.get(timeout=wait_s))
            while len(taken) < MOST_TAKEN:
                taken.append(self._waiting.get_nowait())
        except Empty:
            pass
        self._open.update([message.connection for message in taken if message.ticket])
        return taken

    def acknowledge(self, tickets: Sequence[Ticket]) -> None:
        """Tell the broker that it need not keep messages any longer."""
        for ticket in tickets:
            self._open[ticket.connection] -= 1
            if ticket.connection == self._connection:
                self._client.ack(ticket.packet, 1)
                self.counts["acknowledged"] += 1
            else:
                self.counts["too_late"] += 1

    def close(self) -> None:
        """Disconnect; the broker keeps the session, and what is not acknowledged."""
        self._closing.set()
        self._client.disconnect()
        while not self._waiting.empty():  # the thread may wait for a place
            self._waiting.get_nowait()
        self._client.loop_stop()

    def _make_client(self) -> Any:
        """Return a client that acknowledges nothing by itself, and reconnects by itself."""
        try:
            from paho.mqtt.client import Client  # noqa: PLC0415 - an extra
            from paho.mqtt.enums import CallbackAPIVersion  # noqa: PLC0415
        except ImportError as error:
            raise SettingsError("MQTT needs paho-mqtt; install it with: pip install 'socast[bridge]'") from error
        broker = self._broker
        client: Any = Client(CallbackAPIVersion.VERSION2, broker.client_id, clean_session=False, manual_ack=True)
        if broker.user is not None:
            client.username_pw_set(broker.user, broker.password)
        client.reconnect_delay_set(*BACKOFF_S)
        client.on_connect, client.on_disconnect = self._on_connect, self._on_disconnect
        client.on_subscribe, client.on_message = self._on_subscribe, self._on_message
        return client

    def _on_connect(self, client: Any, _: object, flags: Any, reason: Any, __: object) -> None:
        """Subscribe where the broker has no session; keep the reason where it refuses."""
        if reason.is_failure:
            self._refuse(str(reason))
            return
        self._connection += 1
        self.counts["connections"] += 1
        self._session_kept = flags.session_present
        client.subscribe([(topic, 1) for topic in self._topics])

    def _on_subscribe(self, _: object, __: object, ___: object, reasons: Sequence[Any], ____: object) -> None:
        """Keep the reason if the broker refuses a topic."""
        refused = [topic for topic, reason in zip(self._topics, reasons, strict=False) if reason.is_failure]
        if refused:
            self._refuse(f"it allows no subscription to {refused[0]}")
        else:
            _log.info("broker joined", extra=event_fields(url=self._broker.url, session_kept=self._session_kept))
        self._answered.set()

    def _refuse(self, words: str) -> None:
        """Keep the reason of the first refusal, and log later ones."""
        if self._answered.is_set():
            _log.error("the broker refuses", extra=event_fields(url=self._broker.url, reason=words))
        else:
            self._refusal = words.lower()
            self._answered.set()

    def _on_disconnect(self, _: object, __: object, ___: object, reason: Any, ____: object) -> None:
        """Let the acknowledgements of this connection lapse."""
        self._connection += 1
        if not self._answered.is_set():
            self._refuse(f"it ends the connection ({reason})")
        elif not self._closing.is_set():
            self.counts["disconnections"] += 1
            _log.warning("broker lost", extra=event_fields(url=self._broker.url, reason=str(reason)))

    def _on_message(self, _: object, __: object, message: Any) -> None:
        """Queue a message; wait for a place where too many are in the queue."""
        self.counts["messages"] += 1
        self.counts["again"] += bool(message.dup)
        self.counts["retained"] += bool(message.retain)
        ticket = Ticket(message.mid, self._connection) if message.qos else None
        try:
            topic = message.topic
        except UnicodeDecodeError:
            self.counts["invalid_topic"] += 1
            topic = ""
        if not self._closing.is_set():
            retained = bool(message.retain)
            self._waiting.put(MqttMessage(topic, message.payload, time.time(), retained, self._connection, ticket))


def parse_broker(url: str) -> tuple[str, str, int]:
    """Return scheme, host and port of the address of a broker.

    Examples
    --------
    >>> parse_broker("mqtts://broker.example")
    ('mqtts', 'broker.example', 8883)
    """
    try:
        parts = urlsplit(url)
        host, port = parts.hostname, parts.port
    except ValueError:
        host = port = None
        parts = urlsplit("")
    if "@" in parts.netloc:
        raise SettingsError("--broker holds a user or password; give --user, and --password-file FILE")
    if parts.scheme not in PORTS or not host or parts.path.strip("/") or parts.query or parts.fragment:
        raise SettingsError(f"--broker is {url!r}; write mqtt://HOST:PORT, or mqtts://HOST:PORT for TLS")
    return parts.scheme, host, port or PORTS[parts.scheme]


def check_broker(broker: Broker) -> ssl.SSLContext | None:
    """Check the address and the files of a broker without connecting, and return the settings of TLS."""
    scheme, _, _ = parse_broker(broker.url)
    if scheme == "mqtts":
        return _make_context(broker)
    if broker.authority or broker.certificate or broker.key:
        raise SettingsError(f"--broker is {broker.url}, which uses no TLS; write mqtts://, or leave out the files")
    return None


def _make_context(broker: Broker) -> ssl.SSLContext:
    """Return the settings of TLS; the name of the broker is always checked."""
    if broker.key and not broker.certificate:
        raise SettingsError("--key is of a certificate; give --certificate FILE too")
    file = broker.authority
    try:
        context = ssl.create_default_context(cafile=file)
        if file := broker.certificate:
            context.load_cert_chain(file, broker.key, lambda: "")
    except (OSError, ValueError) as error:  # ssl.SSLError is an OSError
        words = error.strerror if isinstance(error, FileNotFoundError | PermissionError) else "it is no valid PEM file"
        raise SettingsError(
            f"{file} cannot be read: {str(words).lower()}; give PEM files without a passphrase"
        ) from error
    return context
