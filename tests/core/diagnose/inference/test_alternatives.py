"""The products of alternatives are those of the whole covariance matrix; the evidence of one is an integral."""

from copy import copy
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from socast.core.diagnose.inference.alternatives import log_share_within, select_alternatives, weigh_alone
from socast.core.diagnose.inference.scopes import Family, Timing
from socast.core.diagnose.inference.window_model import WindowModel
from tests.support.random_columns import build_covariance, draw_columns


def make_families(columns):
    """Return an effect in all cars, one of two effects in one car, and one that grows in all cars."""
    days, of_car = np.arange(len(columns.start)), np.flatnonzero(columns.car_of_day == 1)
    always = Timing("always", np.ones(len(days)))
    half = Timing("always", np.full(len(of_car), 0.5))
    ramp = Timing("ramp", columns.start / columns.start.max(), columns.dates[0], columns.dates[0], 0.0)
    return [
        Family("headwind", "all", (0,), days, (always,), 0.1, 0.5, lowest=0.0),
        Family("taxi-1", "car", (1, 2), of_car, (half,), 0.01, 0.25, lowest=-1.0),
        Family("all", "all", (3,), days, (ramp,), 0.05, 0.25, lowest=-1.0),
    ]


@pytest.fixture(scope="module")
def model():
    return WindowModel(draw_columns(5, dates=5))


@pytest.fixture(scope="module")
def given(model):
    return select_alternatives(model, make_families(model.columns))


def test_products_are_those_of_the_whole_covariance(model, given):
    columns = np.column_stack([given.build_column(model.columns, at) for at in range(len(given.family))])
    weighed = np.linalg.solve(build_covariance(model), columns)
    assert sorted(given.family.tolist()) == [0, 1, 1, 2]
    np.testing.assert_allclose(given.own, columns.T @ weighed, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(given.match, weighed.T @ model.columns.residual, rtol=1e-8, atol=1e-8)


def list_keys(alternatives):
    """Return family, effect and place of each alternative."""
    return list(zip(*(getattr(alternatives, name).tolist() for name in ("family", "effect", "place")), strict=True))


def test_products_do_not_depend_on_what_is_known(model, given):
    """Alternatives are compared in the place of the known effects, which only decide which are compared."""
    known = model.add(given.build_column(model.columns, 1)[:, np.newaxis])
    beside = select_alternatives(known, make_families(model.columns))
    keys = list_keys(beside)
    order = [keys.index(key) for key in list_keys(given)]
    np.testing.assert_allclose(beside.own[np.ix_(order, order)], given.own, atol=1e-8)
    np.testing.assert_allclose(beside.match[order], given.match, atol=1e-8)


def test_known_effect_stays_among_the_alternatives_however_well_it_is_known(model, given):
    """An effect that the data determine precisely must be compared again, or others would take its place."""
    precise = copy(model)
    precise.variance = 1e-4 * model.variance
    known = precise.add(np.column_stack([given.build_column(model.columns, at) for at in range(len(given.family))]))
    again = select_alternatives(known, make_families(model.columns), given)
    assert set(list_keys(given)) <= set(list_keys(again))


def test_effect_that_a_base_term_imitates_is_not_identified(model):
    effects = model.columns.effects.copy()
    effects[:, 0] = model.columns.base[:, 0]
    columns = replace(model.columns, effects=effects)
    found = select_alternatives(WindowModel(columns), make_families(columns))
    assert 0 not in found.effect
    assert 0 not in found.identified


def test_prior_odds_of_a_family_are_shared_by_its_alternatives(given):
    chances = np.exp(given.log_odds)
    assert chances[given.family == 0].sum() == pytest.approx(0.1 / 0.9)
    assert chances[given.family == 1].sum() == pytest.approx(0.01 / 0.99)


@pytest.mark.parametrize("limits", [(-np.inf, np.inf), (0.0, 2.0), (-4.0, 4.0), (0.0, 0.5)])
@pytest.mark.parametrize(("own", "match"), [(4.0, 3.0), (9.0, -2.0), (0.0, 0.0), (30.0, 90.0)])
def test_evidence_of_one_alternative_is_the_integral_over_its_plausible_coefficients(own, match, limits):
    def density(b):
        return np.exp(match * b - 0.5 * own * b**2) * norm.pdf(b)

    low, high = np.clip(limits, -12.0, 12.0)
    whole, _ = quad(density, low, high)
    evidence = weigh_alone(np.array([own]), np.array([match]), limits)
    assert evidence[0] == pytest.approx(np.log(whole / (norm.cdf(high) - norm.cdf(low))), abs=1e-6)


def test_share_within_limits_keeps_its_digits_far_from_the_middle():
    assert log_share_within((30.0, 31.0)) == pytest.approx(norm.logsf(30.0), abs=1e-9)
    assert log_share_within((-31.0, -30.0)) == pytest.approx(norm.logcdf(-30.0), abs=1e-9)
