"""Run recipes: fit each to some rides and predict others, for many splits, on all cores.

The result of a run depends on its arguments alone, and each run uses one thread, so results are the same for any number
of workers.
"""

from collections.abc import Callable, Hashable, Mapping
from functools import partial
from typing import Any, Final, NamedTuple, Protocol, TypeVar

import numpy as np
import pandas as pd
from joblib import Parallel, delayed, parallel_config
from threadpoolctl import threadpool_limits

from socast.core.batch import Floats
from socast.core.errors import SocastError
from socast.core.evaluate.ride_filter import EvaluatedRides
from socast.core.models import LinearModel
from socast.core.stats.splits import Positions, Split

LEVEL: Final = 0.9
"""Probability of the prediction intervals."""

Progress = Callable[[int, int], None]
"""Called with the number of finished runs and the number of all runs."""

Key = TypeVar("Key", bound=Hashable)
Result = TypeVar("Result")


class FittedModel(Protocol):
    """Describe the model that a recipe returns."""

    def predict_energy(self, columns: Any) -> Floats:
        """Return the energy of rides. [kWh]"""


class EvaluatedRecipe(Protocol):
    """Describe a recipe, treated as a black box."""

    @property
    def title(self) -> str:
        """Title for readers, as in the paper."""

    def fit(self, rides: pd.DataFrame) -> FittedModel:
        """Return a model of these rides."""


class Prediction(NamedTuple):
    """Hold the predictions of a recipe for the rides of a test set.

    Parameters
    ----------
    rows : (n,) int64
        Positions of the rides.
    energy : (n,) float
        Predicted energy; NaN where there is no prediction. [kWh]
    lower, upper : (n,) float or None
        Interval at `LEVEL`, where the model has one. [kWh]
    problem : str
        Reason why there is no prediction at all; otherwise empty.
    limited : int
        Number of predictions that stopped at the limit of the model, see `socast.core.models.limit`.
    """

    rows: Positions
    energy: Floats
    lower: Floats | None = None
    upper: Floats | None = None
    problem: str = ""
    limited: int = 0


def fit_and_predict(recipe: EvaluatedRecipe, evaluated: EvaluatedRides, split: Split) -> Prediction:
    """Return the predictions for the test rides of a split, from a fit to its training rides.

    The model does not see the measured energy of the test rides.
    """
    try:
        model = recipe.fit(evaluated.rides.iloc[split.train])
        test_rides = evaluated.drop_answers().iloc[split.test]
        energy = np.asarray(model.predict_energy(test_rides), dtype=np.float64)
        limited = model.count_limited(test_rides, energy) if isinstance(model, LinearModel) else 0
        if getattr(model, "interval", None) is None:
            return Prediction(split.test, energy, limited=limited)
        lower, upper = model.predict_interval(test_rides, LEVEL)  # type: ignore[attr-defined]
        return Prediction(split.test, energy, np.asarray(lower), np.asarray(upper), limited=limited)
    except SocastError as error:
        return Prediction(split.test, np.full(len(split.test), np.nan), problem=str(error))


def run_in_parallel(
    calls: Mapping[Key, Callable[[], Result]], jobs: int = 1, progress: Progress | None = None
) -> dict[Key, Result]:
    """Return the results of calls, by their keys.

    Parameters
    ----------
    calls : mapping
        Key -> call without arguments. Calls are independent of each other; the longest ones should come first.
    """
    tell = progress or _ignore_progress
    done: dict[Key, Result] = {}
    tell(0, len(calls))
    with parallel_config(backend="loky", inner_max_num_threads=1):
        results = Parallel(n_jobs=jobs, return_as="generator")(
            delayed(call_in_one_thread)(call) for call in calls.values()
        )
        for key, result in zip(calls, results, strict=True):
            done[key] = result
            tell(len(done), len(calls))
    return done


def plan_runs(
    recipes: Mapping[str, EvaluatedRecipe], evaluated: EvaluatedRides, splits: Mapping[Hashable, Split]
) -> dict[tuple[Hashable, str], Callable[[], Prediction]]:
    """Return the calls that run every recipe on every split, by split and recipe; the last recipes come first."""
    return {
        (key, name): partial(fit_and_predict, recipe, evaluated, split)
        for name, recipe in reversed(list(recipes.items()))
        for key, split in splits.items()
    }


def call_in_one_thread(call: Callable[[], Result]) -> Result:
    """Return the result of a call with linear algebra on one thread, so that the order of sums is always the same."""
    with threadpool_limits(1):
        return call()


def _ignore_progress(_done: int, _of: int) -> None:
    """Report no progress."""
