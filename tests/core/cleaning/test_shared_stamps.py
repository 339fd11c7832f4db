"""Test that a pause counts although the counter continues, and that samples which share a stamp are spread."""

import numpy as np
import pytest

from socast.core.cleaning.quality import Quality
from socast.core.totals.tables import MOST_MISTIMED
from tests.support.telemetry import PERIOD, START, cleaned, count, drive, joined, leaf, ran, telemetry, without

N = 300
HOURS = 14 * 3600.0


def two_drives(pause, *, standing=True, where=0.0):
    """Return two drives with a pause between them, over which the counter continues."""
    first, second = drive(N, seed=1), drive(N, seed=2)
    for part in (first, second) if standing else ():
        part["speed_kmh"][[0, 1, -2, -1]] = 0.0
    second["time_s"] = second["time_s"] + N * PERIOD + pause
    second["latitude_deg"] = second["latitude_deg"] - second["latitude_deg"][0] + first["latitude_deg"][-1] + where
    second["seq"] = N + np.arange(N)
    return without(joined(first, second), "ride_id")


@pytest.mark.parametrize("pause", [900.0, HOURS, 12 * 86_400.0])
@pytest.mark.parametrize("standing", [True, False])
def test_pause_over_which_the_counter_continues_divides_rides(pause, standing):
    columns = two_drives(pause, standing=standing)
    pipeline, _ = ran([leaf(), *telemetry(columns)])
    rides = pipeline.take_rides()
    assert len(rides) == 2
    assert rides["start_s"][1] - rides["start_s"][0] > pause
    assert rides["duration_s"].max() < 1.05 * N * PERIOD
    assert pipeline.quality()["samples"]["pause"] == 1


@pytest.mark.parametrize("pause", [70.0, 200.0, 500.0])
def test_short_pause_of_a_standing_car_takes_its_time(pause):
    clean = cleaned(two_drives(pause))
    assert clean.time[-1] == pytest.approx(START + (2 * N - 1) * PERIOD + pause, abs=1.0)
    assert count(clean, Quality.PAUSE) == 1


def test_pause_of_a_car_that_reappears_elsewhere_takes_its_time():
    clean = cleaned(two_drives(200.0, standing=False, where=0.02))
    assert clean.time[-1] == pytest.approx(START + (2 * N - 1) * PERIOD + 200.0, abs=1.0)


@pytest.mark.parametrize("step", [100.0, 3600.0, HOURS])
def test_clock_that_is_set_while_the_car_demonstrably_drives_on_is_no_pause(step):
    columns = without(drive(N, speed=12.0), "ride_id")
    columns["time_s"][150:] += step
    clean = cleaned(columns)
    assert count(clean, Quality.PAUSE) == 0
    assert count(clean, Quality.CLOCK_STEP) == 1
    assert clean.dt.sum() == pytest.approx(PERIOD * (N - 1), abs=1.5)


def test_single_stamp_far_ahead_of_a_standing_car_is_no_pause():
    columns = without(drive(N, speed=0.0, soc_pct=90 - 0.01 * np.arange(N)), "ride_id")
    columns["time_s"][100] += 5000.0
    clean = cleaned(columns)
    assert count(clean, Quality.PAUSE) == 0
    assert clean.dt.sum() == pytest.approx(PERIOD * (N - 1), abs=1.5)


def shared(step, period, *, seq=True, sending=False, n=1800, speed=None):
    """Return a drive whose stamps are floored to whole steps, or are the ends of these steps."""
    true = START + period * np.arange(n)
    columns = drive(n, seed=4, soc_pct=90 - 0.001 * np.arange(n), speed=speed)
    metres = np.concatenate([[0.0], np.cumsum((columns["speed_kmh"][1:] + columns["speed_kmh"][:-1]) / 7.2 * period)])
    columns["latitude_deg"] = columns["latitude_deg"][0] + np.degrees(metres / 6_371_008.8)
    columns["time_s"] = np.floor(true / step) * step + (step if sending else 0.0)
    columns |= {"metres": metres, "seq": np.arange(n)}
    return without(columns, *(() if seq else ("seq",)))


@pytest.mark.parametrize(("step", "period"), [(60.0, 1.0), (60.0, 3.0), (10.0, 3.0), (10.0, 1.0), (30.0, 2.0)])
@pytest.mark.parametrize("seq", [True, False])
@pytest.mark.parametrize("sending", [True, False])
def test_samples_that_share_a_stamp_are_spread_once_their_period_is_known(step, period, seq, sending):
    columns = shared(step, period, seq=seq, sending=sending)
    clean = cleaned(columns)
    late = slice(max(60, int(3 * step / period)), None)
    assert clean.dt[late].sum() == pytest.approx(period * len(clean.dt[late]), rel=0.01, abs=2 * period)
    driven = columns["metres"][-1] - columns["metres"][late.start - 1]
    assert clean.distance[late].sum() == pytest.approx(driven, rel=0.02)
    assert np.all(clean.quality[late] & Quality.STAMP_SHARED)
    assert not np.any(clean.quality[late] & Quality.LATE)


@pytest.mark.parametrize(("step", "period", "fit"), [(60.0, 1.0, False), (10.0, 3.0, True)])
def test_ride_whose_period_was_wrongly_assumed_is_unfit(step, period, fit):
    pipeline, _ = ran([leaf(), *telemetry(shared(step, period, n=900))])
    ride = pipeline.take_rides().iloc[0]
    assert (ride["unfit_reason"] == "clock_unsettled") == (not fit)
    if fit:
        assert ride["duration_s"] == pytest.approx(900 * period, rel=MOST_MISTIMED)
    assert "stamps_shared" in pipeline.quality()["logger_faults"]


def test_single_repeated_stamps_are_no_shared_ones():
    columns = without(drive(N, soc_pct=90 - 0.01 * np.arange(N)), "ride_id")
    columns["time_s"][5::9] = columns["time_s"][4::9][: len(columns["time_s"][5::9])]
    clean = cleaned(columns)
    assert count(clean, Quality.STAMP_SHARED) == 0
    assert np.abs(clean.time - (START + PERIOD * np.arange(N))).max() < 0.1


@pytest.mark.parametrize("period", [2.0, 30.0, 60.0])
@pytest.mark.parametrize("driving", [5.0, 14.0])
def test_pause_is_confirmed_by_a_sample_that_would_continue_the_drive(period, driving):
    first, second = drive(N, seed=1), drive(N, seed=2, speed=driving)
    for made in (first, second):
        made["time_s"] = START + period * np.arange(N)
        start = made["latitude_deg"][0]
        made["latitude_deg"] = start + (made["latitude_deg"] - start) * period / PERIOD
    second["time_s"] = second["time_s"] + N * period + HOURS
    second["latitude_deg"] = second["latitude_deg"] - second["latitude_deg"][0] + first["latitude_deg"][-1]
    second["seq"], second["speed_kmh"][0] = N + np.arange(N), 0.0
    clean = cleaned(without(joined(first, second), "ride_id"), period=period)
    assert count(clean, Quality.PAUSE) == 1
    assert clean.time[-1] == pytest.approx(second["time_s"][-1], abs=period)


@pytest.mark.parametrize("period", [1.0, 3.0])
@pytest.mark.parametrize("late", [0.2, 0.7])
def test_whole_minutes_keep_the_duration_after_each_pause(period, late):
    """A drive that begins within a minute has samples of a part of it only, whose stamp is too early."""
    parts = []
    for number in range(3):
        part = drive(N, seed=number, speed=12.0)
        part["time_s"] = START + 7200.0 * number + 60.0 * late * number + period * np.arange(N)
        parts.append(part | {"seq": np.arange(N)})
    columns = without(joined(parts[0], joined(parts[1], parts[2])), "ride_id", "latitude_deg", "longitude_deg")
    columns["time_s"] = np.floor(columns["time_s"] / 60.0) * 60.0
    clean = cleaned(columns, period=period)
    lasts = [clean.dt[N * number + 1 : N * (number + 1)].sum() for number in (1, 2)]
    assert lasts == pytest.approx([period * (N - 1)] * 2, rel=0.01)


def test_late_samples_among_shared_stamps_add_no_time():
    columns = without(drive(N, speed=12.0), "ride_id", "latitude_deg", "longitude_deg")
    columns["time_s"] = np.floor(columns["time_s"] / 60.0) * 60.0
    order = np.arange(N)
    order[200::17] -= 2
    clean = cleaned({name: values[np.argsort(order, kind="stable")] for name, values in columns.items()})
    assert count(clean, Quality.LATE) > 3
    assert clean.dt[clean.dt > 0.0].sum() == pytest.approx(PERIOD * (N - 1), rel=0.03)
