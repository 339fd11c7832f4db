"""Runs: a recipe is fitted to some rides and predicts others, many times over, on all cores.

What a run gives depends on its arguments alone, and each keeps to one thread, so that results are the same whatever
the number of workers.
"""

from collections.abc import Callable, Hashable, Mapping
from functools import partial
from typing import Any, Final, NamedTuple, Protocol, TypeVar

import numpy as np
import pandas as pd
from joblib import Parallel, delayed, parallel_config
from threadpoolctl import threadpool_limits

from core.batch import Floats
from core.errors import SocastError
from core.evaluate.ride_filter import EvaluatedRides
from core.stats.splits import Positions, Split

LEVEL: Final = 0.9
"""Probability that intervals are asked for."""

Progress = Callable[[int, int], None]
"""Called with the number of runs that are done, and of all."""

Key = TypeVar("Key", bound=Hashable)
Result = TypeVar("Result")


class FittedModel(Protocol):
    """What a recipe gives: a model."""

    def predict(self, columns: Any) -> Floats:
        """Return the energy of rides. [kWh]"""


class EvaluatedRecipe(Protocol):
    """What is judged: a recipe, as a black box."""

    @property
    def name(self) -> str:
        """In results."""

    @property
    def title(self) -> str:
        """For people, as the paper has it."""

    def fit(self, rides: pd.DataFrame) -> FittedModel:
        """Return a model of these rides."""


class Prediction(NamedTuple):
    """What a recipe said of the rides it was tested on.

    Parameters
    ----------
    rows : (n,) int64
        Positions of the rides.
    energy : (n,) float
        NaN where it could not tell. [kWh]
    lower, upper : (n,) float or None
        Its interval at `LEVEL`, where it has one. [kWh]
    problem : str
        Why there is none at all; empty where there is.
    """

    rows: Positions
    energy: Floats
    lower: Floats | None = None
    upper: Floats | None = None
    problem: str = ""


def fit_and_predict(recipe: EvaluatedRecipe, judged: EvaluatedRides, split: Split) -> Prediction:
    """Fit a recipe to the one side of a split and let it predict the other, of which it does not see the answer."""
    try:
        model = recipe.fit(judged.rides.iloc[split.train])
        asked = judged.questions().iloc[split.test]
        energy = np.asarray(model.predict(asked), dtype=np.float64)
        if getattr(model, "interval", None) is None:
            return Prediction(split.test, energy)
        lower, upper = model.predict_interval(asked, LEVEL)  # type: ignore[attr-defined]
        return Prediction(split.test, energy, np.asarray(lower), np.asarray(upper))
    except SocastError as error:
        return Prediction(split.test, np.full(len(split.test), np.nan), problem=str(error))


def run_in_parallel(
    calls: Mapping[Key, Callable[[], Result]], jobs: int = 1, progress: Progress | None = None
) -> dict[Key, Result]:
    """Return what calls give, by their keys.

    Parameters
    ----------
    calls : mapping
        Key to a call without arguments, all independent of each other. Those that take longest had better come first.
    jobs : int
        Processes; 1 is this one.
    progress : callable, optional
    """
    tell = progress or _ignore_progress
    found: dict[Key, Result] = {}
    tell(0, len(calls))
    if jobs == 1:
        for key, call in calls.items():
            found[key] = _in_one_thread(call)
            tell(len(found), len(calls))
        return found
    with parallel_config(backend="loky", inner_max_num_threads=1):
        results = Parallel(n_jobs=jobs, return_as="generator")(delayed(_in_one_thread)(call) for call in calls.values())
        for key, result in zip(calls, results, strict=True):
            found[key] = result
            tell(len(found), len(calls))
    return found


def plan_runs(
    recipes: Mapping[str, EvaluatedRecipe], judged: EvaluatedRides, splits: Mapping[Hashable, Split]
) -> dict[tuple[Hashable, str], Callable[[], Prediction]]:
    """Return the calls that judge every recipe on every split, by split and recipe; the last recipes first."""
    return {
        (key, name): partial(fit_and_predict, recipe, judged, split)
        for name, recipe in reversed(list(recipes.items()))
        for key, split in splits.items()
    }


def _in_one_thread(call: Callable[[], Result]) -> Result:
    """Return what a call gives, with linear algebra kept to one thread, so that sums are always added alike."""
    with threadpool_limits(1):
        return call()


def _ignore_progress(_done: int, _of: int) -> None:
    """Tell nobody."""
