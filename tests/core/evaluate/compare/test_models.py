"""Test the comparison of models with measurements: intervals cover, planted errors are located, and sums add up."""

import msgspec
import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from core.errors import ModelError
from core.evaluate.binning import bin_rides, compute_local_hour
from core.evaluate.compare.datasets import compare_datasets
from core.evaluate.compare.models import compare_pairs, compare_predictions, find_worst_rides, select_rides
from core.evaluate.compare.ride_trace import accumulate_windows, find_ride, locate_divergence, trace_ride
from core.evaluate.relative_errors import LEAST_ENERGY
from core.fit.recipes import FITTED_TERMS, get_recipe
from core.models import ANY, BASIC_PHYSICAL, CORRECTION, EXTENDED_PHYSICAL, Fit, LinearModel, Term
from core.models.features import FEATURES
from core.stats.clustered import assign_vehicle_days, compute_clustered_mean, compute_clustered_ratio, subtract
from core.stats.scores import Estimate
from tests.support import planted_rides
from tests.support.linear_models import STUMP
from tests.support.paths import ROOT
from tools.commands.tables import in_memory

SHIFT = ROOT / "recordings" / "shift.mcap"
seeds = st.integers(0, 2**32 - 1)


def planted(n=400, seed=3, of_day=0.01, **coefficients):
    """Return rides with the energy of extended physics, planted coefficients, and noise of the ride and of its day."""
    table = planted_rides.rides(n, seed)
    table = table.assign(start_s=table["start_s"] + np.arange(n), ride_key=[f"car#{i}" for i in range(n)])
    still = table.assign(effect_aero_drag_wind=table["effect_aero_drag"])  # extended physics knows no wind
    energy = planted_rides.physical_energy(still, coefficients)
    return planted_rides.noisy(table, energy, seed, of_day)


def model(name, terms, coefficients, key=ANY):
    return LinearModel(
        name=name, version="1", recipe=name, terms=tuple(terms), fits={key: Fit(coefficients=tuple(coefficients))}
    )


def compared(rides, **models):
    return compare_predictions(select_rides(rides, models))


@pytest.fixture(scope="module")
def shift():
    return in_memory([SHIFT], EXTENDED_PHYSICAL.effects)


# the clustered interval


def test_interval_of_independent_rides_is_classical():
    values = np.random.default_rng(1).normal(2.0, 1.0, 50)
    result = compute_clustered_mean(values, np.arange(50))
    assert result.error == pytest.approx(values.std(ddof=1) / np.sqrt(50))
    assert result.freedom == pytest.approx(49)


@given(seeds)
def test_repeated_rides_within_cluster_do_not_change_interval(seed):
    rng = np.random.default_rng(seed)
    clusters = rng.integers(0, 6, 40)
    values = rng.normal(clusters, 1.0)
    once, thrice = (
        compute_clustered_mean(values, clusters),
        compute_clustered_mean(np.repeat(values, 3), np.repeat(clusters, 3)),
    )
    assert thrice == pytest.approx(once)


def test_clustered_interval_covers_true_value_where_plain_interval_does_not():
    rng = np.random.default_rng(5)
    held, plain, draws = 0, 0, 600
    for _ in range(draws):
        clusters = np.repeat(np.arange(12), rng.integers(2, 40, 12))
        values = rng.normal(0.0, 0.1, 12)[clusters] + rng.normal(0.0, 0.2, len(clusters))
        result = compute_clustered_mean(values, clusters)
        held += abs(result.value) <= result.ci95
        plain += abs(result.value) <= 1.96 * values.std(ddof=1) / np.sqrt(len(values))
    assert 0.91 < held / draws < 0.98
    assert plain / draws < 0.7


def test_standard_error_is_unbiased_for_unequal_clusters():
    rng = np.random.default_rng(6)
    clusters = np.repeat(np.arange(4), [1, 3, 8, 20])
    squares = [compute_clustered_mean(rng.normal(0.0, 1.0, 32), clusters).error ** 2 for _ in range(4000)]
    assert np.mean(squares) == pytest.approx(1.0 / 32.0, rel=0.08)


def test_one_cluster_has_no_interval():
    assert np.isnan(compute_clustered_mean(np.ones(5), np.zeros(5, np.int64)).ci95)


@given(seeds)
def test_ratio_is_ratio_of_sums_and_scales_with_unit(seed):
    rng = np.random.default_rng(seed)
    above, below, clusters = rng.gamma(2.0, 1.0, 30), rng.gamma(2.0, 5.0, 30), rng.integers(0, 5, 30)
    result, scaled = (
        compute_clustered_ratio(above, below, clusters),
        compute_clustered_ratio(100.0 * above, below, clusters),
    )
    assert result.value == pytest.approx(above.sum() / below.sum())
    assert (scaled.value, scaled.ci95) == pytest.approx((100.0 * result.value, 100.0 * result.ci95))
    assert compute_clustered_ratio(3.0 * below, below, clusters).error == pytest.approx(0.0, abs=1e-12)


def test_difference_has_larger_error_than_either_estimate():
    one, other = Estimate(3.0, 0.3, 10.0), Estimate(1.0, 0.4, 20.0)
    apart = subtract(one, other)
    assert (apart.value, apart.error) == (2.0, 0.5)
    assert 10.0 <= apart.freedom <= 30.0
    assert subtract(other, one).value == -2.0


# conditions


def test_each_ride_is_in_one_bin_of_each_known_property():
    rides = planted(200)
    rides.loc[3, "wind_speed_kmh"] = np.nan
    result = bin_rides(rides)
    assert "driver" not in result
    assert "time of day" not in result  # these rides have no place
    for name, (codes, labels) in result.items():
        assert codes.max() < len(labels)
        assert (codes >= 0).sum() == 200 - (name == "wind")
    ambient = rides["ambient_c"].to_numpy()
    codes, labels = result["temperature"]
    low, high = np.array([[float(x) for x in labels[c].split(" to ")] for c in codes]).T
    assert np.all((low <= ambient) & (ambient < high))


@given(st.floats(1.4e9, 1.9e9), st.floats(-180.0, 180.0))
def test_local_hour_equals_solar_hour_within_half_an_hour(start, longitude):
    hour = compute_local_hour(np.array([start]), np.array([longitude]))[0]
    solar = (start / 3600.0 + longitude / 15.0) % 24.0
    assert 0.0 <= hour < 24.0
    assert abs((hour - solar + 12.0) % 24.0 - 12.0) <= 0.5 + 1e-6


# models against rides


def test_figures_match_their_definitions():
    rides = planted()
    result = compared(rides, m=EXTENDED_PHYSICAL)["models"]["m"]
    error = EXTENDED_PHYSICAL.predict(rides) - rides["energy_kwh"].to_numpy()
    assert result["mae_kwh"]["value"] == pytest.approx(np.abs(error).mean())
    assert result["bias_kwh"]["value"] == pytest.approx(error.mean())
    assert result["rmse_kwh"] == pytest.approx(np.sqrt((error**2).mean()))
    assert result["within"]["10"] == pytest.approx((np.abs(error) <= 0.1 * rides["energy_kwh"].abs()).mean())
    for entries in result["by"].values():
        n = [entry["n"] for entry in entries]
        assert sum(n) <= len(rides)
        if sum(n) == len(rides):
            assert np.average([e["bias_kwh"]["value"] for e in entries], weights=n) == pytest.approx(error.mean())


def test_percentages_and_noise_floor_match_their_definitions():
    rides = planted().assign(energy_soc_sd_kwh=lambda table: np.hypot(0.05, 0.15 * table["energy_kwh"]))
    result = compared(rides, m=EXTENDED_PHYSICAL)
    energy = rides["energy_kwh"].to_numpy()
    error, counted = np.abs(EXTENDED_PHYSICAL.predict(rides) - energy), energy >= LEAST_ENERGY
    errors, floor = result["models"]["m"], 0.05 * np.sqrt(2.0 / np.pi)
    assert result["about"]["noise_floor_kwh"] == pytest.approx(floor)
    assert result["about"]["below_least"] == pytest.approx(1.0 - counted.mean())
    assert errors["wmape"]["value"] == errors["relative"] == pytest.approx(error.sum() / energy.sum())
    assert errors["mape"]["value"] == pytest.approx((error / energy)[counted].mean())
    assert errors["over_floor"] == pytest.approx(error.mean() / floor)


def test_excluded_rides_are_counted_by_reason():
    rides = planted(60)
    rides.loc[:4, ["fit_for_training", "unfit_reason"]] = [False, "too_short"]
    rides.loc[5:6, "energy_kwh"] = np.nan
    rides.loc[7:9, "ambient_c"] = np.nan
    needy = model("needy", [Term(name="a", columns=("ambient_c",), unit="kWh/K")], [1.0])
    about = compared(rides, easy=EXTENDED_PHYSICAL, needy=needy)["about"]
    assert about["left_out"] == {"too short": 5, "no measured energy": 2, "not predicted by needy": 3}
    assert about["read"] == about["rides"] + sum(about["left_out"].values())


def test_planted_error_in_cold_is_significant_in_cold_bins_only():
    rides = planted(800)
    cold = rides["ambient_c"].to_numpy() < -15.0
    rides["energy_kwh"] += 0.3 * cold
    result = compared(rides, m=EXTENDED_PHYSICAL)["models"]["m"]["by"]["temperature"]
    sure = {entry["bin"] for entry in result if entry["q"] < 0.05}
    assert {"-25 to -20", "-20 to -15"} <= sure <= {"below -30", "-30 to -25", "-25 to -20", "-20 to -15"}
    assert all(entry["bias_kwh"]["value"] < -0.2 for entry in result if entry["bin"] in sure)


def test_correct_model_has_few_significant_bins():
    named = 0
    for seed in range(30):
        by = compared(planted(300, seed), m=EXTENDED_PHYSICAL)["models"]["m"]["by"]
        named += any(entry["q"] < 0.05 for entries in by.values() for entry in entries)
    assert named <= 5


def test_models_are_distinguished_on_same_rides():
    rides = planted()
    better = EXTENDED_PHYSICAL
    worse = model("worse", better.terms, [1.3, 1.0, 1.0, 1.0, 1.0])
    result = {
        (p["a"], p["b"]): p
        for p in compare_pairs(select_rides(rides, {"better": better, "worse": worse, "same": better}))
    }
    assert result["better", "same"]["difference_kwh"] == {"value": 0.0, "ci95": 0.0}
    assert result["better", "same"]["p_holm"] == 1.0
    apart = result["better", "worse"]
    assert apart["difference_kwh"]["value"] < -apart["difference_kwh"]["ci95"] < 0.0
    assert apart["p"] < apart["p_holm"] < 0.01


def test_paired_difference_has_narrower_interval_than_separate_errors():
    rides = planted()
    worse = model("worse", EXTENDED_PHYSICAL.terms, [1.1, 1.0, 1.0, 1.0, 1.0])
    result = compared(rides, one=EXTENDED_PHYSICAL, other=worse)
    apart = sum(of_model["mae_kwh"]["ci95"] for of_model in result["models"].values())
    assert result["pairs"][0]["difference_kwh"]["ci95"] < 0.5 * apart


@given(seeds)
def test_result_does_not_depend_on_ride_order(seed):
    rides = planted(60)
    mixed = rides.sample(frac=1.0, random_state=seed)
    for one, other in zip(
        *(compared(table, m=EXTENDED_PHYSICAL)["models"]["m"]["by"]["season"] for table in (rides, mixed)), strict=True
    ):
        assert one["bin"] == other["bin"]
        assert one["bias_kwh"] == pytest.approx(other["bias_kwh"])


def test_worst_rides_come_first_and_relative_errors_need_certain_energy():
    rides = planted(100)
    rides.loc[7, "energy_kwh"] += 5.0
    rides.loc[8, ["energy_kwh", "energy_sd_kwh"]] = [0.001, 0.1]  # next to nothing: no ratio means anything
    result = find_worst_rides(select_rides(rides, {"m": EXTENDED_PHYSICAL}), EXTENDED_PHYSICAL.predict(rides))
    assert result["absolute"][0]["ride"] == "car#7"
    assert result["absolute"][0]["error_kwh"] == pytest.approx(-5.0, abs=0.5)
    for rank in result.values():
        assert len(rank) == 10
    assert "car#8" not in {ride["ride"] for ride in result["relative"]}
    sizes = [abs(ride["relative"]) for ride in result["relative"]]
    assert sizes == sorted(sizes, reverse=True)


def test_model_without_fit_for_any_vehicle_model_is_refused():
    rides = planted(50)
    other = model("other", EXTENDED_PHYSICAL.terms, [1.0] * 5, key="bmw-i3-2014")
    with pytest.raises(
        ModelError, match=r"model other is fitted to bmw-i3-2014, and the rides are of kia-soul-ev-2015, .*\*"
    ):
        select_rides(rides, {"other": other})


def test_rides_without_measured_energy_are_refused():
    with pytest.raises(ModelError, match=r"none of 20 rides can be compared \(20 no measured energy\): give rides"):
        select_rides(planted(20).assign(energy_kwh=np.nan), {"m": EXTENDED_PHYSICAL})


def test_error_names_column_that_is_unknown_in_all_rides():
    rides = planted(20).assign(odometer_km=np.nan)
    needy = model("needy", [Term(name="o", columns=("odometer_km",), unit="kWh/km")], [1.0])
    with pytest.raises(ModelError, match=r"needy predicts none of 20 rides: column 'odometer_km' is unknown"):
        select_rides(rides, {"needy": needy})


def test_two_rides_of_one_day_are_compared_without_intervals():
    rides = planted(300).sort_values(["vehicle_id", "date"])
    days = assign_vehicle_days(rides)
    two = rides[days == days[np.flatnonzero(np.diff(days) == 0)[0]]][:2]
    result = compared(two, m=EXTENDED_PHYSICAL)
    assert np.isnan(result["models"]["m"]["mae_kwh"]["ci95"])
    assert any("too few for intervals" in note for note in result["notes"])


# what predictions are made of


@pytest.mark.parametrize("correction", [None, {ANY: STUMP}, {"tesla-model-s": STUMP}])
@pytest.mark.parametrize("cars", [{}, {"tesla-model-s-1": 1.2, "nissan-leaf-2013-3": 0.9}])
def test_parts_add_up_to_prediction(correction, cars):
    rides = planted(240)
    fitted = get_recipe("fitted_physical").fit(rides, covariance=False)
    model = msgspec.structs.replace(fitted, correction=correction, cars=cars)
    result = model.predict_parts(rides)
    assert list(result) == [term.name for term in FITTED_TERMS] + [CORRECTION] * (correction is not None)
    np.testing.assert_allclose(sum(result.values()), model.predict(rides), rtol=1e-9)


def test_vehicle_model_without_fit_has_no_parts():
    rides = planted(40)
    one = model("one", FITTED_TERMS[:-1], [1.0] * 4, key="tesla-model-s")
    result = one.predict_parts(rides)["rolling"]
    np.testing.assert_array_equal(np.isnan(result), rides["vehicle_model"] != "tesla-model-s")


# the trace of a ride


def test_accumulated_windows_end_with_values_of_ride(shift):
    rides, windows = shift
    for i in range(0, len(rides), 5):
        ride = rides.iloc[[i]].reset_index(drop=True)
        of_ride = windows[windows["ride_key"] == ride["ride_key"].iloc[0]]
        result = accumulate_windows(ride, of_ride)
        for name in (name for name in FEATURES if name in ride):
            tolerance = {"rtol": 0.02} if name in {"wind_from_deg", "wind_speed_kmh"} else {"rtol": 1e-9, "atol": 1e-9}
            np.testing.assert_allclose(result[name].iloc[-1], ride[name].iloc[0], err_msg=name, **tolerance)
        assert result["distance_km"].iloc[0] == 0.0


def test_trace_adds_up_to_measured_and_predicted_energy(shift):
    rides, windows = shift
    ride = find_ride(rides[rides["distance_km"] > 5.0], rides.loc[rides["distance_km"] > 5.0, "ride_key"].iloc[0])
    result = trace_ride(ride, windows, {"plain": EXTENDED_PHYSICAL, "with": _with_constant()})
    assert result["windows"]["measured_kwh"].sum() == pytest.approx(ride["energy_kwh"].iloc[0])
    assert result["windows"]["end_km"][-1] == pytest.approx(ride["distance_km"].iloc[0])
    for name, of_model in result["models"].items():
        assert of_model["start_kwh"] + of_model["energy_kwh"].sum() == pytest.approx(of_model["predicted_kwh"]), name
        np.testing.assert_allclose(sum(of_model["terms"].values()), of_model["energy_kwh"], atol=1e-12)
        assert sum(of_model["start_terms"].values()) == pytest.approx(of_model["start_kwh"])
    assert result["models"]["plain"]["start_kwh"] == 0.0
    assert result["models"]["with"]["start_kwh"] == 0.5
    expected_note = (
        "with is not a sum over windows: each window shows what it adds to the prediction of the ride so far; "
        "+0.500 kWh are predicted before the first window"
    )
    assert [note for note in result["notes"] if "not a sum over windows" in note] == [expected_note]


def _with_constant():
    terms = (*EXTENDED_PHYSICAL.terms, Term(name="constant", columns=(), unit="kWh"))
    return model("with", terms, [1.0] * 5 + [0.5])


def test_windows_without_needed_column_are_refused(shift):
    rides, windows = shift
    ride = find_ride(rides, rides.loc[rides["distance_km"] > 5.0, "ride_key"].iloc[0])
    with pytest.raises(ModelError, match="column 'effect_climbing' is missing in the data: make the tables"):
        trace_ride(ride, windows.drop(columns="effect_climbing"), {"m": BASIC_PHYSICAL})


def test_ride_without_measured_energy_has_no_trace(shift):
    rides, windows = shift
    ride = find_ride(rides, rides["ride_key"].iloc[0]).assign(energy_kwh=np.nan)
    with pytest.raises(ModelError, match="it has no measured energy to compare with"):
        trace_ride(ride, windows, {"m": BASIC_PHYSICAL})


def test_ride_is_found_by_key_or_identifier_and_error_names_similar_keys(shift):
    rides, _ = shift
    key, name = rides["ride_key"].iloc[4], rides["ride_id"].iloc[4]
    assert find_ride(rides, key)["ride_id"].iloc[0] == name
    assert find_ride(rides, name)["ride_key"].iloc[0] == key
    with pytest.raises(ModelError, match=r"ride 'taxi-01#0' is not among \d+ rides: did you mean taxi-001#0"):
        find_ride(rides, "taxi-01#0")
    twice = pd.concat([rides, rides.assign(ride_key="other#" + rides["ride_key"])])
    with pytest.raises(ModelError, match="2 rides are named so: give the ride_key"):
        find_ride(twice, name)


def test_ride_measured_by_soc_is_traced_in_steps_with_note(shift):
    rides, windows = shift
    soc = rides[(rides["energy_kwh"] == rides["energy_soc_kwh"]) & (rides["distance_km"] > 3.0)]
    result = trace_ride(find_ride(rides, soc["ride_key"].iloc[0]), windows, {"m": EXTENDED_PHYSICAL})
    assert result["notes"][0].startswith("measured by the state of charge: in steps")
    assert result["windows"]["measured_kwh"].sum() == pytest.approx(soc["energy_kwh"].iloc[0])


def test_unmeasured_windows_take_mean_power(shift):
    rides, windows = shift
    ride = find_ride(rides, rides.loc[rides["energy_kwh"] == rides["energy_vi_kwh"], "ride_key"].iloc[3])
    of_ride = windows.index[windows["ride_key"] == ride["ride_key"].iloc[0]]
    gone = windows.assign(energy_vi_kwh=windows["energy_vi_kwh"].mask(windows.index == of_ride[1]))
    result = trace_ride(ride, gone, {"m": EXTENDED_PHYSICAL})
    assert any(note.startswith(f"1 of {len(of_ride)} windows were not measured") for note in result["notes"])
    assert result["windows"]["measured_kwh"].sum() == pytest.approx(ride["energy_kwh"].iloc[0])
    with pytest.raises(ModelError, match="none of the windows of this ride has a measured energy"):
        trace_ride(ride, windows.assign(energy_vi_kwh=np.nan), {"m": EXTENDED_PHYSICAL})


@given(seeds, st.integers(0, 15), st.integers(2, 6), st.sampled_from([-1.0, 1.0]))
def test_located_divergence_matches_planted_windows(seed, first, length, sign):
    rng = np.random.default_rng(seed)
    windows = {"duration_s": rng.uniform(50.0, 70.0, 24), "distance_km": rng.uniform(0.2, 1.2, 24)}
    error = sign * 0.004 + rng.normal(0.0, 0.001, 24)  # all along, and here
    error[first : first + length] += 0.1 * sign
    result = locate_divergence(error, windows, float(error.sum()))
    assert (result["first"], result["last"]) == (first, first + length - 1)
    assert result["share"] == pytest.approx(0.1 * length / (0.1 * length + 0.1), abs=0.1)
    assert result["minute"] == pytest.approx(windows["duration_s"][:first].sum() / 60.0)
    assert result["km"] == pytest.approx(windows["distance_km"][:first].sum())


@given(st.floats(-1.0, 1.0))
def test_constant_error_has_no_divergence(rate):
    windows = {"duration_s": np.full(20, 60.0), "distance_km": np.ones(20)}
    assert locate_divergence(np.full(20, rate), windows, 20.0 * rate) is None


# two sets of rides


def test_explained_and_unexplained_parts_add_up_to_difference():
    rides = planted(500)
    models = {"m": EXTENDED_PHYSICAL}
    cold, warm = (select_rides(rides[rides["winter"] == w], models) for w in (1, 0))
    result, turned = compare_datasets(warm, cold, models), compare_datasets(cold, warm, models)
    difference = result["models"]["m"]
    for side in ("first", "second", "difference"):
        value = lambda entry, side=side: entry[side]["value"]  # noqa: E731 - short
        assert sum(map(value, difference["terms"])) == pytest.approx(value(difference["explained"]))
        assert value(difference["explained"]) + value(difference["unexplained"]) == pytest.approx(
            value(result["consumption"])
        )
    assert result["consumption"]["difference"]["value"] == pytest.approx(-turned["consumption"]["difference"]["value"])
    assert result["properties"][0]["name"] == "outside temperature"
    assert difference["terms"][0]["name"] == "accessories"
    n = [sum(counts) for counts in zip(*(e["n"] for e in difference["by"]["temperature"]), strict=True)]
    assert n == [len(warm.rides), len(cold.rides)]


def test_unexplained_difference_equals_planted_unknown_effect():
    models = {"m": EXTENDED_PHYSICAL}
    for factor in (1.0, 1.4):  # tyres of the second set
        rides = planted(500, seed=4)
        rides["energy_kwh"] += (
            (rides["winter"] == 1) * (factor - 1.0) * rides["effect_rolling"] * rides["rolling_resistance"]
        )
        summer, winter = (select_rides(rides[rides["winter"] == w], models) for w in (0, 1))
        result = compare_datasets(summer, winter, models)
        left = result["models"]["m"]["unexplained"]["difference"]
        assert result["consumption"]["difference"]["value"] > 3.0  # it is winter, which the model knows of
        truth = (
            (factor - 1.0) * 100.0 * (rides["effect_rolling"] * rides["rolling_resistance"])[rides["winter"] == 1].sum()
        )
        truth /= rides.loc[rides["winter"] == 1, "distance_km"].sum()
        assert left["value"] == pytest.approx(truth, abs=left["ci95"])
        assert (abs(left["value"]) > left["ci95"]) == (factor > 1.0)


def test_rides_in_both_datasets_are_counted():
    models = {"m": EXTENDED_PHYSICAL}
    rides = planted(60)
    result = compare_datasets(select_rides(rides[:40], models), select_rides(rides[20:], models), models)
    assert result["shared"] == 20
