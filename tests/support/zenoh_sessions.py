"""Real Zenoh sessions on loopback, for tests."""

import faulthandler
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Event, Thread
from typing import Any

from socast.core.wire.messages import Message
from socast.stream.loop import run
from socast.stream.query_service import QueryService
from socast.stream.zenoh_queryable import ZenohQueryable
from socast.stream.zenoh_session import Connection, Node
from socast.stream.zenoh_source import ZenohSource
from tests.support.outlooks import Fleet


@contextmanager
def router(**settings: Any) -> Iterator[tuple[Node, str]]:
    """Give a node that listens at a free port, and where."""
    with Node(Connection(listen=("tcp/127.0.0.1:0",), **settings)) as node:
        yield node, node.endpoints[0]


LONG_WAIT = 30.0
"""Time after which a wait that failed shows what every thread does. [s]"""


def eventually(condition: Callable[[], object], seconds: float = 60.0) -> bool:
    """Return whether something comes true in time."""
    deadline = time.monotonic() + seconds
    while not (has_come := bool(condition())) and time.monotonic() < deadline:
        time.sleep(0.02)  # each question costs the service time, and some take the whole of a log
    if not has_come and seconds >= LONG_WAIT:
        faulthandler.dump_traceback()  # tells which thread waits for what
    return has_come


class Consumer(Fleet):
    """Takes telemetry and answers, as the pipeline does."""

    def __init__(self) -> None:
        super().__init__()
        self.taken: list[Message] = []

    def take(self, messages, record=None) -> None:
        if record:
            record(messages)
        self.taken += messages

    def forecasts(self, **_) -> list[Message]:
        return []

    model_errors = forecasts

    def finish(self) -> list[Message]:
        return []

    def quality(self) -> dict:
        return {}


@contextmanager
def serving(node: Node) -> Iterator[tuple[Consumer, QueryService]]:
    """Give a consumer whose loop runs in a thread, and its query service."""
    stop, consumer = Event(), Consumer()
    with ZenohQueryable(node) as queries:
        service = QueryService(queries, consumer)
        source = ZenohSource(node, stop)
        thread = Thread(target=run, args=(source, consumer), kwargs={"watch": service})
        thread.start()
        try:
            yield consumer, service
        finally:
            stop.set()
            thread.join(20)
    assert not thread.is_alive()


@contextmanager
def live(prefix: str = "") -> Iterator[tuple[Consumer, QueryService, Node]]:
    """Give a consumer whose loop runs in a thread, its query service, and a client at its router."""
    with (
        router(prefix=prefix) as (node, endpoint),
        serving(node) as (consumer, service),
        Node(Connection(connect=(endpoint,), prefix=prefix)) as client,
    ):
        yield consumer, service, client
