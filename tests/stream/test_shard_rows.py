"""A shard takes the rows of its own cars from the batches of gateways."""

import pyarrow as pa
import pytest

from socast.core.pipeline import Pipeline
from socast.core.settings import Limits
from socast.core.wire.arrow_batch import PREFIX, write_rows
from socast.core.wire.message_block import MessageBlock
from socast.core.wire.messages import Message
from socast.core.wire.shard import Shard
from socast.stream.checkpoints import Checkpoints
from socast.stream.mcap_reader import McapSource
from socast.stream.shard_rows import ShardSource
from socast.stream.state_file import StateFile
from tests.support.commands import called
from tests.support.paths import RECORDINGS

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


@pytest.mark.parametrize("index", [1, 2])
def test_a_shard_keeps_of_a_whole_fleets_recording_its_own_cars_and_all_that_the_fleet_taught(index):
    earlier = Pipeline()
    earlier.push([message for block in McapSource(RECORDINGS / "shift.mcap") for message in block])
    pipeline, shard = Pipeline(), Shard(index, 2)
    pipeline.learn_from(earlier, shard.has)
    assert pipeline.lanes.names == [name for name in earlier.lanes.names if shard.has(name)]
    assert 0 < len(pipeline.lanes) < len(earlier.lanes)
    assert pipeline.engine.statistics.energies.dump() == earlier.engine.statistics.energies.dump()
    again = Pipeline()
    again.restore(pipeline.snapshot())
    assert again.lanes.names == pipeline.lanes.names


def test_a_state_with_cars_of_another_shard_is_refused(tmp_path):
    pipeline = Pipeline()
    pipeline.push([Message("fleet/b2/telemetry", b'{"vehicle_id": "b2", "time_s": 1e9}', 1)])
    with StateFile(tmp_path / "x.state") as state:
        Checkpoints(pipeline, state, None).save()
    connection = ("--connect", "tcp/127.0.0.1:1", "--state", tmp_path / "x.state")
    _, err, code = called("live", "--shard", "1/2", *connection)
    assert code == 2
    assert "holds b2, which shard 1/2 does not serve" in err
