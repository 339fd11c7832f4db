"""Leave out each part of the forecasts of the state of charge in turn, and publish what it gains.

A part is left out by one change of the running program, so that everything else learns without it.

Example: python -m socast.tools.bench.soc_ablation --seed 1510 --keep build/ablation
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Final
from unittest import mock

import numpy as np
import pandas as pd
from rich.console import Console

from socast.core.forecast import outlook, plan_tracker
from socast.core.forecast.engine import ForecastEngine
from socast.core.forecast.learning import consumption_terms, energy_regression, fleet
from socast.core.forecast.learning.car_driver import ConsumptionFactors
from socast.core.forecast.learning.consumption_terms import TERMS, CoefficientPrior
from socast.core.forecast.learning.plan_outcomes import PlanOutcomes
from socast.core.vehicles import VehicleModel
from socast.stream.mcap_reader import McapSource
from socast.tools.bench.figures.published import NEEDED, make_parser, publish, write_table
from socast.tools.bench.soc_forecasts import judge, judge_fleet

FLEETS: Final = ("autumn", "autumn-no-shows", "autumn-way-home", "small")
"""Fleets on which parts are left out."""
AHEAD: Final = 2
"""Time ahead at which forecasts are compared. [h]"""
CLIMATE: Final = "heating", "cooling", "heating_waiting", "start_heating", "warm_up_heating"
"""Terms of the regression that depend on heating and air conditioning."""
NOTHING: Final = 1e-9
"""Standard deviation of a coefficient that is 0."""
_Patches = list[Any]


def _fix_terms(*names: str) -> Callable[[], _Patches]:
    """Return how to let terms of the regression be 0."""

    def patch() -> _Patches:
        original = consumption_terms.make_prior

        def make(model: VehicleModel, scale: float) -> CoefficientPrior:
            prior, left = original(model, scale), np.isin(TERMS, names)
            return CoefficientPrior(np.where(left, 0.0, prior.mean), np.where(left, NOTHING, prior.sd))

        return [mock.patch.object(fleet, "make_prior", make)]

    return patch


def _straighten() -> _Patches:
    """Return how to treat displays as if they were no curves."""
    original = ForecastEngine._fill_totals  # noqa: SLF001 - a part is left out where it enters

    def fill(self: ForecastEngine, totals: Any, out: Any) -> None:
        original(self, totals, out)
        out["curve"] = 0.0

    return [mock.patch.object(ForecastEngine, "_fill_totals", fill)]


def _replace(owner: Any, name: str, value: Any) -> Callable[[], _Patches]:
    """Return how to replace an attribute."""
    return lambda: [mock.patch.object(owner, name, value)]


def _forget(self: PlanOutcomes) -> None:
    """Learn nothing of plans."""
    self.today.clear()


PARTS: Final[Mapping[str, tuple[str, Callable[[], _Patches]]]] = {
    "rides": (
        "nothing is learned of rides: energies and the usual mix stay at what physics expects",
        _replace(energy_regression.ModelSums, "apply_daily_update", lambda self, _: self.forget_day()),
    ),
    "climate": ("no heating and air conditioning", _fix_terms(*CLIMATE)),
    "speed": ("no stops, and no air drag that grows with the speed", _fix_terms("stops", "fast")),
    "day effect": (
        "the rides of a day count as independent",
        _replace(energy_regression, "DAY_SD", 1e-6),
    ),
    "warm-up": ("no warm-up of the shift", _fix_terms("warm_up", "warm_up_heating")),
    "plans": ("all that is planned is believed", _replace(PlanOutcomes, "apply_daily_update", _forget)),
    "way home": ("the shift ends with the last planned leg", _replace(outlook, "WAY_HOME", NOTHING)),
    "legs": ("each ride is the next leg", _replace(plan_tracker.ActivePlan, "count_done", lambda *_: 1)),
    "cold battery": (
        "the capacity does not depend on the cold",
        _replace(ConsumptionFactors, "expect_cold_loss", lambda _, celsius: 0.0 * np.nan_to_num(celsius)),
    ),
    "curve": ("the display is straight", _straighten),
}
"""Name of each part -> what the forecasts are without it, and how to leave it out."""


@contextmanager
def leave_out(part: str) -> Iterator[None]:
    """Run the block without a part; the empty name leaves nothing out."""
    with ExitStack() as stack:
        for patch in PARTS[part][1]() if part else ():
            stack.enter_context(patch)
        yield


def main(arguments: list[str] | None = None) -> None:
    """Judge forecasts without each part, and publish the table."""
    parser = make_parser("soc_ablation", __doc__, keep=NEEDED)
    parser.add_argument("--seed", type=int, default=1510)
    parser.add_argument("--recording", type=Path, action="append", default=[], help="recording of real cars beside")
    options = parser.parse_args(arguments)
    rows: list[list[str]] = []
    given = options.recording
    names = [*FLEETS, *(path.stem for path in given)]
    whole: list[float] = []
    for part in ("", *PARTS):
        with leave_out(part):
            errors = [measure(judge_fleet(name, options.seed, 0, options.keep).cases) for name in FLEETS]
            errors += [measure(judge(path.stem, 0, 0.0, McapSource(path), None).cases) for path in given]
        whole = whole or errors
        changes = [f"{100.0 * (error / first - 1.0):+.0f} %" for error, first in zip(errors, whole, strict=True)]
        shown = changes if part else [f"{error:.2f}" for error in errors]
        rows.append([part or "nothing left out", PARTS[part][0] if part else "", *shown])
        Console().print(rows[-1], highlight=False)
    about = (
        f"Mean absolute error {AHEAD} h ahead in % of charge, and its change where a part is left out, seed "
        f"{options.seed}. Changes of a few per cent are chance."
    )
    command = f"python -m socast.tools.bench.soc_ablation --seed {options.seed} --keep build/ablation"
    publish("soc-ablation", command, [about, "", *write_table(["left out", "the forecasts then", *names], rows)])


def measure(cases: pd.DataFrame) -> float:
    """Return the mean absolute error of forecasts some hours ahead. [%]"""
    rows = cases[cases["hours"] == AHEAD]
    return float((rows["soc_mean_pct"] - rows["soc_end_pct"]).abs().mean())


if __name__ == "__main__":
    main()
