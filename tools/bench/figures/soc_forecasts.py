"""Judge forecasts of the state of charge on simulated fleets and real drives, and publish the figures.

Example: python -m socast.tools.bench.figures.soc_forecasts --keep build/soc --ved ved/ --i3 i3/
"""

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from socast.tools.bench.figures.published import NEEDED, make_parser, publish
from socast.tools.bench.soc_forecasts import main as judge
from socast.tools.bench.soc_forecasts import tabulate
from socast.tools.bench.soc_goals import Line
from socast.tools.commands.import_drives import collect_drives, write_recording
from socast.tools.importers.data_sets import DATA_SETS

RUNS: Final = {
    "autumn": ("--fleet", "autumn,trouble", "--seeds", "1500-1501"),
    "small": ("--fleet", "small", "--seeds", "1500-1505"),
    "preset": ("--fleet", "preset", "--seeds", "1500-1501", "--rides", "8000"),
}
"""Fleets that are judged, with seeds on which nothing was chosen."""
_BOTH: Final = re.compile(r"\(([\d.]+) against ([\d.]+)")
ABOUT: Final = (
    "Simulated fleets whose laws are not those of the forecaster. `autumn` has twelve cars over 45 days, with a cold "
    "snap 15 K below everything before, or a heat wave 10 K above; the other fleets whose names begin so have six "
    "cars over 25 days, in each of which something else goes wrong. `small` has three cars over 20 days, two of them "
    "with aged packs. `preset` is the fleet of the paper, 8,000 rides. Errors are in per cent of charge; scores are "
    "relative to those of the regression on earlier days. Coverage is uncertain by about 2 points, that of one day or "
    "of twenty shifts by 10."
)
"""What the table shows."""
REAL_HOURS: Final = 3.0
"""Length of the synthetic shifts of real drives. [h]"""
PERIOD: Final = 3.0
"""Time between two samples of theirs. [s]"""
ABOUT_REAL: Final = (
    "`leaf` is the Nissan Leaf of the Vehicle Energy Dataset (135 rides, 10 months), `i3` the BMW i3 of Munich (31 "
    f"rides), in synthetic shifts of {REAL_HOURS:g} h. Each is one car whose first shift is forecast without any data "
    "of it, so the figures are of few shifts: they tell which method is better, not by how much. Without plans, a "
    "forecast knows the car's earlier shifts only."
)
"""What the table of real drives shows."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and publish."""
    given = make_parser("figures.soc_forecasts", __doc__, keep=NEEDED, ved=None, i3=None).parse_args(arguments)
    keep = given.keep
    keep.mkdir(parents=True, exist_ok=True)
    lines: list[Line] = []
    for name, words in RUNS.items():
        file = keep / f"{name}.json"
        if not file.exists():
            judge([*words, "--json", str(file)])
        lines += [Line(**each) for each in json.loads(file.read_text(encoding="utf-8"))]
    command = "python -m socast.tools.bench.figures.soc_forecasts --keep build/soc"
    shown = [line for line in lines if line.goal or line.what.startswith("2 h ahead")]
    publish("soc-forecasts", command, [ABOUT, "", *tabulate(shown)], list_values(lines))
    if given.ved and given.i3:
        real = judge_real_drives(keep, given.ved, given.i3)
        publish("real-soc", f"{command} --ved ved/ --i3 i3/", [ABOUT_REAL, "", *tabulate(real)], {})


def judge_real_drives(keep: Path, ved: Path, i3: Path) -> list[Line]:
    """Return the lines of the forecasts of real cars, whose rides are concatenated into synthetic shifts."""
    lines: list[Line] = []
    for name, data_set, folder in (("leaf", "ved", ved), ("i3", "bmw-i3", i3)):
        recording, file = keep / f"{name}.mcap", keep / f"{name}.json"
        write_recording(collect_drives([folder], DATA_SETS[data_set]), recording, PERIOD, REAL_HOURS)
        for words in ([], ["--no-plans"]):
            judge(["--recording", str(recording), *words, "--json", str(file)])
            lines += [Line(**each) for each in json.loads(file.read_text(encoding="utf-8"))]
    return lines


def list_values(lines: Sequence[Line]) -> dict[str, str]:
    """Return the error two hours ahead beside that of the regression, for the table of results."""
    told = []
    for line in lines:
        found = _BOTH.search(line.measured)
        if line.what == "2 h ahead: MAE against regression" and found:
            told.append(f"{found[1]} % of charge (`{line.fleet}`), of a regression on earlier days {found[2]} %")
    return {"error": "; ".join(told), "error_on": "simulated fleets, seeds not used for development"}


if __name__ == "__main__":
    main()
