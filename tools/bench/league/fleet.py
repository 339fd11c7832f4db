"""Give each car of the league its faults, send the cars as one stream, judge their rides, and cut it at random."""

from collections.abc import Sequence
from itertools import combinations
from typing import Final, NamedTuple

import numpy as np
import pandas as pd

from socast.core.pipeline import Pipeline
from socast.core.wire.messages import Message
from socast.tools.bench import measures
from socast.tools.bench.league.faults import FAULTS
from socast.tools.bench.league.laws import COLUMNS, WRONG, Truth, Verdict, find_starts, find_truths, judge
from socast.tools.bench.league.loggers import (
    CLOCK,
    Fault,
    Log,
    are_compatible,
    make_car,
    sample,
    settle,
    write_messages,
)

DRIVES: Final = 3
"""Number of drives of a car."""
FLEET: Final = 120
"""Number of cars in one stream."""
CONTROL: Final = "none"
"""Name of what has no fault."""
BLOCK: Final = 20_000
"""Number of messages that are given at once."""
BESIDE: Final = "beside others: "
"""Begins the reason of a drive that is wrong in the stream of the fleet, and not in that of its car alone."""

LARGEST: Final = 3000
"""Largest number of messages of a chunk."""


class Entry(NamedTuple):
    """Hold a car with its faults, its samples, its truths, and the true and stamped beginnings of its drives."""

    number: int
    faults: list[Fault]
    log: Log
    truths: list[Truth]
    starts: list[tuple[float, float]]


def choose_faults(seed: int, number: int, names: Sequence[str] = ()) -> list[Fault]:
    """Return the faults of a car: cars of even numbers have one or none, the others have two."""
    chosen = list(names) or [CONTROL, *FAULTS]
    faults = [FAULTS[each] for each in chosen if each != CONTROL]
    pairs = [pair for pair in combinations(faults, 2) if are_compatible(*pair)]
    if number % 2 == 0 or not pairs:
        alone = chosen[(number // 2 if pairs else number) % len(chosen)]
        return [] if alone == CONTROL else [FAULTS[alone]]
    order = np.random.default_rng([seed, 1]).permutation(len(pairs))
    return list(pairs[order[(number // 2) % len(pairs)]])


def make_entry(seed: int, number: int, faults: Sequence[Fault]) -> Entry:
    """Return a car of the league. It depends on nothing but the arguments."""
    rng = np.random.default_rng([seed, 0, number])
    stays = next((each.stays for each in faults if each.stays), ())
    car = make_car(rng, number, DRIVES, stays)
    settle(car, faults, rng)
    log = sample(rng, car)
    _apply(log, faults, rng, range(CLOCK))
    truths = find_truths(log, faults)
    _apply(log, faults, rng, [CLOCK])
    starts = find_starts(log)
    _apply(log, faults, rng, [CLOCK + 1])
    return Entry(number, list(faults), log, truths, starts)


def _apply(log: Log, faults: Sequence[Fault], rng: np.random.Generator, stages: Sequence[int]) -> None:
    """Let faults act, stage after stage."""
    for stage in stages:
        for each in faults:
            if each.stage == stage:
                each.apply(log, rng)


def write_stream(entries: Sequence[Entry]) -> list[Message]:
    """Return the messages of cars in the order of their receipt."""
    messages = [each for entry in entries for each in write_messages(entry.log)]
    order = np.argsort(np.array([each.receipt_ns for each in messages]), kind="stable")
    return [messages[i] for i in order.tolist()]


def tabulate(messages: Sequence[Message]) -> pd.DataFrame:
    """Return the ride table of a stream, as `socast tables` makes it; of its columns those that are judged."""
    rides, _ = measures.tabulate(messages, BLOCK, two_sided=True)
    return rides[list(COLUMNS)]


def judge_stream(entries: Sequence[Entry]) -> list[Verdict]:
    """Return what became of each drive of some cars, which are cleaned in one stream."""
    rides = tabulate(write_stream(entries))
    of_car = dict(iter(rides.groupby("vehicle_id")))
    return [
        verdict
        for number, faults, log, truths, starts in entries
        for verdict in judge(number, log, truths, starts, faults, of_car.get(log.car.name, rides[:0]))
    ]


def run_fleet(seed: int, cars: Sequence[int], names: Sequence[str] = ()) -> list[Verdict]:
    """Return what became of each drive of a fleet, and mark those that are right in the stream of their car alone."""
    entries = [make_entry(seed, number, choose_faults(seed, number, names)) for number in cars]
    verdicts = judge_stream(entries)
    wrong = {each.car for each in verdicts if each.word == WRONG}
    alone = {
        (each.car, each.drive): each.word
        for entry in entries
        if entry.number in wrong
        for each in judge_stream([entry])
    }
    for each in verdicts:
        if each.word == WRONG and alone[each.car, each.drive] != WRONG:
            each.why = BESIDE + each.why
    return verdicts


def list_fleets(drives: int) -> list[range]:
    """Return the numbers of the cars of each fleet."""
    cars = -(-drives // DRIVES)
    return [range(first, min(first + FLEET, cars)) for first in range(0, cars, FLEET)]


def find_difference(seed: int, cars: Sequence[int], names: Sequence[str] = ()) -> str:
    """Return what depends on how the stream of some cars is cut: forecasts, rides, windows or counts; '' if nothing."""
    messages = write_stream([make_entry(seed, number, choose_faults(seed, number, names)) for number in cars])
    rng = np.random.default_rng([seed, 2])
    for live in (True, False):
        whole, expected = _run(messages, [len(messages)], live=live)
        sizes = np.ceil(np.exp(rng.uniform(0.0, np.log(LARGEST), len(messages)))).astype(int)
        parts, found = _run(messages, np.cumsum(sizes).tolist(), live=live)
        if found != expected:
            return "forecasts"
        for name in ("take_rides", "take_windows"):
            if not _are_equal(getattr(whole, name)(), getattr(parts, name)()):
                return name.removeprefix("take_")
        if whole.quality() != parts.quality():
            return "counts"
    return ""


def _run(messages: Sequence[Message], cuts: Sequence[int], *, live: bool) -> tuple[Pipeline, list[Message]]:
    """Return the pipeline that has taken messages in chunks, and its forecasts."""
    pipeline = Pipeline(keep_forecasts=live, two_sided=not live)
    out, at = list[Message](), 0
    for cut in cuts:
        if at < len(messages):
            out += pipeline.push(messages[at:cut])
            at = cut
    return pipeline, out + pipeline.finish()


def _are_equal(one: pd.DataFrame, other: pd.DataFrame) -> bool:
    """Return whether two tables are equal to the bit."""
    return one.equals(other) and list(one.columns) == list(other.columns)
