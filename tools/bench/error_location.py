"""Measure how often the location of an error is right: level, kind and size of random loads in simulated fleets.

Each seed gives the fleet of the benchmark of hidden effects. Loads of random size are added to the simulated power of
each ride or vehicle-day, so that voltage and current contain them. Sizes are compared as mean powers, because the
energy of a kind by catalogue differs from that of the simulated cars.

Example: python -m socast.tools.bench.error_location --seeds 7301-7320 --keep build/location --publish
"""

import argparse
import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from rich.console import Console
from threadpoolctl import threadpool_limits

from socast.core.diagnose.dataset import gather_windows
from socast.core.diagnose.error_location.locate import locate_error
from socast.core.diagnose.projection import BaseProjection
from socast.core.diagnose.records import ErrorLocation
from socast.core.errors import SocastError
from socast.core.fit.recipes import fit_to_windows
from socast.core.fit.ride_blocks import get_numbers
from socast.core.stats.clustered import compute_wilson_interval
from socast.tools.bench.figures.published import publish
from socast.tools.bench.hidden.cases import SeedData
from socast.tools.bench.hidden.random_loads import RandomLoad, measure_with_loads
from socast.tools.bench.nothing_hidden import parse_seeds
from socast.tools.terminal.rich_table import Column, make_table

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
Record = dict[str, Any]


def main(arguments: list[str] | None = None) -> int:
    """Run the measurement, print its table and, if asked, write it to the page."""
    parser = argparse.ArgumentParser("error-location", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", default="7301-7320", help="seeds, such as 7301-7320 or 7,9")
    parser.add_argument("--keep", type=Path, help="folder for the records of each seed; those in it are used again")
    parser.add_argument("--publish", action="store_true", help="write the table to the pages")
    options = parser.parse_args(arguments)
    console = Console()
    try:
        seeds = parse_seeds(options.seeds)
    except SocastError as error:
        print(error, file=sys.stderr)
        return 2
    records = []
    for seed in seeds:
        of_seed = measure_seed(seed, options.keep)
        records += of_seed
        for record in of_seed:
            console.print(f"{seed} {record['case']}: {', '.join(record['claimed']) or 'nothing'}", highlight=False)
    rows = summarise(records)
    table = make_table([Column("hidden"), *(Column(head, number=True) for head in HEADS)], "Location of the error")
    for name, cells in rows.items():
        table.add_row(name, *cells)
    console.print(table)
    if options.publish:
        command = f"python -m socast.tools.bench.error_location --seeds {options.seeds} --keep build/location"
        publish("error-location", command, make_lines(rows, records))
    return 0


def measure_seed(seed: int, keep: Path | None = None) -> list[Record]:
    """Return the records of all cases of a seed."""
    file = None if keep is None else keep / f"{seed}.json"
    if file is not None and file.exists():
        known: list[Record] = json.loads(file.read_text(encoding="utf-8"))
        return known
    data = SeedData(seed)
    with threadpool_limits(1):
        records = [measure_case(data, name, loads) for name, loads in CASES.items()]
    if file is not None:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps(records, indent=1) + "\n", encoding="utf-8")
    return records


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
        f"| hidden | {' | '.join(HEADS)} |",
        f"|---|{'---|' * len(HEADS)}",
        *(f"| {name} | {' | '.join(cells)} |" for name, cells in rows.items()),
    ]


if __name__ == "__main__":
    sys.exit(main())
