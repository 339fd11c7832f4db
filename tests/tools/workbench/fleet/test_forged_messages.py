"""Whatever a stranger publishes, the board and its pages go on; what is left out is counted by cause."""

import json
from contextlib import closing
from types import SimpleNamespace

import msgspec
import pytest

from socast.core.wire.messages import Finding, Message, Telemetry, encode
from socast.stream.zenoh_session import Connection
from socast.tools.workbench.fleet import board as board_module
from socast.tools.workbench.fleet import feed as feed_module
from socast.tools.workbench.fleet.alarms import list_alarms
from socast.tools.workbench.fleet.board import DEFECT, IMPOSSIBLE, LONGEST_NAME, MOST_BYTES, SURPLUS, TOO_LARGE, Board
from socast.tools.workbench.fleet.cars import describe_car
from socast.tools.workbench.fleet.frames import encode_frame
from socast.tools.workbench.fleet.observer import Observer
from socast.tools.workbench.jobs import Jobs
from socast.tools.workbench.json_routes import Workbench
from socast.tools.workbench.workspace import Workspace
from tests.support.outlooks import OUTLOOK
from tests.support.router_process import RouterProcess
from tests.support.web_requests import Client
from tests.support.workbenches import serve
from tests.support.zenoh_sessions import eventually
from tests.tools.workbench.fleet.test_feed import listening, read_until_frame
from tests.tools.workbench.fleet.test_fleet_time import NOW, forecast

NUMBERS = f"1{'0' * 400} -1{'0' * 400} NaN Infinity 1e308 -1e308 1e999 9007199254740993 18446744073709551616 -1".split()
TOKENS = [*NUMBERS, "null", "true", '"x"', f'"{"x" * 1000}"', f'"{"x" * 100_000}"', '"\\ud800"', "[]", "{}", "[" * 5000]
FINDING = Finding("a", "drag", NOW, "sure", 0.9, [], "2026-01-01", None, None, *[0.1] * 5, "words", [])
SAMPLE = Telemetry("a", NOW, latitude_deg=45.5, longitude_deg=-73.6, speed_kmh=3.0, soc_pct=40.0, charging=True)
GOOD = {
    "fleet/a/forecast": json.loads(forecast("a", 0.0).payload),
    "fleet/a/telemetry": json.loads(encode(SAMPLE)),
    "fleet/a/vehicle": {"model": "leaf"},
    "findings/a/drag": json.loads(encode(FINDING)),
}
FORGED = Message("fleet/evil/forecast", forecast("evil", 0.0).payload.replace(b'time":0', b'time":1' + b"0" * 400), 0)


def forge(record, *path):
    """Yield the payloads of a message with each of the tokens as the value of a field."""
    head, _, tail = json.dumps(record | {path[0]: "@"} if len(path) == 1 else _nest(record, path)).partition('"@"')
    for token in TOKENS:
        yield f"{head}{token}{tail}".encode()


def _nest(record, path):
    return record | {path[0]: record[path[0]] | {path[1]: "@"}}


def list_fields(record):
    """Return the paths of the fields of a message."""
    inner = [(name, field) for name, value in record.items() if isinstance(value, dict) for field in value]
    return [(name,) for name in record] + inner


def read_pages(board):
    """Make everything that pages show."""
    encode_frame(board, 1)
    msgspec.json.encode(list_alarms(board))
    fleet = SimpleNamespace(board=board, get_parts=lambda _: None, ask=lambda *_: OUTLOOK)
    for car in board.vehicle_ids:
        msgspec.json.encode(describe_car(SimpleNamespace(fleet=fleet), SimpleNamespace(path={"car": car})))


@pytest.mark.filterwarnings("ignore:overflow encountered:RuntimeWarning")
@pytest.mark.parametrize("key", GOOD)
def test_message_with_any_value_in_any_field_ends_nothing(key):
    board = Board()
    for path in list_fields(GOOD[key]):
        for time, payload in enumerate(forge(GOOD[key], *path)):
            board.take([forecast("b", float(time)), Message(key, payload, 0), forecast("c", float(time))])
            assert board.counts[DEFECT] == 0, payload[:200]
        read_pages(board)
    board.take([forecast("b", 1000.0)])
    assert board.get_values("b")["time"] == NOW + 1000.0
    assert board.count_refused()["undecodable"] > 0


def test_names_and_times_that_cannot_be_are_refused():
    board = Board()
    long, late = forecast("a", 0.0, ride="r" * (LONGEST_NAME + 1)), forecast("a", 1e300)
    model = Message("fleet/a/vehicle", b'{"model":"%s"}' % (b"m" * (LONGEST_NAME + 1)), 0)
    board.take([long, late, model, model._replace(payload=b'{"model":"%s"}' % (b"m" * MOST_BYTES))])
    assert (len(board), board.models) == (0, {})
    assert board.count_refused() == {IMPOSSIBLE: 3, TOO_LARGE: 1}


def test_made_up_cars_fill_the_board_only_to_its_limit(monkeypatch):
    monkeypatch.setattr(board_module, "MOST_CARS", 10)
    board = Board()
    for number in range(30):
        name = f"x{number}"
        board.take([Message(f"fleet/{name}/vehicle", b'{"model":"leaf"}', 0), forecast(name, 0.0)])
        board.take([Message(f"fleet/{name}/telemetry", encode(Telemetry(name, NOW)), 0)])
    board.take([forecast("x3", 5.0), Message("fleet/x3/vehicle", b'{"model":"zoe"}', 0)])
    assert (len(board), len(board.models), board.models["x3"]) == (10, 10, "zoe")
    assert board.get_values("x3")["time"] == NOW + 5.0
    assert board.count_refused() == {SURPLUS: 60}


def test_message_that_fails_by_a_defect_takes_no_other_with_it(monkeypatch, caplog):
    board, take = Board(), Board._take_value

    def fail(self, identity, value):
        if identity == "bad":
            raise OverflowError
        take(self, identity, value)

    monkeypatch.setattr(Board, "_take_value", fail)
    for _ in range(3):
        board.take([forecast("a", 0.0), forecast("bad", 0.0), forecast("b", 0.0)])
    assert (board.vehicle_ids, board.count_refused()) == (["a", "b"], {DEFECT: 3})
    assert len(caplog.records) == 1


@pytest.fixture
def watched():
    """A workbench that observes a router, which a test may kill."""
    with RouterProcess() as router, router.join() as stranger:
        connection = Connection(connect=(router.endpoint,), mode="client")
        with closing(Observer(connection, Board())) as observer:
            observer.start()
            with serve(Workbench(Workspace(), Jobs(), fleet=observer)) as server:
                yield router, stranger, observer, server


def test_forged_forecast_does_not_end_the_observer(watched):
    _, stranger, observer, server = watched
    assert Client(server, enters=False).get("/readyz")[::2] == (200, b"ok\n")

    def publish(seconds):
        for each in (FORGED, forecast("a", seconds)):
            stranger.session.put(each.key, each.payload)
        return "a" in observer.board.vehicle_ids and observer.board.get_values("a")["time"] == NOW + seconds

    assert all(eventually(lambda seconds=seconds: publish(seconds)) for seconds in (0.0, 9.0))
    assert "evil" not in observer.board.vehicle_ids
    assert set(observer.describe()["refused"]) == {IMPOSSIBLE}
    assert Client(server, enters=False).get("/readyz").code == 200


def test_thread_that_ends_is_seen(watched, monkeypatch):
    _, _, observer, server = watched
    client = Client(server)
    monkeypatch.setattr(observer._source, "take", lambda: 1 / 0)
    assert eventually(lambda: client.get("/readyz").code == 503)
    assert b"because of a defect" in client.get("/readyz").content
    with listening(client) as opened:
        assert "because of a defect" in read_until_frame(opened)[0]["problem"]


def test_router_that_is_gone_is_told(watched):
    router, _, _, server = watched
    router.kill()
    stranger = Client(server, enters=False)
    assert eventually(lambda: stranger.get("/readyz").code == 503)
    assert stranger.get("/readyz").content == f"no router at {router.endpoint}; waiting for it\n".encode()


def test_pages_that_cannot_be_made_are_told_and_come_back(watched, monkeypatch):
    _, _, _, server = watched
    client = Client(server)
    with listening(client) as opened:
        assert read_until_frame(opened)[0]["problem"] == ""
        with monkeypatch.context() as broken:
            broken.setattr(feed_module, "list_alarms", lambda _: 1 / 0)
            assert eventually(lambda: client.get("/readyz").code == 503)
            assert "the pages cannot be renewed" in json.loads(opened.recv(timeout=5))["problem"]
        assert eventually(lambda: client.get("/readyz").code == 200)
        assert json.loads(opened.recv(timeout=5)) == {"problem": ""}
