"""Test the measured energy: labels by voltage and current where known, and never by a faulty state of charge."""

import numpy as np
import pandas as pd
import pytest

from tests.support.telemetry import PERIOD, drive, joined, leaf, picked, ran, telemetry

RIDES, N = 7, 300
CAPACITY = 24.0
LABEL = ["energy_kwh", "energy_sd_kwh", "energy_source"]


def shift(capacity=CAPACITY, quantum=0.5, rides=RIDES):
    """Return rides with voltage and current, and the state of charge of a display of a usable capacity. [kWh]"""
    parts = [drive(N, seed=40 + i, battery_voltage_v=360.0) for i in range(rides)]
    columns = joined(*parts)
    columns["time_s"] = parts[0]["time_s"][0] + PERIOD * np.arange(N * rides)
    columns["seq"] = np.arange(N * rides)
    columns["ride_id"] = np.repeat(np.array([f"r{i}" for i in range(rides)], dtype=object), N)
    columns["latitude_deg"] = 45.5 + np.degrees(np.cumsum(columns["speed_kmh"] / 3.6 * PERIOD) / 6.371e6)
    columns["battery_current_a"] = 4.0 + 0.75 * columns["speed_kmh"]
    used = np.cumsum(360.0 * columns["battery_current_a"]) * PERIOD / 3.6e6
    columns["soc_pct"] = np.floor((98.0 - 100.0 * used / capacity) / quantum) * quantum
    return columns


def tables_of(columns, cuts=()):
    pipeline, _ = ran([leaf(), *telemetry(columns)], cuts, keep_forecasts=False)
    return pipeline.take_rides(), pipeline.take_windows(), pipeline.quality()


def frozen(columns):
    columns["soc_pct"][N : 4 * N - 50] = columns["soc_pct"][N]


def jumping(columns):
    for at, change in ((N + 100, -6.0), (2 * N + 50, 9.0), (4 * N + 200, -15.0)):
        columns["soc_pct"][at:] += change


def scaled(columns):
    columns["soc_pct"] = 95.0 - 0.6 * (95.0 - columns["soc_pct"])


def scaled_within_some_rides(columns):
    for ride in (3, 5):
        rows = slice(ride * N, (ride + 1) * N)
        columns["soc_pct"][rows] = columns["soc_pct"][ride * N] - 0.4 * (
            columns["soc_pct"][ride * N] - columns["soc_pct"][rows]
        )


@pytest.mark.parametrize("fault", [frozen, jumping, scaled, scaled_within_some_rides])
def test_faulty_soc_moves_no_label_where_power_is_known(fault):
    healthy, faulty = shift(), shift()
    fault(faulty)
    for one, other in zip(tables_of(healthy)[:2], tables_of(faulty)[:2], strict=True):
        assert (one["energy_source"] == "vi").all()
        pd.testing.assert_frame_equal(one[LABEL], other[LABEL], check_exact=True)


@pytest.mark.parametrize(("fault", "cause"), [(frozen, "soc_frozen"), (jumping, "soc_jump")])
def test_faulty_soc_is_counted_by_cause(fault, cause):
    columns = shift()
    assert tables_of(columns)[2]["samples"][cause] == 0
    fault(columns)
    rides, _, quality = tables_of(columns)
    assert quality["samples"][cause] == rides[f"quality_{cause}"].sum() > 0
    assert rides["fit_for_training"].all()  # voltage and current measure these rides


@pytest.mark.parametrize(("fault", "cause"), [(frozen, "soc_frozen"), (jumping, "soc_jump")])
def test_faulty_soc_is_no_label_where_power_is_missing_and_the_ride_has_the_reason(fault, cause):
    """The second half of each ride lacks voltage and current."""
    columns = shift()
    fault(columns)
    for ride in range(RIDES):
        columns["battery_current_a"][ride * N + 141 : (ride + 1) * N] = np.nan
    rides, windows, quality = tables_of(columns)
    marked = rides[f"quality_{cause}"] > 0
    assert marked.any()
    assert rides.loc[marked, "energy_source"].isna().all()
    assert rides.loc[marked, "energy_kwh"].isna().all()
    assert (rides.loc[marked, "unfit_reason"] == cause).all()
    assert quality["unfit"][cause] == marked.sum()
    assert (rides.loc[~marked, "energy_source"] == "soc").all()
    assert rides.loc[~marked, "fit_for_training"].all()
    by_soc = windows[windows["energy_source"] == "soc"]
    assert len(by_soc) > 0
    assert (by_soc["energy_kwh"].abs() < 0.04 * CAPACITY + 0.5).all()  # no jump of 6 % or more


def test_soc_that_stays_over_a_long_drive_without_power_is_no_label():
    columns = drive(1200, speed=12.0, soc_pct=80.0)
    ride = tables_of(columns)[0].iloc[0]
    assert ride["unfit_reason"] == "soc_frozen"
    assert np.isnan(ride["energy_kwh"])
    short = tables_of(picked(columns, np.arange(200)))[0].iloc[0]
    assert short["energy_source"] == "soc"


def test_frozen_power_gives_way_to_a_healthy_soc():
    columns = shift()
    truth = tables_of(columns)[0]
    rows = slice(5 * N, 6 * N)
    columns["battery_current_a"][rows] = columns["battery_current_a"][5 * N]
    rides = tables_of(columns)[0]
    assert rides["energy_source"].tolist() == ["vi"] * 5 + ["soc", "vi"]
    assert rides["quality_power_frozen"][5] > 0.5 * N
    error = rides["energy_kwh"][5] - truth["energy_kwh"][5]
    assert abs(error) < 2.5 * rides["energy_sd_kwh"][5]


def test_power_that_contradicts_a_healthy_soc_is_unfit_and_keeps_its_label():
    columns = shift()
    rows = slice(5 * N, 6 * N)
    columns["battery_current_a"][rows] *= 3.0
    rides, _, quality = tables_of(columns)
    assert rides["unfit_reason"].fillna("").tolist() == [""] * 5 + ["contradictory_energy", ""]
    assert quality["unfit"] == {"contradictory_energy": 1}
    assert (rides["energy_source"] == "vi").all()


def test_learned_yield_is_used_where_power_is_missing():
    """The display stands for 17 kWh, and the catalogue has 24."""
    columns = shift(capacity=17.0)
    truth = tables_of(columns)[0]
    columns["battery_current_a"][5 * N :] = np.nan
    rides = tables_of(columns)[0]
    assert rides["energy_source"].tolist() == ["vi"] * 5 + ["soc"] * 2
    capacity, sd = rides["usable_capacity_kwh"], rides["usable_capacity_sd_kwh"]
    assert capacity[0] == pytest.approx(24.0)
    assert capacity[5] == pytest.approx(17.0, abs=2.0 * sd[5])
    assert capacity[6] == capacity[5]  # nothing was learned without voltage and current
    assert sd[5] < 0.3 * sd[0]
    error = (rides["energy_kwh"] - truth["energy_kwh"])[5:]
    assert (error.abs() < 2.0 * rides["energy_sd_kwh"][5:]).all()
    assert (error.abs() < 0.1 * truth["energy_kwh"][5:] + 0.1).all()


@pytest.mark.parametrize(("every", "quantum", "source"), [(2, 0.1, "vi"), (5, 0.1, "soc"), (5, 5.0, "vi")])
def test_fine_charge_measures_where_power_is_sampled_slowly(every, quantum, source):
    """With samples every 6 s V·I measures; with samples every 15 s a display with a fine quantum does."""
    columns = picked(shift(quantum=quantum), slice(None, None, every))
    columns["seq"] = np.arange(len(columns["seq"]))
    pipeline, _ = ran([leaf(period_s=every * PERIOD), *telemetry(columns)], keep_forecasts=False)
    rides = pipeline.take_rides()
    assert set(rides["energy_source"]) == {source}
    assert rides["fit_for_training"].all()


def test_faulty_charge_does_not_measure_where_power_is_sampled_slowly():
    columns = picked(shift(quantum=0.1), slice(None, None, 5))
    columns["seq"] = np.arange(len(columns["seq"]))
    n = N // 5
    columns["soc_pct"][n : 4 * n - 10] = columns["soc_pct"][n]
    pipeline, _ = ran([leaf(period_s=5 * PERIOD), *telemetry(columns)], keep_forecasts=False)
    assert pipeline.take_rides()["energy_source"][2] == "vi"


@pytest.mark.parametrize(("samples", "reason"), [(9, None), (30, "power_frozen")])
def test_share_of_samples_with_a_frozen_current_decides(samples, reason):
    """A current of zero counts as frozen from its eighth sample on."""
    columns = drive(1100, speed=15.0, battery_voltage_v=360.0, battery_current_a=30.0)
    columns["battery_current_a"] += np.arange(1100) % 7
    columns["battery_current_a"][500 : 500 + samples] = 0.0
    ride = tables_of(columns)[0].iloc[0]
    assert ride["quality_power_frozen"] > 0
    assert ride["unfit_reason"] == reason or reason is None
    assert ride["fit_for_training"] == (reason is None)
