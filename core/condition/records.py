"""Declare the results about the condition of cars: their trends, their sudden changes, and the fleet."""

from typing import Annotated

import pandas as pd

from socast.core.records import ConfidenceInterval, PartialRecord, Record, declare


class CarEvent(PartialRecord, frozen=True):
    """Hold a known event of a car, such as a repair, and where it is beside a sudden change."""

    date: Annotated[str, declare("First UTC date after the event.", "date")]
    what: Annotated[str, declare("What happened; empty where the file says nothing.", "what")]
    step_since: Annotated[str | None, declare("First date after the nearest sudden change; None without one.")] = None
    days_after_step: Annotated[int | None, declare("Days from that date to the event; below 0 before it. [d]")] = None


class ConditionStep(Record, frozen=True):
    """Hold a sudden change of a car."""

    since: Annotated[str, declare("First date after the change.", "since")]
    interval: Annotated[tuple[str, str], declare("Dates between which it is with a probability of 90 %.")]
    change_pct: Annotated[float, declare("Change of the quantity. [%]", "change, %", "estimate", "ci95_pct")]
    ci95_pct: Annotated[ConfidenceInterval, declare("95 % interval of the change. [%]")]
    probability: Annotated[float, declare("Probability that there is a change at all. [1]", "probability", "percent")]
    events: Annotated[list[CarEvent], declare("Known events that the interval of dates holds.")] = []


class Trend(PartialRecord, frozen=True):
    """Hold how a quantity of a car is now, how fast it changes, and when it changed suddenly."""

    days: Annotated[int, declare("Number of dates with a measurement.")]
    level_pct: Annotated[float, declare("Last level over what is expected, less 100 %. [%]")]
    ci68_pct: Annotated[ConfidenceInterval, declare("68 % interval of it. [%]")]
    ci95_pct: Annotated[ConfidenceInterval, declare("95 % interval of it. [%]")]
    rate_pct: Annotated[float | None, declare("Change beside sudden ones, None where the data tell little. [%/year]")]
    rate_ci95_pct: Annotated[ConfidenceInterval | None, declare("95 % interval of the rate. [%/year]")]
    is_changing: Annotated[bool, declare("Whether the rate exceeds three standard deviations.")] = False
    steps: list[ConditionStep] = []
    dates: Annotated[list[str], declare("Dates of the following values.")] = []
    measured_pct: Annotated[list[float | None], declare("Value of each date. [%]")] = []
    path_pct: Annotated[list[float | None], declare("Level of each date. [%]")] = []
    path_sd_pct: Annotated[list[float | None], declare("Its standard deviation. [%]")] = []


class CarCondition(PartialRecord, frozen=True):
    """Hold how a car is doing."""

    vehicle_id: Annotated[str, declare("Name of the car.", "car")]
    vehicle_model: Annotated[str, declare("Key of the vehicle model.", "vehicle model")]
    siblings: Annotated[int, declare("Number of other cars with which it is compared; 0 beside the model alone.")]
    consumption: Annotated[Trend | None, declare("Consumption beside the siblings, or else over the model.")] = None
    capacity: Annotated[Trend | None, declare("Usable capacity over that of the catalogue, at mild temperature.")] = (
        None
    )
    nominal_kwh: Annotated[float | None, declare("Usable capacity by the catalogue. [kWh]")] = None
    events: Annotated[list[CarEvent], declare("Known events of this car alone, by their dates.")] = []

    @property
    def has_finding(self) -> bool:
        """Whether the car differs from what is expected, changed suddenly, changes, or lacks capacity."""
        consumption, capacity = self.consumption, self.capacity
        differs = consumption is not None and (consumption.ci95_pct[0] > 0.0 or consumption.ci95_pct[1] < 0.0)
        lacks = capacity is not None and capacity.ci95_pct[1] < 0.0
        return differs or lacks or any(each.is_changing or each.steps for each in (consumption, capacity) if each)

    @property
    def usable_kwh(self) -> float | None:
        """Usable capacity of the last date at mild temperature. [kWh]"""
        if self.capacity is None or self.nominal_kwh is None:
            return None
        return self.nominal_kwh * (1.0 + self.capacity.level_pct / 100.0)


class FleetCondition(Record, frozen=True):
    """Hold how the cars of a fleet are doing, those with a finding first."""

    model: Annotated[str, declare("Name of the model that predicts the energy.")]
    rides: int
    car_days: int
    car_days_left_out: Annotated[int, declare("Number of car-days with too little energy, or with an impossible one.")]
    energy_left_out: Annotated[float, declare("Their share of the measured energy. [1]")]
    first_date: str
    last_date: str
    left_out: Annotated[dict[str, int], declare("Reason -> number of rides left out.")]
    day_sd_pct: Annotated[float, declare("Standard deviation of the consumption from its level, usual day. [%]")]
    cold_loss_pct: Annotated[float | None, declare("Capacity that a kelvin below 10 °C takes off. [%/K]")]
    cars: list[CarCondition] = []
    events: Annotated[list[CarEvent], declare("Known events of all cars, by their dates.")] = []
    events_left_out: Annotated[int, declare("Number of known events of other cars, or outside the dates.")] = 0

    @property
    def table(self) -> pd.DataFrame:
        """One row for each car: consumption, rate, capacity and their intervals."""
        return pd.DataFrame([_make_row(car) for car in self.cars])


def _make_row(car: CarCondition) -> dict[str, str | float | None]:
    """Return a row of the table of cars."""
    row: dict[str, str | float | None] = {"vehicle_id": car.vehicle_id, "vehicle_model": car.vehicle_model}
    for name, trend in (("consumption", car.consumption), ("capacity", car.capacity)):
        row[f"{name}_pct"] = trend.level_pct if trend else None
        row[f"{name}_low_pct"], row[f"{name}_high_pct"] = trend.ci95_pct if trend else (None, None)
        row[f"{name}_rate_pct"] = trend.rate_pct if trend else None
        rates = trend.rate_ci95_pct if trend else None
        row[f"{name}_rate_low_pct"], row[f"{name}_rate_high_pct"] = rates or (None, None)
        row[f"{name}_since"] = trend.steps[-1].since if trend and trend.steps else None
    return row | {"usable_kwh": car.usable_kwh, "nominal_kwh": car.nominal_kwh}
