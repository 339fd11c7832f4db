"""Pipelines that divide a fleet, in one process: each gets its cars, all weather, and what the others contribute."""

from collections.abc import Sequence

from socast.core.wire.messages import BATCH, Message
from socast.core.wire.shard import Shard
from socast.stream.sharded_pipeline import ShardedPipeline


def is_of(message: Message, shard: Shard) -> bool:
    """Return whether a shard receives a message: its cars by their names, and everything that is not about one car."""
    chunks = message.key.split("/")
    return "fleet" not in chunks or chunks[-1] == BATCH or shard.has(chunks[chunks.index("fleet") + 1])


def run_divided(
    messages: Sequence[Message], count: int, size: int = 500, pipelines: Sequence[ShardedPipeline] = ()
) -> tuple[list[Message], list[ShardedPipeline]]:
    """Return the forecasts of all shards, and the pipelines.

    Parameters
    ----------
    messages : sequence of Message
    count : int
        Number of shards.
    size : int
        Number of messages that pass before the shards exchange what they contribute.
    pipelines : sequence of ShardedPipeline
        Shards to go on with.
    """
    shards = list(pipelines) or [ShardedPipeline(Shard(index, count)) for index in range(1, count + 1)]
    out: list[Message] = []
    for start in range(0, len(messages), size):
        part = messages[start : start + size]
        for pipeline in shards:
            out += pipeline.push([message for message in part if is_of(message, pipeline.shard)])
        out += exchange(shards)
    return out, shards


def exchange(shards: Sequence[ShardedPipeline]) -> list[Message]:
    """Give each shard what the others contribute, until nobody has anything to say; return forecasts, where any."""
    out: list[Message] = []
    while True:
        sent = [message for pipeline in shards for message in pipeline.days.take_outgoing()]
        if not sent:
            return out
        for pipeline in shards:
            pipeline.take([message for message in sent if not message.key.endswith(pipeline.shard.chunk)])
            out += pipeline.forecasts()
