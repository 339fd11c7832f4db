"""A sink with its own thread: `put` never waits, and the thread passes on only the newest message of each key."""

from collections.abc import Sequence
from threading import Condition, Thread

from socast.core.wire.messages import Message
from socast.stream.source import Sink


class LatestOnlySink:
    """Pass the newest message of each key to a sink, from a separate thread.

    The loop must not wait for its subscribers, because one stalled subscriber would delay every car. A Zenoh session
    that declares a publisher also waits for the samples that it is delivering, and these samples wait for the loop. The
    next message of a key replaces a message that the thread could not yet pass on. The number of keys therefore bounds
    the memory.

    Parameters
    ----------
    sink : Sink
        Sink that receives the messages. Only the thread puts messages into it.
    """

    def __init__(self, sink: Sink) -> None:
        self._sink = sink
        self._newest: dict[str, Message] = {}
        self._changed = Condition()
        self._closing = False
        self._failure: Exception | None = None
        self._raised = False
        self._thread = Thread(target=self._work, name="latest-only-sink", daemon=True)
        self._thread.start()

    def put(self, messages: Sequence[Message]) -> None:
        """Hand messages to the thread without waiting for the sink."""
        self._raise_failure()
        if messages:
            with self._changed:
                self._newest.update((message.key, message) for message in messages)
                self._changed.notify()

    def close(self) -> None:
        """Wait until the thread has passed on all messages, then close the sink."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        self._thread.join()
        self._sink.close()
        if not self._raised:
            self._raise_failure()

    def _raise_failure(self) -> None:
        """Raise the error that stopped the sink, if any."""
        if self._failure is not None:
            self._raised = True
            raise self._failure

    def _work(self) -> None:
        """Pass waiting messages to the sink until the sink is closed."""
        while True:
            with self._changed:
                while not (self._newest or self._closing):
                    self._changed.wait()
                taken, self._newest = self._newest, {}
            if not taken:
                return
            try:
                self._sink.put(list(taken.values()))
            except Exception as failure:  # noqa: BLE001 - the next put raises it
                self._failure = failure
                return
