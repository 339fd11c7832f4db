"""`make bench`: measure ratios of speed, print them, and publish them."""

import argparse
from collections.abc import Callable
from functools import partial
from typing import Final

from rich.console import Console
from rich.progress import Progress

from socast.tools.bench.figures.published import publish, show_table, write_table, write_verdict
from socast.tools.bench.filters import measure_daily_update, measure_filters
from socast.tools.bench.live import measure_live, measure_security
from socast.tools.bench.measures import (
    Measure,
    measure_arrays,
    measure_fit,
    measure_fit_memory,
    measure_scale,
    measure_start,
)
from socast.tools.bench.replay import measure_decoding, measure_replay, measure_small_blocks

HEADS: Final = ("what", "against", "ratio", "goal", "")
STARTS: Final = (
    ("--help", 15.0, "Half of it is typer and the rest the standard library; no command is imported."),
    ("--version", 15.0, "As for --help; reading the version takes 20 ms of `importlib.metadata`."),
    ("effects list", 50.0, "A third is importing numpy, a fifth typer with its validation, a tenth rich."),
)
"""Words of a command, the largest ratio of its start to that of the interpreter, and what limits it."""
MEASURES: Final[tuple[Callable[[], Measure | list[Measure]], ...]] = (
    measure_live,
    measure_security,
    measure_replay,
    measure_decoding,
    measure_small_blocks,
    measure_arrays,
    measure_scale,
    measure_filters,
    measure_daily_update,
    measure_fit,
    measure_fit_memory,
    *(partial(measure_start, *start) for start in STARTS),
)


def main() -> None:
    """Run every measure, print the ratios, and publish them."""
    argparse.ArgumentParser(prog="python -m socast.tools.bench", description=__doc__).parse_args()
    with Progress(console=Console(stderr=True), transient=True) as progress:
        results = [measure() for measure in progress.track(MEASURES, description="measuring")]
    measures = [each for result in results for each in (result if isinstance(result, list) else [result])]
    show_table("Ratios of speed, measured in turn in one run", HEADS, list_rows(measures), "--n--")
    publish("speed", "make bench", make_lines(measures))


def list_rows(measures: list[Measure]) -> list[list[str]]:
    """Return the cells of each measure."""
    return [[each.name, each.over, f"{each.ratio:.2f}", each.goal, write_verdict(each.met)] for each in measures]


def make_lines(measures: list[Measure]) -> list[str]:
    """Return the lines for the pages."""
    lines = [
        (
            "Each ratio compares the medians of two things measured in turn in one run. The machine is shared and "
            "noisy: read ratios, not seconds."
        ),
        "",
        *write_table(HEADS, list_rows(measures)),
        "",
        "### What limits each measure",
    ]
    for measure in measures:
        figures = ", ".join(f"{name} {value:,.3g}" for name, value in measure.figures.items())
        figures = f" ({figures})".replace("e+05", "e5").replace("e+06", "e6") if figures else ""
        lines += ["", f"**{measure.name[0].upper()}{measure.name[1:]}**{figures}. {measure.bound}"]
    return lines


if __name__ == "__main__":
    main()
