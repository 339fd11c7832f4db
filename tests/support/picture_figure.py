"""Draw the picture of the tutorial's missing effect: `python -m tests.support.picture_figure` writes an SVG.

The figure comes from the diagnosis of `base.json`, the model that the tutorial makes. A test compares its numbers with
those of the tutorial, so it is drawn again whenever they change.
"""

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import pandas as pd

from socast.core import models
from socast.core.diagnose.diagnosis import diagnose
from socast.core.diagnose.records import NamedEffect
from socast.tools.report.diagnosis.finding_words import format_unit
from socast.tools.report.diagnosis.residual_figures import POWER, divide_units
from tests.support.documented_commands import PAGE, documented_commands, prepare_folder, run_command
from tests.support.paths import ROOT

FIGURE: Final = ROOT / "docs" / "missing-effect-picture.svg"
WIDTH, HEIGHT = 820, 420
LEFT, RIGHT, TOP, BOTTOM = 80, 800, 56, 350
"""Edges of the plot. [px]"""
INK, QUIET, BEFORE, AFTER, LINE = "#1f2933", "#5f6b76", "#b3560f", "#1f6fb2", "#1f9e77"
STYLE: Final = "font-family='Helvetica, Arial, sans-serif'"


def picture_figure(missing: NamedEffect) -> str:
    """Return the partial residual of a missing effect as SVG.

    Parameters
    ----------
    missing : mapping
        Its entry in the result of a diagnosis.
    """
    part = missing.partial_residual
    power = POWER[part.per]
    ends = [half or 0.0 for half in part.ci95]
    low = min(y - end for name in ("before", "after") for y, end in zip(getattr(part, name), ends, strict=True))
    high = max(y + end for name in ("before", "after") for y, end in zip(getattr(part, name), ends, strict=True))
    span = (min(0.0, *part.x), max(0.0, *part.x))
    room = 0.05 * (span[1] - span[0])

    def place(x: float, y: float) -> tuple[float, float]:
        across = (x - span[0] + room) / (span[1] - span[0] + 2.0 * room)
        return LEFT + (RIGHT - LEFT) * across, BOTTOM - (BOTTOM - TOP) * (y - low) / (high - low)

    slopes = [part.slope, *part.slope_ci95]
    fan = [*_fan(span, slopes, max), *_fan(span, slopes, min)[::-1]]
    unit = divide_units(power, format_unit(part.unit))
    regressor = f"{'Energy per km' if part.per == 'km' else 'Power'} per {format_unit(part.unit)} [{unit}]"
    lines = [
        (
            f"<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 {WIDTH} {HEIGHT}' width='{WIDTH}' height='{HEIGHT}' "
            f"role='img' {STYLE} font-size='14'>"
        ),
        f"<title>Measured less predicted, before and after {missing.effect} is added</title>",
        f"<rect width='{WIDTH}' height='{HEIGHT}' fill='#ffffff'/>",
        _text(16, 24, f"Measured less predicted [{power}]", weight="bold"),
        _text(LEFT + 250, 24, "● before", BEFORE),
        _text(LEFT + 330, 24, f"□ after {missing.effect} is added", AFTER),
        _text(LEFT + 520, 24, f"slope {slopes[0]:.3g} {format_unit(part.unit)}", LINE),
    ]
    for tick in _ticks(low, high):
        x, y, colour = LEFT, place(0.0, tick)[1], "#8a8a8a" if tick == 0.0 else "#dde2e7"
        lines.append(f"<line x1='{x}' x2='{RIGHT}' y1='{y:.1f}' y2='{y:.1f}' stroke='{colour}'/>")
        lines.append(_text(x - 8, y + 5, f"{tick:g}", QUIET, anchor="end"))
    for tick in _ticks(*span):
        x = place(tick, 0.0)[0]
        lines += [
            f"<line x1='{x:.1f}' x2='{x:.1f}' y1='{BOTTOM}' y2='{BOTTOM + 5}' stroke='#8a8a8a'/>",
            _text(x, BOTTOM + 22, f"{tick:g}", QUIET, anchor="middle"),
        ]
    points = " ".join(f"{x:.1f},{y:.1f}" for x, y in (place(*each) for each in fan))
    lines.append(f"<polygon points='{points}' fill='{LINE}' opacity='0.2'/>")
    (x0, y0), (x1, y1) = (place(x, slopes[0] * x) for x in span)
    lines.append(f"<line x1='{x0:.1f}' y1='{y0:.1f}' x2='{x1:.1f}' y2='{y1:.1f}' stroke='{LINE}' stroke-width='2'/>")
    for name, colour in (("after", AFTER), ("before", BEFORE)):
        for at, value, end in zip(part.x, getattr(part, name), ends, strict=True):
            (x, y), top, bottom = place(at, value), place(at, value + end)[1], place(at, value - end)[1]
            x += 3.0 if name == "after" else -3.0
            lines.append(f"<line x1='{x:.1f}' x2='{x:.1f}' y1='{top:.1f}' y2='{bottom:.1f}' stroke='{colour}'/>")
            lines.append(
                f"<circle cx='{x:.1f}' cy='{y:.1f}' r='4.5' fill='{colour}'/>"
                if name == "before"
                else f"<rect x='{x - 4:.1f}' y='{y - 4:.1f}' width='8' height='8' fill='#ffffff' stroke='{colour}'/>"
            )
    lines += [_text((LEFT + RIGHT) / 2, BOTTOM + 52, regressor, anchor="middle"), "</svg>"]
    return "\n".join(lines) + "\n"


def _fan(span: tuple[float, float], slopes: Sequence[float], pick: Any) -> list[tuple[float, float]]:
    """Return one edge of the band of lines through the origin."""
    return [(x, pick(slope * x for slope in slopes)) for x in (span[0], 0.0, span[1])]


def _ticks(low: float, high: float) -> list[float]:
    """Return multiples of ten within a range, of five where they would be few."""
    step = 10.0 if high - low >= 40.0 else 5.0
    return [step * k for k in range(-100, 101) if low <= step * k <= high]


def _text(x: float, y: float, words: str, colour: str = INK, *, anchor: str = "start", weight: str = "normal") -> str:
    return f"<text x='{x:.1f}' y='{y:.1f}' fill='{colour}' text-anchor='{anchor}' font-weight='{weight}'>{words}</text>"


def diagnose_base(folder: Path) -> NamedEffect:
    """Return the first missing effect of `base.json` in the folder of the tutorial."""
    rides, windows = (pd.read_parquet(folder / "autumn" / f"{name}.parquet") for name in ("rides", "windows"))
    return diagnose(rides, windows, models.load(str(folder / "base.json"))).missing[0]


def main() -> None:
    """Run the tutorial as far as `base.json` and draw the picture of the effect that it lacks."""
    with TemporaryDirectory() as name:
        folder = prepare_folder(Path(name))
        for each in documented_commands(PAGE.read_text(encoding="utf-8")):
            run_command(each.command, folder)
            if (folder / "base.json").exists():
                break
        FIGURE.write_text(picture_figure(diagnose_base(folder)), encoding="utf-8")
    print(f"{FIGURE.name}: written")


if __name__ == "__main__":
    main()
