"""What the other shards of a fleet contribute to daily updates, received over Zenoh beside the samples."""

from collections.abc import Iterator
from contextlib import suppress
from typing import Any, Final

import zenoh
from zenoh import ext, handlers

from socast.core.forecast.shard_days import SPACE
from socast.core.wire.message_block import MessageBlock
from socast.core.wire.messages import Message
from socast.core.wire.shard import Shard
from socast.stream.receipt_clock import ReceiptClock
from socast.stream.zenoh_session import Node
from socast.stream.zenoh_source import ZenohSource

WAITING: Final = 1 << 10
"""Number of contributions that may wait; a shard has one a day."""


class ShardedSource:
    """Add the contributions of other shards to the lists of a source; all else is that of the source.

    A shard that starts asks the caches of the others for their last contributions.

    Parameters
    ----------
    source : ZenohSource
    node : Node
        Session and prefix.
    shard : Shard
        The own shard, of which nothing is received.
    """

    def __init__(self, source: ZenohSource, node: Node, shard: Shard) -> None:
        self._source, self._clock = source, ReceiptClock()
        self._own = f"{node.prefix}{SPACE}{shard.chunk}"
        channel: Any = handlers.RingChannel(WAITING)
        self._subscriber: Any = ext.declare_advanced_subscriber(
            node.session,
            f"{node.prefix}{SPACE}*",
            channel,
            allowed_origin=zenoh.Locality.REMOTE,
            history=ext.HistoryConfig(detect_late_publishers=True),
            recovery=ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
        )

    def __iter__(self) -> Iterator[MessageBlock]:
        """Yield the blocks of the source, with the contributions that have come behind them."""
        for messages in self._source:
            yield MessageBlock.join([messages, self._take()])
        with suppress(zenoh.ZError):
            self._subscriber.undeclare()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._source, name)

    def _take(self) -> list[Message]:
        """Return the contributions that have come."""
        out: list[Message] = []
        with suppress(zenoh.ZError):  # closed
            while (sample := self._subscriber.handler.try_recv()) is not None:
                if (key := str(sample.key_expr)) != self._own:
                    out.append(Message(key, sample.payload.to_bytes(), self._clock.read_ns()))
        return out
