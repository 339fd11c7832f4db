"""Whatever is asked, the desk answers or refuses, counts it, and goes on."""

import logging
from dataclasses import dataclass, field

import msgspec
import pytest

from core.errors import ModelError
from core.wire.messages import Leg, Outlook, encode
from stream.loop import Tally
from stream.query_service import LOG_S, SPEND_S, QueryService
from tests.support.outlooks import NOW, PLANNED, Fleet


@dataclass
class Asked:
    """A question in memory."""

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
class Waiting:
    """Questions in memory."""

    questions: list[Asked]

    def pending(self) -> list[Asked]:
        taken, self.questions = self.questions, []
        return taken


def served(*questions: Asked, fleet=None, **settings) -> QueryService:
    desk = QueryService(Waiting(list(questions)), fleet or Fleet(), **settings)
    desk(Tally())
    return desk


def test_a_ride_and_a_plan_reach_whoever_answers():
    fleet, plan = Fleet(), msgspec.structs.replace(PLANNED, legs=[Leg(5.0, 600.0)])
    first = Asked(parameters="distance_km=18&duration_s=1500&gained_m=40")
    second = Asked(parameters="distance_km=2;duration_s=200", payload=encode(plan))
    desk = served(first, second, Asked(), fleet=fleet)
    assert fleet.asked == [
        ("taxi-7", Leg(18.0, 1500.0, 40.0), None),
        ("taxi-7", Leg(2.0, 200.0), plan),
        ("taxi-7", None, None),
    ]
    (answer,) = second.replies
    told = msgspec.json.decode(answer, type=Outlook)
    assert (told.asked.distance_km, [leg.distance_km for leg in told.legs]) == (2.0, [5.0])
    assert desk.counts() == {"answered": 3, "refused": {}}


BAD = [
    (Asked("*"), "vehicle", "one name"),
    (Asked("taxi-9"), "unknown_vehicle", "taxi-9 is not known"),
    (Asked(parameters="distance_km=-3&duration_s=1500"), "out_of_range", "distance_km is -3"),
    (Asked(parameters="distance_km=far&duration_s=1500"), "parameters", "'far'"),
    (Asked(parameters="what now"), "parameters", "'what now' is no parameter"),
    (Asked(payload=b"rubbish"), "payload", "no plan"),
    (Asked(payload=encode(msgspec.structs.replace(PLANNED, legs=[Leg(1, 60)] * 10_000))), "too_many_legs", "10000"),
    (
        Asked(payload=encode(msgspec.structs.replace(PLANNED, shift_end_s=NOW - 3600.0))),
        "plan_in_the_past",
        "1.0 h before",
    ),
    (Asked("taxi-0"), "failed", "cannot be answered"),
]


@pytest.mark.parametrize(("question", "cause", "told"), BAD, ids=[cause for _, cause, _ in BAD])
def test_what_cannot_be_answered_is_refused_in_words_and_the_next_is_answered(question, cause, told):
    question.refusals.clear()
    after = Asked()
    desk = served(question, after)
    assert question.replies == []
    (words,) = question.refusals
    assert told in words
    assert len(after.replies) == 1
    assert desk.counts() == {"answered": 1, "refused": {cause: 1}}


def test_another_error_that_a_person_can_mend_is_told():
    class Modelless(Fleet):
        def ask(self, *_):
            raise ModelError("the model 'x' has no twizy")

    question = Asked()
    desk = served(question, fleet=Modelless())
    assert question.refusals == ["the model 'x' has no twizy"]
    assert desk.refused == {"unanswerable": 1}


def test_what_an_answer_does_not_know_travels_as_null():
    class Unknowing(Fleet):
        def ask(self, *arguments):
            return msgspec.structs.replace(super().ask(*arguments), soc_pct=float("nan"), reserve_risk=None)

    question = Asked()
    served(question, fleet=Unknowing())
    told = msgspec.json.decode(question.replies[0])
    assert told["soc_pct"] is None
    assert told["reserve_risk"] is None


class Slow(Fleet):
    """Takes 40 ms of a clock for each answer."""

    now = 0.0

    def ask(self, *arguments):
        self.now += 0.04
        return super().ask(*arguments)


def test_telemetry_has_its_turn_between_many_questions_and_none_is_forgotten():
    questions, fleet = [Asked() for _ in range(10)], Slow()
    waiting = Waiting(list(questions))
    desk = QueryService(waiting, fleet, clock=lambda: fleet.now)
    waits = []
    while len(fleet.asked) < 10:
        before = fleet.now
        desk(Tally())
        waits.append(fleet.now - before)
    assert max(waits) < SPEND_S + 0.04 + 1e-9
    assert len(waits) == 4
    assert [len(question.replies) for question in questions] == [1] * 10


def test_one_refusal_of_a_cause_a_second_is_logged_and_all_are_counted(caplog: pytest.LogCaptureFixture):
    ticks = iter(i * LOG_S / 20 for i in range(10_000))
    bad = [Asked("taxi-9") for _ in range(30)] + [Asked(parameters="lunch")]
    desk = QueryService(Waiting(bad), Fleet(), clock=lambda: next(ticks))
    with caplog.at_level(logging.INFO, logger="socast.queries"):
        while sum(desk.refused.values()) < len(bad):
            desk(Tally())
        desk.end()
    assert desk.refused == {"unknown_vehicle": 30, "parameters": 1}
    logged = [record.fields["cause"] for record in caplog.records if record.message == "question refused"]
    assert logged[-1] == "parameters"
    assert 2 <= logged.count("unknown_vehicle") < 10
    assert caplog.records[-1].fields == {"refused.unknown_vehicle": 30, "refused.parameters": 1}


def test_what_should_not_have_happened_is_logged_by_its_name(caplog: pytest.LogCaptureFixture):
    served(Asked("taxi-0"))
    (record, _) = caplog.records
    assert record.exc_info[0] is ZeroDivisionError


def test_where_nothing_was_asked_nothing_is_logged(caplog: pytest.LogCaptureFixture):
    with caplog.at_level(logging.INFO, logger="socast.queries"):
        served().end()
    assert caplog.records == []
