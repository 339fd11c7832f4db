"""Consumers that divide a fleet: what each receives and answers over real Zenoh, and whom it elects."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from threading import Event, Thread

import msgspec
import pytest

from socast.core.errors import AskError
from socast.core.wire.messages import Message, Outlook
from socast.core.wire.shard import By, Shard
from socast.stream.loop import run
from socast.stream.query_service import QueryService
from socast.stream.zenoh_observer import ZenohObserver
from socast.stream.zenoh_queryable import ZenohQueryable, query_outlook
from socast.stream.zenoh_session import Connection, Node
from socast.stream.zenoh_sink import ZenohSink
from socast.stream.zenoh_source import ZenohSource
from socast.stream.zenoh_standby import Standby
from tests.support.commands import refused
from tests.support.shards import make_night, run_shards
from tests.support.zenoh_sessions import Consumer, eventually, router

pytestmark = pytest.mark.long


@contextmanager
def shard_consumer(endpoint: str, shard: Shard) -> Iterator[Consumer]:
    """Run a consumer of a shard in a thread."""
    stop, consumer = Event(), Consumer()
    with Node(Connection(connect=(endpoint,), prefix="city", shard=shard)) as node, ZenohQueryable(node) as queries:
        service = QueryService(queries, consumer)
        thread = Thread(target=run, args=(ZenohSource(node, stop), consumer), kwargs={"watch": service})
        thread.start()
        try:
            yield consumer
        finally:
            stop.set()
            thread.join(20)


@pytest.mark.parametrize("by", ["name", "chunk"])
def test_shards_receive_their_cars_and_all_weather_and_answer_for_their_cars(by: By):
    names = ["taxi-7", "taxi-07", "van_1", "bus.", "x", "Z", "4", "-"]
    before = {name: f"{number}/" if by == "chunk" else "" for number, name in enumerate(names)}
    cars = [Message(f"city/{before[name]}fleet/{name}/telemetry", name.encode(), 0) for name in names]
    weather = Message("city/weather/yul", b"{}", 0)
    gateway = Message(f"city/{'7/' if by == 'chunk' else ''}fleet/depot7/batch", b"", 0)
    with ExitStack() as ending:
        node, endpoint = ending.enter_context(router(prefix="city"))
        shards = [Shard(index, 3, by) for index in (1, 2, 3)]
        consumers = [ending.enter_context(shard_consumer(endpoint, shard)) for shard in shards]
        sink = ZenohSink(node)
        ending.callback(sink.close)
        sink.put([weather, gateway, *cars])
        for shard, consumer in zip(shards, consumers, strict=True):
            deciding = {name: before[name].strip("/") or name for name in names}
            mine = {car.key for name, car in zip(names, cars, strict=True) if shard.has(deciding[name])}
            mine |= {gateway.key} if by == "name" or shard.has("7") else set()
            assert eventually(lambda c=consumer, m=mine: {each.key for each in c.taken} == {weather.key, *m})
            assert len(consumer.taken) == len(mine) + 1
        answer = query_outlook(node, "taxi-7", {})
        assert msgspec.json.decode(answer, type=Outlook).vehicle_id == "taxi-7"
        asked = sum(bool(consumer.asked) for consumer in consumers)
        assert asked == (1 if by == "name" else 3)
        with pytest.raises(AskError, match="is not known"):
            query_outlook(node, "taxi-8", {})


def test_an_observer_of_the_fleet_sees_the_cars_and_forecasts_of_all_shards():
    with ExitStack() as ending:
        node, endpoint = ending.enter_context(router(prefix="city"))
        observer = ZenohObserver(node)
        ending.callback(observer.close)
        sent = []
        for index, name in ((1, "taxi-1"), (2, "taxi-2")):
            shard = ending.enter_context(Node(Connection(connect=(endpoint,), prefix="city", shard=Shard(index, 2))))
            sink = ZenohSink(shard)
            ending.callback(sink.close)
            sent += [f"city/fleet/{name}/telemetry", f"city/fleet/{name}/forecast"]
            sink.put([Message(key, b"{}", 0) for key in sent[-2:]])
        seen = []
        assert eventually(lambda: seen.extend(each.key for each in observer.take()) or set(seen) >= set(sent))


def test_an_observer_of_chunks_sees_the_cars_of_all_chunks_and_the_forecasts():
    with ExitStack() as ending:
        _, endpoint = ending.enter_context(router(prefix="city"))
        viewer = Connection(connect=(endpoint,), prefix="city", shard=Shard(1, 1, "chunk"))
        observer = ZenohObserver(ending.enter_context(Node(viewer)))
        ending.callback(observer.close)
        sink = ZenohSink(ending.enter_context(Node(Connection(connect=(endpoint,)))))
        ending.callback(sink.close)
        sent = {"city/1/fleet/a/telemetry", "city/2/fleet/b/vehicle", "city/fleet/a/forecast", "city/findings/a/x"}
        seen = set()

        def sees_all() -> bool:
            sink.put([Message(key, b"{}", 0) for key in sent])
            seen.update(each.key for each in observer.take())
            return seen == sent

        assert eventually(sees_all)


def test_each_shard_elects_one_of_its_own_consumers():
    with ExitStack() as ending:
        _, endpoint = ending.enter_context(router())

        def join(shard: Shard | None) -> Standby:
            node = ending.enter_context(Node(Connection(connect=(endpoint,), shard=shard)))
            return ending.enter_context(Standby(node))

        active = [join(shard) for shard in (Shard(1, 2), Shard(2, 2), None)]
        assert eventually(lambda: all(each.is_active for each in active))
        waiting = join(Shard(2, 2))
        assert eventually(lambda: waiting.election.token)
        assert not waiting.is_active
        active[1].close()
        assert eventually(lambda: waiting.is_active)
        assert active[0].is_active
        assert active[2].is_active


def test_a_shard_needs_a_router_that_all_join(capsys):
    assert "give --connect or --config" in refused(capsys, "live", "--shard", "1/2")


def test_what_divides_the_fleet_needs_a_shard(capsys):
    assert "give --shard I/N too" in refused(capsys, "live", "--shard-by", "chunk")


def test_a_killed_shard_is_served_by_its_standby_and_all_forecasts_are_those_of_a_replay(tmp_path):
    messages = make_night(tmp_path / "night.mcap", 5, 2400.0, 600.0)
    outcome = run_shards(tmp_path, messages, 2, kill=True, rate=800.0)
    assert outcome.cars_with_forecasts == outcome.cars == 5
    assert outcome.forecasts > 40
    assert outcome.forecasts_after_midnight >= outcome.cars
    assert outcome.takeover_s is not None
    assert (outcome.different, outcome.lost) == (0, 0)
