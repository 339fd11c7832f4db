"""The confidence sequence: it holds however often one looks, where an ordinary interval does not."""

from math import inf, isnan, log, sqrt

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from core.stats.confidence_sequence import EVERYWHERE, LEVEL, MIXTURE, ClusterMoments, MeanInterval, compute_reach

LENGTH = 400
RUNS = 1500
MOST = 0.065
"""Share of runs that may miss at 95 %: that, and two and a half standard deviations of the share of so many runs."""

some = st.lists(st.tuples(st.integers(1, 30), st.floats(-50.0, 50.0)), min_size=1, max_size=60)


def filled(clusters):
    sums = ClusterMoments()
    for size, total in clusters:
        sums.add(size, total)
    return sums


def normal(rng):
    """Clusters of unequal size whose rides depend on nothing but themselves."""
    size = rng.integers(1, 30, LENGTH)
    return size, 0.05 * size + rng.normal(0.0, 0.3 * np.sqrt(size)), np.full(LENGTH, 0.05)


def alike(rng):
    """Rides of a vehicle-day that err together, with heavy tails beside."""
    size = rng.integers(1, 30, LENGTH)
    total = (0.05 + rng.normal(0.0, 0.2, LENGTH)) * size + 0.3 * np.sqrt(size) * rng.standard_t(4, LENGTH)
    return size, total, np.full(LENGTH, 0.05)


def seasons(rng):
    """A gain that comes with the winter, larger for large cars; so is the noise."""
    size = rng.integers(1, 20, LENGTH)
    winter, large = np.arange(LENGTH) % 200 >= 100, rng.random(LENGTH) < 0.2
    mean = np.where(winter, 0.04, 0.0) * np.where(large, 3.0, 1.0)
    scale = np.where(winter, 0.2, 0.05) * np.where(large, 3.0, 1.0)
    return size, mean * size + scale * np.sqrt(size) * rng.standard_t(5, LENGTH), mean


def missed(draw, widths, seed=1):
    """Return the share of runs in which an interval misses the mean of what was driven so far, at any time."""
    rng = np.random.default_rng(seed)
    t = np.arange(1, LENGTH + 1)
    misses = 0
    for _ in range(RUNS):
        size, total, mean = draw(rng)
        truth = np.cumsum(mean * size) / np.cumsum(size)
        n, s = np.cumsum(size) / t, np.cumsum(total) / t
        squares = [np.cumsum(a * b) / t for a, b in ((total, total), (size, total), (size, size))]
        variance = squares[0] - s * s - 2 * truth * (squares[1] - s * n) + truth**2 * (squares[2] - n * n)
        off, spread = np.abs(s - truth * n), np.sqrt(np.maximum(variance, 0.0))
        misses += np.any(off[SEEN] > widths[SEEN] * spread[SEEN])
    return misses / RUNS


ALWAYS = np.array([compute_reach(t) for t in range(1, LENGTH + 1)])
ONCE = 1.96 / np.sqrt(np.arange(1, LENGTH + 1))
SEEN = np.isfinite(ALWAYS)


@pytest.mark.parametrize("draw", [normal, alike, seasons], ids=lambda draw: draw.__name__)
def test_it_holds_however_often_one_looks(draw):
    assert missed(draw, ALWAYS) <= MOST


def test_an_interval_that_is_to_be_looked_at_once_does_not():
    assert missed(normal, ONCE) > 0.3


def test_a_level_is_kept_for_several_models_together():
    assert missed(normal, np.array([compute_reach(t, 1.0 - (1.0 - LEVEL) / 5) for t in range(1, LENGTH + 1)])) <= 0.02


def test_for_many_clusters_it_is_the_asymptotic_sequence():
    for t in (1_000, 100_000):
        spread = t * MIXTURE + 1
        published = sqrt(2 * spread / (t * t * MIXTURE) * log(sqrt(spread) / (1 - LEVEL)))
        assert compute_reach(t) == pytest.approx(published, rel=20.0 / t)


def test_it_shrinks_as_clusters_come_and_is_infinite_before_there_are_enough():
    widths = [compute_reach(t) for t in range(2000)]
    first = next(t for t, width in enumerate(widths) if width < inf)
    assert 10 < first < 20
    assert widths[:first] == [inf] * first
    assert all(a > b for a, b in zip(widths[first:], widths[first + 1 :], strict=False))
    assert compute_reach(50, 0.99) > compute_reach(50, 0.95)


@given(some)
def test_the_mean_is_within_and_too_few_tell_nothing(clusters):
    sums = filled(clusters)
    interval = sums.interval()
    slack = 1e-9 * (1.0 + abs(sums.mean))
    assert interval.lower - slack <= sums.mean <= interval.upper + slack
    assert sums.size == sum(size for size, _ in clusters)
    if len(clusters) < 13:
        assert interval == EVERYWHERE


@given(some, st.sampled_from([-4.0, -0.5, 2.0]))
def test_it_follows_a_change_of_unit_and_of_sign(clusters, factor):
    one = filled(clusters).interval()
    other = filled([(size, factor * total) for size, total in clusters]).interval()
    scaled = sorted((factor * one.lower, factor * one.upper))
    assert list(other) == pytest.approx(scaled, rel=1e-6, abs=1e-6)


@given(st.lists(st.integers(1, 30), min_size=20, max_size=40), st.floats(-1.0, 1.0))
def test_what_differs_by_the_same_in_every_ride_is_known_exactly(sizes, gain):
    assume(abs(gain) > 1e-3)
    interval = filled([(size, gain * size) for size in sizes]).interval()
    if interval != EVERYWHERE:
        assert list(interval) == pytest.approx([gain, gain], rel=1e-4)


def test_models_that_are_the_same_are_not_told_apart():
    assert filled([(7, 0.0)] * 50).interval() == MeanInterval(0.0, 0.0)


def test_nothing_is_known_of_nothing():
    assert isnan(ClusterMoments().mean)
    assert ClusterMoments().interval() == EVERYWHERE


def test_it_goes_on_from_its_state():
    whole, half = filled([(3, 0.5), (4, -0.25)] * 10), filled([(3, 0.5), (4, -0.25)] * 5)
    again = ClusterMoments(half.state)
    for size, total in [(3, 0.5), (4, -0.25)] * 5:
        again.add(size, total)
    assert again.state == whole.state
    assert half.state != whole.state
