"""The query service answers or refuses every query, counts it, and never stops or delays the telemetry."""

import logging
from dataclasses import dataclass, field

import msgspec
import pytest

from socast.core.errors import ModelError
from socast.core.wire.messages import Leg, Outlook, encode
from socast.stream.loop import Tally
from socast.stream.query_service import LOG_S, SPEND_S, QueryService
from tests.support.outlooks import NOW, PLANNED, Fleet


@dataclass
class MemoryQuery:
    """A query in memory."""

    vehicle: str = "taxi-7"
    parameters: str = ""
    payload: bytes | None = None
    replies: list[bytes] = field(default_factory=list)
    refusals: list[str] = field(default_factory=list)

    def reply(self, payload: bytes) -> None:
        self.replies.append(payload)

    def refuse(self, words: str) -> None:
        self.refusals.append(words)


@dataclass
class MemoryQueries:
    """A source of queries in memory."""

    questions: list[MemoryQuery]

    def pending(self) -> list[MemoryQuery]:
        taken, self.questions = self.questions, []
        return taken


def serve(*questions: MemoryQuery, fleet=None, **settings) -> QueryService:
    service = QueryService(MemoryQueries(list(questions)), fleet or Fleet(), **settings)
    service(Tally())
    return service


def test_ride_and_plan_of_query_reach_pipeline():
    fleet, plan = Fleet(), msgspec.structs.replace(PLANNED, legs=[Leg(5.0, 600.0)])
    first = MemoryQuery(parameters="distance_km=18&duration_s=1500&gained_m=40")
    second = MemoryQuery(parameters="distance_km=2;duration_s=200", payload=encode(plan))
    service = serve(first, second, MemoryQuery(), fleet=fleet)
    assert fleet.asked == [
        ("taxi-7", Leg(18.0, 1500.0, 40.0), None),
        ("taxi-7", Leg(2.0, 200.0), plan),
        ("taxi-7", None, None),
    ]
    (answer,) = second.replies
    expected = msgspec.json.decode(answer, type=Outlook)
    assert (expected.asked.distance_km, [leg.distance_km for leg in expected.legs]) == (2.0, [5.0])
    assert service.counts() == {"answered": 3, "refused": {}}


BAD = [
    (MemoryQuery("*"), "vehicle", "one name"),
    (MemoryQuery("taxi-9"), "unknown_vehicle", "taxi-9 is not known"),
    (MemoryQuery(parameters="distance_km=-3&duration_s=1500"), "out_of_range", "distance_km is -3"),
    (MemoryQuery(parameters="distance_km=far&duration_s=1500"), "parameters", "'far'"),
    (MemoryQuery(parameters="what now"), "parameters", "'what now' is no parameter"),
    (MemoryQuery(payload=b"rubbish"), "payload", "no plan"),
    (
        MemoryQuery(payload=encode(msgspec.structs.replace(PLANNED, legs=[Leg(1, 60)] * 10_000))),
        "too_many_legs",
        "10000",
    ),
    (
        MemoryQuery(payload=encode(msgspec.structs.replace(PLANNED, shift_end_s=NOW - 3600.0))),
        "plan_in_the_past",
        "1.0 h before",
    ),
    (MemoryQuery("taxi-0"), "failed", "cannot be answered"),
]


@pytest.mark.parametrize(("question", "cause", "expected"), BAD, ids=[cause for _, cause, _ in BAD])
def test_invalid_query_is_refused_with_reason_and_next_query_is_answered(question, cause, expected):
    question.refusals.clear()
    after = MemoryQuery()
    service = serve(question, after)
    assert question.replies == []
    (words,) = question.refusals
    assert expected in words
    assert len(after.replies) == 1
    assert service.counts() == {"answered": 1, "refused": {cause: 1}}


def test_refusal_passes_on_message_of_other_socast_error():
    class FleetWithoutModel(Fleet):
        def ask(self, *_):
            raise ModelError("the model 'x' has no twizy")

    question = MemoryQuery()
    service = serve(question, fleet=FleetWithoutModel())
    assert question.refusals == ["the model 'x' has no twizy"]
    assert service.refused == {"unanswerable": 1}


def test_unknown_values_are_null_in_answer():
    class FleetWithUnknowns(Fleet):
        def ask(self, *arguments):
            return msgspec.structs.replace(super().ask(*arguments), soc_pct=float("nan"), reserve_risk=None)

    question = MemoryQuery()
    serve(question, fleet=FleetWithUnknowns())
    expected = msgspec.json.decode(question.replies[0])
    assert expected["soc_pct"] is None
    assert expected["reserve_risk"] is None


class SlowFleet(Fleet):
    """A fleet that takes 40 ms of a clock for each answer."""

    now = 0.0

    def ask(self, *arguments):
        self.now += 0.04
        return super().ask(*arguments)


def test_many_queries_never_delay_telemetry_beyond_limit_and_all_are_answered():
    questions, fleet = [MemoryQuery() for _ in range(10)], SlowFleet()
    waiting = MemoryQueries(list(questions))
    service = QueryService(waiting, fleet, clock=lambda: fleet.now)
    waits = []
    while len(fleet.asked) < 10:
        before = fleet.now
        service(Tally())
        waits.append(fleet.now - before)
    assert max(waits) < SPEND_S + 0.04 + 1e-9
    assert len(waits) == 4
    assert [len(question.replies) for question in questions] == [1] * 10


def test_refusals_of_same_cause_are_logged_once_per_period_and_all_counted(caplog: pytest.LogCaptureFixture):
    ticks = iter(i * LOG_S / 20 for i in range(10_000))
    bad = [MemoryQuery("taxi-9") for _ in range(30)] + [MemoryQuery(parameters="lunch")]
    service = QueryService(MemoryQueries(bad), Fleet(), clock=lambda: next(ticks))
    with caplog.at_level(logging.INFO, logger="socast.queries"):
        while sum(service.refused.values()) < len(bad):
            service(Tally())
        service.end()
    assert service.refused == {"unknown_vehicle": 30, "parameters": 1}
    logged = [record.fields["cause"] for record in caplog.records if record.message == "question refused"]
    assert logged[-1] == "parameters"
    assert 2 <= logged.count("unknown_vehicle") < 10
    assert caplog.records[-1].fields == {"refused.unknown_vehicle": 30, "refused.parameters": 1}


def test_defect_is_logged_with_its_exception(caplog: pytest.LogCaptureFixture):
    serve(MemoryQuery("taxi-0"))
    (record, _) = caplog.records
    assert record.exc_info[0] is ZeroDivisionError


def test_service_without_queries_logs_nothing(caplog: pytest.LogCaptureFixture):
    with caplog.at_level(logging.INFO, logger="socast.queries"):
        serve().end()
    assert caplog.records == []
