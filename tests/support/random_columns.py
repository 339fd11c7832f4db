"""Draw columns of windows at random, small enough that the covariance of the windows fits into one matrix."""

import numpy as np

from socast.core import effects
from socast.core.batch import Floats
from socast.core.columns import SECONDS_PER_DAY
from socast.core.diagnose.inference.window_columns import CAR_DIRECTIONS, SHAPES, WindowColumns
from socast.core.diagnose.inference.window_model import CARS, DATES, DAYS, RIDES, D, S, WindowModel

NAMES = ("headwind", "snow", "wet_road", "standby", "payload")
"""Effects of the library whose names the random columns have."""


def draw_columns(seed: int, *, cars: int = 3, dates: int = 3, rides: int = 2, windows: int = 4) -> WindowColumns:
    """Return random columns of cars of one model that drive on the same dates."""
    rng = np.random.default_rng(seed)
    days, n = cars * dates, cars * dates * rides * windows
    at = np.arange(n)

    def draw(width: int) -> Floats:
        return rng.normal(size=(n, width))

    return WindowColumns(
        residual=rng.normal(size=n),
        shapes=0.3 * draw(len(SHAPES)),
        directions=0.3 * draw(len(CAR_DIRECTIONS)),
        base=draw(2),
        common=draw(1),
        expected=(),
        names=NAMES,
        effects=draw(len(NAMES)) / np.array([max(abs(each.low), abs(each.high)) for each in map(effects.get, NAMES)]),
        parts=np.abs(draw(4)),
        ignored=np.zeros(n, dtype=np.bool_),
        ride=at // windows,
        day=at // (windows * rides),
        day_of_ride=np.arange(days * rides) // rides,
        car_of_day=np.arange(days) // dates,
        date_of_day=np.arange(days) % dates,
        kind_of_day=np.zeros(days, dtype=np.int64),
        start=SECONDS_PER_DAY * (np.arange(days) % dates),
        cars=tuple(f"taxi-{car}" for car in range(cars)),
        dates=tuple(str(day) for day in np.datetime64("2018-01-01") + np.arange(dates)),
        measured=1.0 + np.abs(rng.normal(size=n)),
    )


def build_covariance(model: WindowModel) -> Floats:
    """Return the covariance of the windows under a model: measurement, random effects, base and known effects."""
    columns = model.columns
    ride, day = columns.ride, columns.day
    car, date = columns.car_of_day[day], columns.date_of_day[day]
    both = np.column_stack([columns.shapes, columns.directions])
    assert both.shape[1] == S + D
    out = np.diag(model.variance / model.weight)
    for level, unit, loads in (
        (RIDES, ride, columns.shapes),
        (DAYS, day, columns.shapes),
        *([(CARS, car, both)] if model.has_cars else []),
        *([(DATES, date, columns.shapes)] if model.has_dates else []),
    ):
        scaled = loads * np.exp(model.log_spread[level])
        out += (scaled @ scaled.T) * (unit[:, np.newaxis] == unit)
    fixed = np.column_stack([columns.base, columns.common, model.known])
    return np.asarray(out + fixed @ fixed.T)
