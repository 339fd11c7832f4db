"""Who trains and who is tested: by ride as the paper, and by vehicle and by date as honest companions.

A split by ride puts rides of the same car, on the same day, on both sides. That is what the paper does, and it is kind
to a model that learns a car or a day by heart. A split by vehicle holds out whole cars, a split by date the last dates.
"""

from collections.abc import Sequence
from typing import Final, NamedTuple
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

Positions = NDArray[np.int64]

TEST_SHARE: Final = 0.2
"""Share of the rides that is held out, section 5 of the paper."""
REPEATS: Final = 10
"""How often rides are drawn anew, section 5 of the paper."""
FOLDS: Final = 5
"""Into how many parts the cars of a vehicle model are dealt, so that about `TEST_SHARE` of them is held out at once."""


class Split(NamedTuple):
    """Rides to train on and rides to test on, as positions in the table; no ride is in both.

    Parameters
    ----------
    train, test : (n,) int64
        Ascending.
    """

    train: Positions
    test: Positions


def split_by_ride(
    strata: Sequence[tuple[str, int]], seed: int, repeats: int = REPEATS, test_share: float = TEST_SHARE
) -> list[Split]:
    """Return splits drawn at random within each stratum, as section 5 of the paper.

    Parameters
    ----------
    strata : sequence of (str, int)
        Of each ride: its vehicle model and its distance cluster.
    seed : int
        A stratum's draws depend on it, on the repeat and on the stratum alone: another vehicle model in the table
        changes nothing.
    repeats : int
    test_share : float
        Rounded to whole rides in each stratum, so that a stratum of one or two rides only trains.

    Examples
    --------
    >>> [split.test.size for split in by_ride([("a", 0)] * 10 + [("b", 0)] * 5, seed=1, repeats=2)]
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
    vehicle_models, vehicles : sequence of n str
        Of each ride: its vehicle model, and its car.
    seed : int
    folds : int
        Parts into which the cars of each vehicle model are dealt. Of a vehicle model with fewer cars some parts have
        none; one car alone is never held out, as nothing of its vehicle model would be left to train on.

    Returns
    -------
    list of Split
        Empty where no vehicle model has two cars.
    """
    cars: dict[str, set[str]] = {}
    for model, vehicle in zip(vehicle_models, vehicles, strict=True):
        cars.setdefault(model, set()).add(vehicle)
    fold_of: dict[tuple[str, str], int] = {}
    for model, names in cars.items():
        if len(names) > 1:
            rng = np.random.default_rng([seed, crc32(model.encode())])
            fold_of |= {(model, str(name)): i % folds for i, name in enumerate(rng.permutation(sorted(names)))}
    fold = np.array([fold_of.get(pair, -1) for pair in zip(vehicle_models, vehicles, strict=True)], dtype=np.int64)
    return [_split(fold == i) for i in range(folds) if np.any(fold == i)]


def split_by_date(dates: Sequence[str], test_share: float = TEST_SHARE) -> list[Split]:
    """Return the one split that trains on the first dates and tests on the last.

    Parameters
    ----------
    dates : sequence of n str
        Of each ride, ISO 8601.
    test_share : float
        As many last dates are held out as it takes to hold this share of the rides, and never all.

    Returns
    -------
    list of Split
        Empty where there is only one date.
    """
    names, day, rides = np.unique(np.asarray(dates, dtype=str), return_inverse=True, return_counts=True)
    if len(names) < 2:
        return []
    later = np.cumsum(rides[::-1])[::-1]  # rides on that date or after it
    first = max(int(np.flatnonzero(later >= test_share * len(dates))[-1]), 1)
    return [_split(day >= first)]


def _split(tested: NDArray[np.bool_]) -> Split:
    """Return the split of which the tested rides are known."""
    return Split(np.flatnonzero(~tested), np.flatnonzero(tested))
