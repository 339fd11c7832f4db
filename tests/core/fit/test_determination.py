"""Test which coefficients rides determine, and whether the drives that are named would determine the others."""

import numpy as np
import pytest

from socast.core.fit.determination import DETERMINED, MOST_DAYS, MOST_DRIVES
from socast.core.fit.recipes import WINDOW_RECIPES, get_recipe
from tests.support.synthetic_windows import make_tables, make_windows


def determine(windows, recipe="road_load_constant", **errors):
    """Return how far rides determine each term, by term."""
    _, found = get_recipe(recipe).determine(*make_tables(windows, **errors))
    return {each.name: each for each in found["*"]}


def level(windows, share):
    """Return windows with a share of their climbs."""
    climbs = [name for name in windows if name.startswith(("effect_climbing", "gained", "lost"))]
    return windows.assign(**{name: share * windows[name] for name in climbs})


@pytest.mark.parametrize(
    ("share", "drive", "drives", "missing"), [(1e-4, "over hills of 5 %", 1, ""), (0.0, "", None, "elevation")]
)
def test_climbing_on_level_roads_rests_on_its_prior_and_needs_hills_or_an_elevation(share, drive, drives, missing):
    found = determine(level(make_windows(1, 6, 3, 8), share))
    climbing = found["climbing"]
    assert climbing.sd_over_prior == pytest.approx(1.0, abs=1e-6)
    assert not climbing.determined
    assert climbing.days is None
    assert (climbing.drive, climbing.drives, climbing.missing) == (drive, drives, missing)
    assert not missing or not any("hills" in each.drive for each in found.values())


def test_more_days_determine_more():
    few, many = (determine(make_windows(1, days, 3, 6), noise=0.02) for days in (3, 40))
    assert all(many[name].sd_over_prior < few[name].sd_over_prior for name in few)
    assert sum(each.determined for each in many.values()) > sum(each.determined for each in few.values())


def test_as_many_days_as_are_named_do_determine():
    days = 4
    named = {
        name: each.days
        for name, each in determine(make_windows(1, days, 2, 6), noise=0.03, of_ride=0.01).items()
        if each.days is not None
    }
    assert named
    for name, more in named.items():
        later = determine(make_windows(1, days + more, 2, 6), noise=0.03, of_ride=0.01)[name]
        assert later.sd_over_prior < 1.25 * DETERMINED, name


@pytest.mark.parametrize("recipe", WINDOW_RECIPES)
def test_every_number_is_told_and_its_advice_is_within_bounds(recipe):
    found = determine(make_windows(2, 4, 2, 6), recipe, noise=0.02)
    terms = {term.name for term in get_recipe(recipe).terms} - {"accessories"}
    levels = set() if "constant" in recipe else {f"accessories: {each}" for each in ("standby", "heating", "cooling")}
    assert set(found) == terms | levels
    for each in found.values():
        assert 0.0 < each.sd_over_prior <= 1.0 + 1e-9
        assert each.determined == (each.sd_over_prior <= DETERMINED)
        assert each.days is None or 1 <= each.days <= MOST_DAYS
        assert each.drives is None or 1 <= each.drives <= MOST_DRIVES
        assert bool(each.drive) == (each.drives is not None)
        assert not (each.determined and (each.drive or each.days))


def test_model_is_the_one_that_fit_returns():
    tables = make_tables(make_windows(1, 6, 3, 6))
    recipe = get_recipe("road_load")
    model, found = recipe.determine(*tables)
    assert model == recipe.fit(*tables)
    assert set(found) == set(model.fits)


def test_whole_rides_determine_less_than_their_windows():
    rides, windows = make_tables(make_windows(1, 10, 3, 8))
    recipe = get_recipe("road_load_constant")
    by_windows, by_rides = (recipe.determine(rides, each)[1]["*"] for each in (windows, None))
    shares = [np.array([each.sd_over_prior for each in found]) for found in (by_windows, by_rides)]
    assert (shares[0] < shares[1]).mean() > 0.8
