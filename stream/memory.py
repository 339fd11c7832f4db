"""A source and a sink in memory, for tests and for messages that are already in memory."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from socast.core.wire.messages import Message
from socast.stream.closeable import Closeable


@dataclass
class MemorySource:
    """Yield the messages of a list as a source.

    Parameters
    ----------
    chunk : int
        Largest number of messages per yielded list. [1]
    """

    messages: Sequence[Message]
    chunk: int = 4096

    def __iter__(self) -> Iterator[list[Message]]:
        """Yield the messages in their order, `chunk` messages at a time."""
        for at in range(0, len(self.messages), self.chunk):
            yield list(self.messages[at : at + self.chunk])


@dataclass
class MemorySink(Closeable):
    """Keep every message as a sink.

    Parameters
    ----------
    messages : list of Message
        All messages that were put, in order.
    """

    messages: list[Message] = field(default_factory=list)
    closed: bool = False

    def put(self, messages: Sequence[Message]) -> None:
        """Append messages to the list."""
        self.messages += messages

    def close(self) -> None:
        """Set `closed`."""
        self.closed = True
