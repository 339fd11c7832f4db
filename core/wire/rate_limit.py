"""Limit the messages of each key per second, by the times of receipt: a recording leads to the same decisions.

A bucket of each key holds up to `burst` messages and is refilled at the rate. A message takes one, and is refused where
there is none. The bucket of a key that was not heard of for long is full, so that it need not be kept. Buckets are no
part of the state, because that must not depend on when a message was received; they are full after a start.
"""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from socast.core.batch import Floats, grown
from socast.core.compiled_cache import njit
from socast.core.wire.message_block import KeyValues, MessageBlock
from socast.core.wire.messages import Message

MOST_KEYS: Final = 1 << 18
"""Number of keys from which on full buckets are forgotten."""


class RateLimit:
    """Refuse messages of keys that send more than a rate.

    Parameters
    ----------
    rate : float
        Messages of a key per second; 0 for no limit. [1/s]
    burst : float
        Number of messages that a key may send at once.
    """

    def __init__(self, rate: float, burst: float) -> None:
        self._rate, self._burst = rate, burst
        self._place: dict[str, int] = {}
        self._places = KeyValues(lambda key: self._place.setdefault(key, len(self._place)), np.int64)
        self._tokens, self._last = np.zeros(0), np.zeros(0)

    def select(self, messages: Sequence[Message]) -> MessageBlock:
        """Return the messages that are within the limit; the given block itself if all are."""
        messages = MessageBlock.of(messages)
        if self._rate == 0.0 or not messages:
            return messages
        places, known = self._places.get(messages), self._place
        if len(self._tokens) < len(known):
            self._tokens, self._last = grown(self._tokens, len(known), self._burst), grown(self._last, len(known))
        receipts = messages.receipt_ns.astype(np.float64) * 1e-9
        kept = np.ones(len(messages), np.bool_)
        _take_tokens(places, receipts, self._rate, self._burst, self._tokens, self._last, kept)
        if len(known) > MOST_KEYS:
            self._forget_full()
        return messages if kept.all() else messages.take(kept)

    def _forget_full(self) -> None:
        """Forget the buckets that are full by the newest receipt."""
        count = len(self._place)
        tokens, last = self._tokens[:count], self._last[:count]
        left = np.flatnonzero(tokens + self._rate * (last.max() - last) < self._burst)
        keys = list(self._place)
        self._place = {keys[old]: new for new, old in enumerate(left.tolist())}
        self._tokens, self._last = tokens[left], last[left]
        self._places.forget()


@njit(cache=True)
def _take_tokens(
    places: Any, receipts: Floats, rate: float, burst: float, tokens: Floats, last: Floats, kept: Any
) -> None:
    """Refill and empty the buckets by messages, in their order, and write which of them are kept."""
    for i in range(len(places)):
        at = places[i]
        passed = max(receipts[i] - last[at], 0.0)
        tokens[at] = min(tokens[at] + rate * passed, burst)
        last[at] = max(receipts[i], last[at])
        kept[i] = tokens[at] >= 1.0
        tokens[at] -= 1.0 if kept[i] else 0.0
