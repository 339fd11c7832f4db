"""Counters of samples and rides since the start of a run."""

from collections import Counter
from typing import Any

import numpy as np

from core.batch import Ints, grown
from core.cleaning.quality import CAUSES
from core.totals.accumulator import Totals
from core.totals.context import RunContext


class RunCounters:
    """Count samples by quality bit, and closed rides by why they are unfit or not predicted.

    Attributes
    ----------
    samples : (len(CAUSES),) int
        Samples with each quality bit.
    rides : int
        Rides that have ended.
    unfit : Counter
        Of these, rides that are unfit for training, by reason.
    unpredicted : Counter
        Of these, rides whose energy is not predictable, by reason.
    """

    def __init__(self) -> None:
        self.samples: Ints = np.zeros(len(CAUSES), np.int64)
        self.rides = 0
        self.unfit: Counter[str] = Counter()
        self.unpredicted: Counter[str] = Counter()

    def count_samples(self, quality: Ints, lane: Ints) -> None:  # noqa: ARG002 - see `CarCounters`
        """Count the quality bits of samples, (n,) int, of the cars of some lanes, (n,) int."""
        for place in range(len(CAUSES)):
            self.samples[place] += np.count_nonzero(quality & (1 << place))

    def count_rides(self, rides: Totals, unfit_reasons: Any, context: RunContext) -> None:
        """Count rides that have ended.

        Parameters
        ----------
        rides : Totals
            Totals of n rides.
        unfit_reasons : (n,) object
            Why each is unfit for training, None where it is fit.
        context : RunContext
        """
        kinds = rides.at_last("kind").astype(np.int64).tolist()
        self.rides += len(rides.lane)
        self.unfit.update(reason for reason in unfit_reasons.tolist() if reason is not None)
        self.unpredicted.update(why for why in map(context.cars.unpredicted, kinds) if why is not None)

    def describe(self) -> dict[str, Any]:
        """Return `samples` by quality bit, `rides`, and rides `unfit` and `unpredicted` by reason."""
        samples = dict(zip(CAUSES, self.samples.tolist(), strict=True))
        return {
            "samples": samples,
            "rides": self.rides,
            "unfit": dict(self.unfit),
            "unpredicted": dict(self.unpredicted),
        }

    def dump(self) -> Any:
        """Return the state as plain lists."""
        return [self.samples.tolist(), self.rides, dict(self.unfit), dict(self.unpredicted)]

    def load(self, state: Any) -> None:
        """Replace the state by one that `dump` returned."""
        samples, self.rides, unfit, unpredicted = state
        self.samples = np.array(samples, np.int64)
        self.unfit, self.unpredicted = Counter(unfit), Counter(unpredicted)


class CarCounters(RunCounters):
    """Count the samples of each car by quality bit too."""

    def __init__(self) -> None:
        super().__init__()
        self._of_cars: Ints = np.zeros((0, 1 + len(CAUSES)), np.int64)

    def count_samples(self, quality: Ints, lane: Ints) -> None:
        """Count the quality bits of samples, (n,) int, of the cars of some lanes, (n,) int."""
        super().count_samples(quality, lane)
        if not len(lane):
            return
        self._of_cars = grown(self._of_cars, int(lane.max()) + 1)
        rows = len(self._of_cars)
        self._of_cars[:, 0] += np.bincount(lane, minlength=rows)
        for place in range(len(CAUSES)):
            self._of_cars[:, 1 + place] += np.bincount(lane[quality & (1 << place) != 0], minlength=rows)

    def list_cars(self, cars: int) -> tuple[Ints, Ints]:
        """Return the samples of each of some cars, (cars,), and those with each quality bit, (cars, len(CAUSES))."""
        counts = grown(self._of_cars, max(cars, 1))[:cars]
        return counts[:, 0], counts[:, 1:]
