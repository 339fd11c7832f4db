"""Messages of a recording that wait to be sorted by their time of receipt, within a limit of memory."""

from math import inf
from typing import Final

import numpy as np

from socast.core.wire.message_block import MessageBlock

MOST_HELD: Final = 256 << 20
"""Size of messages that wait for earlier ones, beyond which they are delivered out of order. [B]"""
_MESSAGE_BYTES: Final = 32  # of memory that a message takes in addition to its payload
_SORTED_SHARE: Final = 8  # ratio of waiting to new messages at which these are sorted


class WaitingMessages:
    """Hold messages that may have to wait for earlier ones of later blocks, and release them in order.

    Messages that wait are copied, because they would keep the memory of their whole chunk.

    Attributes
    ----------
    disordered : int
        Number of messages that came after messages with a later time of receipt had been released.
    """

    def __init__(self) -> None:
        self.disordered = 0
        self._sorted = MessageBlock.of([])
        self._fresh: list[MessageBlock] = []
        self._count = 0  # of fresh messages
        self._bytes = 0
        self._newest_ns = 0

    def release(self, messages: MessageBlock, following: float) -> MessageBlock:
        """Add the messages of a block; return those up to the time of the next block, in order.

        A few new messages wait until there are more: to sort many waiting messages for each small block would take a
        time that is quadratic in the size of the file.
        """
        self._count += len(messages)
        is_full = self._bytes > MOST_HELD
        if following < inf and not is_full and _SORTED_SHARE * self._count < len(self._sorted):
            self._fresh.append(messages.compact())
            self._bytes += _measure(messages)
            return messages[:0]
        whole = MessageBlock.join([self._sorted, *self._fresh, messages]).sort()
        times = whole.receipt_ns
        cut = len(whole) if is_full or following == inf else int(np.searchsorted(times, np.uint64(following), "right"))
        ready, left = whole[:cut], whole[cut:]
        self._sorted, self._fresh, self._count = left.compact(), [], 0
        self._bytes = _measure(self._sorted)
        if cut:
            self.disordered += int(np.searchsorted(times[:cut], np.uint64(self._newest_ns)))
            self._newest_ns = max(self._newest_ns, int(times[cut - 1]))
        return ready


def _measure(messages: MessageBlock) -> int:
    """Return about how much memory messages take. [B]"""
    return messages.size + _MESSAGE_BYTES * len(messages)
