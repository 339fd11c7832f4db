"""Splits: nothing on both sides, the shares that were asked for, and the same draws for the same seed."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from core.stats.splits import split_by_date, split_by_ride, split_by_vehicle

STRATA = st.lists(st.tuples(st.sampled_from(["leaf", "soul", "s"]), st.integers(0, 6)), min_size=1, max_size=300)
CARS = st.lists(st.tuples(st.sampled_from(["leaf", "soul"]), st.integers(0, 7)), min_size=1, max_size=200)
DATES = st.lists(st.dates().map(str), min_size=1, max_size=200)


def whole(split, n):
    return np.array_equal(np.sort(np.concatenate([split.train, split.test])), np.arange(n))


@given(STRATA, st.integers(0, 2**31))
def test_each_ride_is_on_one_side_and_each_stratum_has_its_share(strata, seed):
    kinds = np.array([f"{model}/{cluster}" for model, cluster in strata])
    for split in split_by_ride(strata, seed, repeats=3):
        assert whole(split, len(strata))
        for kind in set(kinds):
            n = int(np.sum(kinds == kind))
            assert abs(np.sum(kinds[split.test] == kind) - 0.2 * n) <= 0.5


def test_strata_are_drawn_apart_so_that_another_vehicle_model_changes_nothing():
    leaf, soul = [("leaf", 0)] * 40, [("soul", 0)] * 70
    alone, together = split_by_ride(leaf, 3), split_by_ride(leaf + soul, 3)
    for one, two in zip(alone, together, strict=True):
        assert np.array_equal(one.test, two.test[two.test < len(leaf)])


def test_repeats_and_seeds_differ_and_the_same_seed_does_not():
    strata = [("leaf", 0)] * 100
    one, same, other = split_by_ride(strata, 1), split_by_ride(strata, 1), split_by_ride(strata, 2)
    assert len(one) == 10
    assert len({tuple(split.test) for split in one + other}) == 20
    assert all(np.array_equal(a.test, b.test) for a, b in zip(one, same, strict=True))


def test_every_ride_is_drawn_as_often_as_any_other():
    drawn = np.zeros(50)
    for split in split_by_ride([("leaf", 0)] * 50, seed=0, repeats=2000):
        drawn[split.test] += 1
    assert np.all(np.abs(drawn / 2000 - 0.2) < 5 * np.sqrt(0.2 * 0.8 / 2000))


@given(CARS, st.integers(0, 2**31))
def test_a_car_is_on_one_side_and_held_out_once(cars, seed):
    models, names = [m for m, _ in cars], [f"{m}-{i}" for m, i in cars]
    held = []
    for split in split_by_vehicle(models, names, seed):
        assert whole(split, len(cars))
        out = {names[i] for i in split.test}
        assert not out & {names[i] for i in split.train}
        held += sorted(out)
    several = {n for m, n in zip(models, names, strict=True) if len({x for x in names if x.startswith(m)}) > 1}
    assert sorted(held) == sorted(several)


def test_a_vehicle_model_that_is_tested_is_also_trained_on():
    models = ["leaf"] * 12 + ["soul"] * 12
    cars = ["l1", "l2"] * 6 + ["s1"] * 12
    splits = split_by_vehicle(models, cars, seed=4)
    assert len(splits) == 2
    for split in splits:
        assert {models[i] for i in split.test} == {"leaf"}
        assert {models[i] for i in split.train} == {"leaf", "soul"}
    assert split_by_vehicle(["soul"] * 5, ["s1"] * 5, seed=4) == []


@given(DATES)
def test_the_last_dates_are_held_out_and_no_more_than_it_takes(dates):
    splits = split_by_date(dates)
    if len(set(dates)) == 1:
        assert splits == []
        return
    (split,) = splits
    assert whole(split, len(dates))
    days = np.array(dates)
    first = min(days[split.test])
    assert max(days[split.train]) < first
    fewer = np.sum(days[split.test] > first)
    assert fewer < 0.2 * len(dates)


@pytest.mark.parametrize(("share", "tested"), [(0.2, 2), (0.5, 5), (0.99, 9)])
def test_the_share_of_dates_is_the_one_asked_for_and_never_all(share, tested):
    dates = [f"2018-01-{day:02}" for day in range(1, 11)]
    assert split_by_date(dates, share)[0].test.size == tested
