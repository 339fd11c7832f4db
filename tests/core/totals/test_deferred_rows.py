"""Test that rows wait for the end of their ride, whatever the division of the input, and that none is lost."""

from functools import cache

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from socast.core.cleaning.kernel import Cleaner
from socast.core.errors import SettingsError
from socast.core.pipeline import Pipeline
from socast.core.settings import Settings
from socast.core.signals.weather import Sky
from socast.core.totals.clean_rows import CleanRows
from socast.core.totals.deferred_rows import DeferredRows
from socast.tools.simulator.fleet import simulate
from socast.tools.simulator.settings import Faults, Simulation
from tests.support.telemetry import chunked, decoded, drive, leaf, telemetry

CARS = ("a", "b", "c")


def car(name, seed, n=240):
    """Return the samples of a car with three rides, the last of which is open, over hills."""
    rng = np.random.default_rng(seed)
    columns = drive(n, seed=seed, battery_voltage_v=360.0, battery_current_a=30.0)
    columns["elevation_m"] = np.round(50 + 20 * np.sin(columns["metres"] / 300) + rng.normal(0, 2, n), 1)
    columns["ride_id"] = np.array([("A", None, "B", "C")[4 * i // n] for i in range(n)], dtype=object)
    return telemetry(columns, name)


def fleet(seed):
    """Return the samples of several cars in a random order that keeps the order of each car."""
    streams = [car(name, seed + i) for i, name in enumerate(CARS)]
    owners = np.random.default_rng(seed).permutation(np.repeat(np.arange(len(CARS)), len(streams[0])))
    iterators = [iter(stream) for stream in streams]
    return [next(iterators[owner]) for owner in owners]


def rows_of(messages):
    """Return the cleaned rows of messages, under an unknown sky."""
    batch = decoded(messages)
    clean = Cleaner(Settings()).clean(batch, len(CARS))
    nowhere = Sky(*np.full((len(Sky._fields), batch.size), np.nan))
    return CleanRows(clean, nowhere, np.zeros(batch.size, np.int64))


def tabulated(messages, cuts=(), least=100, **options):
    """Return the two-sided tables of messages, which arrive in parts."""
    pipeline = Pipeline(keep_forecasts=False, two_sided=True, **options)
    pipeline.totals.deferred.least = pipeline.totals.deferred._until_release = least
    for part in chunked([*map(leaf, CARS), *messages], cuts):
        pipeline.take(part)
    pipeline.finish()
    return pipeline.take_rides(), pipeline.take_windows()


@settings(max_examples=20)
@given(seed=st.integers(0, 100), cuts=st.lists(st.integers(0, 720), max_size=8), least=st.integers(1, 900))
def test_any_chunking_gives_the_same_tables(seed, cuts, least):
    messages = fleet(seed)
    for one, other in zip(tabulated(messages, cuts, least), tabulated(messages, (), least), strict=True):
        pd.testing.assert_frame_equal(one, other, check_exact=True)


@given(seed=st.integers(0, 100), least=st.integers(1, 900))
@settings(max_examples=10)
def test_releases_change_the_order_of_rides_only(seed, least):
    messages = fleet(seed)
    for one, other in zip(tabulated(messages, (), least), tabulated(messages, (), 10_000), strict=True):
        keys = ["ride_key", *(["window"] if "window" in one else [])]
        pd.testing.assert_frame_equal(
            one.sort_values(keys, ignore_index=True), other.sort_values(keys, ignore_index=True), check_exact=True
        )


def test_every_row_is_released_once_and_in_the_order_of_its_car():
    rows = rows_of(fleet(3))
    deferred = DeferredRows(least=50)
    released = deferred.add(rows.rows(0, 300)) + deferred.add(rows.rows(300, 720)) + deferred.close()
    assert deferred.close() == []
    assert len(released) > 3
    for lane in range(len(CARS)):
        times = np.concatenate([part.clean.time[part.clean.lane == lane] for part in released])
        np.testing.assert_array_equal(times, rows.clean.time[rows.clean.lane == lane])


def test_rows_of_an_open_ride_wait_and_idle_rows_do_not():
    columns = drive(100, speed=np.r_[np.zeros(30), np.full(70, 10.0)], elevation_m=50.0)
    columns["ride_id"][:30] = None
    rows = rows_of(telemetry(columns))
    deferred = DeferredRows(least=100)
    (released,) = deferred.add(rows)
    assert (released.clean.ride == -1).all()
    assert released.size == 30
    (rest,) = deferred.close()
    assert rest.size == 70


def test_ride_without_end_is_released_when_it_is_too_long():
    rows = rows_of(telemetry(drive(400, speed=10.0, elevation_m=50.0)))
    deferred = DeferredRows(least=50, longest=120)
    assert sum(part.size for part in deferred.add(rows)) == 240  # two pieces
    assert len(deferred.ride_codes()) <= 120 + 50


def test_pieces_of_a_long_ride_do_not_depend_on_the_releases():
    rng = np.random.default_rng(3)
    rows = rows_of(telemetry(drive(400, speed=10.0, elevation_m=50.0 + rng.normal(0.0, 3.0, 400))))
    elevations = []
    for least in (7, 130, 1000):
        deferred = DeferredRows(least=least, longest=120)
        parts = [*deferred.add(rows), *deferred.close()]
        place = np.concatenate([part.place for part in parts])
        elevations.append(np.concatenate([part.clean.elevation for part in parts])[np.argsort(place)])
    for other in elevations[1:]:
        np.testing.assert_array_equal(elevations[0], other)


def test_memory_is_bounded_by_the_rows_of_open_rides():
    deferred, most = DeferredRows(least=60), 0
    rows = rows_of(fleet(5))
    for at in range(0, 720, 40):
        deferred.add(rows.rows(at, at + 40))
        most = max(most, len(deferred.ride_codes()))
    assert most <= 3 * 60 + 120


def test_state_continues_as_if_uninterrupted():
    rows = rows_of(fleet(4))
    whole, first, second = DeferredRows(least=100), DeferredRows(least=100), DeferredRows(least=100)
    expected = [*whole.add(rows), *whole.close()]
    parts = first.add(rows.rows(0, 333))
    second.load(first.dump())
    parts += [*second.add(rows.rows(333, 720)), *second.close()]
    assert len(parts) == len(expected)
    for one, other in zip(parts, expected, strict=True):
        for name in one.clean._fields:
            np.testing.assert_array_equal(getattr(one.clean, name), getattr(other.clean, name), name)


def test_snapshot_of_a_pipeline_holds_the_deferred_rows():
    messages = [*map(leaf, CARS), *fleet(6)]
    whole = tabulated(messages)
    first, second = (Pipeline(keep_forecasts=False, two_sided=True) for _ in range(2))
    first.take([*map(leaf, CARS), *messages[:400]])
    second.restore(first.snapshot())
    second.take(messages[400:])
    second.finish()
    order = ["ride_key"]
    pd.testing.assert_frame_equal(
        second.take_rides().sort_values(order, ignore_index=True), whole[0].sort_values(order, ignore_index=True)
    )


def test_names_of_deferred_rides_are_kept(monkeypatch):
    monkeypatch.setattr("socast.core.wire.rides.NAMES", 400)
    columns = drive(1040, speed=10.0)
    columns["ride_id"] = np.array([f"r{i // 2}" for i in range(1040)], dtype=object)
    messages = telemetry(columns)
    pipeline = Pipeline(keep_forecasts=False, two_sided=True)
    for at in range(0, len(messages), 80):
        pipeline.take(messages[at : at + 80])
    assert len(pipeline.decoder.rides) > 400
    pipeline.finish()
    assert sorted(pipeline.take_rides()["ride_id"]) == sorted(set(columns["ride_id"]))


def test_forecasts_exclude_two_sided_tables():
    with pytest.raises(SettingsError, match="keep_forecasts=False"):
        Pipeline(two_sided=True)


@cache
def simulated():
    """Return the messages of four cars on three days, whose displays are pooled each day."""
    simulation = Simulation(vehicles=4, days=3, seed=11, shift_hours=3.0, faults=Faults(unequipped=0.0))
    return list(simulate(simulation))


@cache
def causal_tables():
    """Return the rides and the windows of these messages in a causal pipeline."""
    pipeline = Pipeline(keep_forecasts=False)
    pipeline.take(simulated())
    pipeline.finish()
    return pipeline.take_rides(), pipeline.take_windows()


@pytest.mark.parametrize("least", [500, 20_000])
def test_columns_without_climb_equal_those_of_the_causal_pipeline_to_the_bit(least):
    messages = simulated()
    two_sided = Pipeline(keep_forecasts=False, two_sided=True)
    two_sided.totals.deferred.least = two_sided.totals.deferred._until_release = least
    for part in chunked(messages, range(0, len(messages), 3001)):
        two_sided.take(part)
    two_sided.finish()
    for one, other in zip((two_sided.take_rides(), two_sided.take_windows()), causal_tables(), strict=True):
        by_climb = [name for name in other if name.startswith(("gained_m", "lost_m", "effect_", "unresolved_"))]
        assert not one["gained_m"].equals(other["gained_m"])
        assert len(other) > 40
        pd.testing.assert_frame_equal(one.drop(columns=by_climb), other.drop(columns=by_climb), check_exact=True)


def test_snapshot_within_waiting_totals_continues_as_if_uninterrupted():
    messages = simulated()
    whole, first, second = (Pipeline(keep_forecasts=False, two_sided=True) for _ in range(3))
    for each in (whole, first, second):
        each.totals.deferred.least = each.totals.deferred._until_release = 500
    whole.take(messages)
    first.take(messages[:15_000])
    rides = [first.take_rides()]
    second.restore(first.snapshot())
    second.take(messages[15_000:])
    for each in (whole, second):
        each.finish()
    pd.testing.assert_frame_equal(
        pd.concat([*rides, second.take_rides()], ignore_index=True), whole.take_rides(), check_exact=True
    )


def test_causal_columns_equal_those_of_the_causal_pipeline():
    messages = [*map(leaf, CARS), *fleet(7)]
    causal = Pipeline(keep_forecasts=False)
    causal.take(messages)
    causal.finish()
    expected, (rides, _) = causal.take_rides(), tabulated(messages)
    both = expected.merge(rides, on="ride_key", suffixes=("", "_two_sided"), validate="one_to_one")
    assert len(both) == 9
    np.testing.assert_array_equal(both["gained_causal_m_two_sided"], both["gained_m"])
    np.testing.assert_array_equal(both["lost_causal_m_two_sided"], both["lost_m"])
    np.testing.assert_array_equal(both["energy_kwh_two_sided"], both["energy_kwh"])
    np.testing.assert_array_equal(both["distance_km_two_sided"], both["distance_km"])
    assert (both["gained_m_two_sided"] != both["gained_m"]).any()
