"""Draw the table of a live shift: `python -m tests.support.live_figure` writes `docs/live.svg`.

The shift is that of the demonstration, after some hours.
"""

from dataclasses import replace
from io import StringIO
from re import DOTALL, sub
from typing import Final

from rich._export_format import CONSOLE_SVG_FORMAT
from rich.console import Console

from socast.core.pipeline import Pipeline
from socast.stream.loop import Tally
from socast.stream.mcap_reader import McapSource
from socast.tools.terminal.live_table import count_received, describe_counts, make_fleet_table
from tests.support.evening_shift import EVENING, make_evening_pipeline
from tests.support.paths import ROOT

FIGURE: Final = ROOT / "docs" / "live.svg"
WIDTH: Final = 162
"""Width of the terminal. [characters]"""
FONTS: Final = "ui-monospace, Menlo, Consolas, 'DejaVu Sans Mono', monospace"
"""Fonts of the figure, which a reader has; it asks no other host for one."""
SHOWN: Final = 0.55
"""Share of the messages of the shift after which the table is drawn."""


def run_shift(share: float = SHOWN) -> tuple[Pipeline, Tally]:
    """Return a pipeline that has taken a share of the messages of the shift, and its counts."""
    pipeline, tally, blocks = make_evening_pipeline(), Tally(), list(McapSource(EVENING))
    last = share * sum(map(len, blocks))
    for block in blocks:
        if tally.received >= last:
            break
        pipeline.take(block)
        elapsed = (block[-1].receipt_ns - blocks[0][0].receipt_ns) / 1e9
        forecasts = tally.forecasts + len(pipeline.forecasts())
        tally = replace(tally, received=tally.received + len(block), forecasts=forecasts, seconds=elapsed)
    return pipeline, tally


def live_figure(pipeline: Pipeline, tally: Tally) -> str:
    """Return the table of cars as SVG."""
    console = Console(record=True, width=WIDTH, file=StringIO(), force_terminal=True, color_system="truecolor")
    cars = pipeline.status()
    caption = describe_counts(tally, count_received(pipeline.quality()))
    console.print(make_fleet_table(cars, "Live", caption, len(cars)))
    form = sub(r"@font-face \{\{.*?\}\}", "", CONSOLE_SVG_FORMAT, flags=DOTALL).replace("Fira Code, monospace", FONTS)
    return console.export_svg(title="socast live", unique_id="live", code_format=form)


def main() -> None:
    """Run the shift and draw the table."""
    FIGURE.write_text(live_figure(*run_shift()), encoding="utf-8")
    print(f"{FIGURE.name}: written")


if __name__ == "__main__":
    main()
