"""Test the beginning and end of rides, their fitness for training, and the windows within them."""

import numpy as np
import pandas as pd
import pytest

from socast.core.models import BASIC_PHYSICAL, EXTENDED_PHYSICAL
from socast.core.pipeline import Pipeline
from socast.core.settings import Settings
from tests.support.ride_streams import count_ended, dispatched, in_order, sent, shift
from tests.support.telemetry import PERIOD, START, drive, joined, leaf, make_message, picked, ran, telemetry, without

MOVING, PARKED = 10.0, 0.0


def stretch(parts, **columns):
    """Return a drive that consists of (samples, speed) parts."""
    speed = np.concatenate([np.full(n, float(v)) for n, v in parts])
    return drive(len(speed), speed=speed, **columns)


def rides_of(columns, *others, **options):
    pipeline, _ = ran([leaf(), *others, *telemetry(columns)], **options)
    return pipeline.take_rides(), pipeline


def named(columns, names):
    return columns | {"ride_id": np.array(names, dtype=object)}


def test_rides_follow_the_names_of_the_logger():
    names = ["A"] * 50 + ["B"] * 60 + [None] * 40 + ["A"] * 70
    rides, _ = rides_of(named(drive(220, speed=MOVING), names))
    assert rides["ride_id"].tolist() == ["A", "B", "A"]
    assert rides["ride_key"].tolist() == ["a#0", "a#1", "a#2"]
    assert rides["duration_s"].tolist() == pytest.approx([49 * PERIOD, 59 * PERIOD, 69 * PERIOD])
    assert (rides["start_s"] - START).tolist() == pytest.approx([0, 50 * PERIOD, 150 * PERIOD])
    assert rides["distance_km"].tolist() == pytest.approx([1.47, 1.77, 2.07])
    assert rides["parked_s"].fillna(-1).tolist() == pytest.approx([-1, PERIOD, 41 * PERIOD])


def test_standstill_does_not_end_a_named_ride():
    rides, _ = rides_of(stretch([(50, MOVING), (400, PARKED), (50, MOVING)]))
    assert len(rides) == 1
    assert rides["duration_s"][0] == pytest.approx(499 * PERIOD)


@pytest.mark.parametrize("unnamed", [slice(40, 60), slice(0, 60), slice(0, 100)], ids=["within", "before", "always"])
def test_absent_and_null_names_give_the_same_rides(unnamed):
    columns = drive(100, speed=MOVING)
    tables = []
    for silent in (telemetry(without(columns, "ride_id")), telemetry(named(columns, [None] * 100))):
        messages = telemetry(columns)
        messages[unnamed] = silent[unnamed]
        tables.append(ran([leaf(), *messages])[0].take_rides())
    pd.testing.assert_frame_equal(*tables, check_exact=True)
    assert len(tables[0]) > 0


def test_rides_are_cut_by_motion_before_the_first_name_and_follow_names_after_it():
    names = [None] * 60 + ["A"] * 60 + [None] * 60
    rides, _ = rides_of(named(drive(180, speed=MOVING), names))
    assert rides["ride_id"].tolist() == ["a#0", "A"]
    assert rides["duration_s"].tolist() == pytest.approx([59 * PERIOD, 59 * PERIOD])


def nameless(parts, **columns):
    return without(stretch(parts, **columns), "ride_id")


def test_unnamed_rides_end_at_long_stops():
    columns = nameless([(5, PARKED), (100, MOVING), (100, PARKED), (80, MOVING), (30, PARKED), (60, MOVING)])
    rides, _ = rides_of(columns)
    assert rides["ride_id"].tolist() == ["a#0", "a#1"]
    stop = Settings().stop_time
    assert rides["duration_s"][0] == pytest.approx(100 * PERIOD + stop, abs=4 * PERIOD)  # including the last standstill
    assert rides["duration_s"][1] == pytest.approx(170 * PERIOD, abs=4 * PERIOD)  # a standstill of 90 s is a red light
    assert rides["distance_km"].sum() == pytest.approx(columns["metres"][-1] / 1000, rel=0.01)
    assert rides["parked_s"][1] == pytest.approx(100 * PERIOD - stop, abs=4 * PERIOD)
    assert rides["stops"].tolist() == [1, 1]


def test_unnamed_rides_end_when_the_car_charges():
    columns = nameless([(100, MOVING), (200, PARKED), (100, MOVING)])
    columns["charging"] = np.zeros(400, bool)
    columns["charging"][110:290] = True
    rides, _ = rides_of(columns)
    assert len(rides) == 2
    assert rides["duration_s"][0] == pytest.approx(110 * PERIOD, abs=2 * PERIOD)
    assert np.isnan(rides["time_since_charge_s"][0])
    assert rides["time_since_charge_s"][1] == pytest.approx(110 * PERIOD, abs=2 * PERIOD)


def test_unnamed_rides_end_at_a_long_silence():
    columns = nameless([(300, MOVING)])
    columns["time_s"][150:] += 900.0
    columns["seq"][150:] += 300
    rides, _ = rides_of(columns)
    assert len(rides) == 2
    assert rides["duration_s"].tolist() == pytest.approx([149 * PERIOD, 149 * PERIOD], abs=2 * PERIOD)
    assert rides["parked_s"][1] >= 900.0
    short = nameless([(300, MOVING)])
    short["time_s"][150:] += 300.0
    short["seq"][150:] += 100
    rides, _ = rides_of(short)
    assert len(rides) == 1


def test_unfit_rides_have_a_reason_and_are_counted():
    parts = [("short", 5), ("still", 100), ("long", 1300), ("fit", 200), ("blind", 100)]
    columns = named(drive(sum(n for _, n in parts), speed=MOVING), [name for name, n in parts for _ in range(n)])
    code = columns["ride_id"]
    columns["speed_kmh"][code == "still"] = 0.0
    columns["soc_pct"] = np.where(code == "blind", np.nan, 80 - 0.01 * np.arange(len(code)))
    columns = without(columns, "latitude_deg", "longitude_deg")
    pipeline, _ = ran([leaf(), *telemetry(columns)])
    rides = pipeline.take_rides().set_index("ride_id")
    expected = {
        "short": "too_short",
        "still": "too_little_distance",
        "long": "too_long",
        "fit": "",
        "blind": "no_measured_energy",
    }
    assert rides["unfit_reason"][list(expected)].fillna("").tolist() == list(expected.values())
    assert rides["fit_for_training"].tolist() == rides["unfit_reason"].isna().tolist()
    quality = pipeline.quality()
    assert quality["unfit"] == rides["unfit_reason"].value_counts().to_dict()
    assert quality["rides"] == 5
    assert sum(quality["unfit"].values()) == (~rides["fit_for_training"]).sum()


def test_limits_of_fitness_follow_the_settings():
    columns = stretch([(100, MOVING)], soc_pct=80.0)
    assert rides_of(columns)[0]["fit_for_training"][0]
    assert rides_of(columns, settings=Settings(least_distance=5000))[0]["unfit_reason"][0] == "too_little_distance"
    assert rides_of(columns, settings=Settings(shortest_ride=1000))[0]["unfit_reason"][0] == "too_short"
    assert rides_of(columns, settings=Settings(longest_ride=60))[0]["unfit_reason"][0] == "too_long"


def test_driver_of_a_ride_comes_from_dispatch():
    columns = named(drive(120, speed=MOVING), ["A"] * 60 + ["B"] * 60)
    rides, _ = rides_of(
        columns,
        make_message("ride", ride_id="A", event="start", driver_id="ana"),
        make_message("ride", ride_id="A", event="end"),
        make_message("ride", ride_id="B", event="start"),
    )
    assert rides["driver_id"].fillna("").tolist() == ["ana", ""]


def test_driver_applies_to_every_part_of_a_ride_of_one_car():
    columns = named(drive(180, speed=MOVING), ["A"] * 60 + ["B"] * 60 + ["A"] * 60)
    messages = [
        make_message("ride", "a", ride_id="A", event="start", driver_id="ana"),
        make_message("ride", "b", ride_id="A", event="start", driver_id="bob"),
        *telemetry(columns, "a"),
        *telemetry(columns, "b"),
    ]
    pipeline, _ = ran(messages)
    rides = pipeline.take_rides()
    assert rides[rides["vehicle_id"] == "a"]["driver_id"].fillna("").tolist() == ["ana", "", "ana"]
    assert rides[rides["vehicle_id"] == "b"]["driver_id"].fillna("").tolist() == ["bob", "", "bob"]


def test_end_of_dispatch_ends_a_ride_at_once_and_for_good():
    pipeline = Pipeline()
    ended = count_ended(in_order(shift("a", rides=1)), pipeline)
    assert ended.index(1) == 96  # the vehicle message and 95 samples came before
    assert ended[-1] == 1
    forecast = pipeline.status()[0].forecast
    assert (forecast.ride_id, forecast.ride_distance_km) == (None, 0.0)
    pipeline.finish()
    (ride,) = pipeline.take_rides().to_dict("records")
    assert (ride["ride_id"], ride["duration_s"]) == ("a0", PERIOD * 94)


def test_end_of_another_ride_is_ignored():
    assert set(count_ended(in_order(sent("a", 50), dispatched(START + 10.0, "a", "r0", "end")))) == {0}


def test_start_of_dispatch_begins_an_ended_ride_again():
    at = START + PERIOD * 40
    orders = dispatched(at + 1.0, "a", "r1", "end") + dispatched(at + 7.0, "a", "r1", "start")
    rides = ran(in_order(sent("a", 100), orders))[0].take_rides()
    assert rides["duration_s"].tolist() == [PERIOD * 40, PERIOD * 56]


def test_end_of_dispatch_ends_an_unnamed_ride_until_the_car_has_stood():
    samples = telemetry(nameless([(120, MOVING), (20, PARKED), (160, MOVING)]))
    early, late = (make_message("ride", time=START + at, ride_id="x", event="end") for at in (-5.0, 300.0))
    rides = ran([*samples[:50], early, *samples[50:100], late, *samples[100:]])[0].take_rides()
    assert rides["duration_s"].tolist() == pytest.approx([99 * PERIOD, 159 * PERIOD], abs=2 * PERIOD)


def test_running_errors_are_published_when_the_end_of_dispatch_comes():
    pipeline = Pipeline(EXTENDED_PHYSICAL, shadows=[BASIC_PHYSICAL])
    messages = in_order(shift("a", rides=1))
    place = next(i for i, message in enumerate(messages) if b'"end"' in message.payload)
    pipeline.push(messages[:place])
    assert pipeline.model_errors() == []
    pipeline.push(messages[place : place + 1])
    assert len(pipeline.model_errors()) == 2


def windows_of(columns, **options):
    pipeline, _ = ran([leaf(), *telemetry(columns)], **options)
    return pipeline.take_windows(), pipeline.take_rides()


def test_windows_last_a_minute_where_power_is_measured():
    columns = stretch([(101, MOVING)], battery_voltage_v=360.0, battery_current_a=20.0)
    windows, rides = windows_of(columns)
    assert windows["duration_s"].tolist() == [60.0] * 5
    assert windows["elapsed_s"].tolist() == [0.0, 60.0, 120.0, 180.0, 240.0]
    assert (windows["ride_key"] == rides["ride_key"][0]).all()
    assert windows["window"].is_unique


def test_windows_end_at_steps_of_soc_where_power_is_not_measured():
    columns = stretch([(400, MOVING)])
    columns["soc_pct"] = 90 - np.floor(np.arange(400) / 35)
    windows, _ = windows_of(columns)
    steps = np.flatnonzero(np.diff(columns["soc_pct"])) + 1
    ends = (windows["end_s"] - START).to_numpy()[:-1] / PERIOD
    assert set(ends.round().astype(int)) <= set(steps)
    assert (windows["duration_s"][:-1] >= 60.0).all()
    assert windows["duration_s"].sum() == 399 * PERIOD
    assert (windows["soc_start_pct"][1:].to_numpy() == windows["soc_end_pct"][:-1].to_numpy()).all()


def test_stationary_car_has_no_ride():
    pipeline, _ = ran([leaf(), *telemetry(nameless([(600, PARKED)]))])
    assert pipeline.take_rides().empty
    assert pipeline.take_windows().empty
    assert pipeline.quality()["samples"]["gap"] == 0
    assert len(pipeline.status()) == 1


def test_number_of_rides_is_unchanged_by_lost_samples():
    rng = np.random.default_rng(3)
    parts = [drive(60, seed=i, ride_id=f"r{i}") for i in range(12)]
    columns = joined(*parts)
    columns["time_s"] = START + PERIOD * np.arange(720)
    columns["seq"] = np.arange(720)
    rides, _ = rides_of(picked(columns, rng.random(720) > 0.2))
    assert rides["ride_id"].tolist() == [f"r{i}" for i in range(12)]
