"""Give each car of the league its faults, send the cars as one stream, and judge their rides."""

from collections.abc import Iterator, Sequence
from itertools import combinations
from typing import Final, NamedTuple

import numpy as np
import pandas as pd

from core.models import EXTENDED_PHYSICAL
from core.pipeline import Pipeline
from core.wire.messages import Message
from tools.bench.league.faults import FAULTS, Fault, settle
from tools.bench.league.laws import Truth, Verdict, find_truth, judge
from tools.bench.league.loggers import Log, make_car, sample, write_messages

DRIVES: Final = 3
"""Number of drives of a car."""
FLEET: Final = 120
"""Number of cars in one stream."""
CONTROL: Final = "none"
"""Name of what has no fault."""
BLOCK: Final = 20_000
"""Number of messages that are given at once."""


class Entry(NamedTuple):
    """Hold a car with its faults, its samples and its truth."""

    number: int
    faults: list[Fault]
    log: Log
    truths: list[dict[str, Truth]]


def choose_faults(seed: int, number: int, names: Sequence[str] = ()) -> list[Fault]:
    """Return the faults of a car: every other car has one or none, the others have two.

    Parameters
    ----------
    seed : int
        Seed of the league.
    number : int
        Number of the car.
    names : sequence of str
        Faults to choose from; all of them without any. `none` stands for no fault.
    """
    chosen = list(names) or [CONTROL, *FAULTS]
    pairs = [pair for pair in combinations([each for each in chosen if each != CONTROL], 2) if _are_compatible(*pair)]
    if number % 2 == 0 or not pairs:
        alone = chosen[(number // 2 if pairs else number) % len(chosen)]
        return [] if alone == CONTROL else [FAULTS[alone]]
    place = np.random.default_rng([seed, 1]).permutation(len(pairs))[(number // 2) % len(pairs)]
    return [FAULTS[each] for each in pairs[place]]


def _are_compatible(one: str, other: str) -> bool:
    """Return whether two faults can act together: of the same value, or where both take the last witness, they cannot."""
    spoils = {*FAULTS[one].spoils} & {*FAULTS[other].spoils}
    stays = FAULTS[one].stays, FAULTS[other].stays
    takes = {*FAULTS[one].spoils} | {*FAULTS[other].spoils}
    blind = {"speed", "odometer", "position"} <= takes
    return not spoils and not blind and (not all(stays) or stays[0] == stays[1])


def make_entry(seed: int, number: int, names: Sequence[str] = ()) -> Entry:
    """Return a car of the league. It depends on nothing but the arguments.

    Parameters
    ----------
    seed, number : int
        Seed of the league, and number of the car.
    names : sequence of str
        See `choose_faults`.
    """
    rng = np.random.default_rng([seed, 0, number])
    faults = choose_faults(seed, number, names)
    stays = next((each.stays for each in faults if each.stays), ())
    car = make_car(rng, number, DRIVES, stays)
    settle(car, faults, rng)
    log, truths = sample(rng, car), None
    for stage in range(4):
        if stage == 2:
            truths = find_truth(log)
        for each in faults:
            if each.stage == stage:
                each.apply(log, rng)
    return Entry(number, faults, log, truths or [])


def write_stream(entries: Sequence[Entry]) -> list[Message]:
    """Return the messages of cars in the order of their receipt."""
    written = [write_messages(entry.log) for entry in entries]
    when = np.concatenate([times for times, _ in written])
    messages = [each for _, part in written for each in part]
    return [messages[i] for i in np.argsort(when, kind="stable").tolist()]


def tabulate(messages: Sequence[Message]) -> pd.DataFrame:
    """Return the ride table of a stream, as `socast tables` makes it."""
    pipeline = Pipeline(EXTENDED_PHYSICAL, keep_forecasts=False, two_sided=True)
    for at in range(0, len(messages), BLOCK):
        pipeline.take(messages[at : at + BLOCK])
    pipeline.finish()
    return pipeline.take_rides()


def run_fleet(seed: int, cars: Sequence[int], names: Sequence[str] = ()) -> list[Verdict]:
    """Return what became of each drive of some cars, which are cleaned in one stream."""
    entries = [make_entry(seed, number, names) for number in cars]
    of_car = dict(tuple(tabulate(write_stream(entries)).groupby("vehicle_id")))
    return [
        verdict
        for entry in entries
        if entry.log.car.name in of_car
        for verdict in judge(entry.number, entry.log, entry.truths, entry.faults, of_car[entry.log.car.name])
    ]


def run_league(seed: int, drives: int, names: Sequence[str] = ()) -> Iterator[list[Verdict]]:
    """Yield what became of the drives of each fleet."""
    cars = -(-drives // DRIVES)
    for first in range(0, cars, FLEET):
        yield run_fleet(seed, range(first, min(first + FLEET, cars)), names)
