"""Hide effects, count how often diagnosis names them, and publish the figures.

Example: python -m socast.tools.bench.hidden --part one --seeds 2 --effects cold_rolling,headwind --measurements vi
"""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, get_args

from rich.console import Console
from rich.progress import Progress

from socast.core.diagnose.diagnosis import diagnose
from socast.core.errors import SettingsError
from socast.tools.bench.figures.published import ROOT, make_parser, publish, show_table, tell_errors
from socast.tools.bench.hidden.cases import PARTS, SEEDS, SHAPES, SHARES, Selection, Weather, draw_sample
from socast.tools.bench.hidden.evaluation import Record
from socast.tools.bench.hidden.figures import FILE, compute_figures, draw_reliability, list_stated, summarise_timing
from socast.tools.bench.hidden.page import list_values, make_lines
from socast.tools.bench.hidden.recording import Measurement
from socast.tools.bench.hidden.running import PROCESSES, Task, export_tasks, make_tasks, run_tasks
from socast.tools.simulator.hidden import EFFECTS

RECORDS = "bench-hidden.json"
QUICK = 60
"""Number of data sets of each part with `--quick`."""


def _diagnose(*tables: Any, **options: Any) -> dict[str, Any]:
    """Return the JSON values of a diagnosis that uses all rides."""
    return diagnose(*tables, leave_out=(), **options).to_json()


@tell_errors
def main(arguments: list[str] | None = None) -> None:
    """Run the benchmark."""
    options = _parse(arguments)
    console = Console()
    choice = parse_selection(options)
    parts = parse_list("--part", options.part, tuple(PARTS))
    sizes = parse_sizes(str(QUICK) if options.quick and options.sample is None else options.sample or "", parts)
    todo = [
        task for part in parts for task in make_tasks(part, draw_sample(list(PARTS[part](choice)), sizes.get(part)))
    ]
    todo.sort(key=lambda task: task[1][0].seed)  # so that the drives of a seed are simulated once for all parts
    if options.export:
        count = export_tasks(todo, options.export, options.processes)
        console.print(f"{count:,} data sets written to {options.export}", highlight=False)
        return
    records = collect_records(todo, options.keep, options.processes, console)
    print_figures(records, console)
    Path(options.json or ROOT / RECORDS).write_text(json.dumps(records) + "\n", encoding="utf-8")
    if options.publish:
        words = ["--part", ",".join(parts), "--seeds", str(choice.seeds), "--first-seed", str(choice.first)]
        words += ["--sample", ",".join(f"{part}={size}" for part, size in sizes.items())] if sizes else []
        publish(
            "hidden-effects",
            f"python -m socast.tools.bench.hidden {' '.join(words)} --keep build/hidden",
            make_lines(records),
            list_values(records),
        )
        (ROOT / FILE).write_text(draw_reliability(list_stated(records)), encoding="utf-8")


def _parse(arguments: list[str] | None) -> argparse.Namespace:
    """Return the options."""
    parser = make_parser("hidden", __doc__, keep=None, publish=False)
    parser.add_argument("--part", default=",".join(PARTS), help=f"parts, separated by commas: {', '.join(PARTS)}")
    parser.add_argument("--seeds", type=int, default=SEEDS, help="number of simulations")
    parser.add_argument("--first-seed", type=int, default=0, help="first seed")
    parser.add_argument("--effects", default=",".join(EFFECTS), help="effects, separated by commas")
    parser.add_argument("--shares", default=",".join(map(str, SHARES)), help="shares of the energy")
    parser.add_argument("--measurements", default="vi,soc", help="vi (voltage and current) or soc only")
    parser.add_argument("--weathers", default="none,noisy", help="error of the weather: none or noisy")
    parser.add_argument("--shapes", default=",".join(SHAPES), help=f"shapes of the effects: {', '.join(SHAPES)}")
    parser.add_argument("--sample", help="number of data sets drawn from each part: 60, or one=300,none=100")
    parser.add_argument("--quick", action="store_true", help=f"same as --sample {QUICK}")
    parser.add_argument("--processes", type=int, default=PROCESSES, help="number of processes")
    parser.add_argument("--json", type=Path, help=f"file for all records; default {RECORDS}")
    parser.add_argument("--export", type=Path, help="folder for the data sets as Parquet files; nothing is diagnosed")
    return parser.parse_args(arguments)


def parse_sizes(text: str, parts: Sequence[str]) -> dict[str, int]:
    """Return the number of data sets to draw of each part; a part without a number is run completely."""
    pairs = [item.partition("=") for item in filter(None, text.split(","))]
    sizes = {name: size for name, equals, size in pairs if equals}
    sizes |= {part: name for name, equals, _ in pairs if not equals for part in parts}
    if any(not size.isdigit() or part not in parts for part, size in sizes.items()):
        raise SettingsError(f"--sample is {text!r}; give a number such as 60, or parts of this run as one=300,none=100")
    return {part: int(size) for part, size in sizes.items()}


def parse_selection(options: argparse.Namespace) -> Selection:
    """Return the selection of data sets from the command line."""
    if options.seeds < 1:
        raise SettingsError(f"--seeds is {options.seeds}; give 1 or more")
    if options.first_seed < 0:
        raise SettingsError(f"--first-seed is {options.first_seed}; give 0 or more")
    try:
        shares = tuple(float(text) for text in options.shares.split(","))
    except ValueError:
        raise SettingsError(f"--shares is {options.shares!r}; give numbers such as 0.015,0.03") from None
    return Selection(
        seeds=options.seeds,
        first=options.first_seed,
        effects=parse_list("--effects", options.effects, tuple(EFFECTS)),
        shares=shares,
        measurements=parse_list("--measurements", options.measurements, get_args(Measurement)),
        weathers=parse_list("--weathers", options.weathers, get_args(Weather)),
        shapes=parse_list("--shapes", options.shapes, SHAPES),
    )


def parse_list(option: str, text: str, known: tuple[str, ...]) -> tuple[Any, ...]:
    """Return names from a comma-separated list."""
    names = tuple(filter(None, (part.strip() for part in text.split(","))))
    for name in names:
        if name not in known:
            raise SettingsError(f"{option} {name!r} is unknown; choose from {', '.join(known)}")
    return names


def collect_records(todo: list[Task], keep: Path | None, processes: int, console: Console) -> list[Record]:
    """Return the records of all data sets."""
    records: list[Record] = []
    with Progress(console=Console(stderr=True), transient=True, disable=not console.is_terminal) as progress:
        bar = progress.add_task("diagnosing data sets", total=sum(len(cases) for _, cases in todo))
        for done in run_tasks(todo, _diagnose, keep, processes):
            records += done
            progress.advance(bar, len(done))
    return records


def print_figures(records: list[Record], console: Console) -> None:
    """Print the figures."""
    rows = [
        (figure.what, figure.goal, figure.text, figure.interval, str(figure.of), figure.verdict)
        for figure in compute_figures(records)
        if figure.of
    ]
    show_table("Hidden effects", ("figure", "goal", "is", "95 % interval", "of", ""), rows, "--n-n-")
    seconds, ratio, count = summarise_timing(records)
    if count:
        console.print(f"{seconds:.2f} s a data set, {ratio:,.0f} times STLSQ, of {count}")
    for refused in [r for r in records if "refused" in r]:
        console.print(f"not made: {refused['hidden']}: {refused['refused']}", markup=False, highlight=False)


if __name__ == "__main__":
    sys.exit(main())
