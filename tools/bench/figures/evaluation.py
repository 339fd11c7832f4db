"""Measure the errors of recipes on simulated fleets and on real drives, and publish them.

The fleets are those of the paper's preset, with seeds on which nothing was chosen. Real drives are those of the Vehicle
Energy Dataset (car 455, a Nissan Leaf; arXiv:1905.02081) and of a BMW i3 (DOI 10.21227/6jr9-5235); without the folders
of their files they are not measured, and what was published about them stays.

Example: python -m socast.tools.bench.figures.evaluation --keep build/evaluation --ved ved/ --i3 i3/
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from socast.core.formatting import format_minus
from socast.tools.bench.figures.published import NEEDED, make_parser, publish, run_command, write_table

SEEDS: Final = 241, 242
"""Seeds of the simulated fleets."""
RIDES: Final = 1000
"""Number of rides of each."""
BASELINES: Final = {
    "basic_physical": "basic",
    "basic_rescaled": "basic, rescaled",
    "basic_rescaled_power": "basic, rescaled, with power",
    "telematics_regression": "telematics regression",
}
"""Recipes that others are held against, and their names in the tables."""
RECIPES: Final = (
    *BASELINES,
    "extended_physical",
    "fitted_physical",
    "road_load",
    "hybrid_interactions",
    "pooled_hybrid",
    "boosted_hybrid",
)
"""Recipes of the simulated fleets."""
BEST: Final = "boosted_hybrid"
"""Recipe whose figures are among the results."""
SPLITS: Final = {"ride": "unseen rides", "vehicle": "unseen cars", "date": "unseen dates"}
"""Splits of the rides into training and test, and their names in the tables."""

Report = Mapping[str, Any]


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and publish."""
    given = make_parser("figures.evaluation", __doc__, keep=NEEDED, ved=None, i3=None).parse_args(arguments)
    given.keep.mkdir(parents=True, exist_ok=True)
    fleets = {seed: evaluate_fleet(given.keep, seed) for seed in SEEDS}
    command = "python -m socast.tools.bench.figures.evaluation --keep build/evaluation"
    publish("evaluation", command, list_fleet_lines(fleets), list_fleet_values(fleets))
    if given.ved and given.i3:
        cars = evaluate_real_drives(given.keep, given.ved, given.i3)
        publish("real-drives", f"{command} --ved ved/ --i3 i3/", list_car_lines(cars), list_car_values(cars))


def evaluate_fleet(keep: Path, seed: int) -> Report:
    """Return the report of `socast evaluate` on a simulated fleet."""
    recording, tables, report = (keep / f"teo{seed}{ending}" for ending in (".mcap", "", ".json"))
    run_once(recording, "simulate", "--preset", "teo", "--rides", RIDES, "--seed", seed, "--out", recording)
    run_once(tables, "tables", recording, "--out", tables)
    run_once(report, "evaluate", tables, "--repeats", 3, "--recipes", ",".join(RECIPES), "--json", report)
    return _read(report)


def evaluate_real_drives(keep: Path, ved: Path, i3: Path) -> dict[str, Report]:
    """Return the reports of `socast evaluate` on the drives of two real cars, each by itself."""
    for name, words in (("leaf", ("ved", ved, "--vehicle", 455)), ("i3", ("bmw-i3", i3))):
        run_once(keep / f"{name}.mcap", "import", *words, "--out", keep / f"{name}.mcap")
        limit = ("--speed-limit-kmh", 180) if name == "i3" else ()
        run_once(keep / name, "tables", keep / f"{name}.mcap", "--out", keep / name, *limit)
        run_once(keep / f"{name}.json", "evaluate", keep / name, "--json", keep / f"{name}.json")
    return {"Leaf": _read(keep / "leaf.json"), "i3": _read(keep / "i3.json")}


def list_fleet_lines(fleets: Mapping[int, Report]) -> list[str]:
    """Return the tables of the simulated fleets."""
    lines: list[str] = []
    for seed, report in fleets.items():
        found = report["percentage"]["ride"]
        lines += [
            (
                f"Seed {seed}: {report['about']['fit']:,} rides fit for training, {found['energy_kwh']:.2f} kWh on "
                f"average, measurement noise {found['noise_floor_kwh']:.3f} kWh. Reductions are means over vehicle "
                "models of the average over clusters; the other columns are over all rides."
            ),
            "",
        ]
        rows = []
        for recipe in RECIPES:
            below = [
                "" if recipe == baseline else _percent(report["reduction_by_baseline"][baseline][recipe]["average"], 1)
                for baseline in BASELINES
            ]
            errors = found["recipes"][recipe]
            relative = [_with_interval(errors[name], 1, percent=True) for name in ("wmape", "mape")]
            rows.append([f"`{recipe}`", *below, _with_interval(errors["mae_kwh"], 3), *relative])
        heads = ["recipe", *(f"below {name}" for name in BASELINES.values()), "MAE, kWh", "wMAPE", "MAPE"]
        of_splits = [report["percentage"][split]["recipes"] for split in SPLITS]
        by_split = [
            [f"`{recipe}`", *(_with_interval(each[recipe]["wmape"], 1, percent=True) for each in of_splits)]
            for recipe in RECIPES
        ]
        lines += [*write_table(heads, rows), "", *write_table([f"wMAPE, seed {seed}", *SPLITS.values()], by_split)]
        inside = report["coverage"][BEST]
        lines += [
            "",
            (
                f"The 90 % intervals of `{BEST}` contain {_percent(inside['overall'], 1)} of unseen rides and "
                f"{_percent(inside['by_date'], 1)} on unseen dates."
            ),
            "",
        ]
    return lines[:-1]


def list_fleet_values(fleets: Mapping[int, Report]) -> dict[str, str]:
    """Return the figures of the best recipe for the table of results."""
    both = list(fleets.values())
    on = f"`{BEST}`, two simulated fleets of {RIDES:,} rides, on seeds not used for development"
    of_split = {
        split: " and ".join(_percent(each["percentage"][split]["recipes"][BEST]["wmape"]["value"], 1) for each in both)
        for split in SPLITS
    }
    below = {
        baseline: " and ".join(_percent(each["reduction_by_baseline"][baseline][BEST]["average"]) for each in both)
        for baseline in BASELINES
    }
    return {
        "wmape": f"{of_split['ride']}; unseen cars {of_split['vehicle']}; unseen dates {of_split['date']}",
        "wmape_on": on,
        "below": "; ".join(f"{text} below {BASELINES[name]}" for name, text in below.items()),
        "below_on": "the same two fleets",
        "inside": "contain " + " and ".join(_percent(each["coverage"][BEST]["overall"]) for each in fleets.values()),
        "inside_on": "the same two fleets, unseen rides",
    }


def list_car_lines(cars: Mapping[str, Report]) -> list[str]:
    """Return the table of the real cars."""
    heads = [f"{car}, {words}" for car in cars for words in ("by ride", "last 20 % of dates")]
    counts = [f"{report['about']['fit']} rides of the {car}" for car, report in cars.items()]
    recipes = list(dict.fromkeys(recipe for report in cars.values() for recipe in report["mae"]))
    rows = [
        [f"`{recipe}`", *(cell for report in cars.values() for cell in _list_car_errors(report, recipe))]
        for recipe in recipes
    ]
    return [
        f"{' and '.join(counts)} are fit for training. Mean absolute error, average over clusters of distance, in kWh:",
        "",
        *write_table(["recipe", *heads], rows),
    ]


def list_car_values(cars: Mapping[str, Report]) -> dict[str, str]:
    """Return the figures of the real cars for the table of results."""
    known = {
        car: {recipe: each["wmape"] for recipe, each in report["percentage"]["ride"]["recipes"].items()}
        for car, report in cars.items()
    }
    shared = set.intersection(*(set(errors) for errors in known.values()))
    best = min(shared, key=lambda recipe: sum(errors[recipe]["value"] for errors in known.values()))
    told = [f"{car} {_with_interval(errors[best], 1, percent=True)}" for car, errors in known.items()]
    rides = sum(report["about"]["fit"] for report in cars.values())
    return {"wmape": "; ".join(told), "wmape_on": f"`{best}`, {rides} real rides of two cars, unseen rides"}


def _list_car_errors(report: Report, recipe: str) -> list[str]:
    """Return the error of a recipe on unseen rides and on unseen dates of one car."""
    if recipe not in report["mae"]:
        return ["too few rides", ""]
    (model,) = report["about"]["vehicle_models"]
    by_date = report["splits"]["date"].get(recipe, {}).get(model)
    return [_with_interval(report["mae"][recipe][model]["average"], 3), "" if by_date is None else f"{by_date:.3f}"]


def _with_interval(figure: Mapping[str, float | None], digits: int, *, percent: bool = False) -> str:
    """Return the text of a figure with half of its 95 % interval."""
    value, half, scale = figure["value"], figure["ci95"], 100.0 if percent else 1.0
    if value is None:
        return "–"
    spread = f" ± {scale * half:.{digits}f}" if half is not None else ""
    return f"{scale * value:.{digits}f}{spread}{' %' if percent else ''}"


def _percent(share: float, digits: int = 0) -> str:
    """Return the text of a share in percent."""
    return format_minus(f"{100.0 * share:.{digits}f} %")


def _read(path: Path) -> Report:
    """Return a report."""
    report: Report = json.loads(path.read_text(encoding="utf-8"))
    return report


def run_once(result: Path, *words: object) -> None:
    """Run a command that makes a file or folder, unless that exists."""
    if not result.exists():
        run_command(Path.cwd(), list(map(str, words)))


if __name__ == "__main__":
    main()
