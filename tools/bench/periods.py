"""Measure what the period of the loggers costs in accuracy: `python -m socast.tools.bench.periods`.

The same simulated drives are logged with each period. A model is fitted to the rides of the first days, and predicts
those of the other days. Rides are compared with the truth of the simulation. The cars are those of the default fleet,
with the faults of their loggers, and charge at night, so that the state of charge at the end of each shift is forecast.
"""

from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Any, Final

import numpy as np
import pandas as pd

from socast.core.fit.recipes import get_recipe
from socast.core.wire.messages import Message
from socast.tools.bench.elevation import RECIPE, measure_forecasts, tabulate
from socast.tools.bench.figures.published import keep, make_parser, publish, write_table
from socast.tools.simulator.conditions import Conditions
from socast.tools.simulator.fleet import simulate
from socast.tools.simulator.settings import NIGHT, Simulation
from socast.tools.simulator.truth import Truth

PERIODS: Final = (1.0, 3.0, 5.0, 10.0, 15.0, 30.0, 60.0, 0.0)
"""Periods of the loggers; 0 for loggers that send a sample when a value has changed. [s]"""
SEEDS: Final = (6001, 6002)
"""Seeds on which nothing was chosen."""
CARS: Final = 5
START: Final = datetime(2018, 3, 5, tzinfo=UTC)
DAYS: Final = 10
FIT_DAYS: Final = 6
"""Number of days, of which the first ones are fitted."""


def simulate_fleet(seed: int, periods: Sequence[float]) -> tuple[list[Message], pd.DataFrame]:
    """Return the messages of a fleet, and the true distance [km] and energy [kWh] of its rides.

    Parameters
    ----------
    periods : sequence of float
        Periods of the loggers, assigned to the cars in turn. [s]
    """
    truth, conditions = Truth(), Conditions(periods=tuple(periods))
    simulation = Simulation(vehicles=CARS, start=START, days=DAYS, seed=seed, charging=NIGHT, conditions=conditions)
    messages = list(simulate(simulation, truth))
    names = {"distance_km": "true_km", "energy_kwh": "true_kwh"}
    return messages, pd.DataFrame(truth.rides).rename(columns=names)[["vehicle_id", "ride_id", *names.values()]]


def measure_tables(rides: pd.DataFrame, truth: pd.DataFrame, first: str) -> dict[str, float]:
    """Return the errors of the distance, of the measured energy and of a fitted model, over the true sums. [1]

    Returns
    -------
    dict of str to float
        `distance`, `vi`, `measured` and `predicted`; `sds`, the root mean square of the error of the measured energy in
        its standard uncertainties [1]; `by_soc`, the share of rides that the state of charge measures [1].
    """
    fit = rides[rides["fit_for_training"]]
    model = get_recipe(RECIPE).fit(fit[fit["date"] < first])
    predicted = pd.Series(model.predict_energy(fit), fit.index, name="predicted_kwh")
    joined = fit.join(predicted).merge(truth, on=["vehicle_id", "ride_id"])
    error = {
        "distance": joined["distance_km"] - joined["true_km"],
        "vi": joined["energy_vi_kwh"] - joined["true_kwh"],
        "measured": joined["energy_kwh"] - joined["true_kwh"],
    }
    late = joined[joined["date"] >= first]
    figures = {
        name: float(each.abs().sum() / joined["true_km" if name == "distance" else "true_kwh"][each.notna()].sum())
        for name, each in error.items()
    }
    return figures | {
        "predicted": float((late["predicted_kwh"] - late["true_kwh"]).abs().sum() / late["true_kwh"].sum()),
        "sds": float(np.sqrt(np.mean((error["measured"] / joined["energy_sd_kwh"]) ** 2))),
        "by_soc": float((joined["energy_source"] == "soc").mean()),
    }


def measure_periods(seed: int, periods: Sequence[float]) -> dict[str, float]:
    """Return all figures of a fleet: those of `measure_tables`, and `soc_mae_pct`.

    Units: periods [s].
    """
    messages, truth = simulate_fleet(seed, periods)
    rides, _ = tabulate(messages, None, two_sided=True)
    first = sorted(rides["date"].unique())[FIT_DAYS]
    return measure_tables(rides, truth, first) | {"soc_mae_pct": measure_forecasts(messages, None)}


def make_lines(results: dict[str, list[dict[str, Any]]]) -> list[str]:
    """Return the table of all periods as Markdown."""
    heads = ("period", "distance", "energy by V·I", "measured energy", "error over sd", "by SOC", "prediction")
    rows = []
    for name, figures in results.items():
        mean = {key: float(np.mean([each[key] for each in figures])) for key in figures[0]}
        errors = [f"{100.0 * mean[key]:.1f} %" for key in ("distance", "vi", "measured")]
        shares = [f"{100.0 * mean['by_soc']:.0f} %", f"{100.0 * mean['predicted']:.1f} %"]
        rows.append([name, *errors, f"{mean['sds']:.2f}", *shares, f"{mean['soc_mae_pct']:.2f} points"])
    return write_table([*heads, "end of shift"], rows)


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure every period, and a fleet with all of them, and print the table."""
    parser = make_parser("periods", __doc__, json=None, publish=False)
    parser.add_argument("seeds", nargs="*", type=int, default=SEEDS, help="seeds of the fleets")
    options = parser.parse_args(arguments)
    fleets: dict[str, tuple[float, ...]] = {f"{period:g} s" if period else "on change": (period,) for period in PERIODS}
    fleets["1, 3, 10, 30, 60 s in one fleet"] = (1.0, 3.0, 10.0, 30.0, 60.0)
    lines = make_lines(
        keep(
            options.json,
            lambda: {name: [measure_periods(seed, each) for seed in options.seeds] for name, each in fleets.items()},
        )
    )
    print("\n".join(lines))
    if options.publish:
        seeds = " ".join(map(str, options.seeds))
        publish("periods", f"python -m socast.tools.bench.periods {seeds}", lines)


if __name__ == "__main__":
    main()
