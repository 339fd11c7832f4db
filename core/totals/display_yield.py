"""Learn how much energy the display of each car stands for: usable energy per percent, and its curve over the charge.

The display shows a state of charge s. The battery delivers energy in proportion to

    g(s) = s + b (s^2 - s),

where b is the curve of the display: with b > 0 a percent holds more energy near full charge. A ride that uses the
energy E, by voltage and current, lowers g by k E. The usable capacity is 1/k. In the reported fall of the charge,

    s_1 - s_2 = k E - b D + noise,    D = (s_1^2 - s_1) - (s_2^2 - s_2),

k and b are linear, and the noise is that of the display, because voltage times current is far more precise. The bend
is D = (s_1 - s_2) (s_1 + s_2 - 1). Its first factor has the same noise as the fall, which would bias b, so that of the
energy takes its place: D = k E (s_1 + s_2 - 1) with the k so far. The
standard deviation of the noise is one of `READING_SDS`. For each of them, every ride updates k and b by Bayesian linear
regression in information form, and its probability. The yield is the mean of this mixture. The weight of a ride
decreases with its age, and with its residual beyond `OUTLIER_SDS` (Huber).

The prior of k is that of the vehicle model: the capacity of the catalogue, times a factor that is pooled over all cars
of the model (random effects with known spread). The pooled factor excludes the car itself, and takes effect with the
daily update, so that no result depends on the order of different cars.

References
----------
Gelman et al., Bayesian Data Analysis, 3rd edition, sections 5.4 (hierarchical normal model) and 14.8 (informative
priors in regression), ISBN 978-1-4398-4095-5. Huber, Annals of Mathematical Statistics 35 (1964) 73,
DOI 10.1214/aoms/1177703732.
"""

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from socast.core.batch import Floats, Ints, grown, take_lanes
from socast.core.totals.accumulator import Sums, Totals
from socast.core.totals.display_record import create_unknown_yields
from socast.core.totals.measured_energy import (
    METER_GAIN,
    RIDE_SD,
    find_inverted,
    find_quantum,
    find_soc_faults,
    is_only_stale,
    measure_by_power,
    measure_by_soc,
)
from socast.core.vehicles.fleet import Cars

MODEL_SD: Final = 0.25
"""Standard deviation of the usable capacity of a vehicle model over that of the catalogue. [1]

Estimated: it covers what a manufacturer calls full and the age of a fleet. Two public cars have 0.65 (a Leaf of 2013
after five years, arXiv:1905.02081) and 1.03 (a new BMW i3, DOI 10.21227/6jr9-5235)."""
CAR_SD: Final = 0.08
"""Standard deviation of the usable capacity of the cars of one vehicle model, relative to their mean. [1]

Estimated: capacity fades by some 2 % a year, and the cars of a fleet are of different years."""
CURVE_SD: Final = 0.1
"""Standard deviation of the curve b before any data. [1]

Estimated: the percent of a full battery holds up to 20 % more or less than that of an empty one."""
LARGEST_CURVE: Final = 0.5
"""Largest curve: a percent of a full battery holds three times as much as one of an empty one. [1]"""
READING_SDS: Final = 0.001 * 2.0 ** np.arange(6)
"""Standard deviations that the noise of a fall of the charge beyond its quantum may have. [1]

Before any data their probabilities are proportional to 1/sd, so the mean variance is that of a noise of 0.006. The
public BMW i3 has 0.002, a Leaf of 2013 whose display corrects itself has 0.015 (sources as above)."""
MEMORY: Final = 100.0
"""Number of rides after which the weight of a ride has decreased to 1/e: capacity changes with season and age."""
OUTLIER_SDS: Final = 2.0
"""Residual from which the weight of a ride decreases. [standard deviations]"""
STILL_SDS: Final = 3.0
"""A charge that did not move although it should have by more than this says nothing. [standard deviations]"""
LARGEST_SCORE: Final = 4.0
"""Residual beyond which a ride says nothing more of the noise of the display. [standard deviations]"""
CONTRADICTION_SDS: Final = 8.0
"""Difference at which V·I, and a charge without faults, contradict each other. [standard uncertainties of both]

Estimated: displays that correct themselves reach 6 in a hundred rides (the Leaf). The known fault, drive B02 of the
BMW i3, has 11 (sources as above)."""
SPREAD_RIDES: Final = 4.0
"""Number of rides from which the spread of the yields of a car is known well enough to state a contradiction."""
RELEARN_AFTER: Final = 3
"""Number of rides in a row that contradict what was learned of a car, after which it is forgotten."""
FULL: Final = 1.0 - 1e-9
"""A display that shows this charge may be clipped. [1]"""

_LEVELS: Final = len(READING_SDS)
LANE_YIELD: Final = np.dtype(
    [
        ("info_kk", "f8", (_LEVELS,)),  # information matrix of (k, b), for each of `READING_SDS` [kWh^2]
        ("info_kb", "f8", (_LEVELS,)),  # [kWh]
        ("info_bb", "f8", (_LEVELS,)),  # [1]
        ("score_k", "f8", (_LEVELS,)),  # information matrix times estimate [kWh]
        ("score_b", "f8", (_LEVELS,)),  # [1]
        ("likelihood", "f8", (_LEVELS,)),  # logarithm
        ("rides", "f8"),  # sum of the weights of the rides by age
        ("contradictions", "f8"),  # rides in a row that contradicted what was learned
        ("pooled_model", "f8"),  # code of the vehicle model to which these two contributed
        ("pooled_weight", "f8"),  # weight of the car in the factor of its model
        ("pooled_sum", "f8"),  # weight times factor
    ]
)
"""What is learned of the car in a lane."""
_LEARNED: Final = LANE_YIELD.names[:8]  # type: ignore[index]
"""Fields of a lane that are forgotten when its display has changed."""
_NO_LANES: Final = np.zeros(0, LANE_YIELD)


class _Posterior(NamedTuple):
    """Normal distributions of (k, b), for each of `READING_SDS`, and their probabilities: each (n, levels) float."""

    k: Floats
    b: Floats
    variance_k: Floats
    covariance: Floats
    variance_b: Floats
    probability: Floats


class DisplayYields:
    """Learn the yield of the display of every car from its closed rides, and attach it to totals.

    Parameters
    ----------
    cars : Cars
        Source of the vehicle models and of the catalogue's capacities.
    """

    def __init__(self, cars: Cars) -> None:
        self._cars = cars
        self._lanes: NDArray[Any] = _NO_LANES
        self._codes: dict[str, int] = {}
        self._pooled: Floats = np.zeros((0, 2))  # weight, and weight times factor, of each vehicle model
        self._forgotten: Floats = np.zeros((0, 2))  # the part of it that comes from cars that are forgotten
        self._code_of_kind: Ints = np.zeros(0, np.int64)
        self._yields = create_unknown_yields(0)  # of each lane, for a car of the kind that follows
        self._kind: Ints = np.zeros(0, np.int64)  # -1 where the yield must be computed anew

    def attach(self, sums: Sums, lanes: int) -> Sums:
        """Return totals with the yields that were known when each row closed, and learn from the closed rides.

        Returns
        -------
        Sums
            The same totals with their field `display`. A ride has the yield before it; its last window, too.
        """
        self._grow(lanes)  # also for a car that has sent nothing to sum: a state has a row for each car
        if not any(len(part.lane) for part in sums):
            return sums
        parts = [self.describe(part, lanes) for part in sums]
        rides = parts[0]
        waiting = np.arange(len(rides.lane))
        while len(waiting):  # each turn takes the next ride of every lane
            _, first = np.unique(rides.lane[waiting], return_index=True)
            turn, waiting = waiting[first], np.delete(waiting, first)
            learned, rides.display["contradicted"][turn] = self._learn(rides.rows(turn))
            closed = turn[learned]
            self._kind[rides.lane[closed]] = -1
            for number, part in enumerate(parts):
                running = number == len(parts) - 1  # a due row after which a ride closed is not part of that ride
                later = _find_later(part, rides.lane[closed], rides.at[closed] - running)
                part.display[later] = self._find_yields(part.lane[later], part.kinds[later])
        return Sums(*parts)

    def describe(self, totals: Totals, lanes: int) -> Totals:
        """Return totals with the present yields of their cars."""
        if not len(totals.lane):
            return totals
        self._grow(lanes)
        return totals._replace(display=self._find_yields(totals.lane, totals.kinds))

    def apply_daily_update(self, kind_of_lane: Ints | None = None) -> None:
        """Pool what was learned of the cars of each vehicle model."""
        kind_of_lane = self._cars.of_lane if kind_of_lane is None else kind_of_lane
        lanes = min(len(self._lanes), len(kind_of_lane))
        self._grow(lanes)
        known = self._lanes[:lanes]
        code, weight, total = self._weigh(known, kind_of_lane[:lanes])
        known["pooled_model"], known["pooled_weight"], known["pooled_sum"] = code, weight, total
        self._kind[:] = -1
        self._pooled[:] = self._forgotten
        usable = code >= 0
        np.add.at(self._pooled, code[usable], np.column_stack([weight, total])[usable])

    def _weigh(self, known: NDArray[Any], kinds: Ints) -> tuple[Ints, Floats, Floats]:
        """Return the model of cars, -1 where nothing is known, their weights in its factor, and weight times factor."""
        catalogue = self._cars.capacity[kinds]
        share = _probabilities(known["likelihood"])
        kk, kb, bb, score_k, score_b = ((share * known[name]).sum(axis=1) for name in _LEARNED[:5])
        shrunk = bb + 1.0 / CURVE_SD**2
        information, score = (kk - kb**2 / shrunk) / catalogue**2, (score_k - kb * score_b / shrunk) / catalogue
        usable = (information > 0.0) & np.isfinite(catalogue)  # a comparison with NaN is false
        weight = np.where(usable, 1.0 / (CAR_SD**2 + 1.0 / np.where(usable, information, 1.0)), 0.0)
        factor = np.where(usable, score / np.where(usable, information, 1.0), 0.0)
        return np.where(usable, self._code_of_kind[kinds], -1), weight, weight * factor

    def keep(self, lanes: Ints) -> None:
        """Keep the state of some lanes only, in their order."""
        forgotten = np.delete(self._lanes, lanes[lanes < len(self._lanes)])
        forgotten = forgotten[forgotten["pooled_weight"] > 0.0]  # what they taught of their models remains
        parts = np.column_stack([forgotten["pooled_weight"], forgotten["pooled_sum"]])
        np.add.at(self._forgotten, forgotten["pooled_model"].astype(np.int64), parts)
        self._lanes, self._yields = take_lanes(self._lanes, lanes), take_lanes(self._yields, lanes)
        self._kind = take_lanes(self._kind, lanes)

    def dump(self) -> Any:
        """Return the state as plain values."""
        pooled = (each.tolist() for each in (self._pooled, self._forgotten))
        return self._lanes.tobytes(), list(self._codes), *pooled

    def load(self, state: Any) -> None:
        """Replace the state by one that `dump` returned."""
        lanes, names, pooled, forgotten = state
        self._lanes = np.frombuffer(lanes, LANE_YIELD).copy()
        self._codes = {name: code for code, name in enumerate(names)}
        self._pooled = np.array(pooled, dtype=np.float64).reshape(-1, 2)
        self._forgotten = np.array(forgotten, dtype=np.float64).reshape(-1, 2)
        self._code_of_kind = np.zeros(0, np.int64)
        self._yields, self._kind = create_unknown_yields(len(self._lanes)), np.full(len(self._lanes), -1)

    def _grow(self, lanes: int) -> None:
        """Make room for lanes, and for the kinds of car that have become known."""
        if len(self._lanes) < lanes:
            added = lanes - len(self._lanes)
            self._lanes = np.concatenate([self._lanes, np.zeros(added, LANE_YIELD)])
            self._lanes["pooled_model"][-added:] = -1.0
            self._yields = np.concatenate([self._yields, create_unknown_yields(added)])
            self._kind = np.concatenate([self._kind, np.full(added, -1)])
        if len(self._code_of_kind) < len(self._cars.models):
            names = [self._cars.name(kind) or "" for kind in range(len(self._cars.models))]
            codes = [self._codes.setdefault(name, len(self._codes)) for name in names]
            self._code_of_kind = np.array(codes, np.int64)
            self._pooled = grown(self._pooled, len(self._codes), 0.0)
            self._forgotten = grown(self._forgotten, len(self._pooled), 0.0)

    def _find_yields(self, lanes: Ints, kinds: Ints) -> NDArray[Any]:
        """Return the present yields of cars in lanes, (n,) DISPLAY_YIELD."""
        out = self._yields.take(lanes)
        anew = np.flatnonzero(self._kind[lanes] != kinds)
        if len(anew):
            out[anew] = self._compute_yields(lanes[anew], kinds[anew])
            self._yields[lanes[anew]], self._kind[lanes[anew]] = out[anew], kinds[anew]
        return out

    def _compute_yields(self, lanes: Ints, kinds: Ints) -> NDArray[Any]:
        """Return the yields of cars, by what was learned of them and of their vehicle models."""
        each = self._infer(self._lanes[lanes], kinds)
        out = create_unknown_yields(len(lanes))
        p = each.probability
        out["inverse"] = (p * each.k).sum(axis=1)
        out["curve"] = np.clip((p * each.b).sum(axis=1), -LARGEST_CURVE, LARGEST_CURVE)
        off_k, off_b = each.k - out["inverse"][:, np.newaxis], each.b - out["curve"][:, np.newaxis]
        out["inverse_variance"] = (p * (each.variance_k + off_k**2)).sum(axis=1)
        out["covariance"] = (p * (each.covariance + off_k * off_b)).sum(axis=1)
        out["curve_variance"] = (p * (each.variance_b + off_b**2)).sum(axis=1)
        out["reading_variance"] = (p * READING_SDS**2).sum(axis=1)
        return out

    def _infer(self, known: NDArray[Any], kinds: Ints) -> _Posterior:
        """Return the distributions of the yields of cars, by what was learned of them and of their vehicle models."""
        k, variance = (column[:, np.newaxis] for column in self._find_prior(known, kinds))
        kk, kb, bb = known["info_kk"] + 1.0 / variance, known["info_kb"], known["info_bb"] + 1.0 / CURVE_SD**2
        score_k, score_b = known["score_k"] + k / variance, known["score_b"]
        determinant = kk * bb - kb**2
        return _Posterior(
            k=(bb * score_k - kb * score_b) / determinant,
            b=(kk * score_b - kb * score_k) / determinant,
            variance_k=bb / determinant,
            covariance=-kb / determinant,
            variance_b=kk / determinant,
            probability=_probabilities(known["likelihood"]),
        )

    def _find_prior(self, known: NDArray[Any], kinds: Ints) -> tuple[Floats, Floats]:
        """Return mean and variance of k before the data of the car itself. [1/kWh], [1/kWh^2]"""
        code = self._code_of_kind[kinds]
        weight, total = self._pooled[code].T
        itself = (known["pooled_weight"] > 0.0) & (known["pooled_model"] == code)
        others = weight - np.where(itself, known["pooled_weight"], 0.0)
        precision = others + 1.0 / MODEL_SD**2
        factor = (total - np.where(itself, known["pooled_sum"], 0.0) + 1.0 / MODEL_SD**2) / precision
        catalogue = self._cars.capacity[kinds]
        return factor / catalogue, (CAR_SD**2 + 1.0 / precision) / catalogue**2

    def _learn(self, rides: Totals) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Learn from rides of different cars that have closed; return which were used, and whose meters contradict."""
        energy, _ = measure_by_power(rides, self._cars)
        first, last, inverse = rides.at_first("soc"), rides.at_last("soc"), rides.display["inverse"]
        known = ~np.isnan(energy + first + last + inverse) & (first < FULL) & ~find_inverted(rides)
        used = known & ~find_soc_faults(rides, self._cars) & ~_is_still(rides, energy)
        contradicted = known & is_only_stale(rides)
        contradicted &= find_contradictions(rides, self._lanes["rides"][rides.lane], self._cars)
        if used.any():
            contradicted[used] = self._learn_healthy(rides.rows(np.flatnonzero(used)))
        return used, contradicted

    def _learn_healthy(self, rides: Totals) -> NDArray[np.bool_]:
        """Learn from rides whose meters are known and healthy; return where they contradict each other."""
        energy, sd = measure_by_power(rides, self._cars)
        first, last = rides.at_first("soc"), rides.at_last("soc")
        known = self._lanes[rides.lane]
        each = self._infer(known, rides.kinds)
        mean = (each.k * each.probability).sum(axis=1)
        fall, bend = first - last, mean * energy * (first + last - 1.0)
        of_ride = find_quantum(rides) ** 2 / 6.0 + mean**2 * (sd**2 - (METER_GAIN * energy) ** 2)
        of_ride += (RIDE_SD * mean * energy) ** 2
        contradicted = find_contradictions(rides, known["rides"], self._cars)
        energy, fall, bend, of_ride = (column[:, np.newaxis] for column in (energy, fall, bend, of_ride))
        noise = of_ride + READING_SDS**2
        variance = (
            energy**2 * each.variance_k - 2.0 * energy * bend * each.covariance + bend**2 * each.variance_b + noise
        )
        score = np.abs(fall - each.k * energy + each.b * bend) / np.sqrt(variance)
        new = _update(known, energy, fall, bend, noise, score, variance)
        new[contradicted] = _contradict(known[contradicted], new[contradicted])
        self._lanes[rides.lane] = new
        return contradicted


def _is_still(rides: Totals, energy: Floats) -> NDArray[np.bool_]:
    """Return where the charge stayed the same, but by the energy [kWh] and the display so far it should have fallen.

    Such a display may be frozen, also where no ride is long enough to tell: it teaches nothing until it moves.
    """
    least = find_quantum(rides) + STILL_SDS * np.sqrt(rides.display["reading_variance"])
    still = rides.at_first("soc") == rides.at_last("soc")
    return np.asarray(still & (np.abs(energy) * rides.display["inverse"] > least))


def find_contradictions(rides: Totals, learned: Floats, cars: Cars) -> NDArray[np.bool_]:
    """Return where V·I and the state of charge contradict each other, whatever part of a stale fall is from before."""
    (energy, sd), (by_soc, soc_sd) = measure_by_power(rides, cars), measure_by_soc(rides)
    before = rides.amount("stale_fall") / rides.display["inverse"]
    excess = by_soc - energy
    excess = excess - np.clip(excess, np.minimum(before, 0.0), np.maximum(before, 0.0))
    return np.asarray((np.abs(excess) > CONTRADICTION_SDS * np.hypot(sd, soc_sd)) & (learned > SPREAD_RIDES))


def _find_later(part: Totals, lanes: Ints, at: Ints) -> Ints:
    """Return the rows of a part that are later than the place `at` of their lane; `lanes` are sorted."""
    if not len(lanes):
        return lanes
    found = np.minimum(np.searchsorted(lanes, part.lane), len(lanes) - 1)
    return np.flatnonzero((lanes[found] == part.lane) & (part.at > at[found]))


def _probabilities(likelihood: Floats) -> Floats:
    """Return the probability of each of `READING_SDS` by its logarithmic likelihood, (n, levels). [1]"""
    weight = np.exp(likelihood - likelihood.max(axis=1, keepdims=True)) / READING_SDS
    return np.asarray(weight / weight.sum(axis=1, keepdims=True))


def _update(
    known: NDArray[Any], energy: Floats, fall: Floats, bend: Floats, noise: Floats, score: Floats, variance: Floats
) -> NDArray[Any]:
    """Return what is known of cars after one more ride, (n,) LANE_YIELD; the others are (n, 1) or (n, levels)."""
    new, fade = known.copy(), 1.0 - 1.0 / MEMORY
    weight = np.minimum(1.0, OUTLIER_SDS / np.maximum(score, OUTLIER_SDS)) / noise
    products = energy * energy, -energy * bend, bend * bend, energy * fall, -bend * fall
    for name, product in zip(_LEARNED[:5], products, strict=True):
        new[name] = fade * known[name] + weight * product
    squares = np.minimum(score, LARGEST_SCORE) ** 2
    new["likelihood"] = fade * known["likelihood"] - 0.5 * (np.log(variance) + squares)
    new["rides"] = fade * known["rides"] + 1.0
    new["contradictions"] = 0.0
    return new


def _contradict(known: NDArray[Any], new: NDArray[Any]) -> NDArray[Any]:
    """Return what is known of cars after a ride that contradicts it: of the ride, only the noise of the display.

    After some such rides in a row nothing is known.
    """
    out = known.copy()
    out["likelihood"], out["contradictions"] = new["likelihood"], known["contradictions"] + 1.0
    forgotten = out["contradictions"] >= RELEARN_AFTER
    for name in _LEARNED:
        out[name][forgotten] = 0.0
    return out
