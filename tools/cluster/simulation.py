"""Write the recording of a simulated fleet of any size: cars are driven apart, and their messages merged from files.

The cars of a simulation share its weather and the factors of hidden effects, which the command computes first. Each car
has random streams of its own, so its messages do not depend on where it is driven. The recording and the truth equal
those of a run in one process to the byte.
"""

import gc
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Final

from socast.core.files import replacing
from socast.stream.mcap_writer import replace_recording
from socast.stream.recording_metadata import list_changed_settings, make_metadata
from socast.tools.cluster.workers import Workers
from socast.tools.simulator.car_files import CarFile, CarWriter, ShiftTruth, merge_cars, order_shifts, plan_merge
from socast.tools.simulator.fleet import PreparedFleet, describe_fleet, drive_car, make_fleet_sky, make_members
from socast.tools.simulator.settings import Simulation
from socast.tools.simulator.truth import Truth
from socast.tools.simulator.weather import merge_weather

DRIVE, WRITE = "drive", "write"
"""Stages: driving cars, by tasks; writing their messages, in the command itself."""
TRUTH: Final = ".truth.json"


def write_recording(fleet: PreparedFleet, out: Path, workers: Workers) -> Truth:
    """Write the recording of a fleet, and its truth beside it."""
    simulation, truth = fleet.simulation, Truth()
    describe_fleet(fleet, truth)
    tasks = [(simulation, fleet.factors, number, workers.scratch) for number in range(len(fleet.members))]
    settings = list_changed_settings(simulation, Simulation())
    settings.pop("hidden", None)  # whoever looks for the effect finds it in the truth only
    metadata = make_metadata("simulate", settings=settings)
    with replace_recording(out, metadata=metadata) as sink, _without_garbage_collection():
        cars: list[CarFile] = list(workers.run(DRIVE, write_car, tasks))
        merges = len(plan_merge(cars))
        workers.report(WRITE, 0, merges)
        for done, messages in enumerate(merge_weather(merge_cars(cars), simulation, fleet.sky)):
            sink.put(messages)
            truth.messages += len(messages)
            workers.report(WRITE, done + 1, merges)
    truth.take_shifts(order_shifts(cars), {car.name: car.faults for car in cars})
    truth.write(out.with_suffix(TRUTH))
    return truth


def write_car(simulation: Simulation, factors: tuple[float, ...], number: int, scratch: Path) -> CarFile:
    """Drive a car, and write its messages to a file."""
    fleet = _prepare(simulation, factors)
    member, path = fleet.members[number], scratch / f"car-{number:06d}"
    own, shifts = Truth(factors=fleet.name_factors(), faults={fleet.members[number].name: Counter()}), []
    with replacing(path, is_kept=False) as part, _without_garbage_collection():
        writer = CarWriter(part)
        for messages in drive_car(fleet, member, own):
            writer.write(messages)
            shifts.append(ShiftTruth(writer.last, own.rides, own.displays))
            own.rides, own.displays = [], []
        groups = writer.close()
    return CarFile(member.name, path, groups, shifts, own.faults[member.name])


@lru_cache(maxsize=1)
def _prepare(simulation: Simulation, factors: tuple[float, ...]) -> PreparedFleet:
    """Draw the cars and the weather once in a process."""
    return PreparedFleet(simulation, make_members(simulation), make_fleet_sky(simulation), factors)


@contextmanager
def _without_garbage_collection() -> Iterator[None]:
    """Leave cycles for later: messages are many and hold none, and to look for some takes a tenth of the time."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
