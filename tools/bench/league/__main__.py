"""`python -m socast.tools.bench.league`: measure what the cleaning makes of faulty loggers, whose truth is known."""

import argparse
import json
import sys
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import asdict
from typing import Final, NamedTuple

from rich.console import Console
from rich.progress import Progress

from socast.tools.bench.figures.published import make_parser, publish, show_table, write_table
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
from socast.tools.bench.league.laws import AMOUNTS, ODD, UNFIT, WORDS, WRONG, Verdict

REASONS: Final = 3
"""Number of reasons that are named in a line."""
REPLAYED = 12
"""Number of cars whose stream is cut at random."""
PAIRS = 20
"""Number of pairs that are shown."""


class Line(NamedTuple):
    """Hold what became of the drives with the same faults."""

    name: str
    meaning: str
    drives: int
    words: Counter[str]
    reasons: Counter[str]
    wrong: list[Verdict]


def summarise(name: str, meaning: str, verdicts: Sequence[Verdict]) -> Line:
    """Return the line of some drives."""
    reasons = Counter(each.why for each in verdicts if each.word in {UNFIT, ODD})
    wrong = [each for each in verdicts if each.word == WRONG]
    return Line(name, meaning, len(verdicts), Counter(each.word for each in verdicts), reasons, wrong)


def list_alone(verdicts: Sequence[Verdict]) -> list[Line]:
    """Return a line for each fault alone, and one for no fault."""
    groups = _group(verdicts)
    lines = [summarise(CONTROL, "A logger without a fault.", groups[()])]
    lines += [summarise(each.name, each.meaning, groups[(each.name,)]) for each in FAULTS.values()]
    return [line for line in lines if line.drives]


def list_pairs(verdicts: Sequence[Verdict], most: int) -> list[Line]:
    """Return a line for all pairs together, and for those pairs of which most drives are wrong."""
    groups = {key: each for key, each in _group(verdicts).items() if len(key) > 1}
    lines = [summarise(" + ".join(key), "", each) for key, each in groups.items()]
    worst = sorted((line for line in lines if line.wrong), key=lambda line: (-len(line.wrong), line.name))
    together = summarise("all pairs", "", [each for group in groups.values() for each in group])
    return [together, *worst[:most]] if together.drives else []


def _group(verdicts: Sequence[Verdict]) -> dict[tuple[str, ...], list[Verdict]]:
    """Return the drives by the faults of their car."""
    groups = defaultdict[tuple[str, ...], list[Verdict]](list)
    for each in verdicts:
        groups[each.faults].append(each)
    return groups


def show_shares(line: Line) -> list[str]:
    """Return the shares of a line in percent, by word; empty where there is none."""
    return [f"{100.0 * line.words[word] / line.drives:.1f}" if line.words[word] else "" for word in WORDS]


def show_reasons(line: Line) -> str:
    """Return the most frequent reasons of unfit rides, and what is wrong."""
    unfit = [f"{why} {count}" for why, count in line.reasons.most_common(REASONS)]
    wrong = [f"**{why} {n}**" for why, n in Counter(each.why for each in line.wrong).most_common(REASONS)]
    return ", ".join([*unfit, *wrong])


def name_drive(verdict: Verdict) -> int:
    """Return the number of a drive, as `--drive` takes it."""
    return verdict.car * DRIVES + verdict.drive


def compare(verdict: Verdict) -> str:
    """Return what was found of a drive beside the truth."""
    if not verdict.found:
        return "no ride"
    units = {"distance_km": "km", "energy_kwh": "kWh", "duration_s": "s"}
    parts = [
        f"{verdict.found[name]:.3f} of {verdict.truth[name][0]:.3f} to {verdict.truth[name][1]:.3f} {units[name]}"
        for name in AMOUNTS
    ]
    found = verdict.found
    parts.append(
        f"{found['rides']} rides by {'/'.join(found['source']) or 'nothing'} ± {found['energy_sd_kwh']:.3f} kWh"
    )
    parts += [" ".join(f"{bit}:{count}" for bit, count in found["bits"].items()), " ".join(found["unfit"])]
    return "; ".join(part for part in parts if part)


def make_lines(verdicts: Sequence[Verdict], seed: int, replayed: int, pairs: int) -> list[str]:
    """Return the lines for the page of the documentation."""
    total = summarise("all", "", verdicts)
    shares = zip(WORDS, show_shares(total), strict=True)
    alone = [[f"`{line.name}`", line.meaning, *list_cells(line)] for line in list_alone(verdicts)]
    two = [[line.name, *list_cells(line)] for line in list_pairs(verdicts, pairs)]
    return [
        f"{total.drives:,} drives of seed {seed}: {', '.join(f'{share or 0} % {word}' for word, share in shares)}.",
        f"The forecasts and tables of {replayed:,} drives are the same to the byte when their stream is cut at random.",
        "",
        "### Each fault alone",
        "",
        *write_table(["fault", "what the logger does", "drives", *WORDS, "reasons"], alone),
        "",
        "### Pairs",
        "",
        *write_table(["faults", "drives", *WORDS, "reasons"], two),
    ]


def list_values(verdicts: Sequence[Verdict]) -> dict[str, str]:
    """Return the share of drives that are fit and wrong, for the table of results."""
    total = summarise("all", "", verdicts)
    shares = dict(zip(WORDS, show_shares(total), strict=True))
    return {"wrong": f"{shares[WRONG] or 0} %", "wrong_on": f"{total.drives:,} simulated drives with faults"}


def list_cells(line: Line) -> list[str]:
    """Return the cells of a row after its name."""
    return [str(line.drives), *show_shares(line), show_reasons(line)]


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
    verdicts = list[Verdict]()
    with Progress(console=Console(stderr=True), transient=True) as progress:
        for cars in progress.track(list_fleets(given.drives), description="driving"):
            verdicts += run_fleet(given.seed, cars, names)
    cars = range(min(REPLAYED, -(-given.drives // DRIVES)))
    differs = find_difference(given.seed, cars, names)
    if given.json:
        print(json.dumps({"seed": given.seed, "differs": differs, "drives": [asdict(each) for each in verdicts]}))
    else:
        _show(verdicts, given.examples)
        print(f"cut at random, {len(cars) * DRIVES} drives give {'other ' + differs if differs else 'the same bytes'}")
    if given.publish:
        command = f"python -m socast.tools.bench.league --drives {given.drives} --seed {given.seed}"
        replayed = 0 if differs else len(cars) * DRIVES
        publish("league", command, make_lines(verdicts, given.seed, replayed, PAIRS), list_values(verdicts))
    return int(bool(differs) or any(each.word == WRONG for each in verdicts))


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Return the options."""
    parser = make_parser("league", __doc__, publish=False)
    parser.add_argument("--drives", type=int, default=10_000, help="number of drives")
    parser.add_argument("--seed", type=int, default=1, help="seed of the drives and their faults")
    parser.add_argument("--faults", default="", metavar="NAMES", help="faults to choose from, with commas between them")
    parser.add_argument("--drive", type=int, help="show this drive only, with what was found and its truth")
    parser.add_argument("--examples", type=int, default=0, help="number of wrong drives to show of each fault")
    parser.add_argument("--json", action="store_true", help="print every drive as JSON")
    return parser.parse_args(arguments)


def _show(verdicts: Sequence[Verdict], examples: int) -> None:
    """Print the table, and some wrong drives of each of its lines."""
    lines = [*list_alone(verdicts), *list_pairs(verdicts, PAIRS), summarise("all", "", verdicts)]
    rows = [(line.name, str(line.drives), *show_shares(line), show_reasons(line).replace("*", "")) for line in lines]
    heads = ("faults", "drives", *WORDS, "reasons")
    show_table("What became of the drives [%]", heads, rows, f"-{'n' * (len(heads) - 2)}-")
    for line in lines[:-1]:
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
