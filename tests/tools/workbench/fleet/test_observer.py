"""The observer shows what cars send and a service publishes, passes questions on, and publishes nothing itself."""

import shlex
from contextlib import closing
from types import SimpleNamespace

import pyarrow as pa
import pytest

from socast.core.errors import AskError
from socast.core.wire.arrow_batch import write_rows
from socast.core.wire.messages import Forecast, Message, QualityCounts, Telemetry, encode
from socast.stream.zenoh_session import Connection, Node
from socast.stream.zenoh_sink import ZenohSink
from socast.tools.workbench.fleet.board import Board
from socast.tools.workbench.fleet.cars import answer_question
from socast.tools.workbench.fleet.observer import Observer
from tests.support.commands import done
from tests.support.zenoh_sessions import eventually, live

NOW = 1.7e9


def make_messages(car):
    sample = Telemetry(car, NOW, latitude_deg=45.5, longitude_deg=-73.6, speed_kmh=30.0)
    energies = None, None, 61.5, 0.2, None, None, 0.01
    forecast = Forecast(car, NOW, "r", "model/1", 1.0, 60.0, *energies, quality=QualityCounts(0, 0, 0, 0, 0))
    return [
        Message(f"fleet/{car}/telemetry", encode(sample), 0),
        Message(f"fleet/{car}/forecast", encode(forecast), 0),
    ]


def make_batch(*cars):
    """Return a sample of each of some cars as the batch of a gateway."""
    places = {"latitude_deg": [45.5] * len(cars), "longitude_deg": [-73.6] * len(cars)}
    table = pa.table({"vehicle_id": cars, "time_s": [NOW] * len(cars), "speed_kmh": [40.0] * len(cars)} | places)
    return Message("fleet/depot-3/batch", write_rows(table), 0)


@pytest.fixture(scope="module")
def observed():
    """Run a service under a prefix, an observer of it, and a stranger that hears everything at the router."""
    heard = []
    with live(prefix="montreal") as (consumer, _, client):
        endpoint = client.connection.connect[0]
        with (
            Node(Connection(connect=(endpoint,))) as stranger,
            closing(Observer(Connection(connect=(endpoint,), mode="client", prefix="montreal"), Board())) as observer,
        ):
            stranger.session.declare_subscriber("**", lambda sample: heard.append(str(sample.key_expr)))
            observer.start()
            sink = ZenohSink(client, "montreal/")

            def is_seen():
                sink.put([*make_messages("taxi-7"), *make_messages("taxi-8"), make_batch("van-1", "van-2")])
                return len(observer.board) == 4 and observer.board.get_values("taxi-8")["soc_pct"] == 61.5

            assert eventually(is_seen)
            yield observer, consumer, heard
            sink.close()


def test_observer_shows_samples_and_forecasts_of_its_prefix(observed):
    observer, _, _ = observed
    values = observer.board.get_values("taxi-7")
    assert (values["latitude"], values["soc_pct"], values["reserve_risk"]) == (45.5, 61.5, 0.01)
    state = observer.describe()
    assert (state["mode"], state["time_s"], state["dropped"]) == ("live", NOW, 0)
    assert state["received"] >= 4


def test_observer_shows_cars_behind_a_gateway(observed):
    observer, _, _ = observed
    for car in ("van-1", "van-2"):
        values = observer.board.get_values(car)
        assert (values["latitude"], values["longitude"], values["speed"]) == (45.5, -73.6, 40.0)
    assert observer.board.density.describe()["count"]
    assert "undecodable" not in observer.board.counts


def test_question_goes_to_the_service(observed):
    observer, consumer, _ = observed
    outlook = observer.ask("taxi-7", {"distance_km": "18", "duration_s": "1500"})
    assert (outlook.vehicle_id, outlook.asked.distance_km) == ("taxi-7", 18.0)
    assert consumer.asked[-1][0] == "taxi-7"
    with pytest.raises(AskError, match="distance_km is -1"):
        observer.ask("taxi-7", {"distance_km": "-1", "duration_s": "60"})
    assert observer.get_parts("taxi-7") is None


def test_wrong_question_is_refused_in_the_words_of_the_form(observed):
    request = SimpleNamespace(path={"car": "taxi-7"}, parameters={"distance_km": "18", "duration_s": "90000"})
    with pytest.raises(AskError, match="Duration is 1500, must be 0 to 1440; give minutes"):
        answer_question(SimpleNamespace(fleet=observed[0]), request)


def test_page_of_a_live_service_shows_the_command_that_gives_the_same_answer(observed, capsys):
    observer, _, _ = observed
    parameters = {"distance_km": "18", "duration_s": "1500", "zone": "America/Montreal"}
    request = SimpleNamespace(path={"car": "taxi-7"}, parameters=parameters)
    answer = answer_question(SimpleNamespace(fleet=observer), request)
    program, *words = shlex.split(answer["command"])
    assert (program, words[:6]) == ("socast", ["ask", "taxi-7", "--distance-km", "18", "--duration-min", "25"])
    done(*words)
    printed = capsys.readouterr().out
    assert printed.startswith(f"{answer['word']}: {answer['sentence']}")
    assert all(figure["text"] in printed for figure in answer["figures"])


def test_observer_publishes_nothing(observed):
    observer, _, heard = observed
    observer.ask("taxi-7", {})
    assert {key.split("/")[-1] for key in heard} <= {"telemetry", "batch", "forecast"}
