"""Test the comparison of two sets of rides: parts add up, and a planted effect remains unexplained."""

import pytest

from socast.core.evaluate.compare.datasets import compare_datasets
from socast.core.evaluate.compare.models import select_rides
from socast.core.models import EXTENDED_PHYSICAL
from tests.support.planted_rides import planted


def test_explained_and_unexplained_parts_add_up_to_difference():
    rides = planted(500)
    models = {"m": EXTENDED_PHYSICAL}
    cold, warm = (select_rides(rides[rides["winter"] == w], models) for w in (1, 0))
    result, turned = compare_datasets(warm, cold, models), compare_datasets(cold, warm, models)
    difference = result.models["m"]
    for side in ("first", "second", "difference"):
        value = lambda entry, side=side: getattr(entry, side).value  # noqa: E731 - short
        assert sum(map(value, difference.terms)) == pytest.approx(value(difference.explained))
        assert value(difference.explained) + value(difference.unexplained) == pytest.approx(value(result.consumption))
    assert result.consumption.difference.value == pytest.approx(-turned.consumption.difference.value)
    assert result.properties[0].name == "outside temperature"
    assert difference.terms[0].name == "accessories"
    n = [sum(counts) for counts in zip(*(e.n for e in difference.by["temperature"]), strict=True)]
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
        left = result.models["m"].unexplained.difference
        assert result.consumption.difference.value > 3.0  # it is winter, which the model knows of
        truth = (
            (factor - 1.0) * 100.0 * (rides["effect_rolling"] * rides["rolling_resistance"])[rides["winter"] == 1].sum()
        )
        truth /= rides.loc[rides["winter"] == 1, "distance_km"].sum()
        assert left.value == pytest.approx(truth, abs=left.ci95)
        assert (abs(left.value) > left.ci95) == (factor > 1.0)


def test_rides_in_both_datasets_are_counted():
    models = {"m": EXTENDED_PHYSICAL}
    rides = planted(60)
    result = compare_datasets(select_rides(rides[:40], models), select_rides(rides[20:], models), models)
    assert result.shared == 20
