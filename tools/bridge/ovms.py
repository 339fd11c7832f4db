"""Metrics of the Open Vehicle Monitoring System (OVMS v3) over MQTT.

A module publishes each metric under `{prefix}/{user}/{vehicle}/metric/{name with slashes}` as text, in metric units,
when it changes, and all metrics after it has connected. Of several, that of the module's clock comes first. A
current or power that leaves the battery is positive.

References
----------
Open-Vehicle-Monitoring-System-3: `docs/source/userguide/metrics.rst`, `vehicle/OVMS.V3/main/metrics_standard.cpp` and
`components/ovms_server_v3/src/ovms_server_v3.cpp`, https://github.com/openvehicles/Open-Vehicle-Monitoring-System-3.
"""

import logging
import time
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from types import MappingProxyType
from typing import Any, Final

from socast.core.errors import SettingsError
from socast.stream.mqtt_source import MOST_TAKEN, MqttMessage, MqttSource, Ticket
from socast.stream.structured_log import event_fields
from socast.tools.bridge.row_assembler import FIX, RowAssembler, Signal, Value, parse_number, read_signals

TOPICS: Final = "ovms"
"""Default first levels of all topics."""
CLOCK: Final = "m/time/utc"
"""Metric of the module's clock, as text such as `2023-12-03 02:14:31 UTC`."""
CONNECTED: Final = "s/v3/connected"
"""Metric that is `no` after the module has gone; the broker publishes it then."""
SMALLEST_WINDOW: Final = 10
"""Number of messages after which a broker may wait for acknowledgements."""
MANY_STALLS: Final = 100
"""Number of such waits after which the log says so."""
LONGEST_TEXT: Final = 64
"""Largest length of a value. [B]"""
METRICS: Final[Mapping[str, Signal]] = MappingProxyType(read_signals("ovms") | {"v/p/gpslock": Signal(FIX)})
"""Metric, with slashes -> what it gives."""
_log = logging.getLogger("socast.bridge")


class OvmsReader:
    """Read the messages of a broker into an assembler.

    Parameters
    ----------
    assembler : RowAssembler
        Receives values, and counts what gives none: `bad_topic`, `bad_value`, `stale` (a retained value, whose age is
        unknown) and `same_name` (another user has a car of the same name).
    prefix : str
        First levels of all topics, before user and vehicle.
    """

    def __init__(self, assembler: RowAssembler, prefix: str = TOPICS) -> None:
        self._assembler = assembler
        self._connection = 0
        self._prefix = parse_topic_prefix(prefix)
        self._users: dict[str, str] = {}

    def list_topics(self) -> list[str]:
        """Return the topics to subscribe to, one for each metric that is read."""
        return [f"{self._prefix}+/+/metric/{name}" for name in (*METRICS, CLOCK, CONNECTED)]

    def read(self, message: MqttMessage) -> None:
        """Read a message."""
        topic, payload, received_s, is_retained, connection, ticket = message
        if connection != self._connection:
            self._connection = connection
            self._assembler.interrupt()
        user, _, rest = topic.removeprefix(self._prefix).partition("/")
        vehicle, _, name = rest.partition("/metric/")
        if not topic.startswith(self._prefix) or not vehicle or not name:
            self._assembler.drop("bad_topic", ticket)
        elif self._users.setdefault(vehicle, user) != user:
            self._assembler.drop("same_name", ticket)
        elif is_retained:
            self._assembler.drop("stale", ticket)
        else:
            self._read_metric(vehicle, name, payload, received_s, ticket)

    def _read_metric(self, vehicle: str, name: str, payload: bytes, received_s: float, ticket: Any) -> None:
        """Read the value of a metric."""
        text = payload[: LONGEST_TEXT + 1].decode("utf-8", "replace")
        assembler = self._assembler
        if name == CONNECTED:
            if text == "no":
                assembler.disconnect(vehicle)
            assembler.drop("connections", ticket)
        elif name == CLOCK and (time_s := parse_time(text)) is not None:
            assembler.set_clock(vehicle, time_s, received_s, ticket)
        elif not text.strip():  # the metric is not defined
            assembler.drop("undefined", ticket)
        elif (signal := METRICS.get(name)) and (number := parse_number(signal, text)) is not None:
            assembler.take(Value(vehicle, signal.field, number, received_s, rank=signal.rank, ticket=ticket))
        else:
            assembler.drop("bad_value", ticket)


class OvmsSource:
    """Feed the messages of a broker to a reader, as `socast.tools.bridge.bridge_loop.SignalSource`."""

    def __init__(self, source: MqttSource, reader: OvmsReader) -> None:
        self._source, self._reader = source, reader
        self._is_silent, self._stalls = True, 0

    def feed(self, wait_s: float) -> float:
        """Read what has come, after a wait for it, and return the time up to which everything was read. [Unix s]"""
        messages = self._source.take(wait_s)
        for message in messages:
            self._reader.read(message)
        self._is_silent = not messages
        return messages[-1].received_s if len(messages) == MOST_TAKEN else time.time()

    def is_stalled(self) -> bool:
        """Return whether the broker probably waits for acknowledgements; warn where it does so again and again."""
        waiting = self._source.unacknowledged
        if not self._is_silent or waiting < SMALLEST_WINDOW:
            return False
        self._stalls += 1
        if self._stalls == MANY_STALLS:
            _log.warning(
                "the broker sends few messages before it waits for acknowledgements, and rows are divided by that: "
                "remove its limit (max_inflight_messages 0 of mosquitto)",
                extra=event_fields(unacknowledged=waiting),
            )
        return True

    def acknowledge(self, tickets: Sequence[Ticket]) -> None:
        """Let the broker forget messages."""
        self._source.acknowledge(tickets)

    def count(self) -> Mapping[str, int]:
        """Return the counters of the connection."""
        return self._source.counts


def parse_time(text: str) -> float | None:
    """Return the Unix time of a module's clock; None if it is not a time. [s]

    Examples
    --------
    >>> parse_time("2023-12-03 02:14:31 UTC"), parse_time("1701569671"), parse_time("soon")
    (1701569671.0, 1701569671.0, None)
    """
    try:
        return (
            float(text)
            if text.isdecimal()
            else datetime.fromisoformat(text.removesuffix(" UTC")).replace(tzinfo=UTC).timestamp()
        )
    except (ValueError, OverflowError):
        return None


def parse_topic_prefix(text: str) -> str:
    """Return a topic prefix with one slash at its end; an empty text for an empty prefix.

    Examples
    --------
    >>> parse_topic_prefix("ovms"), parse_topic_prefix("")
    ('ovms/', '')
    """
    levels = text.strip("/")
    if any(each in levels for each in "+#\0") or "//" in levels:
        raise SettingsError(f"--topics is {text!r}; give plain levels such as ovms, without + and #")
    return f"{levels}/" if levels else ""
