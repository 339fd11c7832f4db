"""A diagnosis begins after each midnight, never holds up the loop, and announces what changed."""

import json
import logging
from math import inf

import pytest

from socast.core.errors import SettingsError
from socast.core.models import EXTENDED_PHYSICAL
from socast.core.pipeline import Pipeline
from socast.stream.loop import Tally, run
from socast.stream.memory import MemorySink, MemorySource
from socast.stream.nightly_diagnosis import CarLevel, NightlyCondition, NightlyDiagnosis
from socast.tools.terminal.night_watch import make_finding_fields
from tests.support.findings import make_finding
from tests.support.recorded_shift import make_two_days

DAY = 86_400.0


class Nights:
    """A fleet whose days end on demand, and diagnoses that end on demand."""

    def __init__(self):
        self.midnight, self.code, self.findings, self.jobs, self.ended = -inf, 0, [], 0, 0
        self.sink = MemorySink()
        self.watch = self.make_watch(lambda: self.midnight)

    def make_watch(self, get_midnight, read_condition=lambda: None):
        return NightlyDiagnosis(
            get_midnight,
            self.start,
            self.read,
            self.sink,
            make_finding_fields,
            "p/",
            read_condition=read_condition,
        )

    def start(self):
        self.jobs += 1
        return self

    def read(self):
        return self.findings

    def poll(self):
        return self.code

    def get_error(self):
        return "socast: too few rides"

    def end(self):
        self.ended += 1

    def look(self, midnight=None):
        self.midnight = self.midnight if midnight is None else midnight
        self.watch(Tally())


@pytest.fixture
def nights():
    return Nights()


@pytest.fixture
def log(caplog, monkeypatch):
    monkeypatch.setattr(logging.getLogger("socast"), "propagate", True)
    caplog.set_level(logging.INFO, "socast")
    return caplog


def test_diagnosis_begins_when_a_day_ends_and_not_with_the_first_day(nights):
    began = []
    for midnight in (-inf, DAY, DAY, 2 * DAY, 2 * DAY, DAY, DAY):
        nights.look(midnight)
        began.append(nights.jobs)
    assert began == [0, 0, 0, 1, 1, 1, 1]


def test_change_is_published_and_logged_once(nights, log):
    for night in (1, 2, 3):
        nights.look(night * DAY)
        nights.findings = [make_finding()]
        nights.look()
    (message,) = nights.sink.messages
    assert message.key == "p/findings/taxi-005/tyre_pressure"
    assert json.loads(message.payload)["kwh_per_month"] == 12.1
    (line,) = [record.fields for record in log.records if record.message == "finding"]
    assert (line["status"], line["add"], line["shadow"]) == ("sure", "socast add tyre_pressure", "socast live")
    assert nights.ended == nights.jobs == 2


def test_finding_that_is_gone_is_withdrawn(nights):
    nights.findings = [make_finding()]
    nights.watch = nights.make_watch(lambda: nights.midnight)
    nights.look(DAY)
    nights.look(2 * DAY)
    nights.findings = [make_finding(status="gone")]
    nights.look()
    assert [json.loads(message.payload)["status"] for message in nights.sink.messages] == ["gone"]


def test_diagnosis_that_takes_longer_than_a_day_is_not_started_twice(nights, log):
    nights.code = None
    for night in (1, 2, 3):
        nights.look(night * DAY)
    assert nights.jobs == 1
    assert "still runs" in log.text
    nights.watch.end()
    assert nights.ended == 1


def test_failure_is_logged_and_the_next_night_diagnoses_again(nights, log):
    nights.code = 2
    for night in (1, 2, 3):
        nights.look(night * DAY)
        nights.look()
    reasons = [record.fields["reason"] for record in log.records if record.message == "diagnosis failed"]
    assert reasons == ["socast: too few rides"] * 2
    assert nights.sink.messages == []


def test_findings_that_cannot_be_read_are_logged(nights, log):
    nights.look(DAY)
    nights.look(2 * DAY)

    def fail():
        raise SettingsError("findings.json is no file of findings")

    nights.watch._read = fail
    nights.look()
    assert "diagnosis failed" in log.text


def test_condition_is_read_at_the_start_and_after_each_night_and_kept_where_it_cannot_be_read(nights, log):
    found = [NightlyCondition(1.0, {"car": CarLevel(1.05, 27.0)})]

    def read():
        if isinstance(found[0], Exception):
            raise found[0]
        return found[0]

    watch = nights.make_watch(lambda: nights.midnight, read)
    nights.watch = watch
    assert watch.condition.assessed_s == 1.0
    nights.code = 2  # a diagnosis that fails has assessed the cars before
    nights.look(DAY)
    nights.look(2 * DAY)
    found[0] = NightlyCondition(2.0, {})
    nights.look()
    assert watch.condition.assessed_s == 2.0
    found[0] = SettingsError("c.json is no condition of cars: remove it")
    nights.look(3 * DAY)
    nights.look()
    assert watch.condition.assessed_s == 2.0
    assert [line.fields["cars"] for line in log.records if line.message == "condition of the cars known"] == [1, 0]
    assert "condition of the cars unknown: c.json is no condition of cars" in log.text


def run_two_days(nights):
    """Return what the loop sends on two days of driving."""
    pipeline, sink = Pipeline(EXTENDED_PHYSICAL), MemorySink()
    watch = nights.make_watch(lambda: pipeline.day_rollover.midnight) if nights else lambda _: None
    run(MemorySource(make_two_days(), 200), pipeline, [sink], watch=watch)
    return sink.messages


def test_live_loop_diagnoses_after_midnight_and_forecasts_the_same_to_the_bit(nights):
    nights.findings = []
    plain = run_two_days(None)
    assert run_two_days(nights) == plain
    assert len(plain) > 100
    assert nights.jobs == 1
