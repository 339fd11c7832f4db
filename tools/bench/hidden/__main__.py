"""`make bench-hidden`: hide effects, see whether diagnosis finds them, and keep the figures in BENCHMARKS.md.

python -m tools.bench.hidden --part one --seeds 2 --effects cold_rolling,headwind --shares 0.03 --measurements vi
"""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, get_args

from rich.console import Console
from rich.progress import Progress

from core.diagnose.diagnosis import diagnose
from core.errors import SettingsError, SocastError
from tools.bench.hidden.cases import Weather
from tools.bench.hidden.evaluation import Record
from tools.bench.hidden.figures import compute_figures, summarise_timing
from tools.bench.hidden.page import make_section, replace_section
from tools.bench.hidden.parts import PARTS, SEEDS, SHARES, Selection, draw_sample
from tools.bench.hidden.recording import Measurement
from tools.bench.hidden.running import PROCESSES, Task, make_tasks, run_tasks
from tools.simulator.hidden import EFFECTS
from tools.terminal.rich_table import Column, make_table

ROOT = Path(__file__).parent.parent.parent.parent
RECORDS = "bench-hidden.json"
PAGE = "BENCHMARKS.md"
QUICK = 60
"""Data sets of each part with `--quick`."""


def main(arguments: list[str] | None = None) -> int:
    """Run what was asked for; return the exit code."""
    asked = make_parser().parse_args(arguments)
    console = Console()
    try:
        choice = parse_selection(asked)
        parts = parse_list("--part", asked.part, tuple(PARTS))
        sizes = parse_sizes(str(QUICK) if asked.quick and asked.sample is None else asked.sample or "", parts)
        todo = [
            task for part in parts for task in make_tasks(part, draw_sample(list(PARTS[part](choice)), sizes.get(part)))
        ]
        todo.sort(key=lambda task: task[1][0].seed)  # the drives of a seed are made once for all parts
        records = collect_records(todo, asked.keep, asked.processes, console)
    except SocastError as error:
        print(error, file=sys.stderr)
        return 2
    print_figures(records, console)
    Path(asked.json or ROOT / RECORDS).write_text(json.dumps(records) + "\n", encoding="utf-8")
    if not asked.dry:
        path = ROOT / PAGE
        drawn = ", ".join(f"{size:,} of part {part}" for part, size in sizes.items())
        told = f"drawn at random: {drawn}" if drawn else "all data sets"
        new = make_section(records, f"{choice.seeds} seeds from {choice.first}, {told}")
        path.write_text(replace_section(path.read_text(encoding="utf-8"), new), encoding="utf-8")
    return 0


def make_parser() -> argparse.ArgumentParser:
    """Return what the command line may say."""
    found = argparse.ArgumentParser("bench-hidden", description=__doc__.splitlines()[0])
    found.add_argument("--part", default=",".join(PARTS), help=f"of {', '.join(PARTS)}; several with commas")
    found.add_argument("--seeds", type=int, default=SEEDS, help="how many simulations")
    found.add_argument("--first-seed", type=int, default=0, help="the first of them")
    found.add_argument("--effects", default=",".join(EFFECTS), help="with commas")
    found.add_argument("--shares", default=",".join(map(str, SHARES)), help="of the energy, with commas")
    found.add_argument("--measurements", default="vi,soc")
    found.add_argument("--weathers", default="none,noisy")
    found.add_argument("--shapes", default="first,other", help="the simulator's own, or another")
    found.add_argument("--sample", help="as many data sets, drawn at random: of each part, 60, or one=300,none=100")
    found.add_argument("--quick", action="store_true", help=f"--sample {QUICK}")
    found.add_argument("--keep", type=Path, help="folder for records; those that are there are not made again")
    found.add_argument("--processes", type=int, default=PROCESSES)
    found.add_argument("--json", type=Path, help=f"file for all records, by default {RECORDS}")
    found.add_argument("--dry", action="store_true", help=f"leave {PAGE} as it is")
    return found


def parse_sizes(text: str, parts: Sequence[str]) -> dict[str, int]:
    """Return how many data sets of each part are drawn; a part that is not there is taken whole.

    Raises
    ------
    SettingsError
    """
    pairs = [item.partition("=") for item in filter(None, text.split(","))]
    sizes = {name: size for name, equals, size in pairs if equals}
    sizes |= {part: name for name, equals, _ in pairs if not equals for part in parts}
    if any(not size.isdigit() or part not in parts for part, size in sizes.items()):
        raise SettingsError(f"--sample {text!r} is no size; write 60, or one=300,none=100 with parts of this run")
    return {part: int(size) for part, size in sizes.items()}


def parse_selection(asked: argparse.Namespace) -> Selection:
    """Return what of each part is run.

    Raises
    ------
    SettingsError
    """
    if asked.seeds < 1:
        raise SettingsError(f"--seeds is {asked.seeds}; give 1 or more")
    if asked.first_seed < 0:
        raise SettingsError(f"--first-seed is {asked.first_seed}; give 0 or more")
    try:
        shares = tuple(float(text) for text in asked.shares.split(","))
    except ValueError:
        raise SettingsError(f"--shares {asked.shares!r} are no numbers; write 0.015,0.03") from None
    return Selection(
        seeds=asked.seeds,
        first=asked.first_seed,
        effects=parse_list("--effects", asked.effects, tuple(EFFECTS)),
        shares=shares,
        measurements=parse_list("--measurements", asked.measurements, get_args(Measurement)),
        weathers=parse_list("--weathers", asked.weathers, get_args(Weather)),
        shapes=parse_list("--shapes", asked.shapes, ("first", "other")),
    )


def parse_list(option: str, text: str, known: tuple[str, ...]) -> tuple[Any, ...]:
    """Return names from a list with commas.

    Raises
    ------
    SettingsError
        For one that is unknown.
    """
    names = tuple(filter(None, (part.strip() for part in text.split(","))))
    for name in names:
        if name not in known:
            raise SettingsError(f"{option} {name!r} is unknown; choose from {', '.join(known)}")
    return names


def collect_records(todo: list[Task], keep: Path | None, processes: int, console: Console) -> list[Record]:
    """Return all records."""
    records: list[Record] = []
    with Progress(console=Console(stderr=True), transient=True, disable=not console.is_terminal) as progress:
        bar = progress.add_task("hiding and seeking", total=sum(len(cases) for _, cases in todo))
        for done in run_tasks(todo, diagnose, keep, processes):
            records += done
            progress.advance(bar, len(done))
    return records


def print_figures(records: list[Record], console: Console) -> None:
    """Print the figures."""
    columns = [Column("figure"), Column("goal"), Column("is", number=True), Column("of", number=True), Column("")]
    table = make_table(columns, "Hidden effects")
    for figure in compute_figures(records):
        if figure.of:
            table.add_row(figure.what, figure.goal, figure.text, str(figure.of), "met" if figure.met else "missed")
    console.print(table)
    seconds, ratio, count = summarise_timing(records)
    if count:
        console.print(f"{seconds:.2f} s a data set, {ratio:,.0f} times STLSQ, of {count}")
    for refused in [r for r in records if "refused" in r]:
        console.print(f"not made: {refused['hidden']}: {refused['refused']}", markup=False, highlight=False)


if __name__ == "__main__":
    sys.exit(main())
