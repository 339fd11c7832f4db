"""Measure the processor time of the filters of the state of charge and of the outlook of many cars."""

import time
from collections.abc import Callable
from datetime import UTC, datetime
from typing import Any, Final
from unittest.mock import patch

from socast.core.forecast import engine, soc_filter
from socast.core.forecast.engine import ForecastEngine
from socast.core.pipeline import Pipeline
from socast.core.totals.sample_totals import BLOCK
from socast.core.wire.messages import Leg, Message, Plan, encode
from socast.tools.bench.fleet import PERIOD_S, START_S, make_rounds, make_vehicles, name_car
from socast.tools.bench.measures import Measure, cut_blocks
from socast.tools.simulator.fleet import simulate
from socast.tools.simulator.settings import Simulation

SHARE: Final = 0.02
"""Goal for the share of one processor core. [1]"""
WARM_UP: Final = 20
"""Samples of each car before the clock starts."""


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
    with (
        patch.object(engine, "filter_events", of_filters.wrap(soc_filter.filter_events)),
        patch.object(ForecastEngine, "process", of_all.wrap(ForecastEngine.process)),
    ):
        forecasts = push_rounds(pipeline, cars, WARM_UP, turns)
    passed = turns * PERIOD_S
    share = of_filters.seconds / passed
    return Measure(
        f"filters of the state of charge of {cars:,} cars, a sample every {PERIOD_S:g} s",
        f"{100 * SHARE:g} % of a core",
        share / SHARE,
        "< 1",
        share < SHARE,
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
