"""`make figures`: measure every figure of the pages, and write them there.

Example: python -m socast.tools.bench.figures --only speed,league
"""

import subprocess
import sys
import time
from collections.abc import Sequence
from typing import Final, NamedTuple

from rich.console import Console

from socast.tools.bench.figures.published import ROOT, make_parser, write_pages


class Measurement(NamedTuple):
    """Hold how a measurement is made.

    Parameters
    ----------
    minutes : int
        Time that it takes on two cores. [min]
    """

    minutes: int
    words: tuple[str, ...]


_BENCH: Final = "socast.tools.bench"
TWO_FOLDERS: Final = "evaluation", "soc-forecasts"
"""Measurements that take the folders of two cars, if they are given."""
REAL: Final = "real-cars", "real-condition"
"""Measurements that take the folders of three cars, and are left out without one."""
REAL_FOLDERS: Final = 3
"""Their number."""
MEASUREMENTS: Final = {
    "evaluation": Measurement(5, (f"{_BENCH}.figures.evaluation", "--keep", "build/evaluation")),
    "soc-forecasts": Measurement(15, (f"{_BENCH}.figures.soc_forecasts", "--keep", "build/soc")),
    "soc-ablation": Measurement(15, (f"{_BENCH}.soc_ablation", "--keep", "build/ablation")),
    "hidden-effects": Measurement(
        25,
        (
            *(f"{_BENCH}.hidden", "--publish", "--seeds", "10", "--first-seed", "800", "--keep", "build/hidden"),
            *("--part", "one,two,outside", "--sample", "one=100,two=30,outside=30"),
        ),
    ),
    "nothing-hidden": Measurement(
        10, (f"{_BENCH}.nothing_hidden", "--publish", "--seeds", "4501-4540", "--keep", "build/nothing")
    ),
    "error-location": Measurement(
        10, (f"{_BENCH}.error_location", "--publish", "--seeds", "7421-7432", "--keep", "build/location")
    ),
    "condition": Measurement(2, (f"{_BENCH}.condition_fleets",)),
    "waterfall": Measurement(
        10, (f"{_BENCH}.waterfall", "--publish", "--seeds", "5101-5110", "--json", "build/waterfall.json")
    ),
    "siblings": Measurement(10, (f"{_BENCH}.siblings", "--publish", "--seeds", "325-334", "--keep", "build/siblings")),
    "coefficients": Measurement(
        10, (f"{_BENCH}.coefficients", "--publish", "--seeds", "3201-3260", "--json", "build/coefficients.json")
    ),
    "periods": Measurement(5, (f"{_BENCH}.periods", "--publish", "6001", "--json", "build/periods.json")),
    "elevation": Measurement(
        15, (f"{_BENCH}.elevation", "--publish", "5001", "5002", "5003", "--json", "build/elevation.json")
    ),
    "real-cars": Measurement(15, (f"{_BENCH}.real_cars", "--publish", "--keep", "build/real")),
    "real-condition": Measurement(2, (f"{_BENCH}.real_condition", "--keep", "build/real")),
    "league": Measurement(5, (f"{_BENCH}.league", "--publish", "--drives", "10000")),
    "live-cost": Measurement(2, (f"{_BENCH}.live_cost", "--publish")),
    "speed": Measurement(10, (_BENCH,)),
}
"""Measurements by the name of their block. Ratios of speed come last, when nothing else runs."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure what was asked for, and write the pages; return 1 if a measurement fails."""
    parser = make_parser("figures", __doc__, ved=None, i3=None, model3=None)
    parser.add_argument("--only", default=",".join(MEASUREMENTS), help="measurements, separated by commas")
    parser.add_argument("--render", action="store_true", help="measure nothing, write the pages from what is kept")
    given = parser.parse_args(arguments)
    folders = [f"--{name}={path}" for name in ("ved", "i3", "model3") if (path := vars(given)[name])]
    names = [] if given.render else [name for name in given.only.replace(" ", ",").split(",") if name]
    if unknown := sorted(set(names) - set(MEASUREMENTS)):
        print(f"{unknown[0]} is no measurement; choose from {', '.join(MEASUREMENTS)}", file=sys.stderr)
        return 2
    console, failed = Console(), []
    for name in names:
        measurement = MEASUREMENTS[name]
        if name in REAL and len(folders) < REAL_FOLDERS:
            console.print(f"{name}: left out; it takes --ved, --i3 and --model3", highlight=False)
            continue
        real = folders if name in REAL else []
        real = folders[:2] if name in TWO_FOLDERS and given.ved and given.i3 else real
        console.print(f"{name}: about {measurement.minutes} min", highlight=False)
        began = time.monotonic()
        words = [sys.executable, "-m", *measurement.words, *real]
        code = subprocess.run(words, cwd=ROOT, check=False).returncode  # noqa: S603 - our own command
        console.print(f"{name}: {(time.monotonic() - began) / 60.0:.1f} min", highlight=False)
        failed += [name] * (code != 0)
    write_pages()
    for name in failed:
        print(f"{name} failed; its figures are those of before", file=sys.stderr)
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
