"""`python -m tools.bench.league`: measure how the cleaning deals with the faults of loggers, and write the table."""

import argparse
from collections import Counter, defaultdict

from rich.console import Console
from rich.progress import Progress

from tools.bench.league.faults import FAULTS
from tools.bench.league.fleet import CONTROL, DRIVES, FLEET, make_entry, run_fleet, run_league
from tools.bench.league.laws import Verdict


def main() -> None:
    """Run the league and print its tables."""
    parser = argparse.ArgumentParser(prog="python -m tools.bench.league", description=__doc__)
    parser.add_argument("--drives", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--faults", default="")
    parser.add_argument("--drive", type=int)
    parser.add_argument("--pairs", type=int, default=15)
    parser.add_argument("--examples", type=int, default=2)
    given = parser.parse_args()
    names = [each for each in given.faults.split(",") if each]
    if given.drive is not None:
        show_drive(given.seed, given.drive, names)
        return
    verdicts = list[Verdict]()
    with Progress(console=Console(stderr=True), transient=True) as progress:
        total = -(-given.drives // DRIVES // FLEET) + 1
        for part in progress.track(run_league(given.seed, given.drives, names), total=total, description="driving"):
            verdicts += part
    show(verdicts, given.pairs, given.examples)


def show(verdicts: list[Verdict], pairs: int, examples: int) -> None:
    """Print the tables."""
    groups = defaultdict[tuple[str, ...], list[Verdict]](list)
    for each in verdicts:
        groups[each.faults].append(each)
    alone = [(CONTROL,) if not key else key for key in groups if len(key) < 2]
    print(f"{'fault':28} drives  right  rep.  unfit  odd  WRONG")
    for name in [CONTROL, *FAULTS]:
        if (name,) in alone:
            _line(name, groups[(name,) if name != CONTROL else ()], examples)
    worst = sorted((key for key in groups if len(key) > 1), key=lambda k: -sum(v.word == "wrong" for v in groups[k]))
    for key in worst[:pairs]:
        _line(" + ".join(key), groups[key], 0)
    _line("all pairs", [v for k in groups if len(k) > 1 for v in groups[k]], 0)
    _line("all", verdicts, 0)


def _line(name: str, of: list[Verdict], examples: int) -> None:
    words = Counter(each.word for each in of)
    why = Counter(f"{e.word} {e.why}" for e in of if e.why).most_common(5)
    print(
        f"{name:28} {len(of):6} {words['right']:6} {words['repaired']:5} {words['unfit']:6} {words['odd']:4}"
        f" {words['wrong']:6}   " + ", ".join(f"{w}: {n}" for w, n in why)
    )
    for each in [e for e in of if e.word == "wrong"][:examples]:
        print(f"      --drive {each.car * DRIVES + each.drive}: {_compare(each)}")


def _compare(of: Verdict) -> str:
    parts = [
        f"{name.partition('_')[0]} {of.found.get(name, float('nan')):.3f} of {low:.3f}..{high:.3f}"
        for name, (low, high) in of.truth.items()
    ]
    return (
        ", ".join(parts)
        + f" {of.found.get('rides')} rides {of.found.get('source')} sd {of.found.get('energy_sd_kwh', 0):.3f} {of.found.get('bits')} {of.found.get('unfit')}"
    )


def show_drive(seed: int, drive: int, names: list[str]) -> None:
    """Print what became of one drive."""
    number = drive // DRIVES
    entry = make_entry(seed, number, names)
    car = entry.log.car
    print(
        f"{car.name}: faults {[f.name for f in entry.faults]}, period {car.period}, announces {car.announces}, counts {car.counts}, names {car.names}, sends {sorted(car.sends)}, quantum {car.quantum}, stays {car.track.stays}"
    )
    first = number // FLEET * FLEET
    for each in run_fleet(seed, range(first, max(number + 1, first + 1)), names):
        if each.car == number:
            print(each.drive, each.word, each.why, _compare(each))


if __name__ == "__main__":
    main()
