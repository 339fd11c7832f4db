"""Find slices of the rides for which the bias of a model differs from that for the other rides, and describe them.

A slice is a conjunction of at most three conditions (`socast.core.diagnose.slices.predicates`). A beam search on one
half of the vehicle-days finds the slices whose bias is largest relative to its standard error. The other half confirms
them, and only its results are reported. Then the halves swap roles. The days of a vehicle are assigned to the halves in
pairs of neighbours, so that both halves contain every vehicle and season.

A slice is compared with the other rides by vehicle-days (`socast.core.diagnose.slices.contrast`). The confirming half
keeps the false discovery rate of Benjamini and Hochberg at half the level, so that both directions together keep it at
the level, whatever their dependence. Slices are ranked by the half that found them, because those ranked first by the
confirming half would look better there than they are.

References
----------
Benjamini and Hochberg, Journal of the Royal Statistical Society B 57 (1995) 289. Friedman and Fisher, Statistics and
Computing 9 (1999) 123, DOI 10.1023/A:1008894516817, "Bump Hunting in High-Dimensional Data". Herrera, Carmona,
González, del Jesus, Knowledge and Information Systems 29 (2011) 495, DOI 10.1007/s10115-010-0356-2: beam search for
subgroups.
"""

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.special import stdtr

from socast.core.batch import Floats, Ints
from socast.core.diagnose.records import SliceBias
from socast.core.diagnose.slices.contrast import compute_contrast
from socast.core.diagnose.slices.predicates import Masks, RideCondition, list_conditions, read_dates, read_start_s
from socast.core.fit.ride_blocks import get_names
from socast.core.records import make_interval
from socast.core.stats.multiple_testing import adjust_false_discovery
from socast.core.stats.scores import Estimate
from socast.core.stats.splits import deal_halves

LONGEST: Final = 3
"""Maximum number of conditions of a slice."""
LEAST_RIDES: Final = 8
"""Least number of rides of a half inside and outside a slice."""
BEAM: Final = 12
"""Number of slices that are extended in each step."""
CHILDREN: Final = 32
"""Number of extensions of each slice that are evaluated exactly."""
FINALISTS: Final = 60
"""Number of slices that are evaluated exactly on the residual of those chosen before."""
COST: Final = 0.75
"""Amount by which a further condition must raise the score. [1]"""
DISCOUNT: Final = 0.92
"""Factor by which a further condition reduces the score. [1]"""
LEAST_SCORE: Final = 2.0
"""Score below which a slice is not tested. [1]"""
SAME: Final = 0.6
"""Ratio of shared rides to the rides of either slice above which two slices count as one. [1]"""


class Half(NamedTuple):
    """Hold the rides of one half, ordered by vehicle-day.

    Parameters
    ----------
    masks : (c, n) bool
        Rides for which each condition holds.
    error : (n,) float
        Error of each ride. [kWh]
    starts : (days,) int64
        First ride of each vehicle-day.
    """

    masks: Masks
    error: Floats
    starts: Ints


class Slice(NamedTuple):
    """Hold a conjunction of conditions as it was found.

    Parameters
    ----------
    score : float
        Score less the penalty for the number of conditions. [1]
    sign : int
        Sign of the bias relative to the other rides.
    """

    conditions: tuple[int, ...]
    score: float
    sign: int


class ConfirmedSlice(NamedTuple):
    """Hold a slice, the half in which it was found, and its results in the other half."""

    candidate: Slice
    half: Half
    bias: SliceBias


def find_slices(
    rides: pd.DataFrame, error: Floats, *, seed: int = 0, most: int = 8, level: float = 0.05, dated: bool = True
) -> list[SliceBias]:
    """Return the slices of the rides for which the bias of a model differs, the most certain first.

    Parameters
    ----------
    rides : DataFrame
        n rows of the ride table. A condition does not hold for a ride for which its column is unknown.
    error : (n,) float
        Predicted less measured energy; rides with NaN are left out. [kWh]
    """
    error = np.asarray(error, dtype=np.float64)
    rides, error, day = _in_order(rides, error)
    known, masks = list_conditions(rides, dated=dated)
    if not known:
        return []
    first = deal_halves(int(day.max(initial=-1)) + 1, seed)[day]
    halves = _half(masks, error, day, first), _half(masks, error, day, ~first)
    confirmed: list[ConfirmedSlice] = []
    for one, other in (halves, halves[::-1]):
        confirmed += _confirm(search_slices(one, known, most), one, other, known, level / 2.0)
    confirmed.sort(key=lambda finding: -finding.candidate.score)
    return [each.bias for each in _select_distinct(confirmed, halves, known)[:most]]


def _in_order(rides: pd.DataFrame, error: Floats) -> tuple[pd.DataFrame, Floats, Ints]:
    """Return rides with a known error by vehicle, date and time, so that the order of the table does not matter."""
    kept = np.isfinite(error)
    rides, error = rides.loc[kept], error[kept]
    keys = pd.Series(get_names(rides, "vehicle_id"), dtype=object) + " " + pd.Series(read_dates(rides), dtype=object)
    day = pd.factorize(keys, sort=True)[0].astype(np.int64)
    order = np.lexsort((error, read_start_s(rides), day))
    return rides.iloc[order], error[order], day[order]


def _half(masks: Masks, error: Floats, day: Ints, kept: NDArray[np.bool_]) -> Half:
    """Return the rides of one half, with their masks and the first ride of each vehicle-day."""
    starts = np.flatnonzero(np.diff(day[kept], prepend=-1))
    return Half(masks[:, kept], error[kept], starts)


def search_slices(half: Half, known: Sequence[RideCondition], most: int) -> list[Slice]:
    """Return the slices of a half to test, the best first, each for the residual of those before it."""
    if min(len(half.error) // 2, len(half.starts)) < LEAST_RIDES:
        return []
    pool = _pool(half, known)
    masks = np.array([_mask(half.masks, each) for each in pool], dtype=np.bool_).reshape(len(pool), len(half.error))
    effort = _effort(pool, known)
    signs = np.sign(_plain_score(masks, half.error))
    allowed = np.ones(len(pool), dtype=np.bool_)
    chosen: list[Slice] = []
    taken: list[int] = []
    while allowed.any() and len(chosen) < most:
        left = _left(half.error, masks[taken])
        plain = np.where(allowed, signs * _plain_score(masks, left), -np.inf)
        near = np.argsort(-plain, kind="stable")[:FINALISTS]
        near = near[allowed[near]]
        score = _penalised(signs[near] * compute_contrast(masks[near], left, half.starts).score(), effort[near])
        if score.max() < LEAST_SCORE:
            break
        best = int(near[np.argmax(score)])
        chosen.append(Slice(pool[best], float(score.max()), int(signs[best])))
        taken.append(best)
        allowed &= _overlap(masks, masks[best]) < SAME
    return chosen


def _pool(half: Half, known: Sequence[RideCondition]) -> list[tuple[int, ...]]:
    """Return every slice that the beam search evaluates."""
    pool: list[tuple[int, ...]] = []
    longer: list[tuple[int, ...]] = [(i,) for i in range(len(known))]
    while longer:
        masks = np.array([_mask(half.masks, each) for each in longer])
        certain = np.abs(compute_contrast(masks, half.error, half.starts).score())
        score = _penalised(certain, _effort(longer, known))
        worth = np.argsort(-score, kind="stable")[: np.count_nonzero(score > 0.0)]
        # of two halves that one condition parts, the one that is off is the one to name
        fails = worth if len(longer[0]) > 1 else worth[_further(masks[worth], half.error)]
        pool += [longer[i] for i in fails]
        if len(longer[0]) == LONGEST:
            break
        parents = _beam(masks[worth], certain[worth], half.error)
        longer = _children([longer[worth[i]] for i in parents], masks[worth[parents]], half, known)
    return pool


def _beam(masks: Masks, score: Floats, error: Floats) -> list[int]:
    """Return the slices to extend, each the best for the residual of those before it."""
    plain = np.abs(_plain_score(masks, error))
    worth = np.divide(score, plain, out=np.zeros(len(score)), where=plain > 0.0).clip(0.0, 1.0)
    parents: list[int] = []
    while len(parents) < min(BEAM, len(masks)):
        left = _left(error, masks[parents])
        rank = worth * np.abs(_plain_score(masks, left))
        rank[parents] = -1.0
        parents.append(int(np.argmax(rank)))
    return parents


def _children(
    parents: Sequence[tuple[int, ...]], masks: Masks, half: Half, known: Sequence[RideCondition]
) -> list[tuple[int, ...]]:
    """Return slices with one more condition, for each parent those with the best approximate score."""
    error = (half.error - half.error.mean()).astype(np.float32)
    all_masks = half.masks.astype(np.float32)
    inside = masks.astype(np.float32)
    rides = inside @ all_masks.T
    total = (inside * error) @ all_masks.T
    score = _glance(rides, total, error)
    score[rides > 0.95 * inside.sum(axis=1, keepdims=True)] = 0.0  # hardly narrower
    children: dict[tuple[int, ...], None] = {}
    for row, parent in enumerate(parents):
        mine = {known[i].kind for i in parent}
        best = np.argsort(-np.abs(score[row]), kind="stable")[:CHILDREN]
        for i in best.tolist():
            if score[row, i] != 0.0 and known[i].kind not in mine:
                children[tuple(sorted((*parent, i)))] = None
    return list(children)


def _glance(rides: NDArray[np.float32], total: NDArray[np.float32], error: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the score of the difference of means as if rides were independent; 0 for slices that are too small."""
    n = len(error)
    outside = n - rides
    fair = (rides >= LEAST_RIDES) & (outside >= LEAST_RIDES)
    variance = float(np.var(error)) or 1.0
    safe, safe_out = np.maximum(rides, 1.0), np.maximum(outside, 1.0)
    difference = total / safe - (float(error.sum()) - total) / safe_out
    return np.where(fair, difference / np.sqrt(variance * (1.0 / safe + 1.0 / safe_out)), 0.0).astype(np.float32)


def _plain_score(masks: Masks, error: Floats) -> NDArray[np.float32]:
    """Return the score of the difference of means of k slices as if rides were independent, (k,)."""
    centred = (error - error.mean()).astype(np.float32)
    inside = masks.astype(np.float32)
    return _glance(inside.sum(axis=1), inside @ centred, centred)


def _mask(masks: Masks, conditions: Sequence[int]) -> NDArray[np.bool_]:
    """Return the rides for which all of some conditions hold."""
    return np.logical_and.reduce(masks[list(conditions)], axis=0)


def _further(masks: Masks, error: Floats) -> NDArray[np.bool_]:
    """Return which slices have a mean error at least as far from zero as that of the other rides."""
    total, rides = masks @ error, masks.sum(axis=1)
    return np.abs(total) * (len(error) - rides) >= np.abs(error.sum() - total) * rides


def _effort(slices: Sequence[tuple[int, ...]], known: Sequence[RideCondition]) -> Floats:
    """Return the effort of the conditions of slices, (k,)."""
    return np.array([sum(known[i].effort for i in each) for each in slices], dtype=np.float64)


def _penalised(score: Floats, effort: Floats) -> Floats:
    """Return scores less the penalty for further conditions."""
    return score * DISCOUNT ** (effort - 1.0) - COST * (effort - 1.0)


def _left(error: Floats, masks: Masks) -> Floats:
    """Return the error less the part that the means of slices explain, (n,). [kWh]"""
    columns = np.vstack([np.ones(len(error)), *masks])
    return error - np.linalg.lstsq(columns @ columns.T, columns @ error, rcond=None)[0] @ columns


def _jaccard(masks: Masks, mask: NDArray[np.bool_]) -> Floats:
    """Return the rides that slices share with another, over the rides of either, (k,)."""
    shared = np.count_nonzero(masks & mask, axis=1)
    return shared / np.maximum(np.count_nonzero(masks | mask, axis=1), 1)


def _overlap(masks: Masks, mask: NDArray[np.bool_]) -> Floats:
    """Return the overlap of slices with another slice or with its complement, whichever is larger, (k,)."""
    return np.maximum(_jaccard(masks, mask), _jaccard(masks, ~mask))


def _confirm(
    candidates: Sequence[Slice], one: Half, other: Half, known: Sequence[RideCondition], level: float
) -> list[ConfirmedSlice]:
    """Return the slices that were found in one half and are confirmed in the other, with their results there."""
    if not candidates:
        return []
    masks = np.array([_mask(other.masks, each.conditions) for each in candidates])
    contrast = compute_contrast(masks, other.error, other.starts)
    enough = (contrast.freedom > 0.0) & (masks.sum(axis=1) >= LEAST_RIDES)
    signed = np.array([each.sign for each in candidates]) * contrast.difference / contrast.error
    q = adjust_false_discovery(np.where(enough, stdtr(np.maximum(contrast.freedom, 1.0), -signed), 1.0))
    kept = []
    for i in np.flatnonzero(q <= level).tolist():
        estimate = Estimate(float(contrast.difference[i]), float(contrast.error[i]), float(contrast.freedom[i]))
        words = [known[place].words for place in candidates[i].conditions]
        bias = SliceBias(
            where=", ".join(words),
            conditions=words,
            rides=int(masks[i].sum()),
            bias_kwh=estimate.value,
            ci95=make_interval(*estimate.interval),
            mae_kwh=float(np.abs(other.error[masks[i]]).mean()),
            q=min(2.0 * float(q[i]), 1.0),
        )
        kept.append(ConfirmedSlice(candidates[i], one, bias))
    return kept


def _select_distinct(
    confirmed: Sequence[ConfirmedSlice], halves: Sequence[Half], known: Sequence[RideCondition]
) -> list[ConfirmedSlice]:
    """Return slices without those that equal an earlier one or that an earlier one explains."""
    kept: list[ConfirmedSlice] = []
    for each in confirmed:
        earlier = [other.candidate.conditions for other in kept]
        if earlier and max(_shared(each.candidate.conditions, other, halves) for other in earlier) >= SAME:
            continue
        left = _left(each.half.error, np.array([_mask(each.half.masks, other) for other in earlier]))
        mask = _mask(each.half.masks, each.candidate.conditions)[None, :]
        score = each.candidate.sign * compute_contrast(mask, left, each.half.starts).score()
        if _penalised(score, _effort([each.candidate.conditions], known))[0] >= LEAST_SCORE:
            kept.append(each)
    return kept


def _shared(one: Sequence[int], other: Sequence[int], halves: Sequence[Half]) -> float:
    """Return the overlap of two slices over both halves."""
    masks = [np.concatenate([_mask(half.masks, each) for half in halves]) for each in (one, other)]
    return float(_overlap(masks[0][None, :], masks[1])[0])
