"""`python -m socast.tools.bench.league`: measure what the cleaning makes of faulty loggers, whose truth is known."""

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict

from rich.console import Console
from rich.progress import Progress

from socast.tools.bench.figures.published import publish
from socast.tools.bench.league.faults import FAULTS
from socast.tools.bench.league.fleet import (
    CONTROL,
    DRIVES,
    choose_faults,
    find_difference,
    judge_stream,
    list_fleets,
    make_entry,
    run_fleet,
)
from socast.tools.bench.league.laws import WORDS, WRONG, Verdict
from socast.tools.bench.league.report import (
    Line,
    compare,
    list_alone,
    list_pairs,
    list_values,
    make_lines,
    name_drive,
    show_reasons,
    show_shares,
    summarise,
)
from socast.tools.terminal.rich_table import Column, make_table

REPLAYED = 12
"""Number of cars whose stream is cut at random."""
PAIRS = 20
"""Number of pairs that are shown."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the league, print its tables, and write what is asked for; return 1 if a drive is fit and wrong."""
    given = _parse(arguments)
    names = [each for each in given.faults.split(",") if each]
    if unknown := sorted(set(names) - {CONTROL, *FAULTS}):
        print(f"--faults {unknown[0]}: no such fault; give some of {', '.join([CONTROL, *FAULTS])}", file=sys.stderr)
        return 2
    if given.drive is not None:
        show_drive(given.seed, given.drive, given.drives, names)
        return 0
    verdicts, console = list[Verdict](), Console(stderr=given.json)
    with Progress(console=Console(stderr=True), transient=True) as progress:
        for cars in progress.track(list_fleets(given.drives), description="driving"):
            verdicts += run_fleet(given.seed, cars, names)
    cars = range(min(REPLAYED, -(-given.drives // DRIVES)))
    differs = find_difference(given.seed, cars, names)
    if given.json:
        print(json.dumps({"seed": given.seed, "differs": differs, "drives": [asdict(each) for each in verdicts]}))
    else:
        _show(console, verdicts, given.examples)
        print(f"cut at random, {len(cars) * DRIVES} drives give {'other ' + differs if differs else 'the same bytes'}")
    if given.publish:
        command = f"python -m socast.tools.bench.league --drives {given.drives} --seed {given.seed}"
        replayed = 0 if differs else len(cars) * DRIVES
        publish("league", command, make_lines(verdicts, given.seed, replayed, PAIRS), list_values(verdicts))
    return int(bool(differs) or any(each.word == WRONG for each in verdicts))


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Return the options."""
    parser = argparse.ArgumentParser(prog="python -m socast.tools.bench.league", description=__doc__)
    parser.add_argument("--drives", type=int, default=10_000, help="number of drives")
    parser.add_argument("--seed", type=int, default=1, help="seed of the drives and their faults")
    parser.add_argument("--faults", default="", metavar="NAMES", help="faults to choose from, with commas between them")
    parser.add_argument("--drive", type=int, help="show this drive only, with what was found and its truth")
    parser.add_argument("--examples", type=int, default=0, help="number of wrong drives to show of each fault")
    parser.add_argument("--json", action="store_true", help="print every drive as JSON")
    parser.add_argument("--publish", action="store_true", help="write the tables to the pages")
    return parser.parse_args(arguments)


def _show(console: Console, verdicts: Sequence[Verdict], examples: int) -> None:
    """Print the tables."""
    lines = [*list_alone(verdicts), *list_pairs(verdicts, PAIRS), summarise("all", "", verdicts)]
    columns = [Column("faults"), Column("drives", number=True), *(Column(word, number=True) for word in WORDS)]
    table = make_table([*columns, Column("reasons")], "What became of the drives [%]")
    for line in lines:
        table.add_row(line.name, str(line.drives), *show_shares(line), show_reasons(line).replace("*", ""))
    console.print(table)
    for line in lines[:-1]:
        _show_examples(line, examples)


def _show_examples(line: Line, examples: int) -> None:
    """Print some wrong drives of a line."""
    for each in line.wrong[:examples]:
        print(f"{line.name}: --drive {name_drive(each)}: {each.why}: {compare(each)}")


def show_drive(seed: int, drive: int, drives: int, names: Sequence[str]) -> None:
    """Print what became of one drive, in the stream of its fleet and in that of its car alone."""
    number = drive // DRIVES
    entry = make_entry(seed, number, choose_faults(seed, number, names))
    car = entry.log.car
    print(f"{car.name}: {' and '.join(each.name for each in entry.faults) or 'no fault'}; {car.describe()}")
    fleet = next(cars for cars in list_fleets(max(drives, drive + 1)) if number in cars)
    for where, verdicts in (("alone", judge_stream([entry])), ("in its fleet", run_fleet(seed, fleet, names))):
        for each in verdicts:
            if name_drive(each) == drive:
                print(f"{where}: {each.word} {each.why}\n  {compare(each)}")


if __name__ == "__main__":
    sys.exit(main())
