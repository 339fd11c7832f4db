"""Test that priors state what effects declare, relative to the figures of the cars."""

import numpy as np
import pandas as pd
import pytest

from socast.core import effects
from socast.core.columns import ZERO_CELSIUS
from socast.core.effects import ROAD_LOAD
from socast.core.effects.declaration import Expectation
from socast.core.errors import EffectError
from socast.core.fit.accessory_curve import build_curve, compute_curve_columns, flatten_curve
from socast.core.fit.priors import build_curve_prior, build_prior, find_curve_limits, find_limits
from socast.core.fit.recipes import ROAD_LOAD_TERMS, make_term
from socast.core.models import Term
from socast.core.models.features import Columns
from socast.core.vehicles import ACCESSORIES

TABLE = Columns(pd.DataFrame({"rolling_resistance": [0.008, 0.010], "drag_area_m2": [0.7, 0.7], "effect_standby": 1.0}))


def expect(*columns: str) -> tuple[float, float]:
    prior = build_prior([Term(name="x", columns=columns, unit="1")], TABLE, 2)
    return float(prior.mean[0]), float(np.sqrt(prior.covariance[0, 0]))


def test_every_effect_of_the_road_load_declares_a_cited_expectation_within_its_range():
    for effect in ROAD_LOAD:
        assert effect.expected is not None, effect.name
        assert effect.expected.source
        figure = {"rolling_resistance": 0.008, "drag_area_m2": 0.7}.get(effect.expected.of, 1.0)
        assert effect.low < effect.expected.mean * figure < effect.high, effect.name


def test_expectation_relative_to_a_figure_of_the_car_is_that_of_the_term_with_the_figure():
    declared = effects.get("rolling").expected
    assert expect("effect_rolling", "rolling_resistance") == pytest.approx((declared.mean, declared.sd))
    assert expect("effect_rolling") == pytest.approx((declared.mean * 0.009, declared.sd * 0.009))


def test_plausible_range_stands_for_a_missing_expectation():
    standby = effects.get("standby")
    assert standby.expected is None
    middle, half = (standby.low + standby.high) / 2.0, (standby.high - standby.low) / 2.0
    assert expect("effect_standby") == pytest.approx((middle, half))
    assert expect("effect_standby", "vehicle=taxi-1") == pytest.approx((middle, half))


def test_term_without_an_effect_has_a_weak_prior_about_zero():
    mean, sd = expect("rolling_resistance")
    assert mean == 0.0
    assert sd > 50.0


def test_limits_are_plausible_ranges():
    low, high = find_limits((*ROAD_LOAD_TERMS, make_term("rolling_resistance")), TABLE)
    assert low[0] == pytest.approx(0.004 / 0.009)
    assert (low[-1], high[-1]) == (-np.inf, np.inf)


def test_curve_of_numbers_is_the_curve():
    assert build_curve(flatten_curve(ACCESSORIES)) == ACCESSORIES
    assert build_curve(build_curve_prior().mean) == ACCESSORIES


def test_limits_of_the_curve_keep_choke_points_apart():
    low, high = find_curve_limits()
    assert (low < high).all()
    assert (low[4:] - high[3:-1] >= 0.4).all()


def test_curve_columns_are_derivatives():
    ambient = np.array([-25.0, -5.0, 15.0, 25.0, 40.0])
    numbers = flatten_curve(ACCESSORIES)
    columns = compute_curve_columns(ACCESSORIES, ambient)
    for i in range(len(numbers)):
        step = np.where(np.arange(len(numbers)) == i, 1e-4, 0.0)
        up, down = (build_curve(numbers + sign * step).power(ambient + ZERO_CELSIUS) for sign in (1.0, -1.0))
        np.testing.assert_allclose(columns[:, i], (up - down) / 2e-4, atol=1e-5)


@pytest.mark.parametrize("values", [(np.nan, 1.0, "x"), (1.0, 0.0, "x"), (1.0, 0.1, " ")])
def test_expectation_that_is_no_cited_gaussian_is_refused(values):
    with pytest.raises(EffectError, match="expected coefficient"):
        Expectation(*values)
