"""`make bench`: measure, print, and keep the figures in bench.json and BENCHMARKS.md."""

import json
import os
import platform
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

from rich.console import Console
from rich.progress import Progress

from tools.bench.daily_update import measure_daily_update
from tools.bench.filters import measure_filters
from tools.bench.hidden.page import read_section, replace_section
from tools.bench.learning import measure_fit, measure_fit_memory
from tools.bench.live import measure_live
from tools.bench.measures import Measure, measure_arrays, measure_replay, measure_scale
from tools.bench.startup import measure_effects_start, measure_help_start, measure_version_start
from tools.terminal.rich_table import Column, make_table

MEASURES: tuple[Callable[[], Measure], ...] = (
    measure_live,
    measure_replay,
    measure_arrays,
    measure_scale,
    measure_filters,
    measure_daily_update,
    measure_fit,
    measure_fit_memory,
    measure_help_start,
    measure_version_start,
    measure_effects_start,
)
ROOT = Path(__file__).parent.parent.parent


def main() -> None:
    """Run every measure."""
    console = Console()
    with Progress(console=Console(stderr=True), transient=True) as progress:
        measures = [measure() for measure in progress.track(MEASURES, description="measuring")]
    columns = [Column("what"), Column("against"), Column("ratio", number=True), Column("goal"), Column("")]
    table = make_table(columns, "Ratios of speed, measured in turn in one run")
    for found in measures:
        mark = "met" if found.met else "missed"
        table.add_row(found.name, found.over, f"{found.ratio:.2f}", found.goal, mark)
    console.print(table)
    content = [asdict(found) for found in measures]
    (ROOT / "bench.json").write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    path = ROOT / "BENCHMARKS.md"
    hidden = read_section(path)  # of `make bench-hidden`
    path.write_text(replace_section(make_page(measures), hidden) if hidden else make_page(measures), encoding="utf-8")


def make_page(measures: list[Measure]) -> str:
    """Return BENCHMARKS.md."""
    lines = [
        "# Benchmarks",
        "",
        f"Written by `make bench`, on {os.cpu_count()} cores, Python {platform.python_version()}. Ratios of medians of",
        "two things measured in turn in one run; the machine is shared and noisy, so read ratios, not seconds.",
        "",
        "| what | against | ratio | goal | |",
        "|---|---|---|---|---|",
    ]
    for found in measures:
        met = "met" if found.met else "missed"
        lines.append(f"| {found.name} | {found.over} | {found.ratio:.2f} | {found.goal} | {met} |")
    lines += ["", "## What bounds each", ""]
    for found in measures:
        figures = ", ".join(f"{name} {value:,.3g}" for name, value in found.figures.items())
        figures = figures.replace("e+05", "e5").replace("e+06", "e6")
        lines += [f"**{found.name[0].upper()}{found.name[1:]}** ({figures}). {found.bound}", ""]
    return "\n".join(lines)


if __name__ == "__main__":
    main()
