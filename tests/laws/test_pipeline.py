"""Test over generated data with every fault that live operation and replay give the same results to the bit."""

from itertools import pairwise

import msgspec
import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from socast.core import models
from socast.core.pipeline import Pipeline
from socast.core.wire.messages import Message
from tests.support.faulty_shifts import CARS, car, mixed, shift
from tests.support.fleet_days import CARS as FLEET
from tests.support.fleet_days import DAY as ONE_DAY
from tests.support.fleet_days import DAYS, SETTINGS, START, days, forecasts, merged, plan, trained_pipeline
from tests.support.fleet_days import shift as planned_shift
from tests.support.telemetry import (
    PERIOD,
    chunked,
    drive,
    leaf,
    make_message,
    observed,
    ran,
    telemetry,
)

pytestmark = pytest.mark.long


def same(one, other):
    """Assert that tables, counters and status of two pipelines are equal to the bit."""
    pd.testing.assert_frame_equal(one.take_rides(), other.take_rides(), check_exact=True)
    pd.testing.assert_frame_equal(one.take_windows(), other.take_windows(), check_exact=True)
    assert one.quality() == other.quality()
    assert repr(one.status()) == repr(other.status())


@given(seed=st.integers(0, 200), cuts=st.lists(st.integers(0, 420), max_size=10))
def test_any_chunking_gives_the_same_results(seed, cuts):
    messages = shift(seed)
    whole, expected = ran(messages)
    parts, out = ran(messages, cuts)
    assert out == expected
    assert len(out) > 20
    same(parts, whole)


def test_single_messages_give_the_same_results():
    messages = shift(5)
    whole, expected = ran(messages)
    single, out = ran(messages, range(len(messages)))
    assert out == expected
    same(single, whole)


@given(seed=st.integers(0, 200))
def test_other_vehicles_do_not_change_the_results_of_a_vehicle(seed):
    streams = [car(name, seed + i) for i, name in enumerate(CARS)]
    together, out = ran(mixed(streams, seed))
    rides, windows = together.take_rides(), together.take_windows()
    for name, stream in zip(CARS, streams, strict=True):
        alone, expected = ran(stream)
        assert [message for message in out if message.key == f"fleet/{name}/forecast"] == expected
        mine = rides[rides["vehicle_id"] == name].reset_index(drop=True)
        pd.testing.assert_frame_equal(mine, alone.take_rides(), check_exact=True)
        mine = windows[windows["vehicle_id"] == name].reset_index(drop=True)
        pd.testing.assert_frame_equal(mine, alone.take_windows(), check_exact=True)


@given(seed=st.integers(0, 200), at=st.integers(0, 420))
def test_restart_within_a_ride_changes_no_result(seed, at):
    messages = shift(seed)
    whole, expected = ran(messages)
    first = Pipeline()
    out = first.push(messages[:at])
    rides, windows = first.take_rides(), first.take_windows()
    kept = first.snapshot()
    second = Pipeline()
    second.restore(kept)
    assert second.snapshot() == kept
    assert repr(second.status()) == repr(first.status())
    out += second.push(messages[at:]) + second.finish()
    assert out == expected
    later = second.take_rides(), second.take_windows()
    for before, after, table in zip((rides, windows), later, (whole.take_rides(), whole.take_windows()), strict=True):
        together = pd.concat([part for part in (before, after) if len(part)], ignore_index=True)
        pd.testing.assert_frame_equal(together, table, check_exact=True)
    assert second.quality() | {"duplicates": 0} == whole.quality() | {"duplicates": 0}  # of one process


def test_snapshot_shares_no_memory_with_the_pipeline():
    messages = shift(3)
    first = Pipeline()
    first.push(messages[:200])
    kept = first.snapshot()
    first.push(messages[200:])
    second = Pipeline()
    second.restore(kept)
    assert second.snapshot() == kept
    second.push(messages[200:])
    assert second.snapshot() == first.snapshot()


def test_prediction_never_changes_the_model():
    pipeline, _ = ran(shift(2))
    rides = pipeline.take_rides()
    before = models.encode_model(pipeline.model)
    columns = {name: rides[name].to_numpy(float) for name in pipeline.model.needs}
    for column in columns.values():
        column.flags.writeable = False
    first = pipeline.model.predict_energy(columns)
    assert np.array_equal(first, pipeline.model.predict_energy(columns), equal_nan=True)
    assert models.encode_model(pipeline.model) == before
    parts = [
        pipeline.model.predict_energy({name: column[i : i + 1] for name, column in columns.items()})
        for i in range(len(rides))
    ]
    assert np.array_equal(np.concatenate(parts), first, equal_nan=True)


@pytest.mark.parametrize("model", models.BUILT_IN_MODELS.values(), ids=lambda model: model.name)
def test_model_file_is_unchanged_by_a_round_trip(model):
    assert models.decode_model(models.encode_model(model)) == model


@given(st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=5, max_size=5))
def test_coefficients_are_unchanged_to_the_bit_by_a_round_trip(values):
    fits = {models.ANY: models.Fit(coefficients=tuple(values))}
    model = msgspec.structs.replace(models.EXTENDED_PHYSICAL, fits=fits)
    assert models.decode_model(models.encode_model(model)) == model


def test_messages_are_never_modified():
    messages = shift(1)
    copies = [Message(m.key, bytes(bytearray(m.payload)), m.receipt_ns) for m in messages]
    ran(tuple(messages))
    assert messages == copies


def test_list_gives_the_same_results_as_its_single_samples():
    stream = [
        message
        for message in car("a", 0)
        if message.key.endswith("telemetry") and b'vehicle_id": 5' not in message.payload
    ]
    edges = [*range(0, len(stream), 7), len(stream)]
    lists = [
        Message(stream[a].key, b"[" + b",".join(m.payload for m in stream[a:b]) + b"]", 0) for a, b in pairwise(edges)
    ]
    one, expected = ran([leaf(), *stream])
    other, out = ran([leaf(), *lists])
    assert out == expected
    same(other, one)


def test_weather_and_vehicle_messages_apply_by_row_and_not_by_batch():
    columns = drive(200, speed=10.0)
    messages = telemetry(columns)
    for at, message in (
        (150, observed(time=columns["time_s"][100], temperature_c=3.0)),
        (120, leaf()),
        (60, leaf(mass_kg=2000.0)),
    ):
        messages.insert(at, message)
    whole, expected = ran(messages)
    for cut in range(55, 156, 5):
        other, out = ran(messages, [cut])
        assert out == expected
        assert chunked(messages, [cut])
        assert other.quality() == whole.quality()


def test_time_of_receipt_changes_no_result():
    messages = shift(4)
    _, expected = ran(messages)
    _, out = ran([message._replace(receipt_ns=7 * i) for i, message in enumerate(messages)])
    assert out == expected


def test_round_trip_over_hills_never_takes_less_energy_than_the_level_road():
    base = drive(800, speed=12.0)
    level, _ = ran([leaf(), *telemetry(base | {"elevation_m": np.full(800, 50.0)})])
    hill = 50 + 60 * np.sin(np.pi * np.arange(800) / 799) ** 2
    hilly, _ = ran([leaf(), *telemetry(base | {"elevation_m": hill})])
    one, other = hilly.take_rides(), level.take_rides()
    climb = one["gained_m"][0] - one["lost_m"][0]
    assert abs(climb) < 3.5
    assert float(hilly.model.predict_energy(one)[0]) > float(level.model.predict_energy(other)[0]) - 0.02
    assert one["duration_s"][0] == PERIOD * 799


# Forecasts of the charge over several days, with plans and drivers

DRIVEN = ("a", "c", "f")
TWO_DAYS = len(days((DAYS, DAYS + 1), DRIVEN))
MORE = 12
"""Number of plans per day that arrive at any time, in addition to those at the beginning of shifts."""


def two_days(seed, cars=DRIVEN):
    """Return the messages of two days of some cars, with plans and drivers that arrive at any time."""
    rng = np.random.default_rng(seed)
    parts = []
    for day in (DAYS, DAYS + 1):
        streams = [planned_shift(car, day) for car in cars]
        begin = START + ONE_DAY * day
        for number in range(MORE):
            car, time = cars[int(rng.integers(len(cars)))], begin + float(rng.uniform(-60.0, 7500.0))
            streams.append(
                [(time, plan(car, day, time, int(rng.integers(1, 8)), shift_end_s=begin + 7200.0 + 60.0 * number))]
            )
            streams.append(
                [(time + 5.0, make_message("ride", car, time, ride_id="x", event="start", driver_id=f"d{number % 2}"))]
            )
        parts += merged(*streams)
    return parts


def pushed(pipeline, messages, cuts=()):
    """Push messages through a pipeline, and return its forecasts and its state."""
    out = [forecast for chunk in chunked(messages, cuts) for forecast in pipeline.push(chunk)]
    pipeline.take_rides()
    pipeline.take_windows()
    return out, pipeline.snapshot()


@given(seed=st.integers(0, 200), cuts=st.lists(st.integers(0, TWO_DAYS + 48), max_size=12))
def test_any_chunking_gives_the_same_forecasts_and_learned_state(seed, cuts):
    messages = two_days(seed)
    whole, state = pushed(trained_pipeline(), messages)
    parts, after = pushed(trained_pipeline(), messages, cuts)
    assert parts == whole
    assert after == state
    assert any(each.soc_end_of_shift_pct for each in forecasts(whole, "c").values())


def test_single_messages_give_the_same_forecasts_and_learned_state():
    messages = two_days(3)
    messages = messages[: len(messages) // 2 + 100]
    assert pushed(trained_pipeline(), messages, range(len(messages))) == pushed(trained_pipeline(), messages)


@given(seed=st.integers(0, 200), at=st.integers(0, TWO_DAYS + 48), near=st.sampled_from(["any", "midnight", "plan"]))
def test_restart_at_any_time_changes_no_forecast(seed, at, near):
    messages = two_days(seed)
    if near == "midnight":  # of the second day nothing has been heard, or a few samples of each
        at = len(two_days(seed)) // 2 + at % 12 - 1
    elif near == "plan":  # came last, and no sample after it
        plans = [i + 1 for i, message in enumerate(messages) if message.key.endswith("plan")]
        at = plans[at % len(plans)]
    whole, state = pushed(trained_pipeline(), messages)
    first = trained_pipeline()
    out, kept = pushed(first, messages[:at])
    second = Pipeline(settings=SETTINGS)
    second.restore(kept)
    assert second.snapshot() == kept
    later, after = pushed(second, messages[at:])
    assert out + later == whole
    assert after == state


def test_restart_after_every_message_around_midnight_changes_no_forecast():
    messages = two_days(1)
    middle = len(messages) // 2
    whole, state = pushed(trained_pipeline(), messages[: middle + 20])
    pipeline = trained_pipeline()
    out, kept = pushed(pipeline, messages[: middle - 20])
    for message in messages[middle - 20 : middle + 20]:
        pipeline = Pipeline(settings=SETTINGS)
        pipeline.restore(kept)
        more, kept = pushed(pipeline, [message])
        out += more
    assert (out, kept) == (whole, state)


@given(seed=st.integers(0, 200), car=st.sampled_from(DRIVEN))
def test_other_vehicles_on_the_same_day_do_not_change_the_forecasts_of_a_vehicle(seed, car):
    messages = two_days(seed)
    today = messages[: len(messages) // 2]
    together = [m for m in trained_pipeline().push(today) if f"/{car}/" in m.key]
    alone = trained_pipeline().push([m for m in today if f"/{car}/" in m.key])
    others = merged(*(planned_shift(other, DAYS) for other in FLEET if other != car))
    assert together == alone
    assert [
        m for m in trained_pipeline().push(others + [m for m in today if f"/{car}/" in m.key]) if f"/{car}/" in m.key
    ] == alone
