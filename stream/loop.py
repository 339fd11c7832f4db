"""The loop that live and replay share; they differ only in their source."""

import gc
import logging
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from math import inf
from threading import Event
from types import FrameType
from typing import Any, Final, Protocol

from core.wire.messages import Message
from stream.recorder import Recorder
from stream.source import Sink, Source
from stream.structured_log import event_fields, flatten_counts

REPORT_S: Final = 30.0
"""Time between two lines of counters. [s]"""
PUBLISH_S: Final = 0.5
"""Time between two rounds of forecasts in service. [s]"""

_log = logging.getLogger("socast.run")


class Forecaster(Protocol):
    """What the loop needs of `core.pipeline.Pipeline`."""

    def take(self, messages: Sequence[Message]) -> None:
        """Take messages."""

    def forecasts(self, *, newest_only: bool = False) -> list[Message]:
        """Return the forecasts that have become due since the last call, or of each vehicle the newest."""

    def model_errors(self, *, newest_only: bool = False) -> list[Message]:
        """Return the errors of several models after each ride since the last call, or the newest of each."""

    def finish(self) -> list[Message]:
        """Close open rides, return the last forecasts."""

    def quality(self) -> dict[str, Any]:
        """Return counters."""


@dataclass
class Tally:
    """Count what went through the loop.

    Parameters
    ----------
    received, forecasts, model_errors : int
        Messages received, forecasts sent, and messages on the errors of models sent.
    missed : int
        Messages that were sent and not received, as far as the transport can tell.
    seconds : float
        Time from the first look at the source to its end. [s]
    """

    received: int = 0
    forecasts: int = 0
    model_errors: int = 0
    missed: int = 0
    seconds: float = 0.0


def run(
    source: Source,
    pipeline: Forecaster,
    sinks: Sequence[Sink] = (),
    *,
    recorder: Recorder | None = None,
    publish_s: float = 0.0,
    watch: Callable[[Tally], None] = lambda _: None,
    report_s: float = REPORT_S,
    clock: Callable[[], float] = time.monotonic,
) -> Tally:
    """Push every message through the pipeline and pass its forecasts to the sinks, until the source ends.

    The recorder and then the sinks are closed in every case. Messages are recorded before they are decoded, so a message
    that breaks the pipeline is on disk.

    Parameters
    ----------
    source : Source
        Ends by itself or at its stop event. Its count `missed`, if it has one, is reported.
    pipeline : Forecaster
    sinks : sequence of Sink
        Take the forecasts and the errors of models; closed at the end.
    recorder : Recorder, optional
        Takes the messages received.
    publish_s : float
        Time between two rounds of the newest forecast of each vehicle. [s] A consumer that has fallen behind then does
        not flood its listeners, and one that keeps pace passes on every forecast. At 0 all are passed on.
    watch : callable
        Called after each list, the empty ones included, for a screen or a progress bar.
    report_s : float
        Time between two lines of counters in the log. [s]
    clock : callable
        Monotonic time. [s]

    Returns
    -------
    Tally
    """
    tally, began, which = Tally(), clock(), {"newest_only": publish_s > 0.0}
    due = began + report_s
    published = -inf
    with ExitStack() as closing:
        closing.enter_context(collect_garbage_rarely())
        for sink in sinks:
            closing.callback(sink.close)
        if recorder is not None:
            closing.callback(recorder.close)
        for messages in source:
            if recorder is not None:
                recorder.put(messages)
            if messages:
                tally.received += len(messages)
                pipeline.take(messages)
            if clock() - published >= publish_s:
                published = clock()
                _pass_on(pipeline.forecasts(**which), pipeline.model_errors(**which), sinks, tally)
            tally.seconds = clock() - began
            watch(tally)
            if clock() >= due:
                due = clock() + report_s
                _report("running", tally, source, pipeline, recorder)
        _pass_on(pipeline.forecasts(**which), pipeline.model_errors(**which), sinks, tally)
        _pass_on(pipeline.finish(), pipeline.model_errors(**which), sinks, tally)
        tally.seconds = clock() - began
    _report("finished", tally, source, pipeline, recorder)
    return tally


@contextmanager
def collect_garbage_rarely() -> Iterator[None]:
    """Run the cyclic garbage collector rarely while messages stream; they make no cycles, and it would visit each."""
    before = gc.get_threshold()
    gc.collect()
    gc.freeze()
    gc.set_threshold(100_000, 20, 100)
    try:
        yield
    finally:
        gc.set_threshold(*before)
        gc.unfreeze()


@contextmanager
def stop_on_signals() -> Iterator[Event]:
    """Give an event that SIGINT and SIGTERM set; a second SIGINT interrupts at once, as usual."""
    stop = Event()

    def handle(number: int, frame: FrameType | None) -> None:
        if stop.is_set() and number == signal.SIGINT:
            signal.default_int_handler(number, frame)
        stop.set()

    before = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _pass_on(forecasts: list[Message], errors: list[Message], sinks: Sequence[Sink], tally: Tally) -> None:
    """Pass forecasts and errors of models to every sink."""
    tally.forecasts += len(forecasts)
    tally.model_errors += len(errors)
    if messages := forecasts + errors:
        for sink in sinks:
            sink.put(messages)


def _report(event: str, tally: Tally, source: Source, pipeline: Forecaster, recorder: Recorder | None) -> None:
    """Log all counters."""
    tally.missed = getattr(source, "missed", 0)
    counts: dict[str, Any] = {"messages": tally.received, "forecasts": tally.forecasts, "missed": tally.missed}
    if tally.model_errors:
        counts["model_errors"] = tally.model_errors
    if recorder is not None:
        counts |= {"recorded": recorder.recorded, "unrecorded": recorder.unrecorded}
    rate = tally.received / tally.seconds if tally.seconds > 0 else 0.0
    _log.info(event, extra=event_fields(**counts, per_second=round(rate, 1), **flatten_counts(pipeline.quality())))
