"""Test that cars which are silent for days are forgotten, as if they had never been, for any division of the input."""

from functools import cache

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from socast.core.pipeline import Pipeline
from socast.core.settings import Limits
from tests.support.fleet_days import CARS, DAYS, SETTINGS, forecasts, learned, merged, shift
from tests.support.telemetry import chunked, leaf, make_message

pytestmark = pytest.mark.long
LIMITS = Limits(silent_days=2.0)
GONE = "b"
"""Car that is silent from day 5 on."""


def trained(limits=LIMITS, *, keep_tables=False):
    pipeline = Pipeline(settings=SETTINGS, limits=limits, keep_tables=keep_tables)
    pipeline.restore(learned())
    return pipeline


def later_days(returns=False):
    """Return days 5 to 9 of all cars but one, which may return on day 9, with strangers on some days."""
    days = []
    for day in range(DAYS, DAYS + 5):
        cars = [car for car in CARS if car != GONE or (returns and day == DAYS + 4)]
        streams = [shift(car, day) for car in cars]
        if day % 2:
            stranger = [(t, m._replace(key=m.key.replace("/d/", f"/new-{day}/"))) for t, m in shift("d", day)]
            name = f'"vehicle_id": "new-{day}"'.encode()
            streams.append(
                [(t, m._replace(payload=m.payload.replace(b'"vehicle_id": "d"', name))) for t, m in stranger]
            )
            streams.append([(streams[0][5][0], leaf(f"quiet-{day}"))])
        days += merged(*streams)
    return days


def run(messages, cuts=(), pipeline=None):
    """Return a pipeline after messages, and its forecasts."""
    pipeline = pipeline or trained()
    out = []
    for chunk in chunked(messages, cuts):
        out += pipeline.push(chunk)
    return pipeline, out


def test_silent_car_is_forgotten_by_every_component():
    pipeline, _ = run(later_days(), range(0, 20_000, 400))
    names = pipeline.lanes.names
    assert GONE not in names
    assert set(CARS) - {GONE} <= set(names)
    assert "new-9" in names
    assert "new-5" not in names
    assert "quiet-5" not in names
    lanes = len(names)
    parts = (
        pipeline.totals.cleaner.state,
        pipeline.engine.state,
        pipeline.engine.log._times,
        pipeline.totals.accumulator._open,
    )
    assert max(map(len, parts)) <= 2 * lanes
    assert max(pipeline.engine.plans.plans) < lanes
    assert {status.forecast.vehicle_id for status in pipeline.status()} <= set(names)
    with pytest.raises(Exception, match="has sent nothing"):
        pipeline.ask(GONE)


def test_forgetting_a_car_does_not_change_the_forecasts_of_the_others():
    _, expected = run(later_days(), range(0, 20_000, 400), trained(Limits()))
    _, out = run(later_days(), range(0, 20_000, 400))
    assert len(out) == len(expected) > 2000
    for car in set(CARS) - {GONE}:
        mine, before = forecasts(out, car), forecasts(expected, car)
        assert mine.keys() == before.keys()
        for time, forecast in mine.items():
            for name in ("soc_pct", "ride_energy_measured_kwh", "reserve_risk"):
                one, other = getattr(forecast, name), getattr(before[time], name)
                assert (one is None) == (other is None)
                assert one is None or one == pytest.approx(other, rel=1e-9)


@cache
def run_undivided(returns):
    """Return the forecasts, cars and status after the later days in one piece, and the forecasts of the next day."""
    whole, expected = run(later_days(returns))
    names, status = list(whole.lanes.names), repr(whole.status())
    return expected, names, status, run(next_day(), (), whole)[1]


def next_day():
    return merged(*(shift(car, DAYS + 5) for car in CARS))


@pytest.mark.parametrize("returns", [False, True])
@settings(max_examples=5)
@given(cuts=st.lists(st.integers(0, 15_000), max_size=8))
def test_any_division_gives_the_same_forecasts_and_state(returns, cuts):
    expected, names, status, following = run_undivided(returns)
    parts, out = run(later_days(returns), cuts)
    assert out == expected
    assert parts.lanes.names == names
    assert repr(parts.status()) == status
    restored = Pipeline(settings=SETTINGS, limits=LIMITS, keep_tables=False)
    restored.restore(parts.snapshot())
    assert restored.lanes.names == names
    assert run(next_day(), (), restored)[1] == run(next_day(), (), parts)[1] == following


@pytest.mark.parametrize("step", [1, 3])
def test_divisions_near_the_update_give_the_same_state(step):
    messages = later_days(returns=True)
    starts = [i for i, m in enumerate(messages) if b'"seq": 0,' in m.payload and m.key.startswith("fleet/a/")]
    near = range(starts[-1] - 20, starts[-1] + 80, step)
    whole, expected = run(messages)
    parts, out = run(messages, near)
    assert out == expected
    assert parts.lanes.names == whole.lanes.names
    for name in ("decoder", "plans", "silent_cars"):
        assert repr(getattr(parts, name).dump()) == repr(getattr(whole, name).dump()), name
    lanes = len(whole.lanes)  # arrays have room for more
    assert parts.day_rollover._clocks[:lanes].tobytes() == whole.day_rollover._clocks[:lanes].tobytes()
    assert parts.day_rollover._newest.tolist() == whole.day_rollover._newest.tolist()
    assert parts.totals.cleaner.state[:lanes].tobytes() == whole.totals.cleaner.state[:lanes].tobytes()
    assert parts.engine.state[:lanes].tobytes() == whole.engine.state[:lanes].tobytes()


def test_rides_that_were_not_taken_keep_their_cars():
    gone = Pipeline(settings=SETTINGS, limits=LIMITS)
    gone.push([leaf(GONE), *(m for _, m in shift(GONE, DAYS)), make_message("ride", GONE, ride_id="x", event="end")])
    gone.push(later_days())
    rides = gone.take_rides()
    assert GONE in set(rides["vehicle_id"])
    assert set(rides["vehicle_id"]) >= {"new-5", "a", "f"}
