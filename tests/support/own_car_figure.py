"""Draw what the tutorial of one's own car finds: `python -m tests.support.own_car_figure` writes `docs/own-car.svg`.

The figure comes from the diagnosis that the tutorial runs. A test compares its points with those of the tutorial.
"""

from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import numpy as np
import pandas as pd

from socast.core import models
from socast.core.diagnose.diagnosis import diagnose
from socast.core.diagnose.records import CarDeviation
from tests.support.documented_commands import documented_commands, prepare_folder, run_command
from tests.support.paths import ROOT

PAGE: Final = ROOT / "docs" / "own-car.md"
FIGURE: Final = ROOT / "docs" / "own-car.svg"
WIDTH, HEIGHT = 560, 360
LEFT, RIGHT, TOP, BOTTOM = 62, 544, 74, 300
"""Edges of the plot. [px]"""
LOW, HIGH = -0.25, 0.25
"""Ends of the vertical axis. [1]"""
INK, QUIET, POINT, STEP, BAND = "#1f2933", "#5f6b76", "#1f6fb2", "#b3560f", "#f3e3d3"
STYLE: Final = "font-family='Helvetica, Arial, sans-serif'"
DAY: Final = 86_400.0


def own_car_figure(found: CarDeviation) -> str:
    """Return the energy of each day beside the model's, and the date of the change, as SVG.

    Parameters
    ----------
    found : mapping
        The change, from the result of a diagnosis.
    """
    days = [each.start_s for each in found.shifts]
    first, last = min(days) - DAY, max(days) + DAY
    since, early, late = (_to_seconds(day) for day in (found.since, *found.since_ci90))

    def across(time: float) -> float:
        return LEFT + (RIGHT - LEFT) * (time - first) / (last - first)

    def up(share: float) -> float:
        return BOTTOM - (BOTTOM - TOP) * (share - LOW) / (HIGH - LOW)

    lines = [
        (
            f"<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 {WIDTH} {HEIGHT}' width='{WIDTH}' height='{HEIGHT}' "
            f"role='img' {STYLE} font-size='15'>"
        ),
        "<title>Measured less predicted energy of each day: it rises on 19 June and stays</title>",
        f"<rect width='{WIDTH}' height='{HEIGHT}' fill='#ffffff'/>",
        _text(14, 24, "Measured less predicted energy [%]", weight="bold"),
        _text(14, 48, "● one day, ±1 standard error", POINT),
        _text(250, 48, "▬ mean before and since the change", STEP),
        (
            f"<rect x='{across(early):.1f}' y='{TOP}' width='{across(late) - across(early):.1f}' "
            f"height='{BOTTOM - TOP}' fill='{BAND}'/>"
        ),
    ]
    for tick in (-0.2, -0.1, 0.0, 0.1, 0.2):
        colour = "#8a8a8a" if tick == 0.0 else "#dde2e7"
        lines.append(f"<line x1='{LEFT}' x2='{RIGHT}' y1='{up(tick):.1f}' y2='{up(tick):.1f}' stroke='{colour}'/>")
        lines.append(_text(LEFT - 8, up(tick) + 5, f"{100 * tick:g}".replace("-", "−"), QUIET, anchor="end"))
    for each in found.shifts:
        x, y, half = across(each.start_s), up(each.share), each.error * (BOTTOM - TOP) / (HIGH - LOW)
        lines.append(
            f"<line x1='{x:.1f}' x2='{x:.1f}' y1='{y - half:.1f}' y2='{y + half:.1f}' stroke='{POINT}' opacity='0.5'/>"
        )
        lines.append(f"<circle cx='{x:.1f}' cy='{y:.1f}' r='4.5' fill='{POINT}'/>")
    for inside, ends in ((lambda day: day < since, (first, since)), (lambda day: day >= since, (since, last))):
        level = float(np.mean([each.share for each in found.shifts if inside(each.start_s)]))
        lines.append(
            f"<line x1='{across(ends[0]):.1f}' x2='{across(ends[1]):.1f}' y1='{up(level):.1f}' y2='{up(level):.1f}' "
            f"stroke='{STEP}' stroke-width='3'/>"
        )
    for day in ("2019-06-01", "2019-06-10", "2019-06-19", "2019-07-01"):
        x = across(_to_seconds(day))
        words = f"{datetime.fromisoformat(day):%d %B}".lstrip("0")
        lines.append(f"<line x1='{x:.1f}' x2='{x:.1f}' y1='{BOTTOM}' y2='{BOTTOM + 5}' stroke='#8a8a8a'/>")
        lines.append(_text(x, BOTTOM + 22, words, QUIET, anchor="middle"))
    middle = (across(early) + across(late)) / 2
    lines += [_text(middle, BOTTOM + 46, "probable date (90 %)", STEP, anchor="middle"), "</svg>"]
    return "\n".join(lines) + "\n"


def _to_seconds(day: str) -> float:
    """Return the Unix time at which a day begins. [s]"""
    return datetime.fromisoformat(day).replace(tzinfo=UTC).timestamp()


def _text(x: float, y: float, words: str, colour: str = INK, *, anchor: str = "start", weight: str = "normal") -> str:
    return f"<text x='{x:.1f}' y='{y:.1f}' fill='{colour}' text-anchor='{anchor}' font-weight='{weight}'>{words}</text>"


def find_change(folder: Path) -> CarDeviation:
    """Return the change that the diagnosis of the tutorial finds."""
    rides, windows = (pd.read_parquet(folder / "commuter" / f"{name}.parquet") for name in ("rides", "windows"))
    found = diagnose(rides, windows, models.load(str(folder / "commuter.json")))
    return found.deviations[0]


def main() -> None:
    """Run the tutorial as far as its model and draw what the diagnosis finds."""
    with TemporaryDirectory() as name:
        folder = prepare_folder(Path(name))
        for each in documented_commands(PAGE.read_text(encoding="utf-8")):
            run_command(each.command, folder)
            if (folder / "commuter.json").exists():
                break
        FIGURE.write_text(own_car_figure(find_change(folder)), encoding="utf-8")
    print(f"{FIGURE.name}: written")


if __name__ == "__main__":
    main()
