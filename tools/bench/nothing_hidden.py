"""Measure which effects a diagnosis names, and the z of every candidate, where no effect is hidden.

Each seed gives a small simulated fleet with plain physics. The command line of one or more source trees makes tables of
the same recording, fits `road_load` and diagnoses it, so that two versions of the product can be compared.

Example: python -m socast.tools.bench.nothing_hidden --seeds 4001-4040 --keep build/nothing --tree before=../old --tree
after=.
"""

import json
import statistics
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

from socast.core.diagnose.add.terms import name_scoped
from socast.core.errors import SettingsError
from socast.core.models.features import list_scope
from socast.tools.bench.figures.published import (
    ROOT,
    make_parser,
    parse_seeds,
    publish,
    run_command,
    show_table,
    tell_errors,
    write_json,
    write_table,
)

FLEET: Final = (
    *("--vehicles", "4", "--days", "12", "--day-step", "14", "--shift-hours", "1.5"),
    *("--phenomena", "plain,payload", "--faults", "unequipped=0"),
)
"""Options of `socast simulate`: about 260 rides of four cars, from January to June.

An effect of 3 % of the energy is found in such a fleet. All cars measure voltage and current.
"""
RECIPE: Final = "road_load"


class Fleet(NamedTuple):
    """Hold the diagnosis of a fleet.

    Parameters
    ----------
    rides, windows : int
        Number of rides and windows that were diagnosed.
    named : list of str
        Effects that the diagnosis names in all cars, in a car or a group, or since a date; each name is false.
    z : dict of str to float
        Coefficient of each candidate over its standard error, beside the base alone.
    """

    seed: int
    rides: int
    windows: int
    named: list[str]
    z: dict[str, float]


class Summary(NamedTuple):
    """Hold the z of one effect over all fleets, and the number of fleets in which the effect is named."""

    effect: str
    fleets: int
    least: float
    median: float
    most: float
    named: int


@tell_errors
def main(arguments: list[str] | None = None) -> None:
    """Run the measurement, print its tables and write its JSON file."""
    parser = make_parser("nothing_hidden", __doc__, seeds="4001-4040", keep=None, json=None, publish=False)
    parser.add_argument("--tree", action="append", metavar="NAME=FOLDER", help="source tree; default: this one")
    parser.add_argument("--hidden", action="append", default=[], metavar="EFFECT:SIZE", help="effect to hide")
    options = parser.parse_args(arguments)
    seeds, hidden = parse_seeds(options.seeds), options.hidden
    trees = parse_trees(options.tree or [f"here={ROOT}"])
    measured: dict[str, list[Fleet]] = {name: [] for name in trees}
    with tempfile.TemporaryDirectory() as scratch:
        keep = (options.keep or Path(scratch)).resolve()
        keep.mkdir(parents=True, exist_ok=True)
        for seed in seeds:
            for name, fleet in measure_seed(seed, trees, keep, hidden).items():
                measured[name].append(fleet)
                names = ", ".join(fleet.named) or "nothing"
                print(f"{seed} {name}: {fleet.rides} rides, {fleet.windows} windows, named: {names}")
    for name, fleets in measured.items():
        print_summaries(name, fleets)
    if options.publish:
        command = f"python -m socast.tools.bench.nothing_hidden --seeds {options.seeds}"
        publish("nothing-hidden", command, make_lines(measured, " ".join(FLEET)))
    content = {name: [fleet._asdict() for fleet in fleets] for name, fleets in measured.items()}
    settings = {"fleet": " ".join(FLEET), "hidden": hidden, "seeds": options.seeds, "trees": content}
    write_json(options.json, settings)


def parse_trees(given: Sequence[str]) -> dict[str, Path]:
    """Return the source trees by name."""
    trees = {}
    for text in given:
        name, equals, folder = text.partition("=")
        if not (name and equals) or not Path(folder, "tools", "cli.py").is_file():
            raise SettingsError(f"--tree is {text!r}; give NAME=FOLDER with a folder that holds tools/cli.py")
        trees[name] = Path(folder).resolve()
    return trees


def measure_seed(seed: int, trees: Mapping[str, Path], keep: Path, hidden: Sequence[str] = ()) -> dict[str, Fleet]:
    """Return the diagnosis of one fleet by each source tree."""
    stem = "-".join([*(each.replace(":", "_") for each in hidden), str(seed)])
    recording = keep / f"{stem}.mcap"
    if not recording.exists():
        hide = [word for each in hidden for word in ("--hidden", each)]
        partial = keep / f"{stem}.part.mcap"  # an interrupted run leaves no recording that looks complete
        run_command(ROOT, ["simulate", "--out", str(partial), "--seed", str(seed), *FLEET, *hide])
        partial.rename(recording)
    out = {}
    for name, tree in trees.items():
        file = keep / f"{stem}.{name}.json"
        if not file.exists():
            diagnose_recording(tree, recording, file)
        out[name] = read_fleet(seed, json.loads(file.read_text(encoding="utf-8")))
    return out


def diagnose_recording(tree: Path, recording: Path, file: Path) -> None:
    """Write the diagnosis of a recording, by the command line of a source tree."""
    with tempfile.TemporaryDirectory() as folder:
        tables, model, result = (str(Path(folder, name)) for name in ("tables", "base.json", "result.json"))
        run_command(tree, ["tables", str(recording), "--out", tables])
        run_command(tree, ["fit", tables, "--recipe", RECIPE, "-o", model])
        run_command(tree, ["diagnose", tables, "--model", model, "--json", result])
        file.write_text(Path(result).read_text(encoding="utf-8"), encoding="utf-8")


def read_fleet(seed: int, result: Mapping[str, Any]) -> Fleet:
    """Return what a diagnosis found in a fleet."""
    named = [name_scoped(m["effect"], list_scope(m.get("columns") or ())) for m in result.get("missing") or ()]
    named += [
        name_scoped(one["effect"], [one["who"], *([f"since={one['since']}"] if one["since"] else [])])
        for one in result.get("deviations") or ()
    ]
    z = {row["effect"]: float(row["z"]) for row in result["candidates"] if row["z"] is not None}
    return Fleet(seed, result["data"]["rides"], result["data"]["windows"], named, z)


def summarise_effects(fleets: Sequence[Fleet]) -> list[Summary]:
    """Return the z of each effect over all fleets, the largest absolute median first."""
    out = []
    for effect in dict.fromkeys(name for fleet in fleets for name in fleet.z):
        z = [fleet.z[effect] for fleet in fleets if effect in fleet.z]
        named = sum(effect in {name.partition(" ")[0] for name in fleet.named} for fleet in fleets)
        out.append(Summary(effect, len(z), min(z), statistics.median(z), max(z), named))
    return sorted(out, key=lambda each: -abs(each.median))


def print_summaries(name: str, fleets: Sequence[Fleet]) -> None:
    """Print the table of a source tree."""
    heads = ("effect", "fleets", "min z", "median z", "max z", "named in")
    rows = [
        (row.effect, str(row.fleets), *(f"{z:.1f}" for z in (row.least, row.median, row.most)), str(row.named))
        for row in summarise_effects(fleets)
    ]
    show_table(f"{name}: nothing hidden", heads, rows)
    total = sum(len(fleet.named) for fleet in fleets)
    print(f"{name}: {total} false names in {len(fleets)} fleets")


def make_lines(measured: Mapping[str, Sequence[Fleet]], description: str) -> list[str]:
    """Return the lines for the pages."""
    names = ", ".join(f"{sum(len(each.named) for each in fleets)} by `{tree}`" for tree, fleets in measured.items())
    count = len(next(iter(measured.values())))
    summaries = {tree: {row.effect: row for row in summarise_effects(fleets)} for tree, fleets in measured.items()}
    rows = [
        [
            effect,
            *(
                f"{row.median:.1f} ({row.least:.1f} to {row.most:.1f}){f', named in {row.named}' if row.named else ''}"
                if (row := of_tree.get(effect))
                else "–"
                for of_tree in summaries.values()
            ),
        ]
        for effect in dict.fromkeys(effect for of_tree in summaries.values() for effect in of_tree)
    ]
    return [
        (
            f"{count} simulated fleets without a hidden effect (`{description}`), each diagnosed by the source trees "
            f"in the heads of the columns. False names in all fleets together: {names}. The table shows the z of each "
            "candidate beside the base: median (least to largest) over the fleets in which it can be identified."
        ),
        "",
        *write_table(["effect", *measured], rows),
    ]


if __name__ == "__main__":
    sys.exit(main())
