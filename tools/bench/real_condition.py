"""Measure what `before-after` and `condition` say of three real cars, to which nothing is known to have happened.

Each date is a placebo. Then the measured energies of all rides from a date on are raised by `SIZE`, for each date in
turn. The model is fitted to all rides of the car as they are, and there are no siblings.

Example: python -m socast.tools.bench.real_condition --ved ved/ --i3 i3/ --model3 model3/ --keep build/real
"""

from collections.abc import Sequence
from datetime import date
from typing import Final

import numpy as np
import pandas as pd

from socast.core.batch import Ints
from socast.core.condition.before_after import LEAST_CAMPAIGN_KWH, compare_before_after
from socast.core.condition.campaign import LEAST_DAYS, Campaign
from socast.core.condition.campaign_records import CarChange
from socast.core.condition.car_condition import assess_condition
from socast.core.condition.car_days import gather_car_days
from socast.core.evaluate.compare.models import select_rides
from socast.core.fit.recipes import fit_to_windows
from socast.core.fit.ride_blocks import ENERGY, parse_ride_date
from socast.core.formatting import format_minus
from socast.core.models import LinearModel
from socast.tools.bench.condition_fleets import NEAR, write_share
from socast.tools.bench.figures.published import NEEDED, make_parser, publish, write_table
from socast.tools.bench.real_cars import import_cars

SIZE: Final = 0.06
"""Planted step. [1]"""
RECIPES: Final = {"constant": "road_load_full_constant", "by temperature": "road_load_full"}
"""Accessories of the models -> recipe."""
BEFORE_AFTER: Final = (
    "car",
    "accessories",
    "put in",
    "days",
    "`before-after`: mean estimate",
    "shown at 90 %",
    "90 % interval holds it",
)
CONDITION: Final = ("car", "accessories", "put in", "`condition`: a step is told", f"within {NEAR} days with driving")
"""Heads of the tables."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and publish."""
    parser = make_parser("real_condition", __doc__, ved=NEEDED, i3=NEEDED, model3=NEEDED, keep=NEEDED)
    given = parser.parse_args(arguments)
    given.keep.mkdir(parents=True, exist_ok=True)
    changes, steps = list[list[str]](), list[list[str]]()
    for car in import_cars(given.keep, given.ved, given.i3, given.model3):
        for accessories, recipe in RECIPES.items():
            model = fit_to_windows(recipe, car.rides, car.windows, covariance=False)
            days = gather_car_days(select_rides(car.rides, {model.name: model}), model.name, LEAST_CAMPAIGN_KWH)
            driven = days.consumption.dates[np.isfinite(days.consumption.value[0])]
            tried = driven[LEAST_DAYS : len(driven) - LEAST_DAYS].tolist()
            for size in (0.0, SIZE):
                made = [compare_changed(car.rides, model, at, size) for at in tried]
                off = [find_step(car.rides, model, driven, at, size) for at in (tried if size else tried[:1])]
                head = [car.name, accessories, f"{100.0 * size:.0f} %"]
                mean = format_minus(f"{100.0 * np.mean([each.change for each in made]):+.1f} %")
                shown = write_share([each.is_shown for each in made])
                held = write_share([each.ci90[0] <= size <= each.ci90[1] for each in made])
                changes.append([*head, f"{len(driven)}", mean, shown, held])
                near = write_share([each is not None and each <= NEAR for each in off]) if size else ""
                steps.append([*head, write_share([each is not None for each in off]), near])
    about = (
        f"What is said of each date with {LEAST_DAYS} days with driving on both sides, as the drives are, and with "
        f"{100 * SIZE:.0f} % more energy from that date on. Most days of neighbouring dates are the same, so that the "
        "95 % intervals in parentheses (Wilson) are too narrow. Models are fitted to all drives of the car as they "
        f"are, by {' and '.join(f'`{each}`' for each in RECIPES.values())}. The cars have no siblings: what the model "
        "lacks of the weather is in the days."
    )
    lines = [about, "", *write_table(BEFORE_AFTER, changes), "", *write_table(CONDITION, steps)]
    command = "python -m socast.tools.bench.real_condition --ved ved/ --i3 i3/ --model3 model3/ --keep build/real"
    print("\n".join(lines))
    publish("real-condition", command, lines)


def compare_changed(rides: pd.DataFrame, model: LinearModel, at: int, size: float) -> CarChange:
    """Return the change that is estimated at a date from which on the energies are larger."""
    compared = select_rides(_raise(rides, at, size), {model.name: model})
    days = gather_car_days(compared, model.name, LEAST_CAMPAIGN_KWH)
    change = compare_before_after(days, Campaign((days.cars[0],), at), model.name).change
    assert change is not None  # the date is none to come
    return change


def find_step(rides: pd.DataFrame, model: LinearModel, driven: Ints, at: int, size: float) -> int | None:
    """Return how many days with driving the nearest step that is told lies off the date, None without a step."""
    trend = assess_condition(_raise(rides, at, size), model).cars[0].consumption
    since = [date.fromisoformat(step.since).toordinal() for step in (trend.steps if trend else [])]
    off = np.abs(np.searchsorted(driven, since) - np.searchsorted(driven, at))
    return int(off.min()) if since else None


def _raise(rides: pd.DataFrame, at: int, size: float) -> pd.DataFrame:
    """Return rides whose measured energies are larger from a date on."""
    later = np.array([parse_ride_date(each).toordinal() >= at for each in rides["date"].astype(str)])
    return rides.assign(**{ENERGY: rides[ENERGY] * np.where(later, 1.0 + size, 1.0)})


if __name__ == "__main__":
    main()
