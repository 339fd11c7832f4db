"""Test that rows which carry only part of the fields become samples whose values are not older than they may be."""

import numpy as np
import pytest

from socast.tools.importers.table.guess_values import guess_rows
from socast.tools.importers.table.row_messages import has_period
from socast.tools.importers.table.sampling import HOLD, SLOW_HOLD, Sampling, find_holds, sample_rows
from socast.tools.importers.table.units import FIELD_UNITS

NAN = float("nan")


def make_rows(*rows, fields=("speed_kmh", "battery_current_a")):
    """Return rows of time and fields; a third part may name the car."""
    dtype = [("time", "f8"), ("vehicle", "i4"), ("ride", "i4"), *((name, "f8") for name in fields)]
    made = np.zeros(len(rows), dtype)
    for place, (time, values, *car) in enumerate(rows):
        made[place] = (time, car[0] if car else 0, -1, *values)
    return made


def sample(rows, period=None, *, parts=1, **holds):
    """Return the samples of rows, given in parts."""
    sampling = Sampling(period, find_holds() | holds)
    return np.concatenate(list(sample_rows(np.array_split(rows, parts), sampling)))


def known(values):
    """Return values with None in place of NaN."""
    return [None if np.isnan(value) else value for value in values.tolist()]


def test_value_of_a_row_before_stays_known_up_to_its_age():
    rows = make_rows((0, (50, NAN)), (20, (NAN, 7)), (30, (NAN, NAN)), (31, (NAN, 8)), (62, (60, NAN)))
    samples = sample(rows)
    assert known(samples["speed_kmh"]) == [50, 50, 50, None, 60]
    assert known(samples["battery_current_a"]) == [None, 7, 7, 8, None]


def test_age_of_each_field_is_its_own():
    rows = make_rows((0, (50, 7)), (100, (NAN, NAN)))
    samples = sample(rows, speed_kmh=200.0)
    assert known(samples["speed_kmh"]) == [50, 50]
    assert known(samples["battery_current_a"]) == [7, None]


def test_positions_and_meters_are_never_carried_forward():
    names = ("odometer_km", "latitude_deg", "soc_pct", "ambient_c")
    samples = sample(make_rows((0, (1, 2, 3, 4)), (5, (NAN, NAN, NAN, NAN)), fields=names))
    assert [known(samples[name])[1] for name in names] == [None, None, None, 4]


def test_cars_do_not_share_values():
    samples = sample(make_rows((0, (50, 1), 0), (1, (NAN, NAN), 1), (2, (NAN, NAN), 0)))
    assert known(samples["speed_kmh"]) == [50, None, 50]


def test_every_field_has_an_age():
    assert find_holds().keys() == FIELD_UNITS.keys()
    assert (find_holds()["speed_kmh"], find_holds()["ambient_c"], find_holds()["soc_pct"]) == (HOLD, SLOW_HOLD, 0.0)


def test_period_joins_rows_to_means_and_latest_values():
    rows = make_rows((10.0, (10, 1)), (10.5, (20, NAN)), (11.5, (30, 5)), (14.0, (40, 9)))
    samples = sample(rows, 2.0, battery_current_a=2.0)
    assert samples["time"].tolist() == [11.0, 15.0]
    assert samples["speed_kmh"] == pytest.approx([(10 * 0.5 + 20 + 30 * 0.5) / 2, 40])
    assert samples["battery_current_a"] == pytest.approx([(1 * 1.5 + 5 * 0.5) / 2, 9])


def test_current_of_a_period_gives_the_mean_power():
    fields = ("battery_voltage_v", "battery_current_a")
    samples = sample(make_rows((0, (400, 0)), (1, (300, 100)), (2, (400, 0)), fields=fields), 2.0)
    power = samples["battery_voltage_v"] * samples["battery_current_a"]
    assert power == pytest.approx([15000, 0])


@pytest.mark.parametrize("period", [None, 1.0, 3.0, 7.0])
def test_division_into_blocks_changes_nothing(period):
    rng = np.random.default_rng(5)
    rows = make_rows(*((time, rng.normal(size=2), car) for time in range(200) for car in (0, 1)))
    for name in ("speed_kmh", "battery_current_a"):
        rows[name][rng.random(len(rows)) < 0.6] = NAN
    whole = sample(rows, period)
    for parts in (2, 7, 400):
        assert np.array_equal(whole["time"], sample(rows, period, parts=parts)["time"])
        for name in ("speed_kmh", "battery_current_a"):
            assert whole[name] == pytest.approx(sample(rows, period, parts=parts)[name], abs=1e-9, nan_ok=True)


def test_period_keeps_the_distance_and_the_energy():
    time = np.arange(0, 3600, 1.7)
    speed, current = 50 + 30 * np.sin(time / 40), 40 + 60 * np.cos(time / 23)
    rows = make_rows(*((t, (v, i)) for t, v, i in zip(time, speed, current, strict=True)))
    samples = sample(rows, 5.0)
    assert samples["speed_kmh"].mean() == pytest.approx(speed.mean(), rel=2e-3)
    assert samples["battery_current_a"].mean() == pytest.approx(current.mean(), rel=5e-3)


@pytest.mark.parametrize("step", [1, 3, 12, 25])
def test_rows_that_alternate_are_found_with_a_period(step):
    rows = make_rows(*((t * step, (50, NAN) if t % 2 else (NAN, 5)) for t in range(100)))
    found = guess_rows(rows)
    assert found.period >= 1.8 * step
    assert found.period <= 2.5 * step + 10
    assert found.hold >= found.period


def test_rows_that_hold_all_or_lack_speed_while_parked_are_samples_as_they_are():
    assert guess_rows(make_rows(*((t, (50, 5)) for t in range(50)))) is None
    assert guess_rows(make_rows(*((t, (50 if t < 10 else NAN, 5)) for t in range(50)))) is None
    assert guess_rows(make_rows(*((t, (50,)) for t in range(50)), fields=("speed_kmh",))) is None


@pytest.mark.parametrize(
    ("steps", "regular"),
    [
        ([2.0] * 50, True),
        ([3.0, 3.0, 6.0, 3.0, 9.0] * 20, True),
        ([2.8, 3.2, 3.1, 2.9] * 20, True),
        ([30.0] * 40, True),
        ([0.0, 1.0] * 20, True),
        ([1.0, 1.6, 7.3, 2.4, 22.0] * 20, False),
        ([700.0, 800.0], True),
        ([], True),
    ],
)
def test_times_that_fit_no_period_are_recognised(steps, regular):
    assert has_period(np.concatenate([[5.0], 5.0 + np.cumsum(steps)])) is regular
