"""Draw the elevation of a simulated ride: `python -m tests.support.elevation_figure` writes `docs/guide/elevation.svg`.

Map and fleet are those of `socast.tools.bench.elevation`: the map is learned from six days, and the ride is driven two
months later. It is the one with the largest climb up to `HIGHEST` of those between `SHORTEST` and `LONGEST`.
"""

import argparse
from datetime import UTC, datetime
from math import ceil, floor
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from socast.core.batch import Floats, Lanes
from socast.core.cleaning.elevation_smoother import smooth_elevation
from socast.core.cleaning.kernel import Cleaner
from socast.core.settings import Settings
from socast.core.wire.decoder import Decoder
from socast.tools.bench import elevation as bench
from tests.support.paths import ROOT

FIGURE: Final = ROOT / "docs" / "guide" / "elevation.svg"
SEED: Final = 5001
RIDE_DAY: Final = datetime(2018, 3, 19, tzinfo=UTC), 1
SHORTEST, LONGEST = 3_000.0, 6_000.0
"""Distance of the ride. [m]"""
HIGHEST: Final = 50.0
"""Largest climb of the ride. [m]"""
WIDTH, HEIGHT = 860, 560
LEFT, RIGHT = 70, 650
ELEVATION, ERROR = (44, 300), (352, 500)
"""Upper and lower edge of both plots. [px]"""
WORST: Final = 6.0
"""Ends of the axis of the error. [m]"""
INK, QUIET, GRID = "#1f2933", "#5f6b76", "#c9d1d9"
COLOURS: Final = {"causal": "#b3560f", "two-sided": "#1f6fb2", "two-sided, learned map": "#2b8a3e"}
STYLE: Final = "font-family='Helvetica, Arial, sans-serif'"


class FigureRide(NamedTuple):
    """Hold what the figure shows of a ride, n rows."""

    distance: Floats  # since the start [m]
    truth: Floats  # [m]
    fix: Floats  # as reported, NaN where the receiver repeats it [m]
    estimates: dict[str, Floats]  # [m]


def make_ride(keep: Path | None = None) -> FigureRide:
    """Return the ride of the figure.

    Parameters
    ----------
    keep : Path, optional
        Folder of learned maps, see `socast.tools.bench.elevation`.
    """
    learned = bench.learn_map(SEED, keep)
    messages, truth = bench.simulate_days(SEED, *RIDE_DAY)
    lanes = Lanes()
    batch, _ = Decoder(lanes).decode(messages)
    alone, on_map = (Cleaner(Settings(), each).clean(batch, len(lanes)) for each in (None, learned))
    smoothed, smoothed_on_map = smooth_elevation(alone), smooth_elevation(on_map)
    chosen, most = np.zeros(0, np.int64), 0.0
    for lane, ride in {*zip(alone.lane.tolist(), alone.ride.tolist(), strict=True)}:
        rows = np.flatnonzero((alone.lane == lane) & (alone.ride == ride))
        gained = float(np.maximum(smoothed.climb[rows], 0.0).sum())
        if ride >= 0 and SHORTEST < alone.distance[rows].sum() < LONGEST and most < gained <= HIGHEST:
            chosen, most = rows, gained
    heights = truth.heights[lanes.names[alone.lane[chosen[0]]]]
    time, height = (np.concatenate([part[k] for part in heights]) for k in (0, 1))
    estimates = alone.elevation, smoothed.elevation, smoothed_on_map.elevation
    return FigureRide(
        np.cumsum(alone.distance[chosen]),
        np.interp(alone.time[chosen], time, height),
        alone.elevation_fix[chosen],
        {name: each[chosen] for name, each in zip(COLOURS, estimates, strict=True)},
    )


def elevation_figure(ride: FigureRide) -> str:
    """Return the figure of a ride as SVG.

    Parameters
    ----------
    ride : FigureRide
        The ride.
    """
    low = 10.0 * floor(np.nanmin([ride.truth.min(), np.nanmin(ride.fix)]) / 10.0)
    high = 10.0 * ceil(np.nanmax([ride.truth.max(), np.nanmax(ride.fix)]) / 10.0)
    end = ceil(ride.distance[-1] / 500.0) * 500.0
    x = LEFT + (RIGHT - LEFT) * ride.distance / end

    def scale(values: Any, edges: tuple[int, int], low: float, high: float) -> Any:
        return edges[1] - (edges[1] - edges[0]) * (np.asarray(values) - low) / (high - low)

    lines = [
        (
            f"<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 {WIDTH} {HEIGHT}' width='{WIDTH}' "
            f"height='{HEIGHT}' role='img' {STYLE} font-size='14'>"
        ),
        "<title>Elevation over distance of a simulated ride: truth, fixes and estimates, and their errors</title>",
        f"<rect width='{WIDTH}' height='{HEIGHT}' fill='#ffffff'/>",
        _text(LEFT - 50, ELEVATION[0] - 18, "elevation [m]", weight="bold"),
        _text(LEFT - 50, ERROR[0] - 18, "error of the elevation [m]", weight="bold"),
    ]
    for tick in np.arange(low, high + 1.0, 10.0 if high - low <= 80.0 else 20.0):
        lines += _tick(float(scale(tick, ELEVATION, low, high)), f"{tick:.0f}")
    for tick in (-5.0, 0.0, 5.0):
        lines += _tick(float(scale(tick, ERROR, -WORST, WORST)), f"{tick:+.0f}" if tick else "0")
    for tick in np.arange(0.0, end + 1.0, 1000.0):
        place = LEFT + (RIGHT - LEFT) * tick / end
        lines.append(_text(place, ERROR[1] + 22, f"{tick / 1000.0:.0f}", QUIET, anchor="middle"))
    lines.append(_text((LEFT + RIGHT) / 2, ERROR[1] + 46, "distance [km]", QUIET, anchor="middle"))
    fixes = zip(x, scale(ride.fix, ELEVATION, low, high), strict=True)
    lines += [f"<circle cx='{a:.1f}' cy='{b:.1f}' r='1.8' fill='#9aa5b1'/>" for a, b in fixes if b == b]
    lines.append(_line(x, scale(ride.truth, ELEVATION, low, high), INK, 4.0))
    for name, estimate in ride.estimates.items():
        lines.append(_line(x, scale(estimate, ELEVATION, low, high), COLOURS[name], 2.0))
        error = np.clip(estimate - ride.truth, -WORST, WORST)
        lines.append(_line(x, scale(error, ERROR, -WORST, WORST), COLOURS[name], 2.0))
    return "\n".join([*lines, *_legend(ride), "</svg>"]) + "\n"


def _legend(ride: FigureRide) -> list[str]:
    """Return the names of the lines, with the root mean square of their errors."""
    at, y = RIGHT + 20, ELEVATION[0] + 10
    error = ride.fix - ride.truth
    names = [
        ("truth", INK, None),
        ("fixes", "#7b8794", float(np.sqrt(np.nanmean(error**2)))),
        *(
            (name, COLOURS[name], float(np.sqrt(np.mean((estimate - ride.truth) ** 2))))
            for name, estimate in ride.estimates.items()
        ),
    ]
    lines = []
    for number, (name, colour, rms) in enumerate(names):
        lines.append(_text(at, y + 44 * number, name, colour, weight="bold"))
        if rms is not None:
            lines.append(_text(at, y + 44 * number + 18, f"error {rms:.1f} m (rms)", QUIET))
    return lines


def _text(x: float, y: float, words: str, colour: str = INK, *, anchor: str = "start", weight: str = "normal") -> str:
    return f"<text x='{x:.1f}' y='{y:.1f}' fill='{colour}' text-anchor='{anchor}' font-weight='{weight}'>{words}</text>"


def _tick(y: float, words: str) -> list[str]:
    """Return one line of the grid with its number."""
    return [
        f"<line x1='{LEFT}' x2='{RIGHT}' y1='{y:.1f}' y2='{y:.1f}' stroke='{GRID}' stroke-width='1'/>",
        _text(LEFT - 10, y + 5, words, QUIET, anchor="end"),
    ]


def _line(x: Floats, y: Floats, colour: str, width: float) -> str:
    """Return a line through points."""
    points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))
    return (
        f"<polyline points='{points}' fill='none' stroke='{colour}' stroke-width='{width:g}' stroke-linejoin='round'/>"
    )


def main() -> None:
    """Simulate the ride and draw it."""
    parser = argparse.ArgumentParser(prog="python -m tests.support.elevation_figure", description=__doc__)
    parser.add_argument("--keep", type=Path, help="folder in which learned maps are kept")
    FIGURE.write_text(elevation_figure(make_ride(parser.parse_args().keep)), encoding="utf-8")
    print(f"{FIGURE.name}: written")


if __name__ == "__main__":
    main()
