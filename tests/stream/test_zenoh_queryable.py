"""Queries over Zenoh sessions on loopback are answered or refused with a reason, and never block telemetry."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Event

import msgspec
import pytest

from socast.core.errors import AskError, SettingsError
from socast.core.wire.messages import Leg, Message, Outlook, encode
from socast.stream.zenoh_queryable import WAITING, ZenohQueryable, query_outlook
from socast.stream.zenoh_session import Connection, Node
from socast.stream.zenoh_sink import ZenohSink
from socast.stream.zenoh_source import ZenohSource
from tests.support.outlooks import NOW, PLANNED
from tests.support.zenoh_sessions import eventually, live, router

RIDE = {"distance_km": "18", "duration_s": "1500"}


@pytest.fixture(scope="module")
def service():
    """Run one consumer for all queries of this module."""
    with live() as running:
        yield running


@contextmanager
def unattended() -> Iterator[tuple[ZenohQueryable, Node]]:
    """Run a queryable whose queries no consumer answers, and a client."""
    with (
        router() as (node, endpoint),
        ZenohQueryable(node) as queries,
        Node(Connection(connect=(endpoint,))) as client,
    ):
        yield queries, client


def test_query_is_answered_while_telemetry_is_silent(service):
    consumer, query_service, client = service
    before = query_service.answered
    answer = msgspec.json.decode(query_outlook(client, "taxi-7", RIDE | {"gained_m": "40"}), type=Outlook)
    assert (answer.vehicle_id, answer.asked.distance_km, answer.asked.duration_s) == ("taxi-7", 18.0, 1500.0)
    assert consumer.asked[-1] == ("taxi-7", Leg(18.0, 1500.0, 40.0), None)
    assert query_service.answered == before + 1


@pytest.mark.parametrize("between", "&;")
def test_selector_accepts_both_separators(service, between):
    _, _, client = service
    (reply,) = client.session.get(f"fleet/taxi-7/outlook?distance_km=18{between}duration_s=1500{between}gained_m=40")
    assert str(reply.ok.key_expr) == "fleet/taxi-7/outlook"
    assert json.loads(reply.ok.payload.to_bytes())["asked"]["distance_km"] == 18.0


def test_plan_of_query_is_answered(service):
    _, _, client = service
    sent = {"shift_end_s": NOW + 3600.0, "reserve_soc_pct": 30.0, "legs": [{"distance_km": 7.0, "duration_s": 700}]}
    answer = msgspec.json.decode(query_outlook(client, "taxi-7", {}, json.dumps(sent).encode()), type=Outlook)
    assert [leg.distance_km for leg in answer.legs] == [7.0]


def plan(**changed) -> bytes:
    return encode(msgspec.structs.replace(PLANNED, **changed))


BAD = {
    "a negative distance": ("taxi-7", RIDE | {"distance_km": "-3"}, None, "distance_km is -3, must be 0 to 1000"),
    "text": ("taxi-7", RIDE | {"distance_km": "far"}, None, "distance_km is 'far'"),
    "a parameter that is not known": ("taxi-7", {"lunch": "1"}, None, "'lunch' is no parameter"),
    "a vehicle that is not known": ("taxi-9", RIDE, None, "taxi-9 is not known"),
    "every vehicle": ("*", RIDE, None, "the vehicle is '*'; give one name"),
    "a plan in the past": ("taxi-7", {}, plan(shift_end_s=NOW - 7200.0), "2.0 h before"),
    "10,000 legs": ("taxi-7", {}, plan(legs=[Leg(1.0, 60.0)] * 10_000), "10000 legs, at most 500"),
    "a negative leg": ("taxi-7", {}, plan(legs=[Leg(-1.0, 60.0)]), "leg 1 of the plan: distance_km is -1"),
    "rubbish": ("taxi-7", {}, b"\x00\xff" * 5000, "no plan"),
    "a plan of another vehicle": ("taxi-8", {}, plan(), "of 'taxi-7', the question of taxi-8"),
    "what breaks the answerer": ("taxi-0", RIDE, None, "cannot be answered"),
}


@pytest.mark.parametrize("wrong", BAD)
def test_invalid_query_is_refused_with_reason_and_consumer_continues(service, wrong):
    _, query_service, client = service
    vehicle, parameters, payload, reason = BAD[wrong]
    refused = sum(query_service.refused.values())
    with pytest.raises(AskError) as caught:
        query_outlook(client, vehicle, parameters, payload)
    assert reason in str(caught.value)
    assert sum(query_service.refused.values()) == refused + 1
    assert json.loads(query_outlook(client, "taxi-7", RIDE))["vehicle_id"] == "taxi-7"


def test_invalid_queries_never_interrupt_telemetry(service):
    consumer, _, client = service
    sink, sent = ZenohSink(client), [Message("fleet/a/telemetry", b"%d" % i, 0) for i in range(50)]
    assert eventually(sink.has_subscriber)
    consumer.taken.clear()
    for message in sent:
        client.session.get("fleet/taxi-0/outlook?what=now")
        sink.put([message])
    assert eventually(lambda: len(consumer.taken) == len(sent))
    assert [m.payload for m in consumer.taken] == [m.payload for m in sent]
    assert json.loads(query_outlook(client, "taxi-7", {}))["asked"] is None


def test_queryable_with_prefix_answers_only_its_fleet():
    with live("montreal") as (consumer, _, client):
        assert json.loads(query_outlook(client, "taxi-7", RIDE))["vehicle_id"] == "taxi-7"
        assert [vehicle for vehicle, _, _ in consumer.asked] == ["taxi-7"]
        assert list(client.session.get("fleet/taxi-7/outlook")) == []


def test_excess_queries_never_block_telemetry():
    """The oldest queries end immediately without an answer, the newest are answered, and telemetry still arrives."""
    got: list[Message] = []
    with router() as (node, endpoint), ZenohQueryable(node) as queries, Node(Connection(connect=(endpoint,))) as client:
        source, sink = iter(ZenohSource(node, Event())), ZenohSink(client)
        assert eventually(sink.has_subscriber)
        queries_sent = [client.session.get(f"fleet/taxi-{i}/outlook", timeout=60.0) for i in range(WAITING + 10)]
        sink.put([Message("fleet/a/telemetry", b"{}", 0)])
        assert eventually(lambda: got or got.extend(next(source)))
        assert [list(replies) for replies in queries_sent[:10]] == [[]] * 10
        waiting = queries.pending()
        assert [query.vehicle for query in waiting] == [f"taxi-{i}" for i in range(10, WAITING + 10)]
        for query in waiting:
            query.reply(query.vehicle.encode())
        answers = [reply.ok.payload.to_bytes().decode() for replies in queries_sent[10:] for reply in replies]
    assert answers == [query.vehicle for query in waiting]
    assert queries.unsent == 0


def test_close_ends_waiting_queries_without_answer():
    with unattended() as (queries, client):
        replies = client.session.get("fleet/taxi-7/outlook", timeout=60.0)
        seen: list = []
        assert eventually(lambda: seen.extend(queries.pending()) or seen)
        unseen = client.session.get("fleet/taxi-8/outlook", timeout=60.0)
        seen[0].reply(b"the last")
        queries.close()
        queries.close()
        assert [reply.ok.payload.to_bytes() for reply in replies] == [b"the last"]
        assert list(unseen) == []
        assert queries.pending() == []


def test_answer_to_client_that_has_gone_raises_nothing():
    with router() as (node, endpoint), ZenohQueryable(node) as queries:
        seen: list = []
        with Node(Connection(connect=(endpoint,))) as client:
            client.session.get("fleet/taxi-7/outlook", timeout=60.0)
            assert eventually(lambda: seen.extend(queries.pending()) or seen)
        seen[0].reply(b"{}")
        seen[0].refuse("too late")
        with Node(Connection(connect=(endpoint,))) as client:
            replies = client.session.get("fleet/taxi-8/outlook", timeout=60.0)
            assert eventually(lambda: seen.extend(queries.pending()) or len(seen) == 2)
            seen[1].refuse("no")
            assert [reply.err.payload.to_bytes() for reply in replies] == [b'{"error":"no"}']


def test_query_without_consumer_raises_settings_error():
    with (
        router() as (_, endpoint),
        Node(Connection(connect=(endpoint,), prefix="montreal")) as client,
        pytest.raises(
            SettingsError, match="no consumer answers montreal/fleet/taxi-7/outlook; start `socast live`"
        ) as e,
    ):
        query_outlook(client, "taxi-7", RIDE)
    assert "the shard of this car may be down" in str(e.value)


def test_query_without_answer_in_time_raises_settings_error():
    with unattended() as (queries, client):
        with pytest.raises(SettingsError, match=r"not answered within 0.2 s"):
            query_outlook(client, "taxi-7", RIDE, timeout_s=0.2)
        (late,) = queries.pending()
        late.reply(b"{}")  # the client no longer waits
        replies = client.session.get("fleet/taxi-7/outlook", timeout=60.0)
        seen: list = []
        assert eventually(lambda: seen.extend(queries.pending()) or seen)
        seen[0].reply(b"in time")
        assert [reply.ok.payload.to_bytes() for reply in replies] == [b"in time"]
