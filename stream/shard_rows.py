"""What a shard takes of the batches of gateways, which go to every shard: the rows of its own cars."""

from collections.abc import Iterator
from typing import Any, Final

import numpy as np

from socast.core.settings import Limits
from socast.core.wire.arrow_batch import BatchReader, select_rows
from socast.core.wire.message_block import KeyValues, MessageBlock
from socast.core.wire.messages import BATCH, Message
from socast.core.wire.shard import Shard
from socast.stream.zenoh_source import ZenohSource

_END: Final = f"/{BATCH}"


class ShardSource:
    """Leave the rows of other shards out of the batches of a source; all else is that of the source."""

    def __init__(self, source: ZenohSource, shard: Shard, limits: Limits) -> None:
        self._source, self._shard, self._limits = source, shard, limits
        self._batches = BatchReader(limits.list_samples)
        self._are_batches = KeyValues(lambda key: key.endswith(_END), np.bool_)

    def __iter__(self) -> Iterator[MessageBlock]:
        for block in self._source:
            if self._are_batches.get(block).any():
                own = (self._cut(each) if each.key.endswith(_END) else each for each in block)
                yield MessageBlock.of([message for message in own if message is not None])
            else:
                yield block

    def __getattr__(self, name: str) -> Any:
        return getattr(self._source, name)

    def _cut(self, message: Message) -> Message | None:
        """Return a batch with the rows of this shard's cars only; None without any.

        A batch that cannot be read is left to the shard of the gateway's name, which counts it.
        """
        is_large = len(message.payload) > self._limits.payload_bytes
        rows = "too_large" if is_large else self._batches.take(message.payload)
        if isinstance(rows, str):
            return message if self._shard.has(message.key.split("/")[-2]) else None
        own = [self._shard.has(rows.vehicles.get(at)) for at in range(len(rows.is_usable))]
        if all(own):
            return message
        return message._replace(payload=select_rows(message.payload, own)) if any(own) else None
