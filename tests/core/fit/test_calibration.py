"""Test that intervals have their nominal coverage, and that leverage gives the errors of fits without the ride."""

import msgspec
import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from socast.core.errors import ModelError
from socast.core.fit.calibration import (
    LEAST_CALIBRATION_RIDES,
    PRIOR_SCALE,
    QUANTILE_LEVELS,
    HeldOutErrors,
    add_interval,
    calibrate_interval,
    expect_interval,
)
from socast.core.fit.fitting import fit_terms
from socast.core.fit.recipes import RECIPES, LinearRecipe, make_term
from socast.core.fit.ride_blocks import RideFrame
from socast.core.models import BASIC_PHYSICAL, decode_model, encode_model
from socast.core.models.features import Columns
from socast.core.models.interval import ANY, PredictionInterval
from tests.support.planted_rides import MODELS
from tests.support.pooled_rides import differing, fleet, measured, planted


def heteroscedastic(n: int, seed: int) -> pd.DataFrame:
    """Return rides with skewed errors that grow with size and cold, and are larger for one vehicle model."""
    table = fleet(n, seed)
    random = np.random.default_rng(seed + 50)
    columns = Columns(table)
    size, cold = columns["size_kwh"], columns["heating_need_k"]
    sd = 0.02 + 0.04 * size + 0.002 * size * cold
    sd = sd * np.where(table["vehicle_model"] == MODELS[0], 2.0, 1.0)
    return table.assign(energy_kwh=BASIC_PHYSICAL.predict_energy(table) + sd * (random.gamma(4.0, 0.5, n) - 2.0))


def inside(table: pd.DataFrame, interval: PredictionInterval, level: float = 0.9) -> np.ndarray:
    lower, upper = interval.bounds(BASIC_PHYSICAL.predict_energy(table), table, level)
    energy = table["energy_kwh"].to_numpy()
    return (lower <= energy) & (energy <= upper)


@pytest.fixture(scope="module")
def interval() -> PredictionInterval:
    calibrated = add_interval(BASIC_PHYSICAL, heteroscedastic(6000, 1), fitted=False).interval
    assert calibrated is not None
    return calibrated


@pytest.mark.parametrize("level", [0.5, 0.8, 0.9, 0.98])
def test_interval_covers_new_rides_at_the_nominal_level(interval, level):
    table = heteroscedastic(8000, 2)
    covered = inside(table, interval, level)
    assert covered.mean() == pytest.approx(level, abs=0.02)


def test_interval_covers_each_distance_season_and_vehicle_model(interval):
    table = heteroscedastic(8000, 2)
    covered = inside(table, interval)
    cluster = np.minimum(table["distance_km"] // 5, 4)
    for group in (cluster, table["winter"], table["vehicle_model"], table["ambient_c"] < -10.0):
        share = pd.Series(covered).groupby(group.to_numpy()).mean()
        assert share.min() > 0.85
        assert share.max() < 0.95


def test_interval_is_wider_where_errors_are_larger(interval):
    table = heteroscedastic(3000, 3)
    lower, upper = interval.bounds(np.zeros(3000), table, 0.9)
    width = pd.Series(upper - lower)
    size = Columns(table)["size_kwh"]
    assert width[size > np.quantile(size, 0.9)].mean() > 2.0 * width[size < np.quantile(size, 0.5)].mean()
    assert width[(table["vehicle_model"] == MODELS[0]).to_numpy()].mean() > 1.3 * width.mean()


def test_interval_of_higher_level_contains_that_of_lower_level(interval):
    table = heteroscedastic(500, 4)
    lower, upper = np.inf, -np.inf
    for level in (0.1, 0.5, 0.9, 0.97, 0.99):
        low, high = interval.bounds(np.zeros(500), table, level)
        assert (low <= lower).all()
        assert (high >= upper).all()
        lower, upper = low, high


@pytest.mark.parametrize("level", [0.0, -0.1, 0.995, 1.0, 90.0, float("nan")])
def test_level_outside_the_calibration_is_refused(interval, level):
    with pytest.raises(ModelError, match=r"give a level above 0, up to 0.99"):
        interval.bounds(np.zeros(3), heteroscedastic(3, 5), level)


def test_bounds_are_nan_for_unknown_inputs_but_not_for_unknown_vehicle_models(interval):
    table = heteroscedastic(4, 6)
    table.loc[1, "ambient_c"] = np.nan
    table.loc[2, "vehicle_model"] = None
    table.loc[3, "vehicle_model"] = "horse"
    lower, upper = interval.bounds(np.array([1.0, 1.0, 1.0, np.nan]), table, 0.9)
    assert np.isnan(lower).tolist() == np.isnan(upper).tolist() == [False, True, False, True]


def test_bounds_of_a_row_do_not_depend_on_other_rows(interval):
    table = heteroscedastic(30, 7)
    together = interval.bounds(np.zeros(30), table, 0.9)
    alone = [interval.bounds(np.zeros(1), table.iloc[i : i + 1], 0.9) for i in range(30)]
    np.testing.assert_allclose(np.concatenate(alone, axis=1), together, rtol=1e-13)


def test_model_file_preserves_the_interval_exactly(interval):
    model = msgspec.structs.replace(BASIC_PHYSICAL, interval=interval)
    assert decode_model(encode_model(model)).interval == interval
    table = heteroscedastic(10, 8)
    assert (model.predict_interval(table, 0.9)[0] < model.predict_energy(table)).all()


def test_too_few_rides_give_no_interval():
    assert add_interval(BASIC_PHYSICAL, heteroscedastic(LEAST_CALIBRATION_RIDES - 1, 1), fitted=False).interval is None


def test_no_error_gives_no_expected_interval_and_one_gives_nearly_that_of_the_prior():
    terms = np.array([[1.0, 1.0, 0.0]])
    none = HeldOutErrors(np.empty(0), np.empty((0, 3)), np.empty(0))
    assert expect_interval({"leaf": none}) is None
    usual = PRIOR_SCALE[0] + PRIOR_SCALE[1]
    found = expect_interval({"leaf": HeldOutErrors(np.array([usual]), terms, np.array([5.0]))})
    assert found.scales["leaf"] == pytest.approx(PRIOR_SCALE)
    assert found.scales[ANY] == pytest.approx(np.multiply(PRIOR_SCALE, 2.0))


def test_expected_interval_covers_errors_of_cars_that_err_less_and_more_than_the_prior():
    random = np.random.default_rng(4)
    covered = []
    for rides in (1, 5, 20, 80):
        for _ in range(300):
            size = random.uniform(0.2, 4.0, rides + 20)
            terms = np.column_stack([np.ones(len(size)), size, 0.0 * size])
            spread = terms @ np.array(PRIOR_SCALE) * np.exp(random.normal(0.0, 0.4))
            error = spread * random.normal(0.0, np.sqrt(np.pi / 2.0), len(size))
            found = expect_interval({"leaf": HeldOutErrors(error[:rides], terms[:rides], 10.0 * size[:rides])})
            low, high = found.get_quantiles(10.0 * size[rides:], 0.9)
            scale = terms[rides:] @ np.array(found.scales["leaf"])
            covered.append(np.mean((low * scale <= error[rides:]) & (error[rides:] <= high * scale)))
    shares = np.array(covered).reshape(4, 300).mean(axis=1)
    assert ((shares > 0.87) & (shares < 0.95)).all()


def test_expected_interval_follows_the_errors_of_many_rides_but_not_a_single_odd_one():
    terms = np.tile([1.0, 1.0, 0.0], (90, 1))
    usual = (PRIOR_SCALE[0] + PRIOR_SCALE[1]) * np.ones(90)
    small, odd = expect_interval({"a": HeldOutErrors(0.3 * usual, terms, usual)}), usual.copy()
    odd[7] *= 1000.0
    large = expect_interval({"a": HeldOutErrors(odd, terms, usual)})
    assert small.scales["a"][1] == pytest.approx(0.34 * PRIOR_SCALE[1], rel=0.02)
    assert large.scales["a"][1] < 1.1 * PRIOR_SCALE[1]


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10_000), rides=st.integers(LEAST_CALIBRATION_RIDES, 3000), heavy=st.booleans())
def test_interval_covers_errors_of_any_distribution(seed, rides, heavy):
    random = np.random.default_rng(seed)
    draw = random.standard_t if heavy else random.chisquare
    size = random.uniform(0.1, 5.0, rides)
    terms = np.column_stack([np.ones(rides), size, size * random.uniform(0.0, 30.0, rides)])
    held = HeldOutErrors(size * draw(2, rides), terms, random.uniform(0.0, 30.0, rides))
    fitted = calibrate_interval({"a": held}, {})
    assert fitted is not None
    scale = terms @ np.array(fitted.scales["a"])
    row = np.array(fitted.quantiles)[np.searchsorted(fitted.distances_km, held.distance, side="right") - 1]
    low, high = row[:, QUANTILE_LEVELS.index(0.05)], row[:, QUANTILE_LEVELS.index(0.95)]
    covered = ((low * scale <= held.error) & (held.error <= high * scale)).mean()
    assert 0.89 < covered < 0.96


PLAIN = LinearRecipe(
    "plain",
    "Plain",
    (
        make_term("effect_rolling"),
        make_term("effect_aero_drag"),
        make_term("distance_km"),
        make_term("distance_km", "winter"),
        make_term(),
    ),
)


@pytest.fixture(scope="module")
def small() -> pd.DataFrame:
    table = fleet(240, 5, models=MODELS[:2])
    return measured(table, planted(table, differing(MODELS[:2])))


def test_leverage_gives_the_error_of_a_fit_without_the_ride(small, monkeypatch):
    seen = {}
    monkeypatch.setattr(
        "socast.core.fit.calibration.calibrate_interval", lambda known, other: seen.update(own=known, other=other)
    )
    model = fit_terms(PLAIN, RideFrame(small))
    add_interval(model, small)
    of_model = small[small["vehicle_model"] == MODELS[1]]
    for i in (0, 17, len(of_model) - 1):
        without = fit_terms(PLAIN, RideFrame(of_model.drop(index=of_model.index[i])))
        expected = of_model["energy_kwh"].iloc[i] - without.predict_energy(of_model.iloc[i : i + 1])[0]
        assert seen["own"][MODELS[1]].error[i] == pytest.approx(expected, rel=1e-6)


def test_leverage_gives_the_errors_of_a_fit_without_the_vehicle_model(small, monkeypatch):
    seen = {}
    monkeypatch.setattr(
        "socast.core.fit.calibration.calibrate_interval", lambda known, other: seen.update(own=known, other=other)
    )
    add_interval(fit_terms(PLAIN, RideFrame(small)), small)
    of_model = small["vehicle_model"] == MODELS[1]
    expected = small["energy_kwh"][of_model] - fit_terms(PLAIN, RideFrame(small[~of_model])).predict_energy(
        small[of_model]
    )
    np.testing.assert_allclose(seen["other"][MODELS[1]].error, expected, rtol=1e-6, atol=1e-9)


def test_interval_of_unseen_vehicle_models_covers_more_than_that_of_known_ones():
    coefficients = differing(MODELS, drive=0.15, climate=0.2)
    table = fleet(4000, 9)
    table = measured(table, planted(table, coefficients))
    energy = table["energy_kwh"].to_numpy()
    covered, as_others = [], []
    for name in MODELS:
        new = (table["vehicle_model"] == name).to_numpy()
        model = RECIPES["fitted_physical"].fit(table[~new])
        lower, upper = model.predict_interval(table, 0.9)
        assert np.mean(((lower <= energy) & (energy <= upper))[~new]) == pytest.approx(0.9, abs=0.02)
        covered.append(np.mean(((lower <= energy) & (energy <= upper))[new]))
        scales = dict(model.interval.scales)
        alike = msgspec.structs.replace(model.interval, scales=scales | {ANY: min(scales.values())})
        lower, upper = alike.bounds(model.predict_energy(table), table, 0.9)
        as_others.append(np.mean(((lower <= energy) & (energy <= upper))[new]))
    assert np.mean(covered) > max(0.75, np.mean(as_others) + 0.1)
