"""Test that weather forecasts change the temperature that a forecast expects ahead."""

import numpy as np
import pytest

from socast.core.columns import SECONDS_PER_DAY
from socast.core.forecast.learning.daily_cycle import DailyCycle
from socast.core.forecast.weather_forecasts import MOST_STATIONS, MOST_TIMES, ForecastArrival, WeatherForecasts
from socast.core.pipeline import Pipeline
from socast.core.wire.messages import Weather
from tests.support.fleet_days import DAY, DAYS, SETTINGS, START, days, forecasts, shift, trained_pipeline
from tests.support.telemetry import chunked, observed

NOW = 50.0 * SECONDS_PER_DAY
HOUR = 3600.0
PRESENT = 270.0


def ahead(hours, celsius, station="yul", issued=NOW - HOUR):
    """Return a forecast of a station for some hours from now."""
    return Weather(station, NOW + HOUR * hours, 45.5, -73.7, temperature_c=celsius, issued_s=issued)


def expect(forecasts, now=NOW, hours=2.0, cycle=None):
    """Return the expected change of the temperature over the hours ahead. [K]"""
    time = np.array([now])
    mean = forecasts.expect_ambient(np.array([PRESENT]), time, time + HOUR * hours, cycle or DailyCycle())
    return float(mean[0]) - PRESENT


def given_forecasts(*each):
    known = WeatherForecasts()
    for forecast in each:
        assert known.admit(forecast) is None
        known.add(forecast)
    return known


def learned_cycle():
    """Return a cycle that warms by 1 K/h at all hours."""
    cycle = DailyCycle()
    for _ in range(200):
        time = np.arange(0.0, SECONDS_PER_DAY, 900.0)
        cycle.add_shift(time, time / HOUR)
        cycle.apply_daily_update()
    return cycle


def test_temperature_follows_the_change_that_is_forecast_and_not_its_level():
    falling = [ahead(hour, -10.0 - 4.0 * hour) for hour in range(6)]
    assert expect(given_forecasts(*falling)) == pytest.approx(-4.0)
    assert expect(given_forecasts(*falling), NOW + HOUR, 4.0) == pytest.approx(-8.0)


def test_later_issue_replaces_an_earlier_one_and_not_the_other_way_round():
    old, new = (
        [ahead(hour, rate * hour, issued=NOW - lead * HOUR) for hour in range(4)]
        for rate, lead in ((5.0, 6.0), (-2.0, 0.0))
    )
    assert expect(given_forecasts(*old, *new)) == expect(given_forecasts(*new, *old)) == pytest.approx(-2.0)


def test_stations_count_alike():
    warming, steady = ([ahead(hour, rate * hour, name) for hour in range(4)] for name, rate in (("a", 4.0), ("b", 0.0)))
    assert expect(given_forecasts(*warming, *steady)) == pytest.approx(2.0)


def test_outside_the_forecast_temperature_follows_the_usual_course_of_the_day():
    cycle = learned_cycle()
    known = given_forecasts(*[ahead(hour, 0.0) for hour in (1.0, 2.0)])
    assert expect(known, hours=1.0, cycle=cycle) == pytest.approx(0.5, rel=0.05)
    assert expect(known, NOW + 2.0 * HOUR, 2.0, cycle) == pytest.approx(1.0, rel=0.05)
    for late in (NOW - 7.0 * HOUR, NOW + 3.0 * HOUR):
        assert expect(known, late, 1.0, cycle) == expect(WeatherForecasts(), late, 1.0, cycle)


def test_row_uses_the_forecasts_that_arrived_before_it():
    arrivals = [ForecastArrival(3, ahead(0.0, 0.0)), ForecastArrival(5, ahead(2.0, 8.0))]
    at, known = np.array([2, 4, 6]), WeatherForecasts()
    now = np.full(3, NOW)
    mean = known.expect_between(at, arrivals, np.full(3, PRESENT), now, now + 2.0 * HOUR, DailyCycle())
    assert mean - PRESENT == pytest.approx([0.0, 0.0, 4.0])


@pytest.mark.parametrize(
    "wrong",
    [{"temperature_c": None}, {"temperature_c": 99.0}, {"time_s": 9e9}, {"issued_s": -1.0}],
)
def test_impossible_forecast_is_refused(wrong):
    forecast = Weather(
        **{"station_id": "a", "time_s": NOW, "latitude_deg": 0.0, "longitude_deg": 0.0}
        | {"issued_s": NOW, "temperature_c": 1.0}
        | wrong
    )
    assert WeatherForecasts().admit(forecast) == "out_of_range"


def test_stations_and_times_are_limited():
    known = given_forecasts(*[ahead(1.0, 0.0, f"station-{number}") for number in range(MOST_STATIONS)])
    assert known.admit(ahead(1.0, 0.0, "another")) == "too_many_stations"
    known.forget_before(NOW + 2.0 * HOUR)
    assert known.admit(ahead(1.0, 0.0, "another")) is None
    many = given_forecasts(*[ahead(float(hour), 0.0) for hour in range(MOST_TIMES + 10)])
    assert len(many.dump()[0][1]) == MOST_TIMES


def test_loaded_state_expects_the_same():
    known, other = given_forecasts(*[ahead(hour, 3.0 * hour) for hour in range(5)]), WeatherForecasts()
    other.load(known.dump())
    assert other.dump() == known.dump()
    assert expect(other) == expect(known)


def cold_ahead(begin, celsius):
    """Return the messages of a forecast of falling temperatures for the hours of a shift."""
    return [
        observed(time=begin + HOUR * hour, temperature_c=celsius * hour, issued_s=begin - 10.0) for hour in range(4)
    ]


def end_of_shift(messages):
    pipeline = trained_pipeline(settings=SETTINGS)
    out = [message for part in messages for message in pipeline.push(part)]
    return forecasts(out, "c"), pipeline


def test_forecast_of_cold_lowers_the_charge_at_the_end_alike_for_any_division_of_the_input():
    begin = START + DAY * DAYS
    samples = [message for _, message in shift("c", DAYS)]
    cold = [*samples[:40], *cold_ahead(begin, -10.0), *samples[40:120]]
    (usual, _), (one, whole), (other, cut) = (
        end_of_shift(parts) for parts in ([samples[:120]], [cold], chunked(cold, [7, 41, 43, 90]))
    )
    last = max(usual)
    assert one[last].soc_end_of_shift_pct.mean < usual[last].soc_end_of_shift_pct.mean - 1.0
    assert one == other
    assert whole.snapshot() == cut.snapshot()
    restored = Pipeline(settings=SETTINGS)
    restored.restore(whole.snapshot())
    assert restored.ask("c").soc_end_of_shift_pct == whole.ask("c").soc_end_of_shift_pct


def test_forecasts_for_the_new_day_are_kept_over_midnight():
    pipeline = trained_pipeline(settings=SETTINGS)
    begin = START + DAY * (DAYS + 1)
    pipeline.push([*cold_ahead(begin - 2.0 * DAY, 0.0), *cold_ahead(begin, -10.0)])
    pipeline.push(days([DAYS, DAYS + 1]))
    ((_, course),) = pipeline.engine.weather.dump()
    assert {time for time, *_ in course} == {begin + HOUR * hour for hour in range(4)}


def test_forecast_is_no_observation():
    pipeline = trained_pipeline(settings=SETTINGS)
    before = str(pipeline.totals.stations.dump())
    pipeline.push(cold_ahead(START + DAY * DAYS, -10.0))
    assert str(pipeline.totals.stations.dump()) == before
    assert pipeline.quality()["undecodable"] == {}
    pipeline.push([observed(time=1.0, temperature_c=99.0, issued_s=1.0)])
    assert pipeline.quality()["undecodable"] == {"out_of_range": 1}
