"""Draw the falling error of the tutorial's model: `python -m tests.support.error_figure` writes `docs/error-falls.svg`.

The figure comes from the history of `better.json`, the model that the tutorial makes. A test compares its numbers with
those of the tutorial, so it is drawn again whenever they change.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

from socast.core import models
from tests.support.documented_commands import PAGE, documented_commands, prepare_folder, run_command
from tests.support.paths import ROOT

FIGURE: Final = ROOT / "docs" / "error-falls.svg"
WIDTH, HEIGHT = 820, 360
LEFT, RIGHT, TOP, BOTTOM = 90, 470, 52, 300
"""Edges of the plot. [px]"""
LIMIT: Final = 0.06
"""Upper end of the vertical axis. [kWh]"""
LABELS_APART: Final = 20.0
"""Least distance between the names of the two series. [px]"""
INK, QUIET, HELD_OUT, FINAL = "#1f2933", "#5f6b76", "#1f6fb2", "#b3560f"
STYLE: Final = "font-family='Helvetica, Arial, sans-serif'"


def error_figure(history: Sequence[Mapping[str, Any]]) -> str:
    """Return the figure of a model's history as SVG.

    Parameters
    ----------
    history : sequence of mapping
        Steps of a model file: first the fit, then the effects that were added.
    """
    steps = [step for step in history if step["action"] == "add"]
    places = [LEFT + 60 + (RIGHT - LEFT - 120) * i / len(steps) for i in range(len(steps) + 1)]
    names = [f"{history[0]['recipe']}, fitted", *(f"with {step['effect']}" for step in steps)]
    noise = steps[-1]["noise_floor_kwh"]
    lines = [
        (
            f"<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 {WIDTH} {HEIGHT}' width='{WIDTH}' height='{HEIGHT}' "
            f"role='img' {STYLE} font-size='14'>"
        ),
        "<title>Mean absolute error of a ride before and after the missing effect is added</title>",
        f"<rect width='{WIDTH}' height='{HEIGHT}' fill='#ffffff'/>",
        _text(LEFT - 60, 26, "Mean absolute error of a ride [kWh]", weight="bold"),
        (
            f"<rect x='{LEFT}' y='{_height(noise):.1f}' width='{RIGHT - LEFT}' height='{BOTTOM - _height(noise):.1f}' "
            "fill='#e9edf1'/>"
        ),
    ]
    for tick in range(round(LIMIT * 100) + 1):
        lines += _tick(tick / 100)
    lines += [_text(x, BOTTOM + 24, name, anchor="middle") for x, name in zip(places, names, strict=True)]
    lines.append(_text((LEFT + RIGHT) / 2, BOTTOM + 48, "step in the history of the model", QUIET, anchor="middle"))
    both = [
        (_errors([step["final"] for step in steps]), FINAL, "final hold-out days (decide nothing)"),
        (_errors(steps), HELD_OUT, "held-out days (effect not fitted to them)"),
    ]
    lower, upper = sorted(both, key=lambda series: series[0][-1])
    apart = max(0.0, LABELS_APART - (_height(lower[0][-1]) - _height(upper[0][-1]))) / 2
    lines += _series(places, *upper, above=True, shift=-apart)
    lines += _series(places, *lower, above=False, shift=apart)
    lines += [
        (
            f"<line x1='{LEFT}' x2='{RIGHT}' y1='{_height(noise):.1f}' y2='{_height(noise):.1f}' stroke='{QUIET}' "
            "stroke-width='2' stroke-dasharray='7 5'/>"
        ),
        _text(RIGHT + 14, _height(noise) + 5, f"{noise:.4f}  measurement noise: the error", QUIET),
        _text(RIGHT + 14, _height(noise) + 23, "that a perfect model would show", QUIET),
        "</svg>",
    ]
    return "\n".join(lines) + "\n"


def _errors(steps: Sequence[Mapping[str, Any]]) -> list[float]:
    """Return the error before the first step and after each. [kWh]"""
    return [steps[0]["mae_before_kwh"], *(step["mae_after_kwh"] for step in steps)]


def _height(error: float) -> float:
    """Return the vertical place of an error. [px]"""
    return BOTTOM - (BOTTOM - TOP) * error / LIMIT


def _text(x: float, y: float, words: str, colour: str = INK, *, anchor: str = "start", weight: str = "normal") -> str:
    return f"<text x='{x:.1f}' y='{y:.1f}' fill='{colour}' text-anchor='{anchor}' font-weight='{weight}'>{words}</text>"


def _tick(error: float) -> list[str]:
    """Return one line of the grid with its number."""
    y = _height(error)
    return [
        f"<line x1='{LEFT}' x2='{RIGHT}' y1='{y:.1f}' y2='{y:.1f}' stroke='#c9d1d9' stroke-width='1'/>",
        _text(LEFT - 10, y + 5, f"{error:.2f}", QUIET, anchor="end"),
    ]


def _series(
    places: Sequence[float], errors: Sequence[float], colour: str, name: str, *, above: bool, shift: float
) -> list[str]:
    """Return a line with points, its numbers above or below them, and its name at the right, shifted down. [px]"""
    points = list(zip(places, map(_height, errors), strict=True))
    path = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    end = points[-1][1]
    return [
        f"<polyline points='{path}' fill='none' stroke='{colour}' stroke-width='3'/>",
        *(f"<circle cx='{x:.1f}' cy='{y:.1f}' r='5' fill='{colour}'/>" for x, y in points),
        *(
            _text(x, y + (-12 if above else 24), f"{error:.4f}", colour, anchor="middle")
            for (x, y), error in zip(points[:-1], errors, strict=False)
        ),
        _text(RIGHT + 14, end + 5 + shift, f"{errors[-1]:.4f}  {name}", colour),
    ]


def main() -> None:
    """Run the tutorial as far as `better.json` and draw its history."""
    with TemporaryDirectory() as name:
        folder = prepare_folder(Path(name))
        for each in documented_commands(PAGE.read_text(encoding="utf-8")):
            run_command(each.command, folder)
            if (folder / "better.json").exists():
                break
        FIGURE.write_text(error_figure(models.load(str(folder / "better.json")).history), encoding="utf-8")
    print(f"{FIGURE.name}: written")


if __name__ == "__main__":
    main()
