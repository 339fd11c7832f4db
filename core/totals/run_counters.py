"""Counters of samples and rides since the start of a run."""

from collections import Counter
from typing import Any

import numpy as np

from socast.core.batch import Ints, grown
from socast.core.cleaning.quality import CAUSES
from socast.core.totals.accumulator import Totals
from socast.core.totals.context import RunContext
from socast.core.totals.logger_faults import LoggerFaults, add_faults, count_faults
from socast.core.totals.tables import model_columns, unfit_reason


class RunCounters:
    """Count samples by quality bit, and closed rides by why they are unfit or not predicted.

    Attributes
    ----------
    unfit : Counter
        Of these, rides that are unfit for training, by reason.
    unpredicted : Counter
        Of these, rides whose energy is not predictable, by reason; `model_limit` where the model predicts more than a
        ride can take (`socast.core.models.limit`).
    faults : dict of str to Counter
        Of these, rides that show a fault of a logger, by its name and by car.
    """

    def __init__(self) -> None:
        self.samples: Ints = np.zeros(len(CAUSES), np.int64)
        self.rides = 0
        self.unfit: Counter[str] = Counter()
        self.unpredicted: Counter[str] = Counter()
        self.faults: LoggerFaults = {}

    def count_samples(self, quality: Ints, lane: Ints) -> None:  # noqa: ARG002 - see `CarCounters`
        """Count the quality bits of samples, (n,) int, of the cars of some lanes, (n,) int."""
        marked = quality[quality != 0]  # few, so that each bit is looked for in these only
        for place in range(len(CAUSES)):
            self.samples[place] += np.count_nonzero(marked & (1 << place))

    def count_rides(self, rides: Totals, context: RunContext) -> None:
        """Count rides that have ended."""
        if not len(rides.lane):
            return
        kinds = rides.kinds.tolist()
        self.rides += len(rides.lane)
        self.unfit.update(reason for reason in unfit_reason(rides, context).tolist() if reason is not None)
        self.unpredicted.update(why for why in map(context.cars.unpredicted, kinds) if why is not None)
        add_faults(self.faults, count_faults(rides, context.vehicle_ids))
        model: Any = context.model
        if getattr(model, "is_limited", False):
            columns = model_columns(rides, context, model.needs)
            if limited := model.count_limited(columns, model.predict_energy(columns)):
                self.unpredicted["model_limit"] += limited

    def describe(self) -> dict[str, Any]:
        """Return `samples` by quality bit, `rides`, `unfit` and `unpredicted` ones by reason, and `logger_faults`."""
        samples = dict(zip(CAUSES, self.samples.tolist(), strict=True))
        return {
            "samples": samples,
            "rides": self.rides,
            "unfit": dict(self.unfit),
            "unpredicted": dict(self.unpredicted),
            "logger_faults": {name: dict(cars) for name, cars in self.faults.items()},
        }

    def dump(self) -> Any:
        """Return the state as plain lists."""
        faults = {name: dict(cars) for name, cars in self.faults.items()}
        return [self.samples.tolist(), self.rides, dict(self.unfit), dict(self.unpredicted), faults]

    def load(self, state: Any) -> None:
        """Replace the state by one that `dump` returned."""
        samples, self.rides, unfit, unpredicted, faults = state
        self.samples = np.array(samples, np.int64)
        self.unfit, self.unpredicted = Counter(unfit), Counter(unpredicted)
        self.faults = {name: Counter(cars) for name, cars in faults.items()}


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
