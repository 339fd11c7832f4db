"""Test the split of the measured energy: it adds up, planted effects have their true share, and gaps are named."""

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from socast.core.condition.energy_parts import DRAG_FORM_ERROR, FORM_ERROR, LIMIT, UNEXPLAINED, WAITING
from socast.core.condition.energy_split import (
    DRIVEN_SLOWER,
    FLEET,
    GROUP_COLUMNS,
    LIKE_SIBLINGS,
    EnergySplit,
    split_energy,
)
from socast.core.errors import ModelError, SettingsError
from socast.core.fit.recipes import RECIPES
from socast.core.models import ANY, BASIC_PHYSICAL, CORRECTION, EXTENDED_PHYSICAL, Fit, LinearModel, Term
from socast.core.models.limit import EnergyLimit
from socast.core.stats.scores import compute_half_widths
from tests.support.linear_models import STUMP, make_model
from tests.support.planted_rides import noisy, physical_energy, planted, rides

CAR = "nissan-leaf-2013-1"
TERMS = EXTENDED_PHYSICAL.terms
DRIVERS = [None, "d1", "d2"]


def energies(group):
    """Return the energy of each part of a group. [kWh]"""
    return {share.name: share.energy_kwh.value for share in group.shares}


def fitted(*coefficients, **fields):
    """Return a model of the terms of extended physics."""
    return LinearModel(
        name="m", version="1", recipe="r", terms=TERMS, fits={ANY: Fit(coefficients=coefficients, **fields)}
    )


def with_everything():
    """Return a model with factors of cars, boosted trees, and a limit at which some predictions stop."""
    limit = EnergyLimit(kwh_per_km=0.1, power_kw=1.0)
    model = fitted(1.1, 0.9, 1.2, 1.0, 1.3, limit=limit)
    return replace(model, cars={CAR: 1.25}, correction={ANY: STUMP})


def with_drivers(table):
    return table.assign(driver_id=[DRIVERS[i % 3] for i in range(len(table))])


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([FLEET, *sorted(GROUP_COLUMNS), "car,month", "speed,driver,model"]))
def test_parts_add_up_to_measured_energy_in_every_group(seed, by):
    table = with_drivers(planted(80, seed))
    table["standing_s"] = np.random.default_rng(seed).uniform(0.0, 1.0, len(table)) * table["duration_s"]
    result = split_energy(table, with_everything(), by=by)
    assert energies(result.fleet)[WAITING] > 0.0
    for group in (result.fleet, *result.groups):
        assert sum(energies(group).values()) == pytest.approx(group.measured.energy_kwh.value, rel=1e-9)
        if group.measured.energy_kwh.value > 0.0:
            assert sum(share.share for share in group.shares) == pytest.approx(1.0)
            assert sum(share.range_km for share in group.shares) == pytest.approx(group.distance_km)
    assert result.fleet.measured.energy_kwh.value == pytest.approx(table["energy_kwh"].sum())
    if result.groups:
        for name, energy in energies(result.fleet).items():
            assert sum(energies(group)[name] for group in result.groups) == pytest.approx(energy)


def test_explained_energy_is_the_prediction_also_with_factors_trees_and_limit():
    table = planted(200)
    model = with_everything()
    fleet = split_energy(table, model).fleet
    parts = energies(fleet)
    assert {share.name: share.kind for share in fleet.shares if share.kind != "term"} == {
        CORRECTION: "correction",
        LIMIT: "limit",
        UNEXPLAINED: "unexplained",
    }
    assert parts[LIMIT] < 0.0
    assert sum(parts.values()) - parts[UNEXPLAINED] == pytest.approx(model.predict_energy(table).sum())


def test_factor_of_car_applies_to_each_term():
    table = planted(200)
    table = table[table["vehicle_id"] == CAR]
    plain = energies(split_energy(table, EXTENDED_PHYSICAL).fleet)
    scaled = energies(split_energy(table, replace(EXTENDED_PHYSICAL, cars={CAR: 1.25})).fleet)
    for term in TERMS:
        assert scaled[term.name] == pytest.approx(1.25 * plain[term.name])


def test_planted_effect_has_its_true_share():
    table, planted_rolling = rides(1500), 1.6
    table = noisy(table, physical_energy(table, {"rolling": planted_rolling}))
    model = RECIPES["fitted_physical"].fit(table)
    rolling = next(share for share in split_energy(table, model).fleet.shares if share.name == "rolling")
    truth = planted_rolling * float((table["effect_rolling"] * table["rolling_resistance"]).sum())
    assert rolling.energy_kwh.value == pytest.approx(truth, rel=0.05)
    assert rolling.share == pytest.approx(truth / table["energy_kwh"].sum(), rel=0.05)
    assert abs(rolling.energy_kwh.value - truth) < 2.0 * rolling.energy_kwh.ci95


def test_energy_of_unknown_cause_is_unexplained():
    table = planted(300)
    table["energy_kwh"] = physical_energy(table.assign(effect_aero_drag_wind=table["effect_aero_drag"])) + 0.2
    parts = energies(split_energy(table, EXTENDED_PHYSICAL).fleet)
    assert parts[UNEXPLAINED] == pytest.approx(0.2 * len(table), rel=0.01)


def with_covariance(model, sds):
    """Return a model whose coefficients have given standard errors."""
    covariance = tuple(map(tuple, np.diag(np.square(sds)).tolist()))
    return replace(model, fits={ANY: replace(model.fits[ANY], covariance=covariance, clusters=10)})


def half_widths(group):
    """Return half of the 95 % interval of each part of a group. [kWh]"""
    return {share.name: share.energy_kwh.ci95 for share in group.shares}


WIDTH = float(compute_half_widths(1.0, 9))


def test_intervals_follow_from_the_covariance_of_the_fit_and_from_what_no_data_reduce():
    table, sds = planted(200), [0.1, 0.0, 0.2, 0.0, 0.05]
    fleet = split_energy(table, with_covariance(fitted(1.0, 1.0, 1.0, 1.0, 1.0), sds)).fleet
    parts, halves = energies(fleet), half_widths(fleet)
    assert halves["aero_drag"] == pytest.approx(np.hypot(WIDTH * 0.2, DRAG_FORM_ERROR) * parts["aero_drag"])
    assert halves["climbing"] == pytest.approx(FORM_ERROR * abs(parts["climbing"]))
    of_all = [WIDTH * sd * parts[term.name] for sd, term in zip(sds, TERMS, strict=True)]
    assert halves[UNEXPLAINED] == pytest.approx(np.sqrt(np.sum(np.square(of_all))))


def test_groups_have_no_intervals_because_they_differ_from_the_mean_of_all_rides():
    model = with_covariance(fitted(1.0, 1.0, 1.0, 1.0, 1.0), [0.1] * 5)
    result = split_energy(planted(100), model, by="car")
    assert None not in half_widths(result.fleet).values()
    assert {half for group in result.groups for half in half_widths(group).values()} == {None}


def test_climbing_is_less_certain_where_heights_are_unknown():
    table, model = planted(200), with_covariance(fitted(1.0, 1.0, 1.0, 1.0, 1.0), [0.0] * 5)
    known = half_widths(split_energy(table, model).fleet)["climbing"]
    flat = table["vehicle_id"] == CAR
    some = split_energy(table.assign(effect_climbing=table["effect_climbing"].where(~flat, 0.0)), model)
    missed = float(table.loc[flat, "effect_climbing"].sum())
    assert abs(missed) < half_widths(some.fleet)["climbing"]
    assert half_widths(some.fleet)["climbing"] > 3.0 * known
    assert any(f"the heights of {flat.sum()} rides are unknown" in note for note in some.notes)
    none = split_energy(table.assign(effect_climbing=0.0), model)
    assert half_widths(none.fleet)["climbing"] is None
    assert half_widths(none.fleet)["aero_drag"] > 0.0


def test_slowing_gives_back_what_speeding_up_paid_and_braking_has_the_rest():
    """Coefficients of slowing and braking that trade against each other change neither part."""
    kinetic = {"effect_inertia_positive": 1.0, "effect_inertia_negative": -0.9, "effect_braking": 0.4}
    table = planted(100).assign(**kinetic, effect_auxiliary=0.0)
    terms, n = RECIPES["road_load_constant"].terms, 100
    names = [term.name for term in terms]
    one = dict.fromkeys(names, 1.0) | {"inertia_positive": 1.25, "braking": 0.3}
    costs = ({"inertia_negative": 1.25}, {"inertia_negative": 1.05, "braking": 0.3 - 0.2 * 0.9 / 0.4})
    models = [make_model("m", terms, [(one | cost)[name] for name in names]) for cost in costs]
    plain, traded = (energies(split_energy(table, model).fleet) for model in models)
    assert plain == pytest.approx(traded)
    assert plain["inertia_negative"] == pytest.approx(-1.25 * 0.9 * n)
    assert plain["braking"] == pytest.approx(0.3 * 0.4 * n)
    errors = [0.1 if name == "inertia_negative" else 0.0 for name in names]
    halves = half_widths(split_energy(table, with_covariance(models[0], errors)).fleet)
    assert halves["inertia_negative"] == pytest.approx(FORM_ERROR * 1.25 * 0.9 * n)
    assert halves["braking"] == pytest.approx(np.hypot(WIDTH * 0.1 * 0.9 * n, FORM_ERROR * plain["braking"]))


def test_model_without_standard_errors_has_no_intervals_and_says_so():
    result = split_energy(planted(60), EXTENDED_PHYSICAL)
    assert {share.energy_kwh.ci95 for share in result.fleet.shares} == {None}
    assert any("no standard errors" in note for note in result.notes)


def test_terms_over_time_are_split_by_the_time_in_which_the_car_stood():
    covariance = tuple(map(tuple, np.diag([0.1, 0.1, 0.2, 0.1, 0.05]).tolist()))
    table, model = planted(100), fitted(1.0, 1.0, 1.0, 1.0, 1.0, covariance=covariance, clusters=10)
    whole = split_energy(table, model)
    parts = {share.name: share for share in whole.fleet.shares}
    split = split_energy(table.assign(standing_s=0.3 * table["duration_s"]), model)
    of_split = {share.name: share for share in split.fleet.shares}
    for name, share in ((WAITING, 0.3), ("accessories", 0.7)):
        for figure in ("value", "ci95"):
            expected = share * getattr(parts["accessories"].energy_kwh, figure)
            assert getattr(of_split[name].energy_kwh, figure) == pytest.approx(expected)
    assert of_split["accessories"].what == "climate and accessories while driving"
    assert {name: part for name, part in of_split.items() if name not in {WAITING, "accessories"}} == {
        name: part for name, part in parts.items() if name != "accessories"
    }
    assert "driving takes longer" in find(split, DRIVEN_SLOWER).assumption
    waiting = of_split[WAITING].energy_kwh.value
    saved = find(whole, DRIVEN_SLOWER).energy_kwh.value + waiting / 9.0  # the car stands no longer
    assert find(split, DRIVEN_SLOWER).energy_kwh.value == pytest.approx(saved)


def test_tables_without_standing_time_are_split_without_waiting_and_the_result_says_so():
    result = split_energy(planted(60), EXTENDED_PHYSICAL)
    assert WAITING not in energies(result.fleet)
    assert any("no standing_s, so waiting is no part" in note for note in result.notes)
    table = planted(60).assign(standing_s=np.nan)
    assert WAITING not in energies(split_energy(table, EXTENDED_PHYSICAL).fleet)
    assert WAITING not in energies(split_energy(table.assign(standing_s=60.0), BASIC_PHYSICAL).fleet)


def test_negative_terms_are_returned_energy():
    model = fitted(1.0, 1.0, -0.5, 1.0, 1.0)
    fleet = split_energy(planted(100), model).fleet
    drag = next(share for share in fleet.shares if share.name == "aero_drag")
    assert drag.is_returned
    assert fleet.returned_kwh == pytest.approx(
        -sum(min(share.energy_kwh.value, 0.0) for share in fleet.shares if share.kind != "unexplained")
    )


def test_price_is_that_of_the_energy():
    fleet = split_energy(planted(60), EXTENDED_PHYSICAL, price=0.12).fleet
    for share in (*fleet.shares, fleet.measured):
        assert share.cost == pytest.approx(0.12 * share.energy_kwh.value)
        assert share.cost_per_100km == pytest.approx(0.12 * share.per_100km_kwh.value)
    unpriced = split_energy(planted(60), EXTENDED_PHYSICAL).fleet
    assert {share.cost for share in unpriced.shares} == {None}


def test_groups_are_named_by_car_month_driver_vehicle_model_and_speed():
    table = with_drivers(planted(120)).assign(average_speed_kmh=[19.9, 20.0, np.nan, 60.0] * 30)
    ways = (FLEET, *GROUP_COLUMNS, "speed, car")
    names = {by: [group.name for group in split_energy(table, EXTENDED_PHYSICAL, by=by).groups] for by in ways}
    assert names[FLEET] == []
    assert names["speed"] == ["0–20 km/h", "20–40 km/h", "60 km/h or more", "unknown"]
    both = split_energy(table, EXTENDED_PHYSICAL, by="speed, car").groups
    assert all(group.name == f"{group.of['speed']}, {group.of['car']}" for group in both)
    assert set(names["speed, car"]) <= {f"{speed}, {car}" for speed in names["speed"] for car in names["car"]}
    assert names["car"] == sorted(set(table["vehicle_id"]))
    assert names["month"] == sorted(set(table["date"].str[:7]))
    assert names["driver"] == ["d1", "d2", "unknown"]
    assert names["model"] == sorted(set(table["vehicle_model"]))


def test_rides_that_do_not_count_are_counted_by_reason():
    table = planted(60)
    table.loc[:4, ["fit_for_training", "unfit_reason"]] = [False, "too_short"]
    table.loc[5:6, "energy_kwh"] = np.nan
    table.loc[7:9, "ambient_c"] = np.nan
    model = make_model("needy", [Term(name="a", columns=("ambient_c",), unit="kWh/K")], [1.0])
    result = split_energy(table, model)
    assert result.left_out == {"too short": 5, "no measured energy": 2, "not predicted by needy": 3}
    assert result.read == result.fleet.rides + sum(result.left_out.values())


def exact(count=400, **factors):
    """Return rides of one vehicle model without noise, in which some cars take more than others."""
    table = rides(count, 5, ("nissan-leaf-2013",), cars=4)
    energy = physical_energy(table.assign(effect_aero_drag_wind=table["effect_aero_drag"]))
    by_car = table["vehicle_id"].map({f"nissan-leaf-2013-{car[3:]}": factor for car, factor in factors.items()})
    return table.assign(energy_kwh=energy * by_car.fillna(1.0))


def find(result, what):
    return next(saving for saving in result.savings if saving.what == what)


@pytest.mark.parametrize("known", [False, True])
def test_car_like_its_siblings_saves_what_it_takes_beyond_their_median(known):
    """Also where the model knows the factor of the car."""
    table = exact(car0=1.2)
    car = "nissan-leaf-2013-0"
    model = replace(EXTENDED_PHYSICAL, cars={car: 1.2} if known else {})
    result = split_energy(table, model)
    used = float(table.loc[table["vehicle_id"] == car, "energy_kwh"].sum())
    first = result.cars[0]
    assert (first.vehicle_id, first.factor.value / first.median) == (car, pytest.approx(1.2))
    assert first.saved_kwh == pytest.approx(used * (1.0 - 1.0 / 1.2))
    assert find(result, LIKE_SIBLINGS).energy_kwh.value == pytest.approx(first.saved_kwh)
    assert [each.saved_kwh for each in result.cars[1:]] == pytest.approx([0.0, 0.0, 0.0], abs=1e-9)


def test_term_of_one_car_does_not_hide_that_it_takes_more():
    table = exact(car0=1.2)
    car = "nissan-leaf-2013-0"
    own = Term(name="own", columns=("effect_rolling", "rolling_resistance", f"vehicle={car}"), unit="1")
    model = make_model("m", [*TERMS, own], [1.0, 1.0, 1.0, 1.0, 1.0, 0.5])
    assert split_energy(table, model).cars[0].factor.value == pytest.approx(1.2)


def test_siblings_are_at_least_three_cars_of_a_vehicle_model():
    table = exact()
    result = split_energy(
        table[table["vehicle_id"].isin(["nissan-leaf-2013-0", "nissan-leaf-2013-1"])], EXTENDED_PHYSICAL
    )
    assert result.cars == []
    assert [line.partition(":")[0] for line in result.impossible] == [LIKE_SIBLINGS]


def test_slower_driving_lowers_air_drag_and_takes_longer():
    result = split_energy(planted(100), EXTENDED_PHYSICAL)
    parts = energies(result.fleet)
    saved = 0.19 * parts["aero_drag"] - parts["accessories"] / 9.0
    assert find(result, DRIVEN_SLOWER).energy_kwh.value == pytest.approx(saved)
    assert "stops included" in find(result, DRIVEN_SLOWER).assumption


def test_slower_driving_is_left_out_without_a_term_over_time():
    result = split_energy(planted(100), BASIC_PHYSICAL)
    assert [saving.what for saving in result.savings] == [LIKE_SIBLINGS]
    assert result.impossible == [f"{DRIVEN_SLOWER}: unknown, because the model has no term that acts over time"]


def test_measured_energy_below_zero_has_no_shares():
    table = planted(40)
    fleet = split_energy(table.assign(energy_kwh=-1.0), EXTENDED_PHYSICAL).fleet
    assert {share.share for share in fleet.shares} == {share.range_km for share in fleet.shares} == {None}
    assert sum(energies(fleet).values()) == pytest.approx(-40.0)


def test_record_survives_json():
    result = split_energy(with_drivers(planted(60)), with_everything(), by="driver", price=0.3)
    assert msgspec.convert(result.to_json(), EnergySplit) == result


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        (
            {"by": "colour"},
            SettingsError,
            "'colour'.*: give fleet, or one or several of car, month, driver, model, speed",
        ),
        ({"by": "fleet,car"}, SettingsError, "fleet leaves all rides together and cannot be combined"),
        ({"by": "car,"}, SettingsError, "'' .*: give fleet, or one"),
        ({"price": -0.1}, SettingsError, "is -0.1, and must be 0 or above"),
        ({"price": float("nan")}, SettingsError, "is nan"),
        ({"by": "driver"}, ModelError, "'driver_id' is unknown in all of them; group by car"),
    ],
)
def test_wrong_options_are_refused_with_their_remedy(options, error, message):
    with pytest.raises(error, match=message):
        split_energy(planted(30), EXTENDED_PHYSICAL, **options)


def test_empty_tables_and_tables_without_fit_rides_are_refused():
    table = planted(30)
    with pytest.raises(ModelError, match="there are no rides"):
        split_energy(table[:0], EXTENDED_PHYSICAL)
    with pytest.raises(ModelError, match="none of 30 rides"):
        split_energy(table.assign(fit_for_training=False, unfit_reason="too_short"), EXTENDED_PHYSICAL)
