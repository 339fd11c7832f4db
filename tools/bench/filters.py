"""What it costs to know the state of charge of many cars and to look ahead of each."""

import time
from collections.abc import Callable
from datetime import UTC, datetime
from typing import Any, Final
from unittest.mock import patch

from core.forecast import soc_filter
from core.forecast.engine import Foresight
from core.pipeline import BLOCK, Pipeline
from core.wire.messages import Leg, Message, Plan, encode
from tools.bench.fleet import PERIOD_S, START_S, make_rounds, make_vehicles, name_car
from tools.bench.measures import Measure, cut_blocks
from tools.simulator.fleet import simulate
from tools.simulator.settings import Simulation

SHARE: Final = 0.02
"""Of a core."""
WARM_UP: Final = 20
"""Samples of each car before the clock starts."""


class Stopwatch:
    """Adds up the processor time that calls of a function take. [s]"""

    def __init__(self) -> None:
        self.seconds = 0.0

    def wrap(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return the function, timed."""

        def timed(*arguments: Any) -> Any:
            began = time.process_time()
            try:
                return function(*arguments)
            finally:
                self.seconds += time.process_time() - began

        return timed


def measure_filters(cars: int = 10_000, turns: int = 100) -> Measure:
    """Measure the filters of a fleet whose every car has a plan and intervals, against the time that passes for it."""
    pipeline = Pipeline(keep_tables=False)
    pipeline.learn_from(make_trained_pipeline())
    pipeline.push([*make_vehicles(cars), *make_plans(cars)])
    push_rounds(pipeline, cars, 0, WARM_UP)
    of_filters, of_all = Stopwatch(), Stopwatch()
    with (
        patch.object(soc_filter, "follow", of_filters.wrap(soc_filter.follow)),
        patch.object(Foresight, "follow", of_all.wrap(Foresight.follow)),
    ):
        told = push_rounds(pipeline, cars, WARM_UP, turns)
    passed = turns * PERIOD_S
    share = of_filters.seconds / passed
    return Measure(
        f"filters of the charge of {cars:,} cars, a sample every {PERIOD_S:g} s",
        f"{100 * SHARE:g} % of a core",
        share / SHARE,
        "< 1",
        share < SHARE,
        {
            "filters_pct_of_a_core": 100.0 * share,
            "with_outlook_pct_of_a_core": 100.0 * of_all.seconds / passed,
            "forecasts_per_s": told / passed,
        },
        "Processor time over the time that passes for the cars. The filter is a loop over events, compiled; it hears "
        "the totals of a ride whenever a forecast is due, that is, every fifth sample. The second figure is of all "
        "that is done to look ahead: energies, the filter, plans, the charge at the shift's end with its interval, "
        "and notes for judging it later.",
    )


def make_trained_pipeline() -> Pipeline:
    """Return a pipeline that has learned from some days of a small fleet of the same model."""
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
    """Let a fleet send rounds of samples; return how many forecasts told the charge at the shift's end."""
    told = 0
    for turn in make_rounds(cars, first, count):
        for block in cut_blocks(turn):
            told += sum(b'"soc_end_of_shift_pct":{' in message.payload for message in pipeline.push(block))
    return told
