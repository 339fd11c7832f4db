"""The loop that passes messages from a source through the pipeline; `live` and `replay` differ only in the source."""

import gc
import logging
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from math import inf
from threading import Lock
from typing import Any, Final, TypeAlias

from socast.core.pipeline import Pipeline
from socast.core.totals.logger_faults import explain_fault
from socast.core.wire.messages import Message
from socast.stream.recorder import Recorder
from socast.stream.source import RecoveredMessage, Sink, Source
from socast.stream.structured_log import event_fields, flatten_counts

REPORT_S: Final = 30.0
"""Time between two log lines of counters. [s]"""
PUBLISH_S: Final = 0.5
"""Time between two rounds of published forecasts in live operation. [s]"""

_log = logging.getLogger("socast.run")


@dataclass
class Tally:
    """Count the messages that the loop received and sent.

    Parameters
    ----------
    received, forecasts, model_errors : int
        Numbers of messages received, forecasts sent, and messages sent on the errors of models.
    missed : int
        Number of messages that were sent but not received, as far as the transport detects it.
    recovered : int
        Number of new messages that came from the caches of publishers.
    seconds : float
        Time since the loop first read from the source. [s]
    newest : Message, optional
        Last message of the last list that was not empty.
    """

    received: int = 0
    forecasts: int = 0
    model_errors: int = 0
    missed: int = 0
    recovered: int = 0
    seconds: float = 0.0
    newest: Message | None = None


Watch: TypeAlias = Callable[[Tally], None]
"""A function that the loop calls after each list of messages, empty lists included."""


def combine_watches(*watches: Watch) -> Watch:
    """Return a watch that calls each of several watches."""

    def watch(tally: Tally) -> None:
        for each in watches:
            each(tally)

    return watch


def feed(
    source: Iterable[Sequence[Message]],
    pipeline: Pipeline,
    record: Callable[[Sequence[Message]], None] | None = None,
    *,
    close: bool = True,
) -> Iterator[Sequence[Message]]:
    """Pass each list of messages through a pipeline and yield it, then close the rides in progress.

    Live operation, replays, warm-up, tables, evaluations and the player of the workbench are this loop with another
    source. Only the workers of a cluster, which pass rows of several recordings, call the pipeline themselves.
    """
    for messages in source:
        if messages:
            pipeline.take(messages, record)
        yield messages
    if close:
        pipeline.finish()


class _GarbageRule:
    """Make the cyclic garbage collector run rarely while one loop or several, of any thread, are inside."""

    def __init__(self) -> None:
        self._lock, self._inside, self._before = Lock(), 0, gc.get_threshold()

    def enter(self) -> None:
        """Begin, unless another loop has."""
        with self._lock:
            self._inside += 1
            if self._inside == 1:
                self._before = gc.get_threshold()
                gc.freeze()
                gc.set_threshold(100_000, 20, 100)

    def leave(self) -> None:
        """Return to the previous thresholds after the last loop."""
        with self._lock:
            self._inside -= 1
            if not self._inside:
                gc.set_threshold(*self._before)
                gc.unfreeze()


_garbage_rule = _GarbageRule()


@contextmanager
def collect_garbage_rarely() -> Iterator[None]:
    """Make the cyclic garbage collector run rarely while messages stream; also a decorator.

    Messages form no reference cycles, and every collection would visit each of them. Objects that exist already are not
    visited. The previous thresholds return when the last loop of the process ends.
    """
    _garbage_rule.enter()
    try:
        yield
    finally:
        _garbage_rule.leave()


@collect_garbage_rarely()
def run(
    source: Source,
    pipeline: Pipeline,
    sinks: Sequence[Sink] = (),
    *,
    recorder: Recorder | None = None,
    keep_open: bool = False,
    publish_s: float = 0.0,
    watch: Watch = lambda _: None,
    report_s: float = REPORT_S,
    clock: Callable[[], float] = time.monotonic,
) -> Tally:
    """Pass every message through the pipeline and its forecasts to the sinks, until the source ends.

    The loop always closes the recorder and then the sinks, even after an error. The pipeline passes new messages to the
    recorder before it decodes them, so the recording contains a message that makes the pipeline fail.

    Parameters
    ----------
    source : Source
        Source that ends by itself or at its stop event. The loop logs its counts `missed` and `dropped`;
        `missed` is None where nothing is requested again. It counts the messages of the type `RecoveredMessage` if the
        source says `has_recovered`.
    sinks : sequence of Sink
        Sinks that receive the forecasts and the errors of models. The loop closes them at the end.
    publish_s : float
        Time between two rounds of the newest forecast of each vehicle. [s] A consumer that has fallen behind then does
        not flood its subscribers, and one that keeps pace publishes every forecast. With 0 the loop passes on all
        forecasts.
    watch : callable
        Function that the loop calls after each list of messages, empty lists included, for a screen or a progress bar.
    """
    tally, began, which = Tally(), clock(), {"newest_only": publish_s > 0.0}
    keep, counters = _make_keeper(source, recorder, tally), _CounterLog(tally, source, pipeline, recorder)
    due = began + report_s
    published = -inf
    with ExitStack() as closing:
        for sink in sinks:
            closing.callback(sink.close)
        if recorder is not None:
            closing.callback(recorder.close)
        for messages in feed(source, pipeline, keep, close=False):
            if messages:
                tally.received, tally.newest = tally.received + len(messages), messages[-1]
            elif recorder is not None:
                recorder.put(messages)  # a sync may be due
            if clock() - published >= publish_s:
                published = clock()
                _pass_on(pipeline.forecasts(**which), pipeline.model_errors(**which), sinks, tally)
            tally.seconds = clock() - began
            watch(tally)
            if clock() >= due:
                due = clock() + report_s
                counters.write("running")
        _pass_on(pipeline.forecasts(**which), pipeline.model_errors(**which), sinks, tally)
        if not keep_open:
            _pass_on(pipeline.finish(), pipeline.model_errors(**which), sinks, tally)
        tally.seconds = clock() - began
    counters.write("finished")
    return tally


def _make_keeper(source: Source, recorder: Recorder | None, tally: Tally) -> Callable[[Sequence[Message]], None]:
    """Return the function that receives new messages before the pipeline uses them."""

    def keep(new: Sequence[Message]) -> None:
        if getattr(source, "has_recovered", False):
            tally.recovered += sum(isinstance(message, RecoveredMessage) for message in new)
        if recorder is not None:
            recorder.put(new)

    return keep


def _pass_on(forecasts: list[Message], errors: list[Message], sinks: Sequence[Sink], tally: Tally) -> None:
    """Pass forecasts and errors of models to every sink."""
    tally.forecasts += len(forecasts)
    tally.model_errors += len(errors)
    if messages := forecasts + errors:
        for sink in sinks:
            sink.put(messages)


class _CounterLog:
    """Log all counters, and the rate since the last line."""

    def __init__(self, tally: Tally, source: Source, pipeline: Pipeline, recorder: Recorder | None) -> None:
        self._tally, self._source, self._pipeline, self._recorder = tally, source, pipeline, recorder
        self._received, self._seconds = tally.received, tally.seconds
        self._told = {(name, car) for name, cars in self._get_faults(pipeline.quality()) for car in cars}

    def write(self, event: str) -> None:
        """Log the counters under the name of an event."""
        tally, recorder = self._tally, self._recorder
        missed: int | None = getattr(self._source, "missed", 0)
        tally.missed = missed or 0
        counts: dict[str, Any] = {"messages": tally.received, "forecasts": tally.forecasts}
        counts |= {"recovery": "off"} if missed is None else {"missed": missed}
        if tally.recovered:
            counts["recovered"] = tally.recovered
        if tally.model_errors:
            counts["model_errors"] = tally.model_errors
        if recorder is not None:
            counts |= {"recorded": recorder.recorded, "unrecorded": recorder.unrecorded}
        counts |= flatten_counts({"dropped": getattr(self._source, "dropped", {})})
        counts["per_second"] = self._measure_rate()
        quality = self._pipeline.quality()
        faults = self._get_faults(quality)
        numbers = {"logger_faults": {name: len(cars) for name, cars in faults}}
        _log.info(event, extra=event_fields(**counts, **flatten_counts(quality | numbers)))
        for name, cars in faults:
            for car in sorted(car for car in cars if (name, car) not in self._told):
                self._told.add((name, car))
                _log.warning("logger_fault", extra=event_fields(vehicle=car, fault=name, meaning=explain_fault(name)))

    @staticmethod
    def _get_faults(quality: Mapping[str, Any]) -> list[tuple[str, Mapping[str, int]]]:
        """Return the faults of loggers with their cars."""
        return list(quality.get("logger_faults", {}).items())

    def _measure_rate(self) -> float:
        """Return the messages received per second since the last call. [Hz]"""
        received, seconds = self._tally.received - self._received, self._tally.seconds - self._seconds
        self._received, self._seconds = self._tally.received, self._tally.seconds
        return round(received / seconds, 1) if seconds > 0 else 0.0
