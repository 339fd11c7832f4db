"""Test that the weights of vehicle models reproduce the weighted rows of the paper from its printed cells."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from socast.core.evaluate.paper import published
from socast.core.evaluate.paper.published import WEIGHTED, load_paper
from socast.core.evaluate.paper.results import weigh_vehicle_models

CLUSTERS = ("0-5", "5-10", "10-15", "15-20", "20-25")
KEYS = tuple(model.catalogue[0] for model in load_paper().vehicle_models.values())
RECIPES = tuple(table.recipe for table in load_paper().tables if table.recipe)
TOTALS = [published.get_ride_count(key, "total").value for key in KEYS]
REPEATS_T = 2.262
"""Quantile of Student's t at 97.5 % with 9 degrees of freedom, for the ten repeats of the paper."""


def cells():
    """Return cluster, cells of the vehicle models (None where absent) and weighted cell, for Tables 4 to 11."""
    figures = [published.get_test_consumption, *(lambda k, c, r=r: published.get_mae(r, k, c) for r in RECIPES)]
    return [(c, [figure(key, c) for key in KEYS], figure(WEIGHTED, c)) for figure in figures for c in CLUSTERS]


def last_digit(figure):
    """Return the unit of the last printed digit."""
    return 10.0 ** -len(figure.text.split(" ± ")[0].partition(".")[2])


def deviations(weights_of):
    """Return weighted mean of the printed cells less printed row, over half of the row's last digit."""
    found = []
    for cluster, row, weighted in cells():
        weights = weights_of(cluster, [each is not None for each in row])
        mean = np.average([0.0 if each is None else each.value for each in row], weights=weights)
        found.append((mean - weighted.value) / (0.5 * last_digit(weighted)))
    return np.array(found)


def by_rule(_cluster, known):
    return weigh_vehicle_models(TOTALS, known)


def by_cluster(cluster, known):
    return np.array([published.get_ride_count(key, cluster).value for key in KEYS]) * known


def by_total_in_proportion(_cluster, known):
    return np.array(TOTALS) * known


def test_weights_reproduce_printed_weighted_cells():
    exact = np.abs(deviations(by_rule)) <= 1.0
    assert len(exact) == 40
    assert exact.sum() == 33
    assert exact.mean() >= 0.7


def test_other_weights_reproduce_fewer_cells():
    assert (np.abs(deviations(by_cluster)) <= 1.0).sum() == 5
    assert (np.abs(deviations(lambda _, known: np.array(known, dtype=float))) <= 1.0).sum() == 7
    in_proportion = np.abs(deviations(by_total_in_proportion)) <= 1.0
    assert in_proportion.sum() == 25
    assert not in_proportion[[c == "20-25" for c, *_ in cells()]].any()


def test_remaining_differences_are_within_rounding_of_cells():
    for cluster, row, weighted in cells():
        known = [each is not None for each in row]
        weights = weigh_vehicle_models(TOTALS, known) / sum(TOTALS)
        mean = sum(w * each.value for w, each in zip(weights, row, strict=True) if each)
        rounding = sum(w * 0.5 * last_digit(each) for w, each in zip(weights, row, strict=True) if each)
        assert abs(mean - weighted.value) <= rounding + 0.5 * last_digit(weighted) + 1e-12, cluster


def test_printed_intervals_of_weighted_rows_are_spreads_of_all_rides_of_row():
    """The row's ± is 1.96 standard deviations of the mixture of its cells, so most of it is between vehicle models.

    The cells' ± is taken as Student's t times the standard deviation of ten repeats. The agreement is within 10 %.
    """
    for _, row, weighted in cells():
        known = [each is not None for each in row]
        weights = weigh_vehicle_models(TOTALS, known)[known] / sum(TOTALS)
        value, spread = np.array([(each.value, each.ci95 / REPEATS_T) for each in row if each]).T
        mean = weights @ value
        mixture = np.sqrt(weights @ (spread**2 + (value - mean) ** 2))
        assert weighted.ci95 == pytest.approx(1.96 * mixture, rel=0.11)


@given(st.lists(st.tuples(st.integers(1, 10**6), st.booleans()), min_size=1, max_size=6))
def test_weights_add_up_to_all_rides_whichever_are_absent(models):
    rides, known = zip(*models, strict=True)
    weights = weigh_vehicle_models(rides, known)
    assert weights.sum() == pytest.approx(sum(rides) if any(known) else 0.0)
    assert all((weight > 0.0) == present for weight, present in zip(weights, known, strict=True))
