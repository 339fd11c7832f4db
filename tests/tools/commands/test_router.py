"""`socast router` connects those who join it, and ends when it is stopped."""

from contextlib import nullcontext
from threading import Event, Thread

from socast.core.errors import SettingsError
from socast.stream.zenoh_session import Connection, Node, find_free_port
from socast.tools.commands.router import route
from tests.support.commands import refused
from tests.support.zenoh_sessions import eventually, router


def join(endpoint: str, nodes: list[Node]) -> bool:
    """Try to join a router that may not listen yet, and return whether it was joined."""
    try:
        nodes.append(Node(Connection(connect=(endpoint,))))
    except SettingsError:
        return False
    return True


def test_what_one_node_publishes_reaches_another_one_until_the_router_is_stopped(monkeypatch):
    stop, nodes, seen = Event(), list[Node](), list[str]()
    monkeypatch.setattr("socast.tools.commands.router.stop_on_signals", lambda: nullcontext(stop))
    monkeypatch.setattr("socast.tools.commands.router.log_lines", lambda **_: None)
    endpoint = f"tcp/127.0.0.1:{find_free_port()}"
    runs = Thread(target=route, kwargs={"listen": [endpoint]})
    runs.start()
    try:
        assert eventually(lambda: join(endpoint, nodes))
        assert eventually(lambda: join(endpoint, nodes))
        one, other = nodes
        other.session.declare_subscriber("fleet/*/telemetry", lambda sample: seen.append(str(sample.key_expr)))
        assert eventually(lambda: one.session.put("fleet/taxi-7/telemetry", b"{}") or seen)
    finally:
        for node in nodes:
            node.close()
        stop.set()
        runs.join(20)
    assert not runs.is_alive()
    assert set(seen) == {"fleet/taxi-7/telemetry"}


def test_an_endpoint_that_is_taken_is_one_line(capsys):
    with router() as (_, endpoint):
        assert "cannot listen at" in refused(capsys, "router", "--listen", endpoint)
