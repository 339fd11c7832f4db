"""A shard takes the rows of its own cars from the batches of gateways."""

import pyarrow as pa

from socast.core.pipeline import Pipeline
from socast.core.settings import Limits
from socast.core.wire.arrow_batch import PREFIX, write_rows
from socast.core.wire.message_block import MessageBlock
from socast.core.wire.messages import Message
from socast.core.wire.shard import Shard
from socast.stream.shard_rows import ShardSource

ROWS = {"vehicle_id": ["a1", "b2", "c3", "d4", "a1"], "time_s": [1e9 + 3.0 * at for at in range(5)]}


class ListSource:
    """Yield one block of messages, as a source does."""

    missed = 4

    def __init__(self, messages):
        self.messages = messages

    def __iter__(self):
        yield MessageBlock.of(self.messages)


def test_rows_of_a_batch_are_taken_by_the_shards_of_their_cars_and_recorded_as_such():
    whole = Message("fleet/depot1/batch", write_rows(pa.table(ROWS)), 1)
    broken = Message("fleet/depot1/batch", PREFIX + b"x", 2)
    taken = []
    for index in (1, 2):
        recorded, pipeline = [], Pipeline()
        source = ShardSource(ListSource([whole, broken, whole]), Shard(index, 2), Limits())
        for messages in source:
            pipeline.take(messages, recorded.extend)
        names, quality = pipeline.lanes.names, pipeline.quality()
        taken.append((names, quality["received"], quality["duplicates"], quality["undecodable"]))
        again = Pipeline()
        again.push(recorded)
        assert again.lanes.names == names
        assert source.missed == 4
    assert taken[0] == (["a1", "c3"], {"telemetry": 3}, 3, {"not_arrow": 1})
    assert taken[1] == (["b2", "d4"], {"telemetry": 2}, 2, {})


def test_other_messages_and_batches_of_own_cars_pass_unchanged():
    own = Message("fleet/depot1/batch", write_rows(pa.table({"vehicle_id": ["a1"], "time_s": [1e9]})), 1)
    weather = Message("weather/yul", b"{}", 2)
    (block,) = ShardSource(ListSource([own, weather]), Shard(1, 2), Limits())
    assert list(block) == [own, weather]


def test_a_batch_that_is_too_large_is_left_to_the_shard_of_its_gateway():
    large = Message("fleet/depot1/batch", bytes(2000), 1)
    limits = Limits(payload_bytes=1000)
    blocks = [list(*ShardSource(ListSource([large]), Shard(index, 2), limits)) for index in (1, 2)]
    assert blocks == [[large], []]
