"""Test the search for deviations in few cars and few days, where tests may have no date, sibling or candidate."""

import numpy as np
import pytest

from socast.core.diagnose.projection import BaseProjection
from socast.core.diagnose.siblings.deviations import diagnose_deviations
from socast.core.effects import get_library
from tests.support.synthetic_windows import gather_with_model, make_tables, make_windows


def diagnose_few(cars, days, *, growth=0.0, without=(), groups=None):
    """Return the deviations of few cars, of which one uses more energy from day to day."""
    table = make_windows(cars, days, max(3, -(-24 // (cars * days))), 8)
    day = table.groupby("vehicle_id")["date"].rank(method="dense") - 1.0
    unknown = growth * table["effect_rolling"] * table["rolling_resistance"] * day
    unknown = np.where(table["vehicle_id"] == "taxi-0", unknown, 0.0)
    windows, model = gather_with_model(make_tables(table, unknown=unknown))
    none_known = np.empty((len(windows.measured), 0))
    return diagnose_deviations(BaseProjection(windows, model), model, none_known, without, groups)


@pytest.mark.parametrize("growth", [0.0, 1.0 / 3.0])
@pytest.mark.parametrize(("cars", "days"), [(2, 5), (3, 3), (4, 2), (5, 4), (8, 1)])
def test_few_cars_and_days_give_a_result(cars, days, growth):
    """A change needs three shifts before and after a step, so that cars of few shifts have a ramp only, or none."""
    groups = {f"taxi-{car}": ("north", "south")[car % 2] for car in range(cars)}
    result = diagnose_few(cars, days, growth=growth, groups=groups)
    for one in result.deviations:
        assert np.isfinite([one.share, *one.share_ci95, one.q, one.evidence]).all()
        assert sum(cause.probability for cause in one.causes) >= 0.9


def test_diagnosis_without_any_candidate_finds_nothing():
    assert diagnose_few(2, 6, without=get_library()) == ([], [])
