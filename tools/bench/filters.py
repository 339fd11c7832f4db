"""Measure the processor time of the filters and the outlook of many cars, of the daily update, and of snapshots."""

import time
from collections.abc import Callable
from datetime import UTC, datetime
from itertools import product
from typing import Any, Final
from unittest.mock import patch

import numpy as np

from socast.core.columns import SECONDS_PER_DAY
from socast.core.forecast.engine import ForecastEngine
from socast.core.forecast.learning.fleet import ShiftEnergy
from socast.core.forecast.learning.forecast_errors import RECORD_PERIOD, ForecastRecord, Outcome
from socast.core.forecast.learning.shift_patterns import KEPT_SHIFTS
from socast.core.pipeline import Pipeline
from socast.core.totals.sample_totals import BLOCK
from socast.core.wire.messages import Leg, Message, Plan, encode
from socast.tools.bench.measures import PERIOD_S, START_S, Measure, cut_blocks, make_rounds, make_vehicles, name_car
from socast.tools.simulator.fleet import simulate
from socast.tools.simulator.settings import Simulation

SHARE: Final = 0.02
"""Goal for the share of one processor core. [1]"""
WARM_UP: Final = 20
"""Samples of each car before the clock starts."""
RIDES: Final = 10
"""Rides of a car per day, and as many idle periods."""
NOTES: Final = 60
"""Noted forecasts of a shift of ten hours."""
AT_ONCE: Final = 10
"""Rides that end within one block of samples."""
KEEP_S: Final = 30.0
"""Time between two snapshots in service. [s]"""


class Stopwatch:
    """Add up the processor time of the calls of a function.

    Attributes
    ----------
    seconds : float
        Processor time of all calls. [s]
    """

    def __init__(self) -> None:
        self.seconds = 0.0

    def wrap(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function that is timed when it is called."""

        def timed(*arguments: Any) -> Any:
            began = time.process_time()
            try:
                return function(*arguments)
            finally:
                self.seconds += time.process_time() - began

        return timed


def measure_filters(cars: int = 10_000, turns: int = 100) -> Measure:
    """Measure the filters of a fleet with plans and intervals, against the time that passes for it."""
    pipeline = Pipeline(keep_tables=False)
    pipeline.learn_from(make_trained_pipeline())
    pipeline.push([*make_vehicles(cars), *make_plans(cars)])
    push_rounds(pipeline, cars, 0, WARM_UP)
    of_filters, of_all = Stopwatch(), Stopwatch()
    pipeline.engine.filter_events = of_filters.wrap(pipeline.engine.filter_events)
    with patch.object(ForecastEngine, "process", of_all.wrap(ForecastEngine.process)):
        forecasts = push_rounds(pipeline, cars, WARM_UP, turns)
    passed = turns * PERIOD_S
    share = of_filters.seconds / passed
    return Measure(
        f"filters of the state of charge of {cars:,} cars, a sample every {PERIOD_S:g} s",
        f"{100 * SHARE:g} % of a core",
        share / SHARE,
        "< 1",
        {
            "filters_pct_of_a_core": 100.0 * share,
            "with_outlook_pct_of_a_core": 100.0 * of_all.seconds / passed,
            "forecasts_per_s": forecasts / passed,
        },
        "The figures are processor time over the time that passes for the cars. The filter is a compiled loop "
        "over events. It receives the totals of a ride whenever a forecast is due, which is at every fifth "
        "sample. The second figure covers the whole outlook: energies, the filter, plans, the charge at the "
        "end of the shift with its interval, and notes to evaluate it later.",
    )


def make_trained_pipeline() -> Pipeline:
    """Return a pipeline that has learned from three days of a small fleet of the same model."""
    pipeline = Pipeline(keep_tables=False)
    start = datetime(2026, 1, 1, tzinfo=UTC)
    fleet = Simulation(vehicles=12, days=3, start=start, shift_hours=3.0, models=("kia-soul-ev-2015",), seed=5)
    for block in cut_blocks(list(simulate(fleet)), BLOCK):
        pipeline.push(block)
    return pipeline


def make_plans(cars: int) -> list[Message]:
    """Return a plan for each car: ten rides in five hours."""
    legs = [Leg(6.0, 1000.0)] * 10
    plans = (Plan(name_car(car), START_S, START_S + 5 * 3600.0, 10.0, legs) for car in range(cars))
    return [Message(f"fleet/{plan.vehicle_id}/plan", encode(plan), int(START_S * 1e9)) for plan in plans]


def push_rounds(pipeline: Pipeline, cars: int, first: int, count: int) -> int:
    """Push rounds of samples of a fleet; return how many forecasts give the charge at the end of the shift."""
    forecasts = 0
    for turn in make_rounds(cars, first, count):
        for block in cut_blocks(turn):
            forecasts += sum(b'"soc_end_of_shift_pct":{' in message.payload for message in pipeline.push(block))
    return forecasts


def measure_daily_update(cars: int = 10_000, repeats: int = 3) -> Measure:
    """Measure learning, daily update and snapshots of a fleet on a busy day, against the time that passes for it."""
    pipeline = Pipeline(keep_tables=False)
    pipeline.learn_from(make_trained_pipeline())
    pipeline.push([*make_vehicles(cars), *make_plans(cars)])
    push_rounds(pipeline, cars, 0, WARM_UP)
    learning = time_processor(lambda: _learn(pipeline, cars))
    for lane, number in product(range(cars), range(NOTES)):
        noted = 0, 100.0, -8.0, 0.4, 0.03, 0.8, 1.0
        time_s, end_s = START_S + RECORD_PERIOD * number, START_S + RECORD_PERIOD * NOTES + 60.0
        pipeline.engine.log.record(lane, ForecastRecord(time_s, end_s, *noted))
    snapshots: list[bytes] = []
    snapshot = min(time_processor(lambda: snapshots.append(pipeline.snapshot())) for _ in range(repeats))
    learning += time_processor(lambda: _end(pipeline, cars))
    update = time_processor(pipeline.engine.apply_daily_update)
    share = (learning + update) / SECONDS_PER_DAY + snapshot / KEEP_S
    return Measure(
        f"learning, daily update and snapshots of {cars:,} cars",
        f"{100 * SHARE:g} % of a core",
        share / SHARE,
        "< 1",
        {
            "learning_and_update_pct_of_a_core": 100.0 * (learning + update) / SECONDS_PER_DAY,
            "snapshot_pct_of_a_core": 100.0 * snapshot / KEEP_S,
            "update_s": update,
            "snapshot_s": snapshot,
            "snapshot_mb": len(snapshots[-1]) / 1e6,
        },
        f"The figures are processor time over the time that passes for the cars. {RIDES} rides and idle "
        "periods of each car are added up as they end. A daily update makes tables and quantiles of the sums, "
        f"and the expected values of each car. A snapshot is taken every {KEEP_S:g} s, here at the end of "
        "shifts of ten hours, when most forecasts wait for their evaluation and make up half of it.",
    )


def time_processor(action: Callable[[], object]) -> float:
    """Return the processor time of an action. [s]"""
    began = time.process_time()
    action()
    return time.process_time() - began


def _learn(pipeline: Pipeline, cars: int) -> None:
    """End the rides and idle periods of a day of a fleet, with twenty times the running totals of each car."""
    statistics, lanes = pipeline.engine.statistics, np.arange(cars)
    for _, at in product(range(RIDES), range(0, cars, AT_ONCE)):
        totals = pipeline.totals.accumulator.running(lanes[at : at + AT_ONCE])
        totals = totals._replace(amounts=20.0 * totals.amounts)
        statistics.add_stretches(totals, totals, np.tile(totals.at_first("time") - 3600.0, 2))


def _end(pipeline: Pipeline, cars: int) -> None:
    """End the shift of a fleet: evaluate its forecasts, and learn from it as one of many."""
    engine = pipeline.engine
    for lane in range(cars):
        engine.statistics.add_errors(lane, engine.log.evaluate_shift(lane, Outcome(0.38)))
        model = engine.context.cars.name(int(engine.context.cars.of_lane[lane])) or ""
        for _ in range(KEPT_SHIFTS):
            energy = ShiftEnergy(lane, None, 20.0, 21.0, 24.0, model, 0.0, 7.0, 10.0)
            engine.statistics.add_shift(energy)
