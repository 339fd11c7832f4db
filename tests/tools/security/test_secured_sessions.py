"""Real Zenoh sessions of a secured fleet: whoever may say something is heard, everybody else is refused."""

import json
import re
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from datetime import UTC, datetime, timedelta
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest
import zenoh

from socast.core.errors import AskError, SettingsError
from socast.core.wire.messages import Message, Outlook
from socast.stream import zenoh_standby
from socast.stream.zenoh_observer import ZenohObserver
from socast.stream.zenoh_overlap import GRACE_S, OverlapWatch
from socast.stream.zenoh_queryable import query_outlook
from socast.stream.zenoh_session import Connection, Node
from socast.stream.zenoh_sink import CACHE, ZenohSink
from socast.stream.zenoh_standby import FencedSink, Standby
from socast.tools.security.folder import SecureFolder
from tests.support.secure_fleets import CARS, EXPIRED, REVOKED, change_tls, join, make_fleet, open_router
from tests.support.service import Clock
from tests.support.zenoh_sessions import eventually, serving

pytestmark = pytest.mark.long
OWN, OTHER = CARS


@pytest.fixture(scope="module")
def fleet(tmp_path_factory) -> SecureFolder:
    """Make a fleet whose router each test opens for itself."""
    return make_fleet(tmp_path_factory.mktemp("secure") / "fleet", prefix="montreal")


@pytest.fixture(scope="module", params=["router of its own", "router of the consumer"])
def service(request, tmp_path_factory) -> Iterator[Any]:
    """Run a consumer with either router; give it, its node, and a function that joins as an identity."""
    fleet = make_fleet(tmp_path_factory.mktemp("served") / "fleet", prefix="montreal")
    with ExitStack() as ending:
        node = ending.enter_context(open_router(fleet))
        if request.param == "router of its own":
            node = ending.enter_context(join(fleet, "consumer"))
        consumer, queries = ending.enter_context(serving(node))
        sessions: dict[str, Node] = {}

        def connect(name: str) -> Node:
            if name not in sessions:
                sessions[name] = ending.enter_context(join(fleet, name))
            return sessions[name]

        yield SimpleNamespace(consumer=consumer, queries=queries, node=node, join=connect)


def find_taken(service: Any, key: str) -> list[bytes]:
    """Return the payloads that the consumer took under a key."""
    return [message.payload for message in service.consumer.taken if message.key == key]


def publish(node: Node, key: str, payload: bytes) -> None:
    """Publish with an advanced publisher, and wait until the router has read it."""
    ZenohSink(node).put([Message(node.prefix + key, payload, 0)])
    node.flush()


ALLOWED = [
    (f"cars/{OWN}", f"fleet/{OWN}/telemetry"),
    (f"cars/{OWN}", f"fleet/{OWN}/vehicle"),
    ("dispatch", f"fleet/{OWN}/ride"),
    ("dispatch", f"fleet/{OTHER}/plan"),
    ("weather", "weather/yul"),
]
REFUSED = [
    (f"cars/{OWN}", f"fleet/{OTHER}/telemetry"),
    (f"cars/{OWN}", f"fleet/{OTHER}/vehicle"),
    (f"cars/{OWN}", "fleet/*/telemetry"),
    (f"cars/{OWN}", f"fleet/{OWN}/forecast"),
    (f"cars/{OWN}", f"fleet/{OWN}/plan"),
    (f"cars/{OWN}", f"fleet/{OWN}/ride"),
    (f"cars/{OWN}", "weather/yul"),
    (f"cars/{REVOKED}", f"fleet/{REVOKED}/telemetry"),
    ("dispatch", f"fleet/{OWN}/telemetry"),
    ("dispatch", f"fleet/{OWN}/forecast"),
    ("weather", f"fleet/{OWN}/telemetry"),
    ("weather", f"fleet/{OWN}/plan"),
]


@pytest.mark.parametrize(("name", "key"), ALLOWED)
def test_consumer_takes_what_an_identity_may_publish(service, name, key):
    payload = f"{name} {time.monotonic_ns()}".encode()
    publish(service.join(name), key, payload)
    assert eventually(lambda: payload in find_taken(service, f"montreal/{key}"))


@pytest.mark.parametrize(("name", "key"), REFUSED)
def test_router_refuses_what_an_identity_may_not_publish(service, name, key):
    forged = f"forged {time.monotonic_ns()}".encode()
    node = service.join(name)
    node.session.put(node.prefix + key, forged)  # without an advanced publisher
    publish(node, key, forged)
    publish(service.join("dispatch"), f"fleet/{OWN}/plan", forged + b" and after it a plan")
    assert eventually(lambda: forged + b" and after it a plan" in find_taken(service, f"montreal/fleet/{OWN}/plan"))
    assert forged not in [message.payload for message in service.consumer.taken]


def test_history_of_a_car_reaches_a_consumer_that_starts_later(fleet):
    sent = [Message(f"montreal/fleet/{OWN}/telemetry", b"%d" % number, 0) for number in range(10)]
    with open_router(fleet), join(fleet, f"cars/{OWN}") as car:
        sink = ZenohSink(car)  # its caches live as long as it does
        sink.put(sent)
        with join(fleet, "consumer") as node, serving(node) as (consumer, _):
            assert eventually(lambda: len(consumer.taken) >= len(sent))
    taken = dict.fromkeys(message.payload for message in consumer.taken)  # the pipeline drops repetitions
    assert list(taken) == [message.payload for message in sent]


def test_history_of_forecasts_reaches_a_dispatch_that_starts_later(fleet):
    sent = [Message(f"montreal/fleet/{car}/forecast", b"newest", 0) for car in CARS]
    with open_router(fleet), join(fleet, "consumer") as node:
        sink = ZenohSink(node)
        sink.put(sent)
        with join(fleet, "dispatch") as dispatch:
            observer, heard = ZenohObserver(dispatch, ()), set[str]()

            def hears_all() -> bool:
                heard.update(message.key for message in observer.take())
                return heard == {message.key for message in sent}

            assert eventually(hears_all)
            observer.close()


def test_forecasts_reach_dispatch_and_their_car_but_no_forged_ones_and_no_other_car(service):
    key = f"montreal/fleet/{OWN}/forecast"
    heard: dict[str, list[bytes]] = {"dispatch": [], f"cars/{OWN}": [], f"cars/{OTHER}": []}
    subscribers = [
        service.join(name).session.declare_subscriber(
            key, lambda sample, to=to: to.append(sample.payload.to_bytes()), allowed_origin=zenoh.Locality.REMOTE
        )
        for name, to in heard.items()
    ]
    for name in heard:
        service.join(name).flush()
        service.join(name).session.put(key, b"forged")
        service.join(name).flush()
    ZenohSink(service.node).put([Message(key, b"genuine", 0)])
    assert eventually(lambda: heard["dispatch"] and heard[f"cars/{OWN}"])
    assert set(heard["dispatch"]) == set(heard[f"cars/{OWN}"]) == {b"genuine"}
    assert heard[f"cars/{OTHER}"] == []
    for subscriber in subscribers:
        subscriber.undeclare()


def test_nobody_but_the_consumer_reads_telemetry(service):
    heard: list[zenoh.Sample] = []
    others = [f"cars/{OTHER}", f"cars/{REVOKED}", "dispatch", "weather"]
    subscribers = [
        service.join(name).session.declare_subscriber(key, heard.append)
        for name in others
        for key in ("**", "montreal/fleet/**", f"montreal/fleet/{OWN}/telemetry")
    ]
    for name in others:
        service.join(name).flush()
    before = len(service.consumer.taken)
    publish(service.join(f"cars/{OWN}"), f"fleet/{OWN}/telemetry", b"private")
    assert eventually(lambda: len(service.consumer.taken) > before)
    for name in others:
        replies = service.join(name).session.get(f"montreal/fleet/{OWN}/telemetry/@adv/**", timeout=5.0)
        assert list(replies) == [], "the cache of the publisher answers"
        tokens = service.join(name).session.liveliness().get(f"montreal/fleet/{OWN}/telemetry/@adv/**", timeout=5.0)
        assert list(tokens) == [], "the token of the publisher shows its session"
    assert [sample for sample in heard if sample.payload.to_bytes() == b"private"] == []
    for subscriber in subscribers:
        subscriber.undeclare()


def test_observer_sees_batches_with_the_certificate_of_the_consumer_and_findings_with_that_of_dispatch(fleet):
    batch, forecast, finding = (
        f"montreal/{key}" for key in ("fleet/depot-3/batch", f"fleet/{OWN}/forecast", "findings/all/aero_drag")
    )
    fleet.add([], ["depot-3"])
    with ExitStack() as ending:
        ending.enter_context(open_router(fleet))
        names = ("consumer", "dispatch", "gateways/depot-3", "consumer")
        *readers, gateway, consumer = (ending.enter_context(join(fleet, name)) for name in names)
        observers = [ending.enter_context(closing(ZenohObserver(node))) for node in readers]
        gateway_sink, sink = (ending.enter_context(closing(ZenohSink(node))) for node in (gateway, consumer))
        seen: list[set[str]] = [set(), set()]

        def see_all() -> bool:
            gateway_sink.put([Message(batch, b"batch", 0)])
            sink.put([Message(key, b"published", 0) for key in (finding, forecast)])
            gateway.flush()
            for keys, observer in zip(seen, observers, strict=True):
                keys.update(message.key for message in observer.take())
            return len(seen[0]) >= 2 and len(seen[1]) >= 2

        assert eventually(see_all, 20.0)
        assert seen == [{batch, forecast}, {forecast, finding}]


def test_outlook_is_answered_for_dispatch(service):
    answer = msgspec.json.decode(query_outlook(service.join("dispatch"), "taxi-7", {}), type=Outlook)
    assert answer.vehicle_id == "taxi-7"
    with pytest.raises(AskError, match="taxi-2 is not known"):
        query_outlook(service.join("dispatch"), "taxi-2", {})


@pytest.mark.parametrize("name", [f"cars/{OTHER}", f"cars/{REVOKED}", "weather"])
def test_outlook_is_not_answered_for_others(service, name):
    asked = len(service.consumer.asked)
    with pytest.raises(SettingsError, match="no consumer answers"):
        query_outlook(service.join(name), "taxi-7", {})
    assert len(service.consumer.asked) == asked


def test_car_cannot_answer_in_place_of_the_consumer(fleet):
    asked: list[zenoh.Query] = []
    key = "montreal/fleet/*/outlook"
    with open_router(fleet), join(fleet, f"cars/{OWN}") as car, join(fleet, "dispatch") as dispatch:
        car.session.declare_queryable(key, asked.append)
        car.flush()
        with pytest.raises(SettingsError, match="no consumer answers"):
            query_outlook(dispatch, OWN, {})
    assert asked == []


def test_token_of_a_consumer_is_seen_by_another_consumer_alone(fleet):
    key = "montreal/socast/publisher"  # not asked with `get`: Zenoh may answer it without a token that is there
    with (
        open_router(fleet),
        join(fleet, "consumer") as one,
        join(fleet, "consumer") as two,
        join(fleet, f"cars/{OWN}") as car,
    ):
        seen: list[zenoh.SampleKind] = []
        seen_by_car: list[zenoh.SampleKind] = []
        for node, kinds in ((two, seen), (car, seen_by_car)):
            node.session.liveliness().declare_subscriber(
                key, lambda token, kinds=kinds: kinds.append(token.kind), history=True
            )
            node.flush()
        false = car.session.liveliness().declare_token(key)
        car.flush()
        false.undeclare()
        car.flush()
        two.flush()
        assert seen == []
        eventually(lambda: zenoh.SampleKind.DELETE in seen_by_car, seconds=5.0)
        seen_by_car.clear()  # its own token
        token = one.session.liveliness().declare_token(key)
        assert eventually(lambda: zenoh.SampleKind.PUT in seen)
        token.undeclare()
        assert eventually(lambda: seen[-1] == zenoh.SampleKind.DELETE)
        car.flush()
        assert seen_by_car == []


def test_one_of_two_consumers_publishes_and_the_other_takes_over_whatever_a_car_claims(fleet, monkeypatch):
    monkeypatch.setattr(zenoh_standby, "FENCE_S", 1e6)  # a machine under load makes no consumer passive
    key, heard = f"montreal/fleet/{OWN}/forecast", list[bytes]()
    with ExitStack() as ending:
        ending.enter_context(open_router(fleet))
        dispatch, car, *nodes = (
            ending.enter_context(join(fleet, name)) for name in ("dispatch", f"cars/{OWN}", "consumer", "consumer")
        )
        false = car.session.liveliness().declare_token("montreal/socast/consumers/000000000-false")
        car.flush()
        dispatch.session.declare_subscriber(key, lambda sample: heard.append(sample.payload.to_bytes()))
        dispatch.flush()
        roles = [ending.enter_context(Standby(node)) for node in nodes]
        assert eventually(lambda: [len(role.election._others) for role in roles] == [1, 1])
        assert eventually(lambda: sum(role.is_active for role in roles) == 1)
        number = [role.is_active for role in roles].index(True)
        active, other, old, new = roles[number], roles[1 - number], nodes[number], nodes[1 - number]
        for role, node in ((other, new), (active, old)):
            FencedSink(ZenohSink(node), role).put([Message(key, b"active" if role is active else b"other", 0)])
        assert eventually(lambda: heard)
        old.close()
        assert eventually(lambda: other.is_active and not active.is_active)
        FencedSink(ZenohSink(new), other).put([Message(key, b"other after it", 0)])
        assert eventually(lambda: len(heard) > 1)
        assert heard == [b"active", b"other after it"]
        false.undeclare()


@pytest.fixture
def stranger(fleet, tmp_path) -> Callable[[str], Any]:
    """Return a function that makes the connection of a stranger."""
    other = make_fleet(tmp_path / "other", port=fleet.port)
    trusted = json.loads(fleet.locate(OWN).read_text())["transport"]["link"]["tls"]["root_ca_certificate_base64"]

    def make(kind: str) -> Connection:
        endpoint = (f"tls/127.0.0.1:{fleet.port}",)
        if kind == "no configuration":
            return Connection(connect=endpoint)
        if kind == "plain TCP":
            return Connection(connect=(f"tcp/127.0.0.1:{fleet.port}",))
        if kind == "expired certificate":
            return Connection(config=fleet.locate(EXPIRED))
        if kind == "other authority":
            return Connection(config=other.locate(OWN))
        kept = {"certificate of another authority": ("connect_certificate_base64", "connect_private_key_base64")}

        def change(tls: dict[str, Any]) -> None:
            tls["root_ca_certificate_base64"] = trusted
            tls["enable_mtls"] = kind in kept
            for name in ("connect_certificate_base64", "connect_private_key_base64"):
                if name not in kept.get(kind, ()):
                    del tls[name]

        return Connection(config=change_tls(other.locate(OWN), tmp_path / "stranger.json5", change))

    return make


@pytest.mark.parametrize(
    ("kind", "reason"),
    [
        ("no configuration", "certificate of the router .* is not valid for this node"),
        ("plain TCP", "does not speak Zenoh over plain TCP; .* give tls/127.0.0.1"),
        ("no certificate", "refuses the certificate of this node: .*certificate required"),
        ("expired certificate", "refuses the certificate of this node: .*expired; make another one"),
        ("other authority", "certificate of the router .* is not valid for this node"),
        ("certificate of another authority", "refuses the certificate of this node: .*"),
    ],
)
def test_router_does_not_let_a_stranger_in_and_the_stranger_learns_why(fleet, stranger, kind, reason):
    with open_router(fleet) as router:
        with pytest.raises(SettingsError, match="cannot be joined") as caught:
            Node(stranger(kind))
        assert re.search(reason, str(caught.value))
        assert list(router.session.info.peers_zid()) == []


def test_router_ends_a_connection_when_its_certificate_expires(fleet):
    SecureFolder(fleet.path, clock=lambda: datetime.now(UTC) - timedelta(days=fleet.days, seconds=-3)).add(["taxi-5"])
    with open_router(fleet), join(fleet, "cars/taxi-5") as car:
        assert list(car.session.info.routers_zid()) != []
        assert eventually(lambda: list(car.session.info.routers_zid()) == [])


def test_router_listens_with_tls_only(fleet):
    endpoint = f"tcp/127.0.0.1:{fleet.port}"
    with pytest.raises(SettingsError, match="allows only tls: give tls/"):
        Node(Connection(config=fleet.path / "router.json5", listen=(endpoint,)))


def test_client_does_not_join_a_car_that_passes_for_the_router(fleet, tmp_path):
    def change(tls: dict[str, Any]) -> None:
        for name in ("certificate", "private_key"):
            tls[f"listen_{name}_base64"] = tls.pop(f"connect_{name}_base64")

    config = change_tls(fleet.locate(OWN), tmp_path / "false.json5", change)
    listen = (f"tls/127.0.0.1:{fleet.port}",)
    false = Connection(config=config, mode="router", listen=listen, connect=())
    settings = json.loads(config.read_text())
    del settings["connect"]
    config.write_text(json.dumps(settings))
    with Node(false), pytest.raises(SettingsError, match="cannot be joined"):
        join(fleet, f"cars/{OTHER}")


def test_samples_sent_during_an_outage_of_the_router_are_recovered(fleet):
    key = f"montreal/fleet/{OWN}/telemetry"
    with ExitStack() as ending:
        router = open_router(fleet)
        node, car = (ending.enter_context(join(fleet, name)) for name in ("consumer", f"cars/{OWN}"))
        consumer, _ = ending.enter_context(serving(node))
        sink = ZenohSink(car)
        sink.put([Message(key, b"0", 0)])
        assert eventually(lambda: consumer.taken)
        router.close()
        sink.put([Message(key, b"%d" % number, 0) for number in range(1, CACHE // 2)])
        ending.enter_context(open_router(fleet))
        assert eventually(lambda: car.session.info.routers_zid() and node.session.info.routers_zid())
        last = CACHE // 2

        def sends() -> bool:
            nonlocal last
            sink.put([Message(key, b"%d" % last, 0)])
            last += 1
            time.sleep(0.05)
            return len(find_payloads()) >= last

        def find_payloads() -> list[bytes]:
            return list(dict.fromkeys(message.payload for message in consumer.taken))  # the pipeline drops repetitions

        assert eventually(sends)
        assert find_payloads() == [b"%d" % number for number in range(last)]


def test_consumers_that_overlap_find_each_other(fleet):
    clock = Clock()
    with ExitStack() as ending:
        ending.enter_context(open_router(fleet))
        nodes = [ending.enter_context(join(fleet, "consumer")) for _ in range(2)]
        watches = [ending.enter_context(OverlapWatch(node, standby=False, clock=clock)) for node in nodes]

        def find() -> list[tuple[str, ...]]:
            clock.now += GRACE_S
            for watch in watches:
                watch(None)
            return [watch.found for watch in watches]

        assert eventually(lambda: find() == [("all cars",)] * 2)
