"""Test that values which are sent on change hold as long as their sender means, and give distance and energy."""

import numpy as np
import pandas as pd
import pytest

from socast.tools.importers.table.guess_values import guess_rows
from socast.tools.importers.table.sampling import STAND, Sampling, find_holds, sample_rows
from tests.support.commands import called
from tests.support.own_tables import read_samples
from tests.tools.importers.table.test_sampling import NAN, known, make_rows

START = 1714572000.0
FIELDS = ("speed_kmh", "battery_current_a", "battery_voltage_v", "odometer_km")


def drive(legs=6, stop=80):
    """Return seconds, speed [km/h], current [A] and distance [km] of legs with long stops between them."""
    up, cruise = np.linspace(0, 50, 13), np.full(90, 50.0)
    leg = np.concatenate([up, cruise, up[::-1], np.zeros(stop)])
    speed = np.tile(leg, legs)
    ms = speed / 3.6
    power = 1500 * np.gradient(ms) * ms + 0.4 * ms**3 + 150 * ms + 500
    distance = np.concatenate(([0.0], np.cumsum((ms[1:] + ms[:-1]) / 2))) / 1000
    return START + np.arange(len(speed)), speed, power / 360.0, distance


def send(times, values, *, heartbeat=np.inf, least=0.0):
    """Return times and values that a sender sends: what changed, and the same again after a time."""
    kept, last, sent = [], None, -np.inf
    for time, value in zip(times, values, strict=True):
        if time - sent >= least and (value != last or time - sent >= heartbeat):
            kept.append((time, value))
            last, sent = value, time
    return np.array(kept)


def list_rows(heartbeat=np.inf, least=0.0, odometer=1.0, legs=6):
    """Return rows with one field each."""
    times, speed, current, distance = drive(legs)
    series = (speed.round(), current.round(1), np.full(len(times), 360.0), (1000 + distance * odometer).round(2))
    rows = []
    for place, values in enumerate(series):
        for time, value in send(times, values, heartbeat=heartbeat, least=least):
            cells = [NAN] * 4
            cells[place] = value
            rows.append((time + 0.05 * place, tuple(cells)))
    return make_rows(*sorted(rows, key=lambda row: row[0]), fields=FIELDS)


def integrate(samples):
    """Return distance [km] and energy [kWh] of samples 1 s apart, unknown ones as nothing."""
    power = np.nan_to_num(samples["battery_voltage_v"] * samples["battery_current_a"])
    return np.nan_to_num(samples["speed_kmh"]).sum() / 3600.0, power.sum() / 3.6e6


@pytest.mark.parametrize("heartbeat", [np.inf, 30.0, 60.0, 120.0])
def test_what_a_sender_repeats_and_when_decides_how_long_values_hold(heartbeat):
    rows = list_rows(heartbeat)
    guessed = guess_rows(rows)
    assert guessed.silence is not None
    assert guessed.period == 1.0
    holds = find_holds(guessed.hold) | dict(guessed.holds)
    samples = np.concatenate(list(sample_rows([rows], Sampling(1.0, holds, guessed.silence))))
    _, _, current, distance = drive()
    assert len(samples) == pytest.approx(len(current), abs=100)
    assert integrate(samples) == pytest.approx((distance[-1], current.sum() * 360 / 3.6e6), rel=0.02)


def test_odometer_that_advances_in_silences_shows_that_rows_are_lost():
    rows = list_rows()
    rows["odometer_km"][rows["time"] > 0] += 0.0
    assert guess_rows(rows).silence is not None
    jumps = np.cumsum(np.append(0.0, np.diff(rows["time"]) > 30.0)) * 2.0
    rows["odometer_km"] += jumps
    assert guess_rows(rows).silence is None


def test_sender_in_periods_keeps_the_usual_age():
    times, speed, current, _ = drive()
    rows = [(time, (value, NAN)) for time, value in zip(times, speed.round(), strict=True)]
    rows += [(time + 0.1, (NAN, value)) for time, value in zip(times, current.round(1), strict=True)]
    guessed = guess_rows(make_rows(*sorted(rows, key=lambda row: row[0])))
    assert (guessed.silence, guessed.hold) == (None, 30.0)


def sample(*rows, parts=1, silence=30.0, period=10.0, fields=("speed_kmh", "battery_current_a")):
    """Return samples of rows that are sent on change."""
    given = np.array_split(make_rows(*rows, fields=fields), parts)
    return np.concatenate(list(sample_rows(given, Sampling(period, find_holds(STAND), silence))))


def test_standing_car_stands_until_it_sends_again():
    samples = sample((5, (0, 2)), (205, (10, 2)))
    assert samples["time"].tolist() == [*range(5, 206, 10)]
    assert known(samples["speed_kmh"])[:-2] == [0] * 19
    assert set(known(samples["battery_current_a"])) == {2}


def test_driving_car_that_sends_nothing_is_unknown_after_a_while():
    samples = sample((5, (50, 2)), (205, (0, 2)))
    assert samples["time"].tolist() == [5, 15, 25, 35, 205]
    assert known(samples["speed_kmh"])[:4] == [50, 50, 50, 50]


def test_driving_car_is_known_as_long_as_other_values_arrive():
    samples = sample((5, (50, 2)), *((5 + 20 * k, (NAN, k)) for k in range(1, 11)))
    assert set(known(samples["speed_kmh"])) == {50}


@pytest.mark.parametrize("parts", [2, 5, 40])
def test_division_into_blocks_changes_nothing(parts):
    rows = [(7.0 * k + 0.1 * car, (50 * (k % 3 > 0) + k % 5, k % 7), car) for k in range(120) for car in (0, 1)]
    rows = [row for row in rows if row[0] % 200 > 90 or row[2] == 0]
    whole, divided = sample(*rows), sample(*rows, parts=parts)
    assert np.array_equal(whole["time"], divided["time"])
    for name in ("speed_kmh", "battery_current_a"):
        assert known(whole[name]) == pytest.approx(known(divided[name]))


def test_power_that_is_sent_too_seldom_is_left_out_and_told(tmp_path):
    rows = pd.DataFrame(list_rows(least=5.0)).drop(columns=["vehicle", "ride"])
    rows["time"] = pd.to_datetime(rows["time"], unit="s")
    rows.to_csv(tmp_path / "log.csv", index=False)
    printed, errors, code = called("import", "csv", tmp_path / "log.csv", "--guess", "-o", tmp_path / "log.mcap")
    assert code == 0, errors
    assert "at most every 5 s: too seldom for the energy" in " ".join(printed.split())
    assert {each.battery_current_a for each in read_samples(tmp_path / "log.mcap")} == {None}
