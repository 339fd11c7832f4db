"""Measure how often intervals hold the coefficients of simulated cars: `python -m socast.tools.bench.coefficients`.

Each seed simulates a fleet of one vehicle model with the physics of `road_load`: a constant efficiency, and no effect
that the model lacks. The true coefficients follow from the parameters of the cars. The simulator integrates motion and
power in steps of half a second, and loggers sample them every three, so the tables distort motion and energy as those
of real loggers do.
"""

import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from datetime import UTC, datetime
from multiprocessing import get_context
from typing import Any, Final, NamedTuple

import numpy as np
import pandas as pd

from socast.core import effects
from socast.core.columns import STANDARD_AIR_DENSITY
from socast.core.fit.model_summary import list_coefficients
from socast.core.fit.recipes import fit_to_windows
from socast.core.formatting import format_minus
from socast.core.models import ANY
from socast.core.stats.clustered import compute_clustered_share
from socast.core.vehicles import load_catalogue
from socast.tools.bench.figures.published import (
    keep,
    make_parser,
    parse_seeds,
    publish,
    show_table,
    tell_errors,
    write_table,
)
from socast.tools.bench.measures import tabulate
from socast.tools.simulator.fleet import simulate
from socast.tools.simulator.physics import ROTATING
from socast.tools.simulator.settings import NO_FAULTS, PLAIN_PHENOMENA, Simulation
from socast.tools.simulator.trace import REFERENCE_DENSITY
from socast.tools.simulator.truth import Truth

SEEDS: Final = "3201-3260"
"""Seeds on which nothing was chosen; 3100 to 3135 served the development."""
MODELS: Final = ("kia-soul-ev-2015", "nissan-leaf-2016", "tesla-model-s")
"""Vehicle models, in turn by seed."""
RECIPE: Final = "road_load"
HEADS: Final = ("term", "true", "bias", "spread", "half width", "held, % (95 % interval)")
"""Heads of the table."""
ABOUT: Final = (
    f"The recipe `{RECIPE}` is fitted to simulated fleets of three cars, which drive two hours on each of five days. "
    "The physics has no effect that the model lacks. Coefficients are relative to the catalogue, and the intervals "
    "are those of 95 %. The goal is that 93 to 97 % of them hold the true value."
)
"""What the table shows."""
ALL: Final = "all"
"""Name of the row of all terms; the coefficients of a fleet are correlated, so its interval is clustered by fleet."""


class Estimate(NamedTuple):
    """Hold a coefficient of a fleet.

    Parameters
    ----------
    truth, value, low, high : float
        True value, estimate, and ends of the interval, relative to the figures of the catalogue. [1]
    """

    seed: int
    term: str
    truth: float
    value: float
    low: float
    high: float


@tell_errors
def main(arguments: list[str] | None = None) -> None:
    """Run the measurement, print its table and write its JSON file, which is used again."""
    parser = make_parser("coefficients", __doc__, seeds=SEEDS, json=None, publish=False)
    parser.add_argument("--processes", type=int, default=2, help="number of processes")
    options = parser.parse_args(arguments)
    seeds = parse_seeds(options.seeds)
    kept = keep(options.json, lambda: measure_fleets(seeds, options.processes))
    rows = list_rows([Estimate(**each) for each in kept["estimates"]])
    show_table("Intervals of 95 %", HEADS, rows)
    if options.publish:
        command = f"python -m socast.tools.bench.coefficients --seeds {options.seeds}"
        publish("coefficients", command, [ABOUT, "", *write_table(HEADS, rows)])


def measure_fleets(seeds: Sequence[int], processes: int) -> dict[str, Any]:
    """Return the coefficients of all fleets, as JSON holds them."""
    with ProcessPoolExecutor(processes, get_context("spawn")) as pool:  # a fork would copy locks of threads
        estimates = [estimate._asdict() for fleet in pool.map(measure_fleet, seeds) for estimate in fleet]
    return {"recipe": RECIPE, "estimates": estimates}


def measure_fleet(seed: int) -> list[Estimate]:
    """Return the coefficients of a simulated fleet with their intervals and true values."""
    model, truth = MODELS[seed % len(MODELS)], Truth()
    simulation = Simulation(
        vehicles=3,
        days=5,
        day_step=73,
        shift_hours=2.0,
        start=datetime(2018, 1, 15, tzinfo=UTC),
        seed=seed,
        models=(model,),
        phenomena=PLAIN_PHENOMENA._replace(payload=True),
        faults=NO_FAULTS,
    )
    also = list(effects.list_tabulated())
    rides, windows = tabulate(list(simulate(simulation, truth)), also=also, two_sided=True)
    fitted = fit_to_windows(RECIPE, rides, windows, covariance=False)
    key = model if model in fitted.fits else ANY
    true = find_truth(truth, rides)
    return [
        Estimate(seed, each.term, true[each.term], each.value, each.low, each.high)
        for each in list_coefficients(fitted, key)
        if each.term in true and each.low is not None and each.high is not None
    ]


def find_truth(truth: Truth, rides: pd.DataFrame) -> dict[str, float]:
    """Return the true coefficients of a fleet: the means over its cars, weighted by their distances.

    Returns
    -------
    dict of str to float
        Coefficient of each term that the simulator determines, relative to the catalogue. A wheel speed that is s times
        the true one divides the coefficient of a term in v^n by s^n.
    """
    distance = rides.groupby("vehicle_id")["distance_km"].sum()
    sums: dict[str, float] = {}
    for name, car in truth.cars.items():
        entry, share = load_catalogue()[car["model"]], float(distance.get(name, 0.0) / distance.sum())
        mass, paid, speed = car["mass"] / entry.mass_kg, 1.0 / car["efficiency"], car["speedometer"]
        rolling = car["rolling_resistance"] / entry.rolling_resistance
        drag = car["drag_area"] / (entry.drag_coefficient * entry.frontal_area_m2)
        inertia = mass * ROTATING * paid / speed**2
        own = {
            "rolling": mass * rolling * paid / speed,
            "climbing": mass * paid,
            "aero_drag": drag * REFERENCE_DENSITY / STANDARD_AIR_DENSITY * paid / speed**3,
            "inertia_positive": inertia,
            "inertia_negative": inertia,
            "braking": paid - car["efficiency"],
        }
        for term, value in own.items():
            sums[term] = sums.get(term, 0.0) + share * value
    return sums


def list_rows(estimates: Sequence[Estimate]) -> list[list[str]]:
    """Return how often the intervals hold the true values, by term and over all, as cells below `HEADS`."""
    rows = []
    for term, mine in _group_by_term(estimates):
        truth, value, low, high = np.array([each[2:] for each in mine]).T
        share = compute_clustered_share((low <= truth) & (truth <= high), np.array([each.seed for each in mine]))
        figures = truth.mean(), (value - truth).mean(), (value - truth).std(), (high - low).mean() / 2.0
        cells = [format_minus(f"{figure:.3f}") for figure in figures] if term != ALL else [""] * len(figures)
        held = f"{share['value'] * 100:.0f} ({share['low'] * 100:.0f} to {share['high'] * 100:.0f})"
        rows.append([term, *cells, held])
    return rows


def _group_by_term(estimates: Sequence[Estimate]) -> Iterator[tuple[str, list[Estimate]]]:
    """Yield the estimates of each term, then all."""
    for term in dict.fromkeys(each.term for each in estimates):
        yield term, [each for each in estimates if each.term == term]
    yield ALL, list(estimates)


if __name__ == "__main__":
    sys.exit(main())
