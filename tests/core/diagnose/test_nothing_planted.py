"""Test that little is found where nothing is planted: no missing effect, and rarely a deviation."""

from functools import cache

import pytest

from socast.core.diagnose.deviations import describe_deviations, rank_cars
from socast.core.diagnose.projection import BaseProjection
from socast.core.diagnose.selection import select_missing
from socast.core.stats.evidence import ClusterSums
from tests.support.inferences import infer
from tests.support.synthetic_windows import make_tables, make_windows

pytestmark = pytest.mark.long

SEEDS = range(4)
GROUPS = {"taxi-0": "north", "taxi-1": "south", "taxi-2": "south", "taxi-3": "north"}


@cache
def infer_from_noise(seed, *, grouped):
    """Return windows without a planted effect, their model, and the inference, which both tests judge."""
    tables = make_tables(make_windows(), seed=seed, of_day=0.03, of_ride=0.003)
    return infer(tables, groups=GROUPS if grouped else None)


@pytest.mark.parametrize("seed", SEEDS)
def test_no_effect_is_named(seed):
    windows, model, found = infer_from_noise(seed, grouped=False)
    clusters = [ClusterSums(windows.day), ClusterSums(windows.date)]
    assert select_missing(BaseProjection(windows, model), found, clusters, 0, 0.0).effects == ()


@pytest.mark.parametrize("grouped", [False, True])
def test_deviations_are_rare(grouped):
    """A fleet has a false deviation with a probability of 0.1 at most, and two of four with one of 0.05."""
    inferences = [infer_from_noise(seed, grouped=grouped) for seed in SEEDS]
    assert sum(describe_deviations(windows, found, dated=True) != [] for windows, _, found in inferences) <= 1
    assert {len(rank_cars(found)) for *_, found in inferences} == {4}
