"""Estimate whether the consumption of cars changed with a campaign, such as a repair or new tyres.

The car-days of each car, less those of its siblings, give the change by generalised least squares
(`socast.core.condition.step_fit`), and the same estimate of placebo campaigns calibrates its interval
(`socast.core.condition.placebo`).
"""

from typing import Final

import numpy as np
from scipy.special import ndtri, stdtrit

from socast.core.batch import Floats, Ints
from socast.core.condition.campaign import AFTER, BEFORE, LEAST_DAYS, OUT, Campaign, States
from socast.core.condition.campaign_records import BeforeAfter, CarChange, CarSeries, LevelPath, PlaceboSpread
from socast.core.condition.car_days import LEAST_SIBLINGS, CarDays, write_date
from socast.core.condition.detection_time import foresee_detection
from socast.core.condition.level_model import Series, smooth_levels
from socast.core.condition.placebo import calibrate_errors, try_placebos
from socast.core.condition.step_fit import (
    DeviationPanel,
    StepFit,
    combine_steps,
    estimate_panel,
    fit_step,
    subtract_untreated,
)
from socast.core.errors import ModelError, suggest_names
from socast.core.formatting import format_count

LEAST_CAMPAIGN_KWH: Final = 0.2
"""Least predicted energy of a car-day; the variance of a day with little energy is large. [kWh]"""


def compare_before_after(days: CarDays, campaign: Campaign, model: str) -> BeforeAfter:
    """Return the change of consumption that came with a campaign, or how long one would take to be seen."""
    series = days.consumption
    rows = _find_rows(days, campaign)
    states = np.array([campaign.classify(car, series.dates) for car in days.cars])
    treated = np.isin(np.arange(len(days.cars)), rows)
    deviation, shared, siblings = subtract_untreated(series, days.models, treated)
    is_planned = campaign.at is not None and campaign.at > series.dates[-1]
    for row in rows:
        _check_days(days.cars[row], deviation.value[row], states[row], campaign, is_planned=is_planned)
    alike = np.isin(siblings > 0, siblings[rows] > 0) | treated
    panel, split = estimate_panel(deviation, shared, states, treated, alike)
    placebos, independent = try_placebos(panel, days.cars, campaign, rows, np.flatnonzero(alike & ~treated))
    judged = [] if is_planned else rows
    fits = [fit_step(panel, row, states[row]) for row in judged]
    whole = combine_steps(panel, fits, rows, days.models, siblings) if fits else None
    placebo = calibrate_errors(placebos, independent, whole.ratio if whole else None)
    cars = [
        _make_change(
            days.cars[row],
            fit,
            placebo,
            panel.value[[row]],
            states[[row]],
            int(siblings[row]),
            _measure_after(days, [row], states),
        )
        for row, fit in zip(judged, fits, strict=True)
    ]
    change = None
    if whole is not None:
        name = days.cars[rows[0]] if len(rows) == 1 else "all"
        after = _measure_after(days, rows, states)
        change = _make_change(name, whole, placebo, panel.value[rows], states[rows], int(siblings[rows].min()), after)
    return BeforeAfter(
        vehicles=[days.cars[row] for row in rows],
        model=model,
        at=write_date(campaign.at) if campaign.at else None,
        until=write_date(campaign.until) if campaign.until else None,
        what=campaign.what,
        last_date=write_date(series.dates[-1]),
        change=change,
        cars=cars,
        placebo=placebo,
        detection=foresee_detection(panel, states, rows, siblings, placebo.scale, campaign.sizes),
        series=[
            _make_series(panel, split, row, days.cars[row], states[row], fit)
            for row, fit in zip(judged, fits, strict=True)
        ],
        notes=_list_notes(days, rows, siblings, placebo),
    )


def _find_rows(days: CarDays, campaign: Campaign) -> list[int]:
    """Return the rows of the cars of a campaign."""
    if unknown := [each for each in campaign.vehicles if each not in days.cars]:
        raise ModelError(f"vehicle {unknown[0]!r} has no rides here; {suggest_names(unknown[0], days.cars)}")
    first, last = (write_date(days.consumption.dates[at]) for at in (0, -1))
    if campaign.at is not None and campaign.at <= days.consumption.dates[0]:
        raise ModelError(
            f"the date is {write_date(campaign.at)}, and the rides are of {first} to {last}: give a date after "
            f"{first}, or recordings of earlier days"
        )
    return [days.cars.index(each) for each in dict.fromkeys(campaign.vehicles)]


def _check_days(car: str, value: Floats, state: States, campaign: Campaign, *, is_planned: bool) -> None:
    """Refuse a car with too few days before or after."""
    before, after = ("off", "on") if campaign.at is None else ("before the date", "after the date")
    for words, wanted in ((before, BEFORE), (after, AFTER)):
        count = int((np.isfinite(value) & (state == wanted)).sum())
        if count < LEAST_DAYS and not (is_planned and wanted == AFTER):
            longer = f"more than {format_count(campaign.days, 'day')} (--days), " if campaign.days else ""
            remedy = f"{longer}more rides, or another date" if campaign.at else "more rides, or other days"
            raise ModelError(
                f"{car} has {format_count(count, 'day')} with measurements {words}, and a comparison takes "
                f"{LEAST_DAYS}: give {remedy}"
            )


def _make_change(
    name: str,
    fit: StepFit,
    placebo: PlaceboSpread,
    value: Floats,
    states: States,
    siblings: int,
    per_100km_kwh: float | None,
) -> CarChange:
    """Return an estimate with its intervals."""

    def bound(share: float) -> tuple[float, float]:
        half = float(stdtrit(placebo.freedom, 0.5 + 0.5 * share)) * placebo.scale * fit.variance**0.5
        return float(np.expm1(fit.size - half)), float(np.expm1(fit.size + half))

    counts = [int((np.isfinite(value) & (states == state)).sum()) for state in (BEFORE, AFTER)]
    return CarChange(
        vehicle_id=name,
        change=float(np.expm1(fit.size)),
        ci90=bound(0.90),
        ci95=bound(0.95),
        ratio=fit.ratio,
        days_before=counts[0],
        days_after=counts[1],
        siblings=siblings,
        per_100km_kwh=per_100km_kwh,
    )


def _measure_after(days: CarDays, rows: list[int], states: States) -> float | None:
    """Return the measured energy of cars on the days after over their distance, None where unknown. [kWh/100 km]"""
    if days.distance_km is None:
        return None
    measured, km = np.exp(days.consumption.value[rows]) * days.consumption.amount[rows], days.distance_km[rows]
    used = (states[rows] == AFTER) & np.isfinite(measured)
    return 100.0 * float(measured[used].sum()) / float(km[used].sum()) if km[used].sum() > 0.0 else None


def _make_series(panel: DeviationPanel, split: Series, row: int, car: str, state: States, fit: StepFit) -> CarSeries:
    """Return the days of a car and its smoothed level before and after."""
    n = len(panel.value)
    of_car = Series(split.dates, *(each[[row, n + row]] for each in split[1:]))
    path = smooth_levels(of_car, panel.found)
    half = float(ndtri(0.95)) * path.sd

    def draw(at: int) -> LevelPath:
        days = np.flatnonzero(np.isfinite(of_car.value[at]))
        kept = slice(days[0], days[-1] + 1)
        bounds = (path.level[at] + side * half[at] - fit.level for side in (0.0, -1.0, 1.0))
        level, low, high = (np.expm1(each[kept]).tolist() for each in bounds)
        return LevelPath(date=[write_date(each) for each in panel.dates[kept]], level=level, low=low, high=high)

    used = np.isfinite(panel.value[row]) & (state != OUT)
    return CarSeries(
        vehicle_id=car,
        date=[write_date(each) for each in panel.dates[used]],
        deviation=np.expm1(panel.value[row, used] - fit.level).tolist(),
        after=(state[used] == AFTER).tolist(),
        level_before=draw(0),
        level_after=draw(1),
    )


def _list_notes(days: CarDays, rows: list[int], siblings: Ints, placebo: PlaceboSpread) -> list[str]:
    """Return what limits the answer."""
    notes = []
    if alone := [days.cars[row] for row in rows if not siblings[row]]:
        notes.append(
            f"No siblings of {', '.join(alone)}: fewer than {LEAST_SIBLINGS} other cars of the same vehicle model have "
            "rides on the same dates. Weather that the model lacks counts as the change."
        )
    if not placebo.campaigns:
        notes.append("No placebo campaign is possible, so the interval rests on the model of the noise alone.")
    return notes
