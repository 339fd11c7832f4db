"""Measure learning from a day of many cars, the daily update, and snapshots of the whole state."""

import time
from collections.abc import Callable
from itertools import product
from typing import Final

import numpy as np

from socast.core.columns import SECONDS_PER_DAY
from socast.core.forecast.learning.car_driver import KEPT_SHIFTS
from socast.core.forecast.learning.fleet import ShiftEnergy
from socast.core.forecast.learning.forecast_errors import RECORD_PERIOD, ForecastRecord, Outcome
from socast.core.pipeline import Pipeline
from socast.tools.bench.filters import SHARE, WARM_UP, make_plans, make_trained_pipeline, push_rounds
from socast.tools.bench.fleet import START_S, make_vehicles
from socast.tools.bench.measures import Measure

RIDES: Final = 10
"""Rides of a car per day, and as many idle periods."""
NOTES: Final = 60
"""Noted forecasts of a shift of ten hours."""
AT_ONCE: Final = 10
"""Rides that end within one block of samples."""
KEEP_S: Final = 30.0
"""Time between two snapshots in service. [s]"""


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
        share < SHARE,
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
        engine.statistics.add_errors(engine.log.evaluate_shift(lane, Outcome(0.38)))
        model = engine.context.cars.name(int(engine.context.cars.of_lane[lane])) or ""
        for _ in range(KEPT_SHIFTS):
            energy = ShiftEnergy(lane, None, 20.0, 21.0, 24.0, model, 0.0, 7.0, 10.0)
            engine.statistics.add_shift(energy)
