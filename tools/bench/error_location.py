"""Measure how often the location of an error is right: level, kind and size of random loads in simulated fleets.

Each seed gives the fleet of the benchmark of hidden effects. Loads of random size are added to the simulated power of
each ride or vehicle-day, so that voltage and current contain them. Sizes are compared as mean powers, because the
energy of a kind by catalogue differs from that of the simulated cars.

Example: python -m socast.tools.bench.error_location --seeds 7301-7320 --keep build/location --publish
"""

import sys
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from types import MappingProxyType
from typing import Final, NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from socast.core.batch import Floats
from socast.core.columns import GRAVITY
from socast.core.diagnose.dataset import gather_windows
from socast.core.diagnose.error_location.locate import locate_error
from socast.core.diagnose.projection import BaseProjection
from socast.core.diagnose.records import ErrorLocation
from socast.core.fit.recipes import fit_to_windows
from socast.core.fit.ride_blocks import get_numbers
from socast.core.stats.clustered import compute_wilson_interval
from socast.tools.bench.figures.published import (
    keep,
    make_parser,
    parse_seeds,
    publish,
    show_table,
    tell_errors,
    write_table,
)
from socast.tools.bench.hidden.cases import SeedData
from socast.tools.bench.hidden.drives import BASE, Drives, Readings, RecordedShift, enter_readings, integrate_shift
from socast.tools.bench.hidden.evaluation import Record
from socast.tools.simulator.hidden import EffectInputs, compute_braking_power, compute_rolling_power
from socast.tools.simulator.shift import NO_RIDE
from socast.tools.simulator.trace import REFERENCE_DENSITY

START: Final = 300.0
"""Time constant with which a load at the beginning of a ride decays. [s]"""


class RandomLoad(NamedTuple):
    """Describe a load.

    Parameters
    ----------
    level : {"car", "driver", "date", "day", "ride"}
        What has a size of its own.
    size : float
        Standard deviation of the sizes: W for `constant` and `beginning`, otherwise a share of the power of the kind.
    """

    level: str
    kind: str
    size: float


def _drag(view: EffectInputs) -> Floats:
    return np.asarray(0.5 * REFERENCE_DENSITY * view.car.drag_area * view.trace.speed**3)


def _climbing(view: EffectInputs) -> Floats:
    return np.asarray(view.car.mass * GRAVITY * np.maximum(view.trace.grade, 0.0) * view.trace.speed)


KINDS: Final[Mapping[str, Callable[[EffectInputs], Floats]]] = MappingProxyType(
    {
        "constant": lambda view: np.ones(len(view.trace.time)),
        "rolling": compute_rolling_power,
        "drag": _drag,
        "climbing": _climbing,
        "braking": compute_braking_power,
        "beginning": lambda view: np.exp(-view.trace.elapsed / START),
    }
)
"""Power of each kind of load, for a size of 1. [W]"""


def measure_with_loads(drives: Drives, loads: Sequence[RandomLoad], seed: int) -> Readings:
    """Return the readings of the cars with random loads.

    Returns
    -------
    Readings
        With the power of each load at a size of 1 as `hidden`, in the order of `loads`.
    """
    rng = np.random.default_rng([seed, 11])
    deviates: list[dict[object, float]] = [{} for _ in loads]
    cars, out = drives.vehicles, drives.make_readings(len(loads))
    for leg in drives.legs:
        view = leg.driven.view
        nominal = np.stack([KINDS[load.kind](view) for load in loads]) if loads else None
        power = np.zeros(len(view.trace.time))
        for number, (load, drawn) in enumerate(zip(loads, deviates, strict=True)):
            units = _name_units(leg, load.level)
            sizes = np.array([drawn.setdefault(unit, float(rng.normal())) if unit else 0.0 for unit in units])
            if nominal is not None:
                power += load.size * sizes[leg.driven.shift.timeline.ride] * nominal[number]
        enter_readings(out, cars.index(leg.member.name), leg, integrate_shift(leg, BASE, power), nominal)
    return out


def _name_units(leg: RecordedShift, level: str) -> list[object]:
    """Return the unit of each ride of a shift; the last entry, None, is that of the time between rides."""
    shift, name = leg.driven.shift, leg.member.name
    assert NO_RIDE == -1  # the last entry of the list
    whole: Mapping[str, object] = {"car": name, "date": int(shift.time // 86_400.0), "day": (name, leg.first)}
    if level in whole:
        return [whole[level]] * len(shift.trips) + [None]
    if level == "driver":
        return [*(trip.driver_id for trip in shift.trips), None]
    return [*((name, trip.ride_id) for trip in shift.trips), None]


RECIPE: Final = "road_load"
CASES: Final[dict[str, tuple[RandomLoad, ...]]] = {
    "nothing": (),
    "±300 W per ride": (RandomLoad("ride", "constant", 300.0),),
    "±300 W per day": (RandomLoad("day", "constant", 300.0),),
    "±20 % of the drag per day": (RandomLoad("day", "drag", 0.2),),
    "±300 W per ride and ±20 % of the drag per day": (
        RandomLoad("ride", "constant", 300.0),
        RandomLoad("day", "drag", 0.2),
    ),
    "±1,500 W at the beginning of each ride": (RandomLoad("ride", "beginning", 1500.0),),
}
"""Loads of each data set of a seed."""


@tell_errors
def main(arguments: list[str] | None = None) -> None:
    """Run the measurement, print its table and, if asked, write it to the page."""
    parser = make_parser("error_location", __doc__, seeds="7301-7320", keep=None, publish=False)
    options = parser.parse_args(arguments)
    records = list[Record]()
    for seed in parse_seeds(options.seeds):
        records += keep(options.keep and options.keep / f"{seed}.json", partial(measure_seed, seed))
        for record in records[-len(CASES) :]:
            print(f"{seed} {record['case']}: {', '.join(record['claimed']) or 'nothing'}")
    rows = summarise(records)
    show_table("Location of the error", ("hidden", *HEADS), [(name, *cells) for name, cells in rows.items()])
    if options.publish:
        command = f"python -m socast.tools.bench.error_location --seeds {options.seeds} --keep build/location"
        publish("error-location", command, make_lines(rows, records))


def measure_seed(seed: int) -> list[Record]:
    """Return the records of all cases of a seed."""
    data = SeedData(seed)
    with threadpool_limits(1):
        return [measure_case(data, name, loads) for name, loads in CASES.items()]


def measure_case(data: SeedData, name: str, loads: Sequence[RandomLoad]) -> Record:
    """Return what is located in a data set."""
    names = [f"{load.level} {load.kind}" for load in loads]
    tables = data.recording("none").tables(measure_with_loads(data.drives, loads, data.seed), "vi", names)
    model = fit_to_windows(RECIPE, tables.rides, tables.windows)
    seen = gather_windows(tables.rides, tables.windows, model)
    base = BaseProjection(seen, model)
    begin = time.process_time()
    located = locate_error(seen, base)
    there = tables.windows["ride_key"].isin(seen.rides["ride_key"]).to_numpy()
    hours = float(get_numbers(tables.windows, "duration_s")[there].sum()) / 3600.0
    power = {each: 1000.0 * float(tables.hidden[each].to_numpy()[there].sum()) / hours for each in names}
    true = {each: load.size * power[each] for each, load in zip(names, loads, strict=True)}
    return judge(located, true) | {
        "seed": data.seed,
        "case": name,
        "rides": len(seen.rides),
        "seconds": time.process_time() - begin,
    }


def judge(located: ErrorLocation, true: dict[str, float]) -> Record:
    """Return what was claimed, and whether names and sizes are right.

    Units: true [W].
    """
    claimed = {f"{load.level} {load.kind}": load for load in located.loads}
    return {
        "claimed": list(claimed),
        "sizes": [(load.size_w, load.low_w, load.high_w) for load in located.loads],
        "true": list(true.values()),
        "right": set(claimed) == set(true),
        "found": sum(name in claimed for name in true),
        "hidden": len(true),
        "inside": sum(
            claimed[name].low_w <= size <= claimed[name].high_w for name, size in true.items() if name in claimed
        ),
        "ratios": [claimed[name].size_w / size for name, size in true.items() if name in claimed],
    }


HEADS: Final = (
    "data sets",
    "level and kind right",
    "loads found",
    "size in the 95 % interval",
    "estimated over true size",
)


def summarise(records: Sequence[Record]) -> dict[str, list[str]]:
    """Return the cells of each case."""
    rows = {}
    for name in CASES:
        mine = [record for record in records if record["case"] == name]
        found, hidden = sum(r["found"] for r in mine), sum(r["hidden"] for r in mine)
        ratios = sorted(ratio for r in mine for ratio in r["ratios"])
        middle = f"{ratios[len(ratios) // 2]:.3f} ({ratios[0]:.2f} to {ratios[-1]:.2f})" if ratios else "–"
        rows[name] = [
            str(len(mine)),
            format_share(sum(r["right"] for r in mine), len(mine)),
            format_share(found, hidden),
            format_share(sum(r["inside"] for r in mine), found),
            middle,
        ]
    return rows


def format_share(count: int, of: int) -> str:
    """Return a share with its 95 % Wilson interval.

    Examples
    --------
    >>> format_share(19, 20)
    '19 of 20 (76 to 99 %)'
    """
    if not of:
        return "–"
    low, high = compute_wilson_interval(count / of, of)
    return f"{count} of {of} ({100.0 * low:.0f} to {100.0 * high:.0f} %)"


def make_lines(rows: dict[str, list[str]], records: Sequence[Record]) -> list[str]:
    """Return the lines for the pages."""
    seconds = sorted(record["seconds"] for record in records)
    return [
        (
            f"Fleets of 8 cars, about {records[0]['rides']:,} rides each, with loads of random size in voltage and "
            "current. Right: all hidden loads are claimed at their level and kind, and nothing else. Intervals of "
            f"shares are those of Wilson, at 95 %. Locating took {seconds[len(seconds) // 2]:.1f} s of processor time "
            f"(median; at most {seconds[-1]:.1f} s)."
        ),
        "",
        *write_table(["hidden", *HEADS], [[name, *cells] for name, cells in rows.items()]),
    ]


if __name__ == "__main__":
    sys.exit(main())
