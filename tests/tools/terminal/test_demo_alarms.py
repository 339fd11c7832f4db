"""The demonstration tells which cars were at risk, asks two of them about a ride, and repeats findings."""

import pytest

from socast.core.pipeline import Pipeline
from socast.stream.loop import Tally
from socast.stream.mcap_reader import McapSource
from socast.tools.terminal.demo_verdict import AlarmWatch, read_findings
from tests.support.evening_recording import CAR, EFFECT
from tests.support.evening_shift import EVENING, make_evening_pipeline


@pytest.fixture(scope="module")
def evening():
    """Return the watch after the evening, and the newest risk of each car."""
    pipeline, source = make_evening_pipeline(), McapSource(EVENING)
    watch, received = AlarmWatch(pipeline, (source.count or 0) // 2), 0
    for block in source:
        pipeline.take(block)
        pipeline.forecasts()
        received += len(block)
        watch(Tally(received=received))
    return watch, {car.forecast.vehicle_id: car.forecast for car in pipeline.status()}


def test_cars_that_run_empty_are_warned_hours_before(evening):
    watch, cars = evening
    empty = {name for name, car in cars.items() if car.soc_pct < 5.0}
    assert len(empty) == 3
    assert empty == set(watch.warned)
    assert all(each.newest_s - each.since_s > 2.0 * 3600.0 for each in watch.warned.values())
    assert all(name in watch.list_sentences()[0] for name in empty)


def test_ride_is_refused_to_the_car_at_risk_and_granted_to_the_safest(evening):
    watch, _ = evening
    refused, granted = watch.answers
    assert refused.startswith(f"NO: {max(watch.warned, key=lambda name: name == CAR)} cannot take 18 km")
    assert granted.startswith("YES: ")
    assert refused in watch.list_sentences()[1]


def test_finding_of_the_night_is_repeated():
    (finding,) = read_findings(McapSource(EVENING))
    assert finding.startswith(f"Finding: {CAR} uses ")
    assert EFFECT.replace("_", " ") in finding


def test_fleet_without_risk_says_nothing():
    watch = AlarmWatch(Pipeline(), 0)
    watch(Tally())
    assert watch.list_sentences() == []
