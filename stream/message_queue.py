"""A queue of received messages that is limited by number and by size, between a receiving thread and the loop."""

from collections import deque
from threading import Condition
from typing import Final

from socast.core.wire.message_block import MessageBlock

MOST_MESSAGES: Final = 1 << 14
"""Largest number of queued messages; more would exceed the CPU's cache."""


class MessageQueue:
    """Hold messages until the loop takes them; one thread puts and one thread takes.

    Parameters
    ----------
    most_bytes : float
        Size of the payloads from which the queue is full. [B]
    most_messages : int
        Number of messages from which the queue is full.

    Attributes
    ----------
    size : int
        Size of their payloads. [B]
    """

    def __init__(self, most_bytes: float, most_messages: int = MOST_MESSAGES) -> None:
        self.messages = 0
        self.size = 0
        self._most_bytes, self._most_messages = most_bytes, most_messages
        self._blocks: deque[tuple[MessageBlock, int, bool]] = deque()
        self._changed = Condition()
        self._has_ended = False

    def put(self, messages: MessageBlock, size: int, *, recovered: bool = False, patience_s: float) -> bool:
        """Append messages as soon as the queue is not full.

        Units: size [B].

        Returns
        -------
        bool
            False if the queue stayed full, or has ended; it then does not hold the messages.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._has_ended or not self._is_full(), patience_s)
            if self._has_ended or self._is_full():
                return False
            self._blocks.append((messages, size, recovered))
            self.messages += len(messages)
            self.size += size
            self._changed.notify_all()
        return True

    def wait(self, patience_s: float) -> bool:
        """Wait until messages are queued or the queue has ended; return whether messages are queued."""
        with self._changed:
            self._changed.wait_for(lambda: self._has_ended or self._blocks, patience_s)
            return bool(self._blocks)

    def take(self, most_messages: int, most_bytes: int) -> tuple[MessageBlock, bool]:
        """Remove the oldest messages up to a number and a size, but at least one block.

        Messages that came from the caches of publishers are not joined with others.

        Units: most_bytes [B].
        """
        out: list[MessageBlock] = []
        count = size = 0
        with self._changed:
            recovered = bool(self._blocks) and self._blocks[0][2]
            while self._blocks and self._blocks[0][2] == recovered and count < most_messages and size < most_bytes:
                messages, of_block, _ = self._blocks.popleft()
                out.append(messages)
                count, size = count + len(messages), size + of_block
            self.messages -= count
            self.size -= size
            self._changed.notify_all()
        return MessageBlock.join(out), recovered

    def end(self) -> None:
        """Accept no more messages; what is queued can still be taken."""
        with self._changed:
            self._has_ended = True
            self._changed.notify_all()

    def drop(self) -> int:
        """Accept no more messages, remove what is queued, and return the number of removed messages."""
        with self._changed:
            self.end()
            count, self.messages, self.size = self.messages, 0, 0
            self._blocks.clear()
        return count

    @property
    def has_ended(self) -> bool:
        """Return whether no more messages will come."""
        return self._has_ended

    def _is_full(self) -> bool:
        """Return whether nothing may be appended."""
        return self.messages >= self._most_messages or self.size >= self._most_bytes
