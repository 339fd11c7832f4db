"""A sink behind a thread: `put` never waits, and only the newest message of each key is passed on."""

from collections.abc import Sequence
from threading import Condition, Thread

from core.wire.messages import Message
from stream.source import Sink


class LatestOnlySink:
    """Pass messages to a sink from a thread of its own, the newest of each key.

    The loop must not wait for its listeners: a stalled listener would hold up every car. A Zenoh session that declares a
    publisher also waits for the samples that it is delivering, and these wait for the loop to take them. A message that
    cannot be passed on at once is replaced by the next one of its key, so the number of keys bounds the memory.

    Parameters
    ----------
    sink : Sink
        Used by the thread only.
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
        """Leave messages to be passed on.

        Raises
        ------
        Exception
            Whatever stopped the sink.
        """
        self._raise_failure()
        if messages:
            with self._changed:
                self._newest.update((message.key, message) for message in messages)
                self._changed.notify()

    def close(self) -> None:
        """Wait until all messages have been passed on, and close the sink.

        Raises
        ------
        Exception
            Whatever stopped the sink, unless `put` has raised it.
        """
        with self._changed:
            self._closing = True
            self._changed.notify()
        self._thread.join()
        self._sink.close()
        if not self._raised:
            self._raise_failure()

    def _raise_failure(self) -> None:
        """Raise what stopped the sink."""
        if self._failure is not None:
            self._raised = True
            raise self._failure

    def _work(self) -> None:
        """Pass on what has come, until closed."""
        while True:
            with self._changed:
                while not (self._newest or self._closing):
                    self._changed.wait()
                taken, self._newest = self._newest, {}
            if not taken:
                return
            try:
                self._sink.put(list(taken.values()))
            except Exception as failure:  # noqa: BLE001 - raised by the next put
                self._failure = failure
                return
