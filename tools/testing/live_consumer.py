"""A live consumer for tests: real Zenoh sessions on loopback, in a thread of the process of the test.

The test publishes in bursts that fit into Zenoh's channels, and the next burst waits for the consumer. A router and a
client in one process could otherwise wait for each other (`socast.stream.zenoh_receiver`). The consumer publishes all
forecasts, as a replay does, and not only the newest of each round, so that they do not depend on time.
"""

import json
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from itertools import chain, groupby, islice
from pathlib import Path
from threading import Condition, Event, Thread
from typing import Any, Final, NamedTuple, Self, TypeAlias, TypeVar

import pandas as pd

from socast.core import models
from socast.core.errors import SettingsError
from socast.core.forecast.forecast_table import is_forecast, tabulate_forecasts
from socast.core.pipeline import Pipeline
from socast.core.wire.messages import Message, address
from socast.stream.loop import Tally, run
from socast.stream.query_service import QueryService
from socast.stream.source import Source, merge_sources
from socast.stream.zenoh_observer import ZenohObserver
from socast.stream.zenoh_queryable import ZenohQueryable, query_outlook
from socast.stream.zenoh_session import Connection, Node
from socast.stream.zenoh_sink import ZenohSink
from socast.stream.zenoh_source import ZenohSource
from socast.tools.terminal.recordings import open_recordings
from socast.tools.testing.made_recording import gather_messages, write_recording
from socast.tools.testing.replayed import Replayed, sort_rides, take_tables

LOOPBACK: Final = "tcp/127.0.0.1:0"
"""Where the consumer listens: a free port of loopback, and nowhere else."""
BURST: Final = 128
"""Number of messages that are published at once; Zenoh's channels hold more."""
PATIENCE_S: Final = 120.0
"""Longest wait for the consumer. [s]"""
_POLL_S: Final = 0.01
_INPUTS: Final = ("telemetry", "batch", "vehicle", "ride", "plan", "weather")
_Result = TypeVar("_Result")
Given: TypeAlias = str | Path | Iterable[Message | Mapping[str, Any]]
"""A recording, a folder of recordings, or messages and samples."""


class _Taken(NamedTuple):
    """Hold what the pipeline has made, and the number of forecasts that it has published."""

    rides: pd.DataFrame
    quality: pd.DataFrame
    forecasts: int


class LiveConsumer:
    """Run a consumer at a router on loopback, and a client that publishes to it; a context manager.

    Attributes
    ----------
    endpoint : str
        Where the consumer listens, for other clients.
    """

    def __init__(self, model: str | Path, out: Path) -> None:
        self._pipeline, self._out = Pipeline(models.load(str(model))), out
        self._stop, self._changed = Event(), Condition()
        self._failure: BaseException | None = None
        self._asked: list[Callable[[], None]] = []
        self._tally = Tally()
        self._rides: list[pd.DataFrame] = []
        self._received: list[Message] = []
        self._sent = 0
        with ExitStack() as opening:
            router = opening.enter_context(Node(Connection(listen=(LOOPBACK,), mode="router", recovery=False)))
            self.endpoint = router.endpoints[0]
            queries = opening.enter_context(ZenohQueryable(router))
            source, service = ZenohSource(router, self._stop), QueryService(queries, self._pipeline)
            self._client = opening.enter_context(Node(Connection(connect=(self.endpoint,), recovery=False)))
            self._observer = ZenohObserver(self._client, sent=())
            opening.callback(self._observer.close)
            self._publisher = ZenohSink(self._client)
            self._thread = Thread(
                target=self._run, args=(source, ZenohSink(router), service), name="socast-live", daemon=True
            )
            self._thread.start()
            opening.callback(self._end_thread)
            self._wait(self._publisher.has_subscriber, "the consumer does not subscribe")
            self._client.flush()  # the router then knows the subscription to forecasts
            self._closing = opening.pop_all()

    def publish(self, *given: Given) -> None:
        """Publish recordings, or messages and samples, and wait until the consumer has taken them.

        Messages that are no input, such as recorded forecasts, are left out.
        """
        self._refuse_ended()
        for burst in _divide(_read(given)):
            self._publisher.put(burst)
            self._sent += len(burst)
            self._wait(lambda: self._tally.received >= self._sent, "the consumer does not take what was published")

    def results(self) -> Replayed:
        """Return forecasts, rides that have ended and counters, of all that was published so far."""
        taken = self._take() if self._stop.is_set() else self._call(self._take)
        self._rides.append(taken.rides)
        self._wait(lambda: self._receive() >= taken.forecasts, "forecasts that were published do not arrive")
        rides = pd.concat([each for each in self._rides if len(each)] or self._rides[:1], ignore_index=True)
        write_recording(self._received, self._out)
        return Replayed(tabulate_forecasts(self._received), sort_rides(rides), taken.quality, self._out)

    def ask(self, vehicle: str, **ride: float) -> dict[str, Any]:
        """Ask the consumer for the outlook of a car, perhaps after one more ride: `distance_km` and `duration_s`."""
        self._refuse_ended()
        answer = query_outlook(self._client, vehicle, {name: str(value) for name, value in ride.items()})
        return dict(json.loads(answer))

    def finish(self) -> Replayed:
        """End the consumer, which closes the rides in progress, and return the results."""
        self._end_thread()
        return self.results()

    def close(self) -> None:
        """End the consumer and close the sessions; a second call has no effect."""
        self._closing.close()

    def __enter__(self) -> Self:
        """Return the consumer."""
        return self

    def __exit__(self, *_: object) -> None:
        """End the consumer."""
        self.close()

    def _run(self, source: ZenohSource, sink: ZenohSink, service: QueryService) -> None:
        """Run the loop of the service, in its thread."""

        def watch(tally: Tally) -> None:
            service(tally)
            with self._changed:
                self._tally = tally
                for act in self._asked:
                    act()
                self._asked.clear()
                self._changed.notify_all()

        try:
            self._tally = run(source, self._pipeline, [sink], watch=watch)
        except BaseException as error:  # noqa: BLE001 - the test raises it
            self._failure = error
        finally:
            with self._changed:
                self._changed.notify_all()

    def _take(self) -> _Taken:
        """Return what the pipeline has made; called where the loop does not run at the same time."""
        return _Taken(*take_tables(self._pipeline), self._tally.forecasts)

    def _receive(self) -> int:
        """Return the number of forecasts that have arrived from the consumer."""
        self._received += filter(is_forecast, self._observer.take())
        if self._observer.dropped:
            raise SettingsError(f"{self._observer.dropped:,} forecasts were dropped; ask for results() more often")
        return len(self._received)

    def _end_thread(self) -> None:
        """End the loop, which publishes the last forecasts; a second call has no effect."""
        self._stop.set()
        self._thread.join(PATIENCE_S)
        if self._thread.is_alive():
            raise SettingsError(f"the consumer does not end within {PATIENCE_S:g} s")

    def _call(self, act: Callable[[], _Result]) -> _Result:
        """Return what a function returns that is called in the thread of the loop."""
        results: list[_Result] = []
        with self._changed:
            self._asked.append(lambda: results.append(act()))
        self._wait(lambda: bool(results), "the consumer does not answer")
        return results[0]

    def _wait(self, condition: Callable[[], bool], failure: str) -> None:
        """Wait until something comes true; raise what ended the consumer."""
        deadline = time.monotonic() + PATIENCE_S
        while not condition():
            if self._failure is not None:
                raise self._failure
            if time.monotonic() > deadline:
                raise SettingsError(f"{failure} within {PATIENCE_S:g} s")
            with self._changed:
                self._changed.wait(_POLL_S)

    def _refuse_ended(self) -> None:
        if self._stop.is_set():
            raise SettingsError("the consumer has ended; start another one")


def _read(given: Sequence[Given]) -> Iterable[Message]:
    """Yield the messages of recordings, folders and lists that a consumer takes, merged by their times of receipt."""
    files = [each for each in given if isinstance(each, str | Path)]
    sources: list[Source] = [*open_recordings([Path(file) for file in files])]
    lists = [each for each in given if not isinstance(each, str | Path)]
    if made := gather_messages(*([each] if isinstance(each, Message | Mapping) else each for each in lists)):
        sources.append([made])
    messages: Iterable[Message] = chain.from_iterable(merge_sources(sources)) if sources else ()
    for message in messages:
        at = address(message.key)
        if at is None or at.kind not in _INPUTS:
            continue
        if not message.key.startswith(("fleet/", "weather/")):
            raise SettingsError(
                f"key {message.key!r} has a prefix; the consumer takes keys that begin with fleet/ or weather/"
            )
        yield message


def _divide(messages: Iterable[Message]) -> Iterator[list[Message]]:
    """Yield bursts of messages; those of weather alone, as it would overtake telemetry (`ZenohSource`)."""
    for _, group in groupby(messages, key=lambda message: message.key.startswith("weather/")):
        while burst := list(islice(group, BURST)):
            yield burst
