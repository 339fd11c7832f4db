"""Evaluate models and forecasts on measured rides.

Every function returns what the command of the same purpose writes with `--json`, as a record.
"""

from collections.abc import Mapping, Sequence
from datetime import date
from pathlib import Path

import pandas as pd

from socast.core.condition import before_after as _before_after
from socast.core.condition.campaign import Campaign as _Campaign
from socast.core.condition.campaign_records import BeforeAfter
from socast.core.condition.car_condition import assess_condition as _assess
from socast.core.condition.car_days import gather_car_days as _gather
from socast.core.condition.energy_split import EnergySplit
from socast.core.condition.energy_split import split_energy as _split
from socast.core.condition.records import FleetCondition
from socast.core.diagnose.inference.events import read_events as _read_events
from socast.core.evaluate.compare import models as _models
from socast.core.evaluate.compare import ride_trace as _ride_trace
from socast.core.evaluate.compare.datasets import compare_datasets as _contrast
from socast.core.evaluate.compare.records import DatasetContrast, RideTrace
from socast.core.evaluate.paper import protocol as _protocol
from socast.core.models import EXTENDED_PHYSICAL, LinearModel
from socast.core.pipeline import Pipeline
from socast.core.stats.splits import REPEATS
from socast.results import Comparison, RecipeEvaluation, SocEvaluation, _show
from socast.stream.loop import feed as _feed
from socast.stream.mcap_reader import McapSource
from socast.stream.source import merge_sources
from socast.tools.commands import evaluate_soc as _evaluate_soc

__all__ = [
    "assess_condition",
    "compare_before_after",
    "compare_datasets",
    "compare_models",
    "evaluate_recipes",
    "evaluate_soc_forecasts",
    "split_energy",
    "trace_ride",
]


def evaluate_recipes(
    rides: pd.DataFrame,
    recipes: Sequence[str] | None = None,
    windows: pd.DataFrame | None = None,
    *,
    seed: int = 0,
    repeats: int = REPEATS,
    left_out_of_training: Sequence[str] = (),
    jobs: int = 1,
) -> RecipeEvaluation:
    """Fit recipes on splits of rides and return their errors on the rides held out.

    Parameters
    ----------
    rides : (n, columns) DataFrame
        A ride table.
    recipes : sequence of str, optional
        Names of recipes; by default all.
    windows : (m, columns) DataFrame, optional
        The window table; the segment model takes part where it is given.
    seed : int
        Seed of splits and draws. The same seed gives the same result.
    repeats : int
        Number of random splits by ride.
    left_out_of_training : sequence of str
        Vehicle models on which no model for a new vehicle model is trained; the paper leaves out `nissan-leaf`.
    jobs : int
        Number of processes.

    Returns
    -------
    RecipeEvaluation
        The parts that `socast evaluate --json` writes, as attributes; DataFrames `errors` (one row for each recipe and
        vehicle model) and `percentages`; `to_json()` for plain values.

    Raises
    ------
    ModelError
        Where the rides cannot be evaluated.
    SettingsError
        Where a recipe is unknown, or a vehicle model to leave out has no rides.
    """
    names = None if recipes is None else ",".join(recipes)
    chosen = _protocol.select_recipes(names, windows, seed)
    result = _protocol.evaluate(
        rides, chosen, seed=seed, repeats=repeats, left_out_of_training=left_out_of_training, jobs=jobs
    )
    return _show(RecipeEvaluation, result)


def compare_models(rides: pd.DataFrame, models: Mapping[str, LinearModel]) -> Comparison:
    """Compare models with the measured energy of rides, on the rides that every model predicts.

    Parameters
    ----------
    rides : (n, columns) DataFrame
        A ride table.
    models : mapping of str to LinearModel
        Models by the label that the result uses.

    Returns
    -------
    Comparison
        The parts that `socast compare --json` writes, as attributes; DataFrames `errors`, one row for each model, and
        `worst_rides`; `to_json()` for plain values.

    Raises
    ------
    ModelError
        Where a column is missing, or no ride can be compared.

    Examples
    --------
    >>> import socast
    >>> tables = socast.make_tables("recordings/shift.mcap")
    >>> result = compare_models(tables.rides, {"basic": socast.load_model("basic_physical")})
    >>> result.errors[["model", "rides"]].to_dict("records")
    [{'model': 'basic', 'rides': 57}]
    """
    return _show(Comparison, _models.compare_predictions(_models.select_rides(rides, models)))


def compare_before_after(
    rides: pd.DataFrame,
    model: LinearModel,
    vehicles: Sequence[str],
    at: date,
    *,
    until: date | None = None,
    days: int | None = None,
    what: str = "",
) -> BeforeAfter:
    """Return how the consumption of cars changed on a date, at equal conditions and beside their siblings.

    Parameters
    ----------
    rides : (n, columns) DataFrame
        A ride table.
    model : LinearModel
        The model whose prediction stands for equal conditions.
    vehicles : sequence of str
        The cars that were repaired.
    at : date
        UTC date of the repair, which is left out; after the last ride, the result says how long a change will take
        to be seen.
    until : date, optional
        Last date that counts.
    days : int, optional
        Number of days before and after that count. [d]
    what : str
        What was done, in words.

    Raises
    ------
    ModelError
        Where a car is unknown, or has too few days before or after.
    """
    last = None if until is None else until.toordinal()
    campaign = _Campaign(tuple(vehicles), at.toordinal(), last, days, what=what)
    car_days = _gather(_models.select_rides(rides, {model.name: model}), model.name, _before_after.LEAST_CAMPAIGN_KWH)
    return _before_after.compare_before_after(car_days, campaign, model.name)


def compare_datasets(first: pd.DataFrame, second: pd.DataFrame, models: Mapping[str, LinearModel]) -> DatasetContrast:
    """Return how two ride tables differ and how much of the difference each term of a model explains.

    Parameters
    ----------
    first, second : DataFrame
        Ride tables.
    models : mapping of str to LinearModel
        Models by the label that the result uses.

    Raises
    ------
    ModelError
        Where a column is missing, or no ride can be compared.
    """
    return _contrast(_models.select_rides(first, models), _models.select_rides(second, models), models)


def split_energy(
    rides: pd.DataFrame, model: LinearModel, *, by: str = "fleet", price: float | None = None
) -> EnergySplit:
    """Return where the measured energy of rides went, by the terms of a model, and what it does not explain.

    Parameters
    ----------
    rides : (n, columns) DataFrame
        A ride table.
    model : LinearModel
        The model whose terms divide the energy.
    by : str
        `fleet`, or what is also split: `car`, `month`, `driver` or `model`.
    price : float, optional
        Price of energy in any currency. [price/kWh]

    Returns
    -------
    EnergySplit
        The parts that `socast waterfall --json` writes, as attributes; `to_json()` for plain values.

    Raises
    ------
    ModelError
        Where a column is missing, or no ride is fit for training, measured and predicted.
    SettingsError
        For an unknown way to group, and a price that is not 0 or above.

    Examples
    --------
    >>> import socast
    >>> tables = socast.make_tables("recordings/shift.mcap")
    >>> fleet = split_energy(tables.rides, socast.load_model("extended_physical")).fleet
    >>> parts = sum(part.energy_kwh.value for part in fleet.shares)
    >>> abs(parts - fleet.measured.energy_kwh.value) < 1e-9
    True
    """
    return _split(rides, model, by=by, price=price)


def assess_condition(rides: pd.DataFrame, model: LinearModel, *, events: str | Path | None = None) -> FleetCondition:
    """Return how each car is doing: its consumption beside its siblings, its usable capacity, and since when.

    Parameters
    ----------
    rides : (n, columns) DataFrame
        A ride table of at least six dates.
    model : LinearModel
        The model that predicts the consumption.
    events : path, optional
        CSV file of repairs, tyre changes and the like: `date`, the first UTC date after the event, `vehicle_id`, empty
        for all cars, and `what` happened. Each is placed beside the sudden changes of its car, and alters nothing.

    Returns
    -------
    FleetCondition
        What `socast condition --json` writes, as attributes, cars with a finding first; `.table` has a row of each.

    Raises
    ------
    ModelError
        Where no ride is fit for training, measured and predicted, where the dates are fewer than six, and where the
        file of events cannot be read.

    Examples
    --------
    >>> import socast
    >>> tables = socast.make_tables("recordings/autumn.mcap")
    >>> condition = assess_condition(tables.rides, socast.load_model("extended_physical"))
    >>> sorted(condition.table["vehicle_id"])
    ['taxi-001', 'taxi-002', 'taxi-003', 'taxi-004', 'taxi-005']
    """
    return _assess(rides, model, _read_events(Path(events)) if events else ())


def trace_ride(rides: pd.DataFrame, windows: pd.DataFrame, ride: str, models: Mapping[str, LinearModel]) -> RideTrace:
    """Return measured and predicted power and energy of one ride, window by window.

    Parameters
    ----------
    rides, windows : DataFrame
        The two tables of the same rides.
    ride : str
        The `ride_key` or the `ride_id` of a ride.
    models : mapping of str to LinearModel
        Models by the label that the result uses.

    Raises
    ------
    ModelError
        Where there is no such ride, or the identifier names several rides.
    """
    return _ride_trace.trace_ride(_ride_trace.find_ride(rides, ride), windows, models)


def evaluate_soc_forecasts(
    *recordings: str | Path, model: LinearModel = EXTENDED_PHYSICAL, truth: str | Path | None = None
) -> SocEvaluation:
    """Replay recordings and evaluate the forecasts of the state of charge at each shift's end.

    Fleet statistics are learned during the replay, so every forecast rests only on what came before it.

    Parameters
    ----------
    *recordings : str or Path
        MCAP files of several weeks, merged in the order of receipt.
    model : LinearModel
        The model that makes the forecasts.
    truth : str or Path, optional
        Truth of a simulation with conditions; outcomes are then what a healthy display shows.

    Returns
    -------
    SocEvaluation
        The parts that `socast evaluate-soc --json` writes, as attributes; DataFrames `errors` (one row for each time
        ahead) and `forecasts`; `to_json()` for plain values.

    Raises
    ------
    RecordingError
        Where a file cannot be read.
    ModelError
        Where no forecast can be evaluated: give recordings of more days.
    """
    displays = None if truth is None else _evaluate_soc.read_displays(Path(truth))
    collector = _evaluate_soc.SocForecasts(Pipeline(model, keep_outlooks=True))
    for _ in _feed(collector.cut(merge_sources([McapSource(path) for path in recordings])), collector.pipeline):
        collector.pipeline.forecasts()
        collector()
    return _show(SocEvaluation, collector.evaluated(displays))
