"""A delivery is done when a router has read it, and is repeated where a router went away."""

from threading import Event, Thread

from socast.core.wire.messages import Message
from socast.stream.zenoh_delivery import ZenohDelivery
from tests.support.router_process import RouterProcess
from tests.support.zenoh_sessions import eventually

MESSAGE = Message("fleet/taxi-7/telemetry", b"{}", 0)


def test_delivery_waits_for_a_router_and_ends_with_it():
    with RouterProcess() as router, router.join() as node, ZenohDelivery(node) as delivery:
        assert delivery.deliver([MESSAGE], Event())
        router.kill()
        assert eventually(lambda: not node.session.info.routers_zid())
        done: list[bool] = []
        thread = Thread(target=lambda: done.append(delivery.deliver([MESSAGE], Event())))
        thread.start()
        router.start()
        with router.join() as other:
            received: list[bytes] = []
            subscriber = other.session.declare_subscriber(
                MESSAGE.key, lambda sample: received.append(sample.payload.to_bytes())
            )
            thread.join(60)
            assert done == [True]
            assert delivery.deliver([MESSAGE], Event())
            assert eventually(lambda: received)
            subscriber.undeclare()


def test_stop_ends_the_wait_for_a_router():
    with RouterProcess() as router, router.join() as node, ZenohDelivery(node) as delivery:
        router.kill()
        assert eventually(lambda: not node.session.info.routers_zid())
        stop = Event()
        stop.set()
        assert not delivery.deliver([MESSAGE], stop)


def test_delivery_is_repeated_where_the_router_went_away_in_between(monkeypatch):
    with RouterProcess() as router, router.join() as node, ZenohDelivery(node) as delivery:
        flushes: list[int] = []

        def flush() -> None:
            flushes.append(1)
            if len(flushes) == 1:  # the router dies before it has read everything
                router.kill()
                assert eventually(lambda: delivery._lost)
                router.start()

        monkeypatch.setattr(node, "flush", flush)
        assert delivery.deliver([MESSAGE], Event())
        assert len(flushes) == 2
        assert delivery.repeated == 1
