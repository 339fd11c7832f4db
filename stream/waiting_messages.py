"""Messages of a recording that wait to be sorted by their time of receipt, within a limit of memory."""

from bisect import bisect_left, bisect_right
from math import inf
from operator import itemgetter
from typing import Final

from core.wire.messages import Message

MOST_HELD: Final = 256 << 20
"""Size of messages that wait for earlier ones, beyond which they are delivered out of order. [B]"""
_MESSAGE_BYTES: Final = 128  # of memory that a message takes in addition to its payload
_SORTED_SHARE: Final = 8  # ratio of waiting to new messages at which these are sorted
_payload, _receipt = itemgetter(1), itemgetter(2)


class WaitingMessages:
    """Hold messages that may have to wait for earlier ones of later blocks, and release them in order.

    Attributes
    ----------
    disordered : int
        Number of messages that came after messages with a later time of receipt had been released.
    """

    def __init__(self) -> None:
        self.disordered = 0
        self._sorted: list[Message] = []
        self._fresh: list[Message] = []
        self._bytes = 0
        self._newest_ns = 0

    def release(self, messages: list[Message], following: float) -> list[Message]:
        """Add the messages of a block; return those up to the time of the next block, in order.

        A few new messages wait until there are more: to sort many waiting messages for each small block would take a
        time that is quadratic in the size of the file.
        """
        self._fresh += messages
        is_full = self._bytes > MOST_HELD
        if following < inf and not is_full and _SORTED_SHARE * len(self._fresh) < len(self._sorted):
            self._bytes += _measure(messages)
            return []
        self._sorted += self._fresh
        self._sorted.sort(key=_receipt)
        cut = len(self._sorted) if is_full else bisect_right(self._sorted, following, key=_receipt)
        ready, self._sorted, self._fresh = self._sorted[:cut], self._sorted[cut:], []
        self._bytes = _measure(self._sorted)
        if ready:
            self.disordered += bisect_left(ready, self._newest_ns, key=_receipt)
            self._newest_ns = max(self._newest_ns, ready[-1].receipt_ns)
        return ready


def _measure(messages: list[Message]) -> int:
    """Return about how much memory messages take. [B]"""
    return sum(map(len, map(_payload, messages))) + _MESSAGE_BYTES * len(messages)
