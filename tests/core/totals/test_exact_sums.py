"""Sums do not depend on the order or the grouping of what is added."""

from fractions import Fraction

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from socast.core.totals.exact_sums import ExactSums

VALUES = st.lists(st.floats(-1e25, 1e25), min_size=1, max_size=30)


def summed(values):
    sums = ExactSums(cells=(2, 3))
    for value in values:
        sums.add("cells", value, (1, 2))
    return sums


@given(values=VALUES, seed=st.integers(0, 99), count=st.integers(1, 4))
def test_any_order_and_any_groups_give_the_same_bits(values, seed, count):
    order = np.random.default_rng(seed).permutation(len(values))
    merged = ExactSums(cells=(2, 3))
    for part in range(count):
        merged.merge(summed([values[i] for i in order[part::count]]))
    assert merged.dump() == summed(values).dump()
    assert merged.get("cells").tobytes() == summed(values).get("cells").tobytes()


@given(values=VALUES)
def test_sums_are_as_exact_as_floats(values):
    exact = float(sum(map(Fraction, values)))
    assert abs(summed(values).get("cells")[1, 2] - exact) <= 4e-16 * abs(exact) + 1e-20


def test_what_is_not_finite_counts_as_nothing():
    assert not summed([np.nan, np.inf, -np.inf, 1e300]).get("cells").any()


def test_sums_are_restored():
    sums, again = summed([1.5, -0.1]), ExactSums(cells=(2, 3))
    again.load(sums.dump())
    assert again.dump() == sums.dump()
    sums.clear()
    assert not sums.get("cells").any()
