"""Test the comparison of models with measurements: planted errors are located, and equal models do not differ."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from socast.core.errors import ModelError
from socast.core.evaluate.compare.models import compare_pairs, compare_predictions, find_worst_rides, select_rides
from socast.core.evaluate.records import EstimatedValue
from socast.core.evaluate.relative_errors import LEAST_ENERGY
from socast.core.fit.ride_blocks import assign_vehicle_days
from socast.core.models import EXTENDED_PHYSICAL, Term
from tests.support.linear_models import make_model
from tests.support.planted_rides import planted

seeds = st.integers(0, 2**32 - 1)


def compared(rides, **models):
    return compare_predictions(select_rides(rides, models))


def test_figures_match_their_definitions():
    rides = planted()
    result = compared(rides, m=EXTENDED_PHYSICAL).models["m"]
    error = EXTENDED_PHYSICAL.predict_energy(rides) - rides["energy_kwh"].to_numpy()
    assert result.mae_kwh.value == pytest.approx(np.abs(error).mean())
    assert result.bias_kwh.value == pytest.approx(error.mean())
    assert result.rmse_kwh == pytest.approx(np.sqrt((error**2).mean()))
    assert result.within["10"] == pytest.approx((np.abs(error) <= 0.1 * rides["energy_kwh"].abs()).mean())
    for entries in result.by.values():
        n = [entry.n for entry in entries]
        assert sum(n) <= len(rides)
        if sum(n) == len(rides):
            assert np.average([e.bias_kwh.value for e in entries], weights=n) == pytest.approx(error.mean())


def test_percentages_and_noise_floor_match_their_definitions():
    rides = planted().assign(energy_soc_noise_kwh=0.05)
    result = compared(rides, m=EXTENDED_PHYSICAL)
    energy = rides["energy_kwh"].to_numpy()
    error, counted = np.abs(EXTENDED_PHYSICAL.predict_energy(rides) - energy), energy >= LEAST_ENERGY
    errors, floor = result.models["m"], 0.05 * np.sqrt(2.0 / np.pi)
    assert result.about.noise_floor_kwh == pytest.approx(floor)
    assert result.about.below_least == pytest.approx(1.0 - counted.mean())
    assert errors.wmape.value == errors.relative == pytest.approx(error.sum() / energy.sum())
    assert errors.mape.value == pytest.approx((error / energy)[counted].mean())
    assert errors.over_floor == pytest.approx(error.mean() / floor)


def test_excluded_rides_are_counted_by_reason():
    rides = planted(60)
    rides.loc[:4, ["fit_for_training", "unfit_reason"]] = [False, "too_short"]
    rides.loc[5:6, "energy_kwh"] = np.nan
    rides.loc[7:9, "ambient_c"] = np.nan
    needy = make_model("needy", [Term(name="a", columns=("ambient_c",), unit="kWh/K")], [1.0])
    about = compared(rides, easy=EXTENDED_PHYSICAL, needy=needy).about
    assert about.left_out == {"too short": 5, "no measured energy": 2, "not predicted by needy": 3}
    assert about.read == about.rides + sum(about.left_out.values())


def test_planted_error_in_cold_is_significant_in_cold_bins_only():
    rides = planted(800)
    cold = rides["ambient_c"].to_numpy() < -15.0
    rides["energy_kwh"] += 0.3 * cold
    result = compared(rides, m=EXTENDED_PHYSICAL).models["m"].by["temperature"]
    sure = {entry.bin for entry in result if entry.is_significant}
    assert {"-25 to -20", "-20 to -15"} <= sure <= {"below -30", "-30 to -25", "-25 to -20", "-20 to -15"}
    assert all(entry.bias_kwh.value < -0.2 for entry in result if entry.bin in sure)


def test_correct_model_has_few_significant_bins():
    named = 0
    for seed in range(30):
        by = compared(planted(300, seed), m=EXTENDED_PHYSICAL).models["m"].by
        named += any(entry.is_significant for entries in by.values() for entry in entries)
    assert named <= 5


def test_models_are_distinguished_on_same_rides():
    rides = planted()
    better = EXTENDED_PHYSICAL
    worse = make_model("worse", better.terms, [1.3, 1.0, 1.0, 1.0, 1.0])
    result = {
        (p.a, p.b): p for p in compare_pairs(select_rides(rides, {"better": better, "worse": worse, "same": better}))
    }
    assert result["better", "same"].difference_kwh == EstimatedValue(value=0.0, ci95=0.0)
    assert result["better", "same"].p_holm == 1.0
    apart = result["better", "worse"]
    assert apart.difference_kwh.value < -apart.difference_kwh.ci95 < 0.0
    assert apart.p < apart.p_holm < 0.01


def test_paired_difference_has_narrower_interval_than_separate_errors():
    rides = planted()
    worse = make_model("worse", EXTENDED_PHYSICAL.terms, [1.1, 1.0, 1.0, 1.0, 1.0])
    result = compared(rides, one=EXTENDED_PHYSICAL, other=worse)
    apart = sum(of_model.mae_kwh.ci95 for of_model in result.models.values())
    assert result.pairs[0].difference_kwh.ci95 < 0.5 * apart


@given(seeds)
def test_result_does_not_depend_on_ride_order(seed):
    rides = planted(60)
    mixed = rides.sample(frac=1.0, random_state=seed)
    for one, other in zip(
        *(compared(table, m=EXTENDED_PHYSICAL).models["m"].by["season"] for table in (rides, mixed)), strict=True
    ):
        assert one.bin == other.bin
        assert one.bias_kwh.to_json() == pytest.approx(other.bias_kwh.to_json())


def test_worst_rides_come_first_and_relative_errors_need_certain_energy():
    rides = planted(100)
    rides.loc[7, "energy_kwh"] += 5.0
    rides.loc[8, ["energy_kwh", "energy_sd_kwh"]] = [0.001, 0.1]  # next to nothing: no ratio means anything
    rides.loc[9, ["energy_kwh", "energy_sd_kwh"]] = [-3.0, 1.0]
    result = find_worst_rides(select_rides(rides, {"m": EXTENDED_PHYSICAL}), EXTENDED_PHYSICAL.predict_energy(rides))
    assert result.absolute[0].ride == "car#7"
    assert result.absolute[0].error_kwh == pytest.approx(-5.0, abs=0.5)
    assert len(result.absolute) == len(result.relative) == 10
    assert next(ride.relative for ride in result.absolute if ride.ride == "car#9") is None
    assert "car#8" not in {ride.ride for ride in result.relative}
    sizes = [abs(ride.relative) for ride in result.relative]
    assert sizes == sorted(sizes, reverse=True)


def test_model_without_fit_for_any_vehicle_model_is_refused():
    rides = planted(50)
    other = make_model("other", EXTENDED_PHYSICAL.terms, [1.0] * 5, key="bmw-i3-2014")
    with pytest.raises(
        ModelError, match=r"model other is fitted to bmw-i3-2014, and the rides are of kia-soul-ev-2015, .*\*"
    ):
        select_rides(rides, {"other": other})


def test_rides_without_measured_energy_are_refused():
    with pytest.raises(ModelError, match=r"none of 20 rides can be compared \(20 no measured energy\): give rides"):
        select_rides(planted(20).assign(energy_kwh=np.nan), {"m": EXTENDED_PHYSICAL})


def test_error_names_column_that_is_unknown_in_all_rides():
    rides = planted(20).assign(odometer_km=np.nan)
    needy = make_model("needy", [Term(name="o", columns=("odometer_km",), unit="kWh/km")], [1.0])
    with pytest.raises(ModelError, match=r"needy predicts none of 20 rides: column 'odometer_km' is unknown"):
        select_rides(rides, {"needy": needy})


def test_two_rides_of_one_day_are_compared_without_intervals():
    rides = planted(300).sort_values(["vehicle_id", "date"])
    days = assign_vehicle_days(rides)
    two = rides[days == days[np.flatnonzero(np.diff(days) == 0)[0]]][:2]
    result = compared(two, m=EXTENDED_PHYSICAL)
    assert result.models["m"].mae_kwh.ci95 is None
    assert any("too few for intervals" in note for note in result.notes)


def test_frames_have_a_row_for_each_model_and_worst_ride():
    result = compared(planted(100), one=EXTENDED_PHYSICAL, other=EXTENDED_PHYSICAL)
    assert result.errors["model"].tolist() == ["one", "other"]
    assert result.errors["mae_kwh"].tolist() == [one.mae_kwh.value for one in result.models.values()]
    assert {"mae_kwh_ci95", "within_5", "rmse_kwh"} <= set(result.errors)
    assert result.worst_rides.groupby("model")["error_kwh"].size().to_dict() == {"one": 10, "other": 10}
