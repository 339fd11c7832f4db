"""A sink behind a thread: who puts never waits, and of each key the newest message is handed on."""

from collections.abc import Sequence
from threading import Condition, Thread

from core.wire.messages import Message
from stream.source import Sink


class LatestOnlySink:
    """Hands messages to a sink from a thread of its own.

    The loop that listens must not wait for those that it speaks to: a listener that has stalled would hold up every
    car, and a Zenoh session that declares a publisher waits for the samples that it is delivering, which wait for the
    loop to take them. What cannot be handed on at once is replaced when there is something newer of its key, so that
    memory is bounded by the number of keys.

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
        self._told = False
        self._thread = Thread(target=self._work, name="outbox", daemon=True)
        self._thread.start()

    def put(self, messages: Sequence[Message]) -> None:
        """Leave messages to be handed on.

        Raises
        ------
        Exception
            Whatever stopped the sink.
        """
        self._tell()
        if messages:
            with self._changed:
                self._newest.update((message.key, message) for message in messages)
                self._changed.notify()

    def close(self) -> None:
        """Wait until all has been handed on, and close the sink.

        Raises
        ------
        Exception
            Whatever stopped the sink, if nobody was told.
        """
        with self._changed:
            self._closing = True
            self._changed.notify()
        self._thread.join()
        self._sink.close()
        if not self._told:
            self._tell()

    def _tell(self) -> None:
        """Raise what stopped the sink."""
        if self._failure is not None:
            self._told = True
            raise self._failure

    def _work(self) -> None:
        """Hand on what there is, until closed."""
        while True:
            with self._changed:
                while not (self._newest or self._closing):
                    self._changed.wait()
                taken, self._newest = self._newest, {}
            if not taken:
                return
            try:
                self._sink.put(list(taken.values()))
            except Exception as failure:  # noqa: BLE001 - told to whoever puts next
                self._failure = failure
                return
