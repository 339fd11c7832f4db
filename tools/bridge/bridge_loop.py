"""The loop of every bridge: read signals, assemble rows, deliver them, and then acknowledge what they hold."""

import logging
import time
from collections.abc import Mapping, Sequence
from math import inf
from threading import Event
from typing import Any, Final, Protocol

from socast.stream.loop import REPORT_S
from socast.stream.structured_log import event_fields, flatten_counts
from socast.stream.zenoh_delivery import ZenohDelivery
from socast.tools.bridge.row_assembler import RowAssembler

LOOK_UP_S: Final = 0.1
"""Longest wait for signals before rows are looked at again. [s]"""
_log = logging.getLogger("socast.bridge")


class SignalSource(Protocol):
    """Feed signals to the assembler of a bridge."""

    def feed(self, wait_s: float) -> float:
        """Read what has come, after a wait for it, and return the time up to which everything was read. [Unix s]"""

    def is_stalled(self) -> bool:
        """Return whether the sender waits for acknowledgements and sends nothing more before."""

    def acknowledge(self, tickets: Sequence[Any]) -> None:
        """Let the sender forget messages."""

    def count(self) -> Mapping[str, int]:
        """Return the counters of the source."""


def run_bridge(
    source: SignalSource,
    assembler: RowAssembler,
    delivery: ZenohDelivery,
    stop: Event,
    report_s: float = REPORT_S,
) -> None:
    """Pass signals on as rows until `stop` is set; then pass on the rows that are open.

    A message is acknowledged only after a router has read the row that holds it.
    """
    due = time.monotonic() + report_s
    try:
        while not stop.is_set():
            now = source.feed(LOOK_UP_S)
            assembler.close_due(inf if source.is_stalled() else now)
            _pass_on(source, assembler, delivery, stop)
            if time.monotonic() >= due:
                due = time.monotonic() + report_s
                assembler.forget_silent(now)
                _report("counters", source, assembler, delivery)
        assembler.close_due()
        _pass_on(source, assembler, delivery, stop)
    finally:
        _report("bridge ends", source, assembler, delivery)


def _pass_on(source: SignalSource, assembler: RowAssembler, delivery: ZenohDelivery, stop: Event) -> None:
    """Deliver complete rows, and acknowledge the messages that they hold."""
    messages, tickets = assembler.pop()
    if (not messages or delivery.deliver(messages, stop)) and tickets:
        source.acknowledge(tickets)


def _report(event: str, source: SignalSource, assembler: RowAssembler, delivery: ZenohDelivery) -> None:
    """Log the counters."""
    counts = {"vehicles": assembler.vehicles, "rows": assembler.counts["rows"], "repeated": delivery.repeated}
    others = {name: count for name, count in assembler.counts.items() if name != "rows"}
    _log.info(event, extra=event_fields(**counts, **flatten_counts({"source": source.count(), "signals": others})))
