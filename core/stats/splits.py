"""Splits of rides into training and test sets: by ride as in the paper, and by vehicle and by date for comparison.

A split by ride puts rides of the same car, on the same day, into both sets. The paper does this, and it favours models
that memorise a car or a day. A split by vehicle holds out whole cars; a split by date holds out the last dates.
"""

from collections.abc import Sequence
from typing import Final, NamedTuple
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

Positions = NDArray[np.int64]

TEST_SHARE: Final = 0.2
"""Share of the rides that is held out, section 5 of the paper. [1]"""
REPEATS: Final = 10
"""Number of random draws of the test rides, section 5 of the paper."""
FOLDS: Final = 5
"""Number of parts into which the cars of a vehicle model are dealt, so that about `TEST_SHARE` of them is held out at
once.
"""


def deal_folds(count: int, folds: int, seed: int | Sequence[int]) -> Positions:
    """Return the fold of each of some units, which are dealt at random into at most `folds` of nearly equal size.

    Examples
    --------
    >>> np.bincount(deal_folds(103, 5, seed=0)).tolist()
    [21, 21, 21, 20, 20]
    """
    return np.random.default_rng(seed).permutation(count) % min(folds, count)


def deal_names(names: Sequence[str], folds: int, seed: Sequence[int]) -> Positions:
    """Return the fold of each row; rows of a name share one, and the order of the rows changes nothing."""
    known, code = np.unique(np.asarray(names, dtype=str), return_inverse=True)
    return np.asarray(np.argsort(np.random.default_rng(seed).permutation(len(known))) % folds)[code]


def deal_halves(count: int, seed: int) -> NDArray[np.bool_]:
    """Return for each of ordered units whether it is in the first half; one of two neighbours is."""
    heads = np.random.default_rng(seed).random(count // 2 + 1) < 0.5
    return np.repeat(heads, 2)[:count] ^ (np.arange(count) % 2 == 1)


class Split(NamedTuple):
    """Hold the positions of training and test rides in the table; no ride is in both.

    Parameters
    ----------
    train, test : (n,) int64
        Positions, ascending.
    """

    train: Positions
    test: Positions


def split_by_ride(
    strata: Sequence[tuple[str, int]], seed: int, repeats: int = REPEATS, test_share: float = TEST_SHARE
) -> list[Split]:
    """Return splits drawn at random within each stratum, as in section 5 of the paper.

    Parameters
    ----------
    seed : int
        Seed of the draws. The draws of a stratum depend only on the seed, the repeat and the stratum, so another
        vehicle model in the table changes nothing.
    test_share : float
        Share of test rides, rounded to whole rides in each stratum: a stratum of one or two rides is only trained on.
        [1]

    Examples
    --------
    >>> [split.test.size for split in split_by_ride([("a", 0)] * 10 + [("b", 0)] * 5, seed=1, repeats=2)]
    [3, 3]
    """
    members: dict[tuple[str, int], list[int]] = {}
    for position, stratum in enumerate(strata):
        members.setdefault(stratum, []).append(position)
    splits = []
    for repeat in range(repeats):
        tested = np.zeros(len(strata), dtype=bool)
        for (name, cluster), rides in members.items():
            rng = np.random.default_rng([seed, repeat, crc32(name.encode()), cluster])
            tested[rng.permutation(rides)[: int(test_share * len(rides) + 0.5)]] = True
        splits.append(_split(tested))
    return splits


def split_by_vehicle(
    vehicle_models: Sequence[str], vehicles: Sequence[str], seed: int, folds: int = FOLDS
) -> list[Split]:
    """Return splits that hold out whole cars; over all splits each car is held out once.

    Parameters
    ----------
    folds : int
        Number of parts into which the cars of each vehicle model are dealt. A vehicle model with fewer cars is absent
        from some parts. A single car is never held out, as no ride of its vehicle model would remain for training.
    """
    models, cars = (np.asarray(names, dtype=str) for names in (vehicle_models, vehicles))
    fold = np.full(len(models), -1, dtype=np.int64)
    for model in np.unique(models).tolist():
        rows = models == model
        if len(set(cars[rows].tolist())) > 1:
            fold[rows] = deal_names(cars[rows], folds, [seed, crc32(model.encode())])
    return [_split(fold == i) for i in range(folds) if np.any(fold == i)]


def split_by_date(dates: Sequence[str], test_share: float = TEST_SHARE) -> list[Split]:
    """Return the one split that trains on the first dates and tests on the last.

    Parameters
    ----------
    test_share : float
        Least share of rides to hold out. As few last dates as reach it are held out, and never all dates. [1]
    """
    names, day, rides = np.unique(np.asarray(dates, dtype=str), return_inverse=True, return_counts=True)
    if len(names) < 2:
        return []
    later = np.cumsum(rides[::-1])[::-1]  # rides on that date or after it
    first = max(int(np.flatnonzero(later >= test_share * len(dates))[-1]), 1)
    return [_split(day >= first)]


def _split(tested: NDArray[np.bool_]) -> Split:
    """Return the split with the given test rides."""
    return Split(np.flatnonzero(~tested), np.flatnonzero(tested))
