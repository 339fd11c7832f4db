"""Test that neither the cuts of batches nor the size of pending input change any forecast."""

from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from socast.core.forecast.due_forecasts import PendingInput
from socast.core.forecast.plan_tracker import DriverNamed, PlanArrival
from socast.core.totals import sample_totals
from socast.core.totals.accumulator import Accumulator, join_totals
from socast.core.vehicles.fleet import ReplacedKind
from tests.support.fleet_days import CARS, DAYS, merged, plan, shift, trained_pipeline
from tests.support.telemetry import START, chunked, leaf, make_message, observed

pytestmark = pytest.mark.long

BEGIN = START + 86_400.0 * DAYS


def day(*also):
    """Return the messages of a day of three cars, with others inserted at some times."""
    return merged(*(shift(car, DAYS) for car in CARS[:3]), list(also))


def whole(messages, cuts=()):
    pipeline = trained_pipeline()
    return [m.payload for chunk in chunked(messages, cuts) for m in pipeline.push(chunk)]


def renamed(messages, car):
    """Return messages of car `c` under the name of another car."""
    return [
        (time, m._replace(key=m.key.replace("/c/", f"/{car}/"), payload=m.payload.replace(b'"c"', f'"{car}"'.encode())))
        for time, m in messages
    ]


def weather(number):
    """Return a number of weather observations of a distant place, spread over the shift."""
    times = BEGIN + np.linspace(100.0, 7000.0, number)
    return [(time, observed("far", time, (50.0, -60.0), temperature_c=3.0)) for time in times.tolist()]


@pytest.mark.parametrize("block", [100, 4000])
@given(cuts=st.lists(st.integers(0, 1400), max_size=6))
def test_cuts_weather_and_block_size_change_no_forecast(block, cuts):
    assert in_blocks(block, day(*weather(40)), cuts) == expected()


@pytest.mark.parametrize("cuts", [(), (3, 501, 502, 1200)])
def test_blocks_of_few_rows_change_no_forecast(cuts):
    """Plans and vehicle messages stand within a batch, after rows whose forecasts have been computed before it ends."""
    plans = [(BEGIN + at, plan("a", DAYS, BEGIN + at, last=4)) for at in (1800.5, 3555.0)]
    heavier = [(BEGIN + at, leaf("c", BEGIN + at, mass_kg=2000.0 + at)) for at in (900.0, 3600.0)]
    messages = day(*weather(40), *plans, *heavier)
    assert in_blocks(7, messages, cuts) == whole(messages) != expected()


def in_blocks(block, messages, cuts):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sample_totals, "BLOCK", block)
        return whole(messages, cuts)


@cache
def expected(observations=40):
    return whole(day(*weather(observations)))


def test_plan_between_two_rides_gives_same_forecasts_for_any_cut():
    late = [(BEGIN + at, plan("a", DAYS, BEGIN + at, last=4)) for at in (3300.0, 3555.0, 3590.0, 3601.0)]
    for number in range(len(late)):
        messages = day(late[number])
        place = messages.index(late[number][1])
        assert whole(messages) == whole(messages, range(place - 60, place + 60))


def test_late_or_changed_vehicle_model_gives_same_forecasts_for_any_cut():
    first, *rest = renamed(shift("c", DAYS), "z")
    other = make_message("vehicle", "z", BEGIN, model="nissan-leaf-2016")
    messages = [m for _, m in [first, *rest[:2]]] + [leaf("z"), leaf("z"), *(m for _, m in rest[2:150])]
    messages += [other, other, leaf("z"), other, *(m for _, m in rest[150:])]
    payloads = whole(messages)
    assert payloads == whole(messages, range(1, len(messages)))
    assert payloads != whole([m for m in messages if m is not other])


def test_changes_of_the_vehicle_model_between_plans_and_shifts_give_same_forecasts_for_any_cut():
    """The car of lane z is another one from some message on: plans, ends of shifts and what they teach follow it."""
    heavy = [(BEGIN + at, leaf("z", BEGIN + at, mass_kg=2000.0 + at)) for at in (30.0, 900.0, 3600.0, 20_000.0)]
    light = [(time + 1.0, leaf("z", time)) for time, _ in heavy]
    plans = [(BEGIN + at, plan("z", DAYS, BEGIN + at, last=4)) for at in (30.5, 31.5, 3600.5, 3601.5)]
    late = [
        (time + 43_200.0, m._replace(payload=m.payload.replace(b'"time_s": 17057', b'"time_s": 17058')))
        for time, m in renamed(shift("c", DAYS), "z")[:40]
        if m.key.endswith("telemetry")
    ]
    messages = merged(
        *(shift(car, DAYS) for car in CARS[:2]), renamed(shift("c", DAYS), "z"), heavy, light, plans, late
    )
    first = trained_pipeline()
    expected = [m.payload for m in first.push(messages)]
    state = first.snapshot()
    changes = {messages.index(m) for _, m in [*heavy, *light, *plans, *late]}
    near = [place for place in range(len(messages)) if changes & set(range(place - 12, place + 13))]
    for cuts in (near, range(0, len(messages), 7), range(0, len(messages), 100)):
        pipeline = trained_pipeline()
        assert [m.payload for chunk in chunked(messages, cuts) for m in pipeline.push(chunk)] == expected
        assert pipeline.snapshot() == state


def test_vehicle_messages_and_observations_do_not_cut_a_batch(monkeypatch):
    pipeline, calls = trained_pipeline(), []
    clean = pipeline.totals.cleaner.clean_between
    monkeypatch.setattr(pipeline.totals.cleaner, "clean_between", lambda *args: calls.append(1) or clean(*args))
    samples = [m for _, m in shift("c", DAYS)][:200]
    between = zip((leaf("c", mass_kg=1500.0 + i % 3) for i in range(200)), (m for _, m in weather(200)), strict=True)
    pipeline.push([m for sample, others in zip(samples, between, strict=True) for m in (sample, *others)])
    assert len(calls) == 1


@given(cuts=st.lists(st.integers(0, 1400), max_size=6), queried=st.lists(st.integers(0, 6), max_size=3))
def test_status_queries_and_snapshots_change_no_forecast(cuts, queried):
    pipeline, messages = trained_pipeline(), day(*weather(5))
    for number, chunk in enumerate(chunked(messages, cuts)):
        pipeline.take(chunk)
        if number in queried:
            pipeline.status(), pipeline.ask("a"), pipeline.snapshot()
    assert [m.payload for m in pipeline.forecasts()] == expected(5)
    assert pipeline.snapshot()


def test_later_dispatch_messages_wait_and_messages_count_from_first_batch():
    accumulator = Accumulator(0)
    none = accumulator.none()
    rows = none._replace(**{name: np.zeros((2, *part.shape[1:]), part.dtype) for name, part in none._asdict().items()})
    pending = PendingInput(none)
    assert not pending
    plan_later = PlanArrival(9, 1, None)
    pending.add_arrival(DriverNamed(5, 0, "x"))
    pending.add_arrival(plan_later)
    pending.add_sums(accumulator.close()._replace(running=rows._replace(at=rows.at + 3)), 2)
    pending.add_sums(accumulator.close()._replace(running=rows._replace(at=rows.at + 5)), 2)
    assert pending.size == 6
    pending.add_replaced([ReplacedKind(6, 0, 1), ReplacedKind(8, 0, 2)])
    sums, plans, drivers, forecasts, replaced = pending.take(7)
    assert forecasts == []
    assert replaced == [ReplacedKind(6, 0, 1), ReplacedKind(8, 0, 2)]
    assert sums.running.at.tolist() == [3, 3, 5, 5]
    assert (plans, drivers) == ([], [DriverNamed(5, 0, "x")])
    assert pending.size == 0
    pending.end_batch(9)
    pending.add_sums(accumulator.close()._replace(running=rows._replace(at=rows.at + 2)), 2)
    sums, plans, *_, replaced = pending.take(4)
    assert replaced == [ReplacedKind(8, 0, 2)]
    assert sums.running.at.tolist() == [11, 11]
    assert plans == [plan_later]
    assert not pending


def test_joining_no_totals_returns_none():
    none = Accumulator(3).none()
    assert join_totals([], none) is none
    assert join_totals([none, none], none) is none
