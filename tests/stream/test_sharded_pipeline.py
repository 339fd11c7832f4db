"""Shards of a fleet make the forecasts of one consumer, to the bit, with what all of them learn."""

import base64
import random
import zlib

import msgspec
import numpy as np
import pyarrow as pa
import pytest

from socast.core.errors import SocastError
from socast.core.forecast.day_schema import CONTENT
from socast.core.forecast.shard_days import Contribution
from socast.core.pipeline import Pipeline
from socast.core.wire.arrow_batch import PREFIX, write_rows
from socast.core.wire.messages import Leg, Message, Plan
from socast.core.wire.shard import Shard
from socast.stream.sharded_pipeline import ShardedPipeline
from tests.support.divided_fleets import exchange, is_of, run_divided
from tests.support.forged_states import find_parts, list_mutations, replace
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


def test_rows_of_a_gateways_batch_are_taken_by_the_shards_of_their_cars():
    rows = {"vehicle_id": ["a1", "b2", "c3", "d4", "a1"], "time_s": [1e9 + 3.0 * at for at in range(5)]}
    whole = Message("fleet/depot1/batch", write_rows(pa.table(rows)), 1)
    broken = Message("fleet/depot1/batch", PREFIX + b"x", 2)
    taken = []
    for index in (1, 2):
        recorded = []
        shard = ShardedPipeline(Shard(index, 2))
        shard.take([whole, broken, whole], recorded.extend)
        names, quality = shard.lanes.names, shard.quality()
        taken.append((names, quality["received"], quality["duplicates"], quality["undecodable"]))
        again = ShardedPipeline(Shard(index, 2))
        again.push(recorded)
        assert again.lanes.names == names
    assert taken[0] == (["a1", "c3"], {"telemetry": 3}, 3, {"not_arrow": 1})
    assert taken[1] == (["b2", "d4"], {"telemetry": 2}, 2, {})


def test_shards_by_a_chunk_of_the_key_make_the_forecasts_of_one_consumer_without_that_chunk(night):
    sent = []
    for message in night[:3000]:
        chunks = message.key.split("/")
        area = [chunks[1][-1]] if chunks[0] == "fleet" else []
        sent.append(message._replace(key="/".join(["city", *area, *chunks])))

    def run(count):
        """Return the forecasts of all shards; areas are divided as names that are single digits."""
        out = []
        for index in range(1, count + 1):
            shard = ShardedPipeline(Shard(index, count, "chunk"), prefix="city/")
            out += shard.push([m for m in sent if "/fleet/" not in m.key or shard.shard.has(m.key.split("/")[1])])
        return sorted(out)

    expected = run(1)
    assert {message.key.rsplit("/", 2)[0] for message in expected} == {"city/fleet"}
    assert run(2) == expected


@pytest.mark.parametrize(("by", "kept"), [("name", 2), ("chunk", 5)])
def test_a_shard_takes_over_what_earlier_recordings_told_of_its_cars(night, by, kept):
    earlier = Pipeline()
    earlier.push([m for m in night[:2000] if not m.key.endswith("7/telemetry") and not m.key.endswith("6/telemetry")])
    shard = ShardedPipeline(Shard(1, 2, by))
    shard.learn_from(earlier)
    assert shard.lanes.names == [name for name in earlier.lanes.names if by == "chunk" or shard.shard.has(name)]
    assert len(shard.lanes) >= kept
    assert len(shard.engine.state) >= len(shard.lanes)


def test_a_batch_stays_whole_where_a_chunk_of_the_key_divides_the_fleet():
    shard = ShardedPipeline(Shard(1, 2, "chunk"))
    shard.take([Message("1/fleet/depot/batch", write_rows(pa.table({"vehicle_id": ["b2"], "time_s": [1e9]})), 1)])
    assert shard.lanes.names == ["b2"]


def test_a_plan_of_a_car_that_has_sent_nothing_waits_for_its_samples(night):
    names = [f"taxi-{number:03}" for number in range(20)]
    shard = ShardedPipeline(Shard(1, 1))
    shard.push(night[:500])
    plans = [Plan(name, 1_516_057_300.0, 1_516_060_000.0, 10.0, [Leg(5.0, 600.0)]) for name in names]
    shard.push([Message(f"fleet/{each.vehicle_id}/plan", msgspec.json.encode(each), 0) for each in plans])
    assert len(shard.plans.dump()) == len(names)


@pytest.mark.parametrize(
    "payload",
    [b"", b"{}", b'{"shard":"1/3","day":17547,"content":""}', b'{"shard":"1/2","day":17547,"content":"eJwDAAAAAAE="}'],
)
def test_what_is_no_contribution_changes_nothing(payload):
    shard = ShardedPipeline(Shard(2, 2))
    shard.push([Message("socast/shards/1-of-2", payload, 0)])
    assert shard.days.begun == []


def test_no_forged_contribution_does_harm(night):
    shards = [ShardedPipeline(Shard(index, 2)) for index in (1, 2)]
    for shard in shards:
        shard.push([message for message in night if is_of(message, shard.shard)])
    (sent,), rng = shards[0].days.take_outgoing(), random.Random(5)
    known = msgspec.json.decode(sent.payload, type=Contribution)
    content = msgspec.msgpack.decode(zlib.decompress(base64.b64decode(known.content)))
    state, refused, tried, shard = shards[1].snapshot(), 0, 0, shards[1]
    for path, value in find_parts(CONTENT, content, places=1):
        for mutation in rng.sample(every := list_mutations(value), min(4, len(every))):
            packed = msgspec.msgpack.encode(replace(content, path, mutation))
            forged = msgspec.structs.replace(known, content=base64.b64encode(zlib.compress(packed)).decode())
            shard.take([Message(sent.key, msgspec.json.encode(forged), 0)])
            refused, tried = refused + bool(shard.days.absent), tried + 1
            if not shard.days.absent:  # it was used
                shard.push([message for message in night[-20:] if is_of(message, shard.shard)])
                shard = ShardedPipeline(Shard(2, 2))
                shard.restore(state)
    assert refused > 0.3 * tried
