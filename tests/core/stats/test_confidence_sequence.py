"""The confidence sequence holds however often it is read, where an ordinary interval does not."""

from math import inf, isnan, log, sqrt

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from socast.core.stats.confidence_sequence import (
    EVERYWHERE,
    LEVEL,
    MIXTURE,
    ClusterMoments,
    MeanInterval,
    compute_reach,
)

LENGTH = 400
RUNS = 1500
MOST = 0.065
"""Share of runs that may miss at 95 %: 5 % and two and a half standard deviations of the share over so many runs. [1]
"""

CLUSTERS = st.lists(st.tuples(st.integers(1, 30), st.floats(-50.0, 50.0)), min_size=1, max_size=60)


def fill(clusters):
    sums = ClusterMoments()
    for size, total in clusters:
        sums.add(size, total)
    return sums


def normal_rides(rng):
    """Draw clusters of unequal size whose rides are independent."""
    size = rng.integers(1, 30, LENGTH)
    return size, 0.05 * size + rng.normal(0.0, 0.3 * np.sqrt(size)), np.full(LENGTH, 0.05)


def similar_rides(rng):
    """Draw vehicle-days whose rides share an error, with heavy tails."""
    size = rng.integers(1, 30, LENGTH)
    total = (0.05 + rng.normal(0.0, 0.2, LENGTH)) * size + 0.3 * np.sqrt(size) * rng.standard_t(4, LENGTH)
    return size, total, np.full(LENGTH, 0.05)


def seasons(rng):
    """Draw a gain that appears in winter and is larger for large cars, as is its noise."""
    size = rng.integers(1, 20, LENGTH)
    winter, large = np.arange(LENGTH) % 200 >= 100, rng.random(LENGTH) < 0.2
    mean = np.where(winter, 0.04, 0.0) * np.where(large, 3.0, 1.0)
    scale = np.where(winter, 0.2, 0.05) * np.where(large, 3.0, 1.0)
    return size, mean * size + scale * np.sqrt(size) * rng.standard_t(5, LENGTH), mean


def compute_miss_rate(draw, widths, seed=1):
    """Return the share of runs in which an interval misses the mean of the rides so far, at any time."""
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


@pytest.mark.parametrize("draw", [normal_rides, similar_rides, seasons], ids=lambda draw: draw.__name__)
def test_sequence_holds_however_often_it_is_read(draw):
    assert compute_miss_rate(draw, ALWAYS) <= MOST


def test_interval_for_one_reading_misses_when_read_often():
    assert compute_miss_rate(normal_rides, ONCE) > 0.3


def test_level_is_kept_for_several_models_together():
    assert (
        compute_miss_rate(
            normal_rides, np.array([compute_reach(t, 1.0 - (1.0 - LEVEL) / 5) for t in range(1, LENGTH + 1)])
        )
        <= 0.02
    )


def test_sequence_is_asymptotic_for_many_clusters():
    for t in (1_000, 100_000):
        spread = t * MIXTURE + 1
        published = sqrt(2 * spread / (t * t * MIXTURE) * log(sqrt(spread) / (1 - LEVEL)))
        assert compute_reach(t) == pytest.approx(published, rel=20.0 / t)


def test_reach_is_infinite_for_few_clusters_and_then_shrinks():
    widths = [compute_reach(t) for t in range(2000)]
    first = next(t for t, width in enumerate(widths) if width < inf)
    assert 10 < first < 20
    assert widths[:first] == [inf] * first
    assert all(a > b for a, b in zip(widths[first:], widths[first + 1 :], strict=False))
    assert compute_reach(50, 0.99) > compute_reach(50, 0.95)


@given(CLUSTERS)
def test_interval_holds_sample_mean_and_is_infinite_for_few_clusters(clusters):
    sums = fill(clusters)
    interval = sums.interval()
    slack = 1e-9 * (1.0 + abs(sums.mean))
    assert interval.lower - slack <= sums.mean <= interval.upper + slack
    assert sums.size == sum(size for size, _ in clusters)
    if len(clusters) < 13:
        assert interval == EVERYWHERE


@given(CLUSTERS, st.sampled_from([-4.0, -0.5, 2.0]))
def test_interval_scales_with_unit_and_sign(clusters, factor):
    one = fill(clusters).interval()
    other = fill([(size, factor * total) for size, total in clusters]).interval()
    scaled = sorted((factor * one.lower, factor * one.upper))
    assert list(other) == pytest.approx(scaled, rel=1e-6, abs=1e-6)


@given(st.lists(st.integers(1, 30), min_size=20, max_size=40), st.floats(-1.0, 1.0))
def test_constant_gain_gives_interval_of_zero_width(sizes, gain):
    assume(abs(gain) > 1e-3)
    interval = fill([(size, gain * size) for size in sizes]).interval()
    if interval != EVERYWHERE:
        assert list(interval) == pytest.approx([gain, gain], rel=1e-4)


def test_identical_models_give_interval_at_zero():
    assert fill([(7, 0.0)] * 50).interval() == MeanInterval(0.0, 0.0)


def test_no_clusters_give_infinite_interval():
    assert isnan(ClusterMoments().mean)
    assert ClusterMoments().interval() == EVERYWHERE


def test_restored_state_continues_sums():
    whole, half = fill([(3, 0.5), (4, -0.25)] * 10), fill([(3, 0.5), (4, -0.25)] * 5)
    again = ClusterMoments(half.state)
    for size, total in [(3, 0.5), (4, -0.25)] * 5:
        again.add(size, total)
    assert again.state == whole.state
    assert half.state != whole.state
