"""Splits: disjoint sets, the requested shares, and equal draws for equal seeds."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from socast.core.stats.splits import deal_halves, deal_names, split_by_date, split_by_ride, split_by_vehicle

STRATA = st.lists(st.tuples(st.sampled_from(["leaf", "soul", "s"]), st.integers(0, 6)), min_size=1, max_size=300)
CARS = st.lists(st.tuples(st.sampled_from(["leaf", "soul"]), st.integers(0, 7)), min_size=1, max_size=200)
DATES = st.lists(st.dates().map(str), min_size=1, max_size=200)


def covers_all_rides(split, n):
    return np.array_equal(np.sort(np.concatenate([split.train, split.test])), np.arange(n))


@given(STRATA, st.integers(0, 2**31))
def test_each_ride_is_in_one_set_and_each_stratum_has_its_share(strata, seed):
    kinds = np.array([f"{model}/{cluster}" for model, cluster in strata])
    for split in split_by_ride(strata, seed, repeats=3):
        assert covers_all_rides(split, len(strata))
        for kind in set(kinds):
            n = int(np.sum(kinds == kind))
            assert abs(np.sum(kinds[split.test] == kind) - 0.2 * n) <= 0.5


def test_another_vehicle_model_does_not_change_draws():
    leaf, soul = [("leaf", 0)] * 40, [("soul", 0)] * 70
    alone, together = split_by_ride(leaf, 3), split_by_ride(leaf + soul, 3)
    for one, two in zip(alone, together, strict=True):
        assert np.array_equal(one.test, two.test[two.test < len(leaf)])


def test_repeats_and_seeds_differ_and_equal_seeds_repeat_draws():
    strata = [("leaf", 0)] * 100
    one, same, other = split_by_ride(strata, 1), split_by_ride(strata, 1), split_by_ride(strata, 2)
    assert len(one) == 10
    assert len({tuple(split.test) for split in one + other}) == 20
    assert all(np.array_equal(a.test, b.test) for a, b in zip(one, same, strict=True))


def test_every_ride_is_drawn_equally_often():
    drawn = np.zeros(50)
    for split in split_by_ride([("leaf", 0)] * 50, seed=0, repeats=2000):
        drawn[split.test] += 1
    assert np.all(np.abs(drawn / 2000 - 0.2) < 5 * np.sqrt(0.2 * 0.8 / 2000))


@given(CARS, st.integers(0, 2**31))
def test_each_car_is_in_one_set_and_held_out_once(cars, seed):
    models, names = [m for m, _ in cars], [f"{m}-{i}" for m, i in cars]
    held = []
    for split in split_by_vehicle(models, names, seed):
        assert covers_all_rides(split, len(cars))
        out = {names[i] for i in split.test}
        assert not out & {names[i] for i in split.train}
        held += sorted(out)
    several = {n for m, n in zip(models, names, strict=True) if len({x for x in names if x.startswith(m)}) > 1}
    assert sorted(held) == sorted(several)


def test_tested_vehicle_models_are_also_trained_on():
    models = ["leaf"] * 12 + ["soul"] * 12
    cars = ["l1", "l2"] * 6 + ["s1"] * 12
    splits = split_by_vehicle(models, cars, seed=4)
    assert len(splits) == 2
    for split in splits:
        assert {models[i] for i in split.test} == {"leaf"}
        assert {models[i] for i in split.train} == {"leaf", "soul"}
    assert split_by_vehicle(["soul"] * 5, ["s1"] * 5, seed=4) == []


@given(DATES)
def test_as_few_last_dates_as_needed_are_held_out(dates):
    splits = split_by_date(dates)
    if len(set(dates)) == 1:
        assert splits == []
        return
    (split,) = splits
    assert covers_all_rides(split, len(dates))
    days = np.array(dates)
    first = min(days[split.test])
    assert max(days[split.train]) < first
    fewer = np.sum(days[split.test] > first)
    assert fewer < 0.2 * len(dates)


@pytest.mark.parametrize(("share", "tested"), [(0.2, 2), (0.5, 5), (0.99, 9)])
def test_share_of_dates_is_as_requested_and_never_all(share, tested):
    dates = [f"2018-01-{day:02}" for day in range(1, 11)]
    assert split_by_date(dates, share)[0].test.size == tested


@given(st.lists(st.text("abc", max_size=2), min_size=1, max_size=60), st.integers(1, 6), st.integers(0, 2**31))
def test_rows_of_a_name_share_a_fold_and_folds_have_nearly_equal_numbers_of_names(names, folds, seed):
    fold_of = dict(zip(names, deal_names(names, folds, [seed]).tolist(), strict=True))
    backwards = dict(zip(names[::-1], deal_names(names[::-1], folds, [seed]).tolist(), strict=True))
    count = np.bincount(list(fold_of.values()), minlength=min(folds, len(fold_of)))
    assert fold_of == backwards
    assert len(count) == min(folds, len(fold_of))
    assert count.max() - count.min() <= 1
    assert [fold_of[name] for name in names] == deal_names(names, folds, [seed]).tolist()


@given(st.integers(0, 60), st.integers(0, 2**31))
def test_one_of_two_neighbours_is_in_each_half(count, seed):
    first = deal_halves(count, seed)
    assert all(first[i] != first[i + 1] for i in range(0, count - 1, 2))
