"""The web server answers from the status of the loop, and never from the loop itself."""

import logging
import socket
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from threading import Event, Thread

import pytest

from socast.core.errors import SettingsError
from socast.core.pipeline import Pipeline
from socast.stream import health
from socast.stream.health import LOOPBACK_HOST, MOST_CLIENTS, HealthServer, HttpAddress, parse_http_address
from socast.stream.loop import Tally, run
from socast.stream.metrics import READY, make_registry
from socast.stream.service_snapshot import ServiceSnapshot
from socast.stream.service_status import LIVE_S, ServiceStatus, ServiceWatch
from tests.support.service import FULL as WITH_OVERLAP
from tests.support.service import Clock, ask_page, read_metrics
from tests.support.zenoh_sessions import eventually

FREE = HttpAddress(LOOPBACK_HOST, 0)
FULL = replace(WITH_OVERLAP, overlapping=())


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def status(clock):
    return ServiceStatus(clock=clock)


@pytest.fixture
def server(status):
    registry = make_registry(lambda: status.snapshot, lambda: not status.find_obstacle(), status.get_loop_age)
    with HealthServer(FREE, status, registry) as server:
        yield server


def test_service_is_live_while_it_starts_and_ready_after_the_first_turn(server, status, clock):
    clock.now += 10 * LIVE_S
    assert ask_page(server.address, "/livez") == (200, "ok\n")
    assert ask_page(server.address, "/readyz") == (503, "starting\n")
    ServiceWatch(status, lambda *_: FULL, clock=clock)(Tally())
    assert ask_page(server.address, "/readyz") == (200, "ok, publishes\n")


def test_service_is_ready_once_the_caches_of_publishers_were_asked_and_remains_so(server, status, clock):
    snapshots = iter([replace(FULL, is_catching_up=waits) for waits in (True, False, True)])
    watch = ServiceWatch(status, lambda *_: next(snapshots), clock=clock)
    watch(Tally())
    assert ask_page(server.address, "/readyz") == (503, "starting: asking the caches of publishers\n")
    for _ in range(2):
        clock.now += 1.0
        watch(Tally())
        assert ask_page(server.address, "/readyz")[0] == 200


@pytest.mark.parametrize(
    ("publishes", "answer"), [(None, "ok\n"), (True, "ok, publishes\n"), (False, "ok, on standby\n")]
)
def test_a_consumer_of_several_says_whether_it_publishes_and_is_ready_either_way(
    server, status, clock, publishes, answer
):
    ServiceWatch(status, lambda *_: replace(FULL, publishes=publishes), clock=clock)(Tally())
    assert ask_page(server.address, "/readyz") == (200, answer)
    assert ask_page(server.address, "/livez") == (200, "ok\n")


def test_a_consumer_that_overlaps_with_another_one_is_ready_and_names_the_other(server, status, clock):
    ServiceWatch(status, lambda *_: replace(WITH_OVERLAP, shard="1/2"), clock=clock)(Tally())
    assert ask_page(server.address, "/readyz") == (200, "ok, publishes, shard 1/2, overlaps with shard 3/3\n")


def test_a_consumer_that_has_left_the_election_is_live_and_not_ready(server, status, clock):
    left = replace(FULL, publishes=False, obstacle="left the election")
    ServiceWatch(status, lambda *_: left, clock=clock)(Tally())
    assert ask_page(server.address, "/readyz") == (503, "left the election\n")
    assert ask_page(server.address, "/livez") == (200, "ok\n")


def test_hung_loop_is_neither_live_nor_ready(server, status, clock):
    ServiceWatch(status, lambda *_: FULL, clock=clock)(Tally())
    clock.now += LIVE_S
    assert ask_page(server.address, "/livez")[0] == 200
    clock.now += 1.0
    for page in ("/livez", "/readyz"):
        assert ask_page(server.address, page) == (503, "the loop has not moved for 31 s, limit 30 s\n")
    assert read_metrics(ask_page(server.address, "/metrics")[1])[READY] == 0.0


def test_real_loop_that_waits_in_its_source_is_not_live():
    status, release = ServiceStatus(limit_s=0.2), Event()

    def make_source():
        yield []
        release.wait(20.0)

    with HealthServer(FREE, status, make_registry(lambda: None, lambda: True, lambda: 0.0)) as server:
        watch = ServiceWatch(status, lambda *_: ServiceSnapshot())
        loop = Thread(target=run, args=(make_source(), Pipeline()), kwargs={"watch": watch})
        loop.start()
        assert eventually(lambda: ask_page(server.address, "/livez")[0] == 503)
        release.set()
        loop.join(20.0)


def test_service_that_stops_is_live_but_not_ready(server, status, clock):
    stop = Event()
    watch = ServiceWatch(status, lambda *_: FULL, stop=stop, clock=clock)
    watch(Tally())
    stop.set()
    watch(Tally())
    clock.now += 10 * LIVE_S
    assert ask_page(server.address, "/livez")[0] == 200
    assert ask_page(server.address, "/readyz") == (503, "stopping\n")


def test_metrics_are_served_in_the_format_that_the_client_asks_for(server, status):
    status.snapshot = FULL
    code, text = ask_page(server.address, "/metrics?x=1")
    assert code == 200
    assert read_metrics(text)["socast_messages_total"] == 9.0
    _, open_metrics = ask_page(server.address, "/metrics", accept="application/openmetrics-text; version=1.0.0")
    assert open_metrics.endswith("# EOF\n")


def test_other_pages_and_methods_are_refused(server):
    assert ask_page(server.address, "/") == (404, "pages: /metrics /livez /readyz\n")
    assert ask_page(server.address, "/../../etc/passwd")[0] == 404
    assert ask_page(server.address, "/metrics", "POST")[0] == 501
    assert ask_page(server.address, "/livez", "HEAD") == (200, "")


def test_clients_that_send_nothing_do_not_occupy_the_server_for_long(server, monkeypatch):
    monkeypatch.setattr("socast.stream.health._Handler.timeout", 0.2)
    silent = [socket.create_connection(server.address) for _ in range(2 * MOST_CLIENTS)]
    assert eventually(lambda: try_page(server.address) == 200)
    for each in silent:
        each.close()


def try_page(address):
    """Return the code of /livez, None where the server closes the connection."""
    try:
        return ask_page(address, "/livez")[0]
    except OSError:
        return None


def test_many_scrapes_at_once_are_answered(server, status):
    status.snapshot = FULL
    with ThreadPoolExecutor(MOST_CLIENTS // 2) as clients:
        codes = list(clients.map(lambda _: ask_page(server.address, "/metrics")[0], range(40)))
    assert codes == [200] * 40


def test_busy_port_is_one_line_with_a_remedy(server, status):
    with pytest.raises(SettingsError, match="Address already in use; choose another address with --metrics"):
        HealthServer(server.address, status, make_registry(lambda: None, lambda: True, lambda: 0.0))


def test_unknown_host_is_one_line(status):
    with pytest.raises(SettingsError, match=r"cannot serve metrics at no\.such\.host\.invalid:1"):
        HealthServer(HttpAddress("no.such.host.invalid", 1), status, make_registry(lambda: None, bool, float))


def test_port_is_free_again_after_the_end(status):
    registry = make_registry(lambda: None, lambda: True, lambda: 0.0)
    with HealthServer(FREE, status, registry) as first:
        address = first.address
    with HealthServer(address, status, registry):
        assert ask_page(address, "/livez")[0] == 200


def test_only_an_address_beyond_loopback_warns(status, caplog, monkeypatch):
    monkeypatch.setattr(logging.getLogger("socast"), "propagate", True)
    registry = make_registry(lambda: None, lambda: True, lambda: 0.0)
    for host in ("127.0.0.1", "localhost"):
        with HealthServer(HttpAddress(host, 0), status, registry):
            pass
    assert caplog.records == []
    with HealthServer(HttpAddress("0.0.0.0", 0), status, registry):
        pass
    (line,) = caplog.records
    assert "let a firewall admit Prometheus alone" in line.message


@pytest.mark.parametrize(
    "text", ["", "http", "1.2.3.4", "1.2.3.4:", "1.2.3.4:65536", "::1:9464", "host:-1", "host:9 4", "²"]
)
def test_wrong_address_is_refused_with_examples(text):
    with pytest.raises(SettingsError, match=r"HOST:PORT such as 127\.0\.0\.1:9464") as error:
        parse_http_address(text)
    assert f"'{text}'" in str(error.value)


def test_addresses_are_written_as_they_are_read():
    for text in ("127.0.0.1:9464", "[::1]:9464", "example.org:80"):
        assert str(parse_http_address(text)) == text
    assert str(parse_http_address(":9464")) == "127.0.0.1:9464"


def test_half_requests_do_not_keep_others_out(server):
    silent = [socket.create_connection(server.address) for _ in range(2 * MOST_CLIENTS)]
    for each in silent:
        each.sendall(b"GET /li")
    assert all(ask_page(server.address, "/livez")[0] == 200 for _ in range(5))
    for each in silent:
        each.close()


def test_request_that_comes_byte_by_byte_is_cut_off(server, monkeypatch):
    monkeypatch.setattr(health, "CLIENT_S", 0.3)
    with socket.create_connection(server.address) as slow:
        slow.settimeout(0.05)

        def is_cut_off() -> bool:
            try:
                slow.sendall(b"x")
                return slow.recv(10) == b""
            except TimeoutError:
                return False
            except OSError:
                return True

        assert eventually(is_cut_off, 4.0)
