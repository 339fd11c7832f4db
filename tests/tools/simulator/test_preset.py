"""The preset `teo` simulates the fleet of the paper at a smaller size and in its proportions."""

import json
import re
from collections import Counter
from dataclasses import replace
from datetime import UTC, datetime
from itertools import islice, pairwise

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from socast.core.errors import SettingsError
from socast.core.pipeline import Pipeline
from socast.core.totals.tables import WINTER as SEASON
from socast.core.totals.tables import is_winter
from socast.core.wire.messages import address
from socast.tools.cli import main
from socast.tools.simulator.cars import make_car
from socast.tools.simulator.conditions import Conditions
from socast.tools.simulator.driver import drive_route
from socast.tools.simulator.fleet import simulate
from socast.tools.simulator.preset import (
    WINTER_TYRE_SEASON,
    YEAR,
    apportion_total,
    draw_distances,
    is_winter_tyre_season,
    load_preset,
    make_drivers,
    make_orders,
    plan_cars,
)
from socast.tools.simulator.settings import ALL_PHENOMENA, NO_FAULTS, PERIOD, UTC_OFFSET, Simulation
from socast.tools.simulator.shift import make_shift
from socast.tools.simulator.weather import make_sky
from socast.tools.simulator.world import make_route
from tests.support.simulated import SUMMER, WINTER, run_simulation

pytestmark = pytest.mark.long
TEO = load_preset("teo")
SMALL = Simulation(preset="teo", rides=800, seed=21, faults=TEO.fleet.faults)
TABLE_2 = {
    "kia-soul-ev-2015": (118_621, 12_772, 426, 31, 9, 3, 4),
    "nissan-leaf-2016": (23_687, 2485, 92, 3, 2, 0, 0),
    "tesla-model-s": (9302, 7363, 4700, 676, 29, 3, 9),
    "tesla-model-x": (4858, 4512, 3195, 538, 19, 3, 5),
}
TABLE_3 = {
    "kia-soul-ev-2015": (0.50, 1.44, 2.449, 3.11),
    "nissan-leaf-2016": (0.74, 1.93, 3.03, 3.96),
    "tesla-model-s": (0.76, 1.68, 2.46, 3.22),
    "tesla-model-x": (0.86, 1.83, 2.68, 3.60),
}
ALL_RIDES = 193_347


@pytest.fixture(scope="module")
def year():
    """Return the truth and the ride table of a small fleet, whose loggers sample half as often as usual."""
    messages, truth = run_simulation(replace(SMALL, conditions=Conditions(periods=(2 * PERIOD,))))
    pipeline = Pipeline(keep_forecasts=False)
    pipeline.push(messages)
    pipeline.finish()
    rides = pipeline.take_rides()
    rides["cluster"] = np.minimum(rides["distance_km"] // 5, 6).astype(int)
    return truth, rides


@pytest.fixture(scope="module")
def logged():
    """Return the decoded telemetry of a fleet without faults but quantisation, and its truth."""
    messages, truth = run_simulation(replace(SMALL, rides=100, faults=replace(NO_FAULTS, quantised=1.0)))
    rows = [json.loads(m.payload) for m in messages if address(m.key).kind == "telemetry"]
    return truth, pd.DataFrame(rows)


def tabulate_rides(truth):
    """Return the true rides with passengers."""
    rides = pd.DataFrame(truth.rides)
    rides["model"] = [truth.cars[name]["model"] for name in rides["vehicle_id"]]
    rides["ambient_season"] = is_winter(rides["start_s"].to_numpy())
    return rides[rides["distance_km"] > 0].reset_index(drop=True)


def count_clusters(metres):
    return np.bincount(np.minimum(metres // 5000, 6).astype(int), minlength=7)


class TestPlan:
    def test_preset_has_the_rides_of_table_2(self):
        assert {model: tuple(table["rides"]) for model, table in TEO.models.items()} == TABLE_2
        assert sum(map(sum, TABLE_2.values())) == ALL_RIDES

    @pytest.mark.parametrize("rides", [800, 20_000])
    def test_rides_have_the_proportions_of_the_paper(self, rides):
        cars_planned = plan_cars(TEO, rides, 3)
        for model, counts in TABLE_2.items():
            metres = np.concatenate(
                [
                    d.distances
                    for planned_car in cars_planned
                    if planned_car.model == model
                    for d in planned_car.planned_shifts
                ]
            )
            expected = np.array(counts) / ALL_RIDES * rides
            assert len(metres) == pytest.approx(expected.sum(), abs=1)
            np.testing.assert_allclose(count_clusters(metres), expected, atol=2)

    def test_every_car_drives_in_all_seasons_at_most_once_a_day(self):
        for rides in (20_000, 400_000):
            for planned_car in plan_cars(TEO, rides, 5):
                days = [planned_shift.day for planned_shift in planned_car.planned_shifts]
                assert all(a < b for a, b in pairwise(days))
                assert 0 <= days[0] < YEAR / 4 < 3 * YEAR / 4 < days[-1] < YEAR

    def test_drivers_share_cars_and_keep_their_style(self):
        cars_planned = plan_cars(TEO, 20_000, 5)
        drivers, cars = {}, {}
        for number, planned_car in enumerate(cars_planned):
            for planned_shift in planned_car.planned_shifts:
                assert drivers.setdefault(planned_shift.driver.name, planned_shift.driver) == planned_shift.driver
                cars.setdefault(planned_shift.driver.name, set()).add(number)
        assert len({driver.style for driver in drivers.values()}) == len(drivers) > len(cars_planned) > 40
        assert min(map(len, cars.values())) > 3
        assert all(
            len({planned_shift.driver.name for planned_shift in planned_car.planned_shifts}) > 5
            for planned_car in cars_planned
        )

    @given(st.lists(st.integers(0, 10_000), min_size=3, max_size=7), st.integers(1, 3000), st.integers(0, 99))
    def test_distances_fill_clusters_in_proportion(self, counts, number, seed):
        counts = np.array([1 + max(counts), *counts])[:7]
        metres = draw_distances(counts, number, np.random.default_rng(seed))
        assert len(metres) == number
        assert 350 <= metres.min() <= metres.max() <= 34e3
        expected = counts / counts.sum() * number
        assert np.abs(np.cumsum(count_clusters(metres))[: len(counts)] - np.cumsum(expected)).max() < 1.5

    @given(st.lists(st.integers(1, 1000), min_size=1, max_size=9), st.integers(0, 5000))
    def test_apportioned_numbers_add_up(self, shares, total):
        numbers = apportion_total(np.array(shares), total)
        assert sum(numbers) == total
        exact = np.array(shares) / sum(shares) * total
        assert np.abs(np.array(numbers) - exact).max() < 1

    @pytest.mark.parametrize(
        ("day", "on"), [((12, 14), False), ((12, 15), True), ((2, 1), True), ((3, 15), True), ((3, 16), False)]
    )
    def test_winter_tyres_are_mounted_from_15_december_to_15_march(self, day, on):
        assert is_winter_tyre_season(datetime(2018, *day, 12, tzinfo=UTC).timestamp()) is on
        assert WINTER_TYRE_SEASON == SEASON


class TestRideTable:
    def test_driven_distances_have_the_proportions_of_the_paper(self, year):
        rides = year[1][year[1]["fit_for_training"]]
        for model, counts in TABLE_2.items():
            group = rides[rides["vehicle_model"] == model]
            share = np.bincount(group["cluster"], minlength=7) / len(group)
            expected = np.array(counts) / sum(counts)
            assert np.abs(share - expected).max() < 0.02 + 2 / len(group), model
            assert len(group) / len(rides) == pytest.approx(sum(counts) / ALL_RIDES, abs=0.02)

    def test_consumption_agrees_with_the_paper(self, year):
        rides, filled = year[1][year[1]["fit_for_training"]], 0
        for (model, cluster), group in rides.groupby(["vehicle_model", "cluster"]):
            if len(group) < 15 or cluster > 3:
                continue
            filled += 1
            shifts = group["ride_id"].str.rsplit("-", n=1).str[0]  # rides of a shift share car, driver and weather
            residuals = (group["energy_kwh"] - group["energy_kwh"].mean()).groupby(shifts).sum()
            error = float(np.sqrt((residuals**2).sum())) / len(group)
            paper = TABLE_3[model][cluster]
            assert abs(group["energy_kwh"].mean() - paper) < 0.15 * paper + 3 * error, (model, cluster)
        assert filled >= 8

    def test_one_seventh_of_the_rides_is_unfit(self, year):
        unfit = 1 - year[1]["fit_for_training"].mean()
        assert unfit == pytest.approx(28_283 / ALL_RIDES, abs=0.04)
        assert {"too_short", "too_long"} <= set(year[1]["unfit_reason"].dropna())

    def test_energy_is_measured_by_state_of_charge_only(self, year):
        rides = year[1][year[1]["fit_for_training"]]
        assert rides["energy_vi_kwh"].isna().all()
        assert rides["hvac_kwh"].isna().all()
        for column in ("energy_kwh", "odometer_km", "ambient_c", "wind_speed_kmh", "time_since_charge_s"):
            assert rides[column].notna().mean() > 0.99, column

    def test_temperatures_are_those_of_montreal(self, year):
        ambient = year[1]["ambient_c"]
        assert -36 < ambient.min() < -14
        assert 24 < ambient.max() < 33
        winter = year[1]["winter"] == 1
        assert winter.mean() == pytest.approx(91 / 365, abs=0.08)
        assert ambient[winter].mean() < ambient[~winter].mean() - 12

    def test_no_car_runs_empty(self, year):
        assert min(ride["soc_end_pct"] for ride in year[0].rides) > 3


class TestTruth:
    def test_weather_reaches_the_requested_extremes(self):
        mild, wild = (make_sky(WINTER.timestamp(), 365, 4, extremes) for extremes in (None, (-30.5, 30.5)))
        clock = (wild.time + UTC_OFFSET) / 3600 % 24
        by_day = wild.temperature[(clock >= 7) & (clock <= 19)]
        assert (by_day.min(), by_day.max()) == pytest.approx((-30.5, 30.5))
        assert -38 < wild.temperature.min() < wild.temperature.max() < 38
        moderate = np.abs(mild.temperature - np.median(mild.temperature)) < 8
        np.testing.assert_array_equal(mild.temperature[moderate], wild.temperature[moderate])
        assert (np.diff(wild.temperature[np.argsort(mild.temperature)]) >= -1e-9).all()

    def test_winter_tyres_add_rolling_resistance_in_winter_only(self, year):
        parts = pd.DataFrame([ride["parts_kwh"] for ride in year[0].rides if ride["distance_km"] > 0])
        winter = tabulate_rides(year[0])["ambient_season"] == 1
        share = (parts["winter_tyres"].fillna(0) / parts["rolling"]).to_numpy()
        np.testing.assert_allclose(share[winter], 0.15, rtol=0.02)
        assert share[~winter].max() == 0

    def test_without_the_phenomenon_there_are_no_winter_tyres(self):
        _, truth = run_simulation(replace(SMALL, rides=100, phenomena=ALL_PHENOMENA._replace(winter_tyres=False)))
        assert "winter_tyres" not in truth.summary()["parts_kwh"]

    def test_capacity_falls_with_the_odometer(self, year):
        rides = tabulate_rides(year[0])
        rides = rides[rides["soc_start_pct"] - rides["soc_end_pct"] > 0.2]
        inside = rides["energy_kwh"] + rides["battery_resistance_kwh"]
        rides["capacity"] = 100 * inside / (rides["soc_start_pct"] - rides["soc_end_pct"])
        slopes = {}
        for name, group in rides.groupby("vehicle_id"):
            years = (group["start_s"] - group["start_s"].min()) / (YEAR * 86400)
            slope, new = np.polyfit(years, group["capacity"] / group["capacity"].iloc[0], 1, w=inside[group.index])
            slopes[name] = slope / new
        assert max(slopes.values()) < 0
        wear = {name: year[0].cars[name]["wear"] for name in slopes}
        lost = {name: -slopes[name] / wear[name] * (1 - wear[name]) for name in slopes}
        gained = {name: 110e3 * YEAR / year[0].cars[name]["odometer"] for name in slopes}
        assert [lost[name] for name in slopes] == pytest.approx([gained[name] for name in slopes], rel=0.1)

    def test_drivers_differ_in_speed_and_warmth(self):
        kia = make_car("kia-soul-ev-2015", np.random.default_rng(1))
        way = make_route((0.0, 0.0), (2800.0, 2200.0), np.random.default_rng(2))
        speeds = [
            np.mean([drive_route(way, d.style, 0.3, np.random.default_rng(s)).after.mean() for s in range(5)])
            for d in make_drivers(30, 4)
        ]
        assert np.std(speeds) > 0.02 * np.mean(speeds)
        assert np.std([driver.warmth for driver in make_drivers(30, 4)]) == pytest.approx(1.5, rel=0.4)
        planned_shift = plan_cars(TEO, 100, 1)[0].planned_shifts[0]
        shift = make_shift(
            "r",
            SUMMER.timestamp(),
            make_orders(TEO.fleet, planned_shift),
            kia,
            20.0,
            NO_FAULTS,
            np.random.default_rng(3),
        )
        assert {trip.driver_id for trip in shift.trips} == {planned_shift.driver.name}
        metres = [shift.timeline.moved[shift.timeline.ride == ride].sum() for ride in range(len(shift.trips))]
        np.testing.assert_allclose(metres, planned_shift.distances, rtol=0.1, atol=250)


class TestLogger:
    def test_loggers_send_the_fields_of_the_paper(self, logged):
        _, rows = logged
        for field in ("battery_voltage_v", "battery_current_a", "battery_temperature_c", "hvac_w", "ambient_c"):
            assert field not in rows, field
        for field in ("soc_pct", "odometer_km", "speed_kmh", "latitude_deg", "elevation_m"):
            assert rows[field].notna().all(), field
        for _, group in rows.groupby("vehicle_id"):
            assert group["time_s"].is_monotonic_increasing
            assert group["odometer_km"].is_monotonic_increasing
            years = (group["time_s"].max() - group["time_s"].min()) / (YEAR * 86400)
            assert group["odometer_km"].max() - group["odometer_km"].min() == pytest.approx(110 * YEAR * years, abs=200)

    def test_state_of_charge_has_the_steps_of_the_model(self, logged):
        truth, rows = logged
        steps = {truth.cars[name]["model"]: truth.cars[name]["soc_step"] for name in truth.cars}
        assert len(set(steps.values())) > 1
        for name, group in rows.groupby("vehicle_id"):
            levels = group["soc_pct"].to_numpy() / truth.cars[name]["soc_step"]
            np.testing.assert_allclose(levels, np.round(levels), atol=1e-2)


class TestCommand:
    @pytest.mark.parametrize(
        ("arguments", "expected"),
        [
            (["--preset", "uber"], "no preset is called 'uber'; choose from teo"),
            (["--fleet", "small", "--days", "3"], "fleet small has its own settings; leave out all others"),
            (["--fleet", "small", "--phenomena", "plain"], "fleet small has its own settings; leave out all others"),
            (["--fleet", "uber"], "no fleet is called 'uber'; choose from autumn"),
            (["--rides", "500"], "--rides needs a preset; give one such as --preset teo"),
            (
                ["--preset", "teo", "--vehicles", "3", "--day-step", "2"],
                "preset teo has its own --vehicles, --day-step",
            ),
            (["--preset", "teo", "--rides", "5"], "rides is 5; give 100 to 1000000"),
        ],
    )
    def test_wrong_settings_give_an_error_of_one_line(self, arguments, expected, tmp_path, capsys):
        with pytest.raises(SystemExit) as ended:
            main(["simulate", "--out", str(tmp_path / "x.mcap"), *arguments])
        assert ended.value.code == 2
        error = capsys.readouterr().err
        assert re.fullmatch(r"socast: [^\n]+\n", error), error
        assert expected in error
        assert not list(tmp_path.iterdir())

    def test_preset_combines_with_seed_start_hidden_phenomena_and_faults(self, tmp_path, capsys):
        out = tmp_path / "small.mcap"
        with pytest.raises(SystemExit) as ended:
            main(
                f"simulate --preset teo --rides 100 --seed 4 --start 2019-07-01 --hidden headwind:0.03 "
                f"--phenomena all,-snow --faults none,gap=0.001 --out {out}".split()
            )
        assert ended.value.code == 0
        assert "hidden: headwind" in capsys.readouterr().out
        truth = json.loads(out.with_suffix(".truth.json").read_text())
        settings = truth["simulation"]
        assert (settings["preset"], settings["rides"], settings["seed"]) == ("teo", 100, 4)
        assert not {"vehicles", "days", "models"} & set(settings)
        assert "snow" not in settings["phenomena"]
        assert truth["total"]["rides"] == 100  # without false starts
        assert Counter(truth["total"]["faults"])["gap"] > 0 == Counter(truth["total"]["faults"])["jitter"]
        first = min(ride["start_s"] for ride in truth["rides"])
        assert datetime(2019, 7, 1, tzinfo=UTC).timestamp() < first
        assert truth["total"]["hidden"]["headwind"]["absolute_share"] == pytest.approx(0.03, rel=0.2)

    def test_same_seed_gives_same_messages(self):
        first, again, other = (
            list(islice(simulate(replace(SMALL, rides=100, seed=seed)), 5000)) for seed in (21, 21, 22)
        )
        assert first == again != other

    def test_simulation_without_preset_has_its_own_size(self):
        with pytest.raises(SettingsError, match="rides is 10; give 100"):
            replace(SMALL, rides=10)
        _, truth = run_simulation(Simulation(vehicles=1, start=WINTER, shift_hours=0.5))
        assert "preset" not in truth.settings
        assert truth.settings["vehicles"] == 1
