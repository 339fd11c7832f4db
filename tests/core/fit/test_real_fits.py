"""Test fits of `road_load` to few and all rides of two real cars, each judged on other dates.

The bars are the errors of the best earlier fit of these tables: least squares on windows without priors, at commit
944c71d. `python -m tests.support.real_fits --before FOLDER` measures both. That fit had coefficients such as 2.2 for
`inertia_negative`, which no car has.
"""

import pytest

from socast.core.fit.recipes import fit_to_windows
from socast.core.models.plausibility import list_implausible
from tests.support.real_fits import DATA, RECIPE, evaluate_fits, load_tables

pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(not DATA.is_dir(), reason=f"the public data sets are not at {DATA}"),
]

FULL = "road_load_full"
BARS = {("ved", 30): 0.1195, ("ved", 60): 0.1025, ("ved", None): 0.0989, ("bmw-i3", None): 0.2817}
"""Error on other dates by car and number of rides. [kWh]"""


@pytest.mark.parametrize(("car", "count"), BARS)
def test_error_on_other_dates_is_no_larger_than_before_and_coefficients_are_plausible(car, count):
    found = evaluate_fits(car, count, RECIPE)
    assert found.error <= BARS[car, count]
    assert found.outside == {}


@pytest.mark.parametrize(("car", "count"), BARS)
def test_cold_tyres_and_motor_losses_lower_the_error_on_other_dates(car, count):
    plain, full = (evaluate_fits(car, count, recipe) for recipe in (RECIPE, FULL))
    assert full.error < plain.error
    assert full.outside == {}


@pytest.mark.parametrize("recipe", [RECIPE, FULL])
@pytest.mark.parametrize("car", ["ved", "bmw-i3"])
def test_slowing_and_braking_of_real_cars_are_within_their_ranges_and_not_at_a_limit(car, recipe):
    model = fit_to_windows(recipe, *load_tables(car), covariance=False)
    assert list_implausible(model) == {}
    for fitted in model.fits.values():
        assert fitted.converged
        assert not {term.name for term in model.terms} & set(fitted.limited)
