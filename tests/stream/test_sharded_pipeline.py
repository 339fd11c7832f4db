"""Shards of a fleet make the forecasts of one consumer, to the bit, with what all of them learn."""

import numpy as np
import pytest

from core.errors import SocastError
from core.wire.messages import Message
from core.wire.shard import Shard
from stream.sharded_pipeline import ShardedPipeline
from tests.support.divided_fleets import exchange, is_of, run_divided
from tests.support.shards import make_night

BEFORE_S, AFTER_S = 2700.0, 1200.0
"""Time before and after midnight: rides end before the half hour that counts for the second update. [s]"""


@pytest.fixture(scope="module")
def night(tmp_path_factory) -> list[Message]:
    return make_night(tmp_path_factory.mktemp("night") / "night.mcap", 7, BEFORE_S, AFTER_S)


@pytest.fixture(scope="module")
def expected(night):
    return run_divided(night, 1)


def tables_of(pipeline: ShardedPipeline) -> str:
    """Return everything that the cars of a fleet learn together."""
    statistics = pipeline.engine.statistics
    rides = {name: sums.sums.dump() for name, sums in statistics.rides._sums.items()}
    learned = statistics.conformal.table, statistics.correction.factor, statistics.daily_cycle._since_midnight
    return repr((rides, statistics.rides.tables, [part.tolist() for part in learned], statistics.factors._drivers))


@pytest.mark.parametrize(("count", "size"), [(2, 501), (5, 299)])
def test_forecasts_of_all_shards_are_those_of_one_consumer_to_the_bit(night, expected, count, size):
    out, shards = run_divided(night, count, size)
    assert len(out) > 300
    assert sorted(out) == sorted(expected[0])
    assert {tables_of(shard) for shard in shards} == {tables_of(expected[1][0])}
    assert all(shard.days.tables_of == shard.days.ended > 0 for shard in shards)


def test_the_update_changes_forecasts(night, expected):
    alone = ShardedPipeline(Shard(1, 2)).push(night)
    assert sorted(alone) != sorted(expected[0])


def test_an_absent_shard_blocks_nothing_and_is_left_out_of_the_next_update(night):
    shard = ShardedPipeline(Shard(2, 2))
    out = shard.push([message for message in night if is_of(message, shard.shard)])
    cars = {message.key for message in out}
    assert cars == {
        message.key.replace("telemetry", "forecast")
        for message in night
        if "/telemetry" in message.key and is_of(message, shard.shard)
    }
    assert shard.days.absent == (1,)
    assert shard.days.tables_of == shard.days.ended - 1
    shard.days.end_day(shard.days.ended + 1)
    assert shard.days.left_out == 1
    assert shard.days.tables_of == shard.days.ended - 1
    assert shard.days.absent == (1,)


def test_a_restart_at_any_place_changes_no_forecast(night, expected):
    rng = np.random.default_rng(1)
    shards = [ShardedPipeline(Shard(index, 2)) for index in (1, 2)]
    out = []
    for part in np.array_split(np.arange(len(night)), 12):
        out += run_divided([night[i] for i in part], 2, 200, shards)[0]
        which = int(rng.integers(2))
        again = ShardedPipeline(shards[which].shard)
        again.restore(shards[which].snapshot())
        shards[which] = again
        out += exchange(shards)
    assert sorted(out) == sorted(expected[0])


def test_a_shard_that_comes_back_contributes_late_and_has_the_same_tables(night, expected):
    shards = [ShardedPipeline(Shard(index, 2)) for index in (1, 2)]
    for shard in shards:  # one after the other, without a word between them
        shard.push([message for message in night if is_of(message, shard.shard)])
    assert [shard.days.absent for shard in shards] == [(2,), (1,)]
    exchange(shards)
    assert [shard.days.absent for shard in shards] == [(), ()]
    assert tables_of(shards[0]) == tables_of(shards[1]) == tables_of(expected[1][0])


def test_a_shard_without_cars_contributes_nothing_and_blocks_nothing(night, expected):
    shards = [ShardedPipeline(Shard(index, 2)) for index in (1, 2)]
    out = shards[0].push(night[:-200])
    exchange(shards)
    assert [shard.days.absent for shard in shards] == [(), ()]
    assert tables_of(shards[0]) == tables_of(shards[1]) == tables_of(expected[1][0])
    assert out


def test_a_shard_of_parked_cars_ends_the_day_with_the_others(night):
    silent = next(m.key for m in night if m.key.endswith("/telemetry"))
    shards = [ShardedPipeline(Shard(index, 2)) for index in (1, 2)]
    owner = next(shard for shard in shards if shard.shard.has(silent.split("/")[1]))
    early = [m for m in night if m.receipt_ns < night[0].receipt_ns + 1500 * 10**9]
    for shard in shards:
        mine = [m for m in (early if shard is owner else night) if is_of(m, shard.shard)]
        shard.push(mine)
    exchange(shards)
    assert [shard.days.absent for shard in shards] == [(), ()]
    assert not owner.cleaner.state["riding"].any()


def test_the_state_of_another_shard_is_refused():
    state = ShardedPipeline(Shard(1, 2)).snapshot()
    with pytest.raises(SocastError, match="that of shard 1/2, and this is shard 2/2"):
        ShardedPipeline(Shard(2, 2)).restore(state)


@pytest.mark.parametrize(
    "payload",
    [b"", b"{}", b'{"shard":"1/3","day":17547,"content":""}', b'{"shard":"1/2","day":17547,"content":"eJwDAAAAAAE="}'],
)
def test_what_is_no_contribution_changes_nothing(payload):
    shard = ShardedPipeline(Shard(2, 2))
    shard.push([Message("socast/shards/1-of-2", payload, 0)])
    assert shard.days.begun == []
