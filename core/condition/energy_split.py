"""Split the measured energy of rides into the terms of a model, and what the model does not explain.

The prediction of each ride is a sum of parts (`socast.core.condition.energy_parts`). The rest, measured less predicted,
is unexplained. The parts therefore add up to the measured energy, in every group of rides.

The distance of a part is its energy over the present mean consumption. The distances therefore add up to that driven.
"""

from collections.abc import Mapping
from math import inf, isfinite
from types import MappingProxyType
from typing import Annotated, Any, Final, NamedTuple

import numpy as np
import pandas as pd
from msgspec import field
from msgspec.structs import replace
from numpy.typing import NDArray

from socast.core.condition.car_days import LEAST_SIBLINGS, forget_cars
from socast.core.condition.energy_parts import (
    LIMIT,
    STANDING,
    UNEXPLAINED,
    WAITING,
    PredictionParts,
    acts_over_time,
    is_air_drag,
    split_predictions,
)
from socast.core.effects import get_library
from socast.core.errors import ModelError, SettingsError
from socast.core.evaluate.compare.models import ComparedRides, select_rides
from socast.core.evaluate.records import EstimatedValue, hold_estimate
from socast.core.formatting import format_count
from socast.core.models import CORRECTION, VEHICLE, VEHICLE_MODEL, LinearModel
from socast.core.models.plausibility import describe_implausible, describe_limited
from socast.core.records import Record, declare
from socast.core.stats.clustered import compute_clustered_ratio

FLEET: Final = "fleet"
"""Way to group rides that leaves them together."""
GROUP_COLUMNS: Final[Mapping[str, str]] = MappingProxyType(
    {"car": VEHICLE, "month": "date", "driver": "driver_id", "model": VEHICLE_MODEL, "speed": "average_speed_kmh"}
)
"""Other ways to group rides -> the column of the ride table."""
SPEED_CLASSES: Final[Mapping[float, str]] = MappingProxyType(
    {20.0: "0–20 km/h", 40.0: "20–40 km/h", 60.0: "40–60 km/h", inf: "60 km/h or more"}
)
"""Mean speed, stops included, below which a ride belongs to a class -> name of the class. [km/h]"""
UNKNOWN_GROUP: Final = "unknown"
DRIVING: Final = " while driving"
"""What follows the words of a term whose energy while the car stands is a part of its own."""
MEASURED: Final = "measured"
WORDS: Final[Mapping[str, str]] = MappingProxyType(
    {
        "accessories": "climate and accessories",
        "aero_drag": "air drag",
        "aero_drag_wind": "drag in the wind",
        "braking": "losses in braking",
        "cold_rolling": "cold tyres",
        "drivetrain_loss_torque": "losses of the motor",
        "inertia": "speed changes",
        "inertia_negative": "slowing",
        "inertia_positive": "speeding up",
    }
)
"""Term of a model -> what takes its energy, where the name does not say it."""
SLOWER: Final = 0.9
"""Speed of the slower drive over the present one. [1]"""
LIKE_SIBLINGS: Final = "each car like the median of its vehicle model"
DRIVEN_SLOWER: Final = "10 % slower"


class EnergyAmount(Record, frozen=True):
    """Hold an amount of energy of some rides: its size, and what it means in distance and money."""

    energy_kwh: Annotated[EstimatedValue, declare("Energy. [kWh]", "kWh", "amount")] = EstimatedValue()
    share: Annotated[float | None, declare("Energy over the measured energy. [1]", "of measured", "percent")] = None
    per_100km_kwh: Annotated[
        EstimatedValue, declare("Energy per distance. [kWh/100 km]", "kWh/100 km", "two decimals")
    ] = EstimatedValue()
    range_km: Annotated[
        float | None, declare("Distance that it brings at the present mean consumption. [km]", "km", "amount")
    ] = None
    cost: Annotated[float | None, declare("Energy times its price. [price]", "price", "two decimals")] = None
    cost_per_100km: Annotated[
        float | None, declare("The same per distance. [price/100 km]", "price/\n100 km", "two decimals")
    ] = None


class EnergyShare(EnergyAmount, frozen=True, kw_only=True):
    """Hold the energy that a part of a prediction takes from the battery, negative where it returns some."""

    what: Annotated[str, declare("What takes the energy, in words.", "where the energy goes")]
    name: Annotated[str, declare("Name of the term of the model, or of another part.", "term")]
    kind: Annotated[str, declare("`term`, `waiting`, `correction`, `limit`, `unexplained`, or `measured` for the sum.")]

    @property
    def is_returned(self) -> bool:
        """Whether a part of the model returns energy to the battery."""
        return self.kind != UNEXPLAINED and (self.energy_kwh.value or 0.0) < 0.0


class GroupEnergy(Record, frozen=True, kw_only=True):
    """Hold where the energy of a group of rides went."""

    name: Annotated[str, declare("Name of the group.", "group")]
    of: Annotated[dict[str, str], declare("What its rides share, by way to group.")] = field(default_factory=dict)
    rides: Annotated[int, declare("Number of rides.", "rides", "count")]
    vehicles: Annotated[int, declare("Number of cars.", "cars", "count")]
    distance_km: Annotated[float, declare("Distance. [km]", "km", "count")]
    measured: Annotated[EnergyShare, declare("Measured energy.")]
    shares: Annotated[list[EnergyShare], declare("Parts of the prediction, then what is unexplained.")]
    returned_kwh: Annotated[float, declare("Sum of the parts that return energy, not negative. [kWh]")]


class EnergySaving(EnergyAmount, frozen=True, kw_only=True):
    """Hold the energy that another way of driving would save, by the model."""

    what: Annotated[str, declare("What would differ.", "if, by the model")]
    assumption: Annotated[str, declare("What the figure assumes, in words.")]


class CarEnergyFactor(Record, frozen=True, kw_only=True):
    """Hold the measured over the predicted energy of a car, beside its siblings."""

    vehicle_id: Annotated[str, declare("Name of the car.", "car")]
    vehicle_model: Annotated[str, declare("Key of its vehicle model.", "vehicle model")]
    rides: Annotated[int, declare("Number of rides.", "rides", "count")]
    factor: Annotated[EstimatedValue, declare("Measured over predicted energy. [1]", "factor", "three decimals")]
    median: Annotated[
        float, declare("Median factor of the cars of its vehicle model. [1]", "median of its model", "three decimals")
    ]
    saved_kwh: Annotated[float, declare("Energy that the median would save. [kWh]", "would save, kWh", "signed")]


class EnergySplit(Record, frozen=True, kw_only=True):
    """Hold where the measured energy of rides went, by the terms of a model."""

    model: Annotated[str, declare("Name of the model.")]
    version: Annotated[str, declare("Version of the model.")]
    by: Annotated[str, declare("How rides are grouped: `fleet`, or ways such as `car`, separated by commas.")]
    price: Annotated[float | None, declare("Price of energy. [price/kWh]")]
    read: Annotated[int, declare("Number of rides read.")]
    left_out: Annotated[dict[str, int], declare("Reason -> number of rides left out.")]
    first_date: str
    last_date: str
    fleet: Annotated[GroupEnergy, declare("All rides together.")]
    groups: Annotated[list[GroupEnergy], declare("Groups by name; empty for `fleet`.")]
    savings: Annotated[list[EnergySaving], declare("What other driving would save, by the model.")]
    impossible: Annotated[list[str], declare("Why a saving cannot be told.")]
    cars: Annotated[list[CarEnergyFactor], declare("Cars that have siblings, the largest saving first.")]
    notes: Annotated[list[str], declare("Notes for the reader.")]


class _Scale(NamedTuple):
    """Hold what turns an energy of some rides into shares, distance and money."""

    measured: float
    distance_km: float
    price: float | None

    def describe_amount(self, energy: float, half: float | None = None) -> dict[str, Any]:
        """Return the fields of an `EnergyAmount`. [kWh]"""
        known, per = self.measured > 0.0, 100.0 / self.distance_km if self.distance_km > 0.0 else None
        return {
            "energy_kwh": EstimatedValue(value=energy, ci95=half),
            "share": energy / self.measured if known else None,
            "per_100km_kwh": EstimatedValue(
                value=None if per is None else per * energy, ci95=None if per is None or half is None else per * half
            ),
            "range_km": self.distance_km * energy / self.measured if known else None,
            "cost": None if self.price is None else self.price * energy,
            "cost_per_100km": None if self.price is None or per is None else self.price * per * energy,
        }


def split_energy(
    rides: pd.DataFrame, model: LinearModel, *, by: str = FLEET, price: float | None = None
) -> EnergySplit:
    """Return where the measured energy of rides went, by the terms of a model.

    Parameters
    ----------
    by : str
        `FLEET`, or one or several of `GROUP_COLUMNS`, separated by commas.
    price : float, optional
        Price of energy in any currency. [price/kWh]

    Raises
    ------
    ModelError
        Where no ride is fit for training, measured and predicted, or what groups the rides is unknown.
    SettingsError
        For an unknown way to group, and a price that is not 0 or above.
    """
    ways = parse_ways(by)
    if price is not None and not (isfinite(price) and price >= 0.0):
        raise SettingsError(f"the price of a kWh is {price:g}, and must be 0 or above: give one such as 0.12")
    chosen = select_rides(rides, {model.name: model})
    parts = split_predictions(model, chosen)
    every = np.ones(len(chosen.rides), np.bool_)
    fleet = _sum_group(FLEET, every, chosen, parts, price, halves=parts.compute_half_widths())
    order = [share.name for share in fleet.shares]
    labels = list(zip(*(_name_by(chosen.rides, way) for way in ways), strict=True))
    groups = []
    for label in sorted(set(labels)):
        rows = np.array([each == label for each in labels])
        group = _sum_group(", ".join(label), rows, chosen, parts, price, order=order)
        groups.append(replace(group, of=dict(zip(ways, label, strict=True))))
    scale = _Scale(fleet.measured.energy_kwh.value or 0.0, fleet.distance_km, price)
    savings, impossible = list[EnergySaving](), list[str]()
    cars = _compare_siblings(model, chosen)
    for saving in (_save_like_siblings(cars, scale), _save_by_slowing(model, fleet, scale)):
        (impossible if isinstance(saving, str) else savings).append(saving)  # type: ignore[arg-type]
    return EnergySplit(
        model=model.name,
        version=model.version,
        by=",".join(ways) or FLEET,
        price=price,
        read=chosen.read,
        left_out=chosen.left_out,
        first_date=str(chosen.rides["date"].min()),
        last_date=str(chosen.rides["date"].max()),
        fleet=fleet,
        groups=groups,
        savings=savings,
        impossible=impossible,
        cars=cars,
        notes=_list_notes(parts, chosen, fleet),
    )


def parse_ways(by: str) -> tuple[str, ...]:
    """Return the ways to group rides that a text names, each once; none for all rides together.

    Examples
    --------
    >>> parse_ways("car,month"), parse_ways("fleet")
    (('car', 'month'), ())
    """
    ways = tuple(dict.fromkeys(each.strip() for each in by.split(",")))
    if ways == (FLEET,):
        return ()
    if FLEET in ways:
        raise SettingsError(f"{FLEET} leaves all rides together and cannot be combined: leave it out of {by!r}")
    for way in ways:
        if way not in GROUP_COLUMNS:
            raise SettingsError(
                f"rides cannot be grouped by {way!r} (--by {by!r}): give {FLEET}, or one or several of "
                f"{', '.join(GROUP_COLUMNS)}, separated by commas"
            )
    return ways


def _name_by(rides: pd.DataFrame, way: str) -> list[str]:
    """Return the group of each ride by one way."""
    column = GROUP_COLUMNS[way]
    if column not in rides or rides[column].isna().all():
        raise ModelError(f"rides cannot be grouped by {way}: column {column!r} is unknown in all of them; group by car")
    names = rides[column].astype(object).astype(str)
    if way == "month":
        names = names.str[:7]
    elif way == "speed":
        names = pd.cut(rides[column], [0.0, *SPEED_CLASSES], right=False, labels=list(SPEED_CLASSES.values()))
    return list(names.astype(object).where(rides[column].notna(), UNKNOWN_GROUP))


def _sum_group(
    name: str,
    rows: NDArray[np.bool_],
    chosen: ComparedRides,
    parts: PredictionParts,
    price: float | None,
    *,
    order: list[str] | None = None,
    halves: Mapping[str, float] = MappingProxyType({}),
) -> GroupEnergy:
    """Return where the energy of a group of rides went, in the given order or with the largest part first."""
    rides = chosen.rides[rows]
    measured, distance = float(chosen.measured[rows].sum()), float(rides["distance_km"].sum())
    scale = _Scale(measured, distance, price)
    driving = parts.split_terms
    sums = {part: float(energy[rows].sum()) for part, energy in parts.energies.items()}
    shares = [
        EnergyShare(
            what=WORDS.get(part, part.replace("_", " ") if part in get_library() else part)
            + (DRIVING if part in driving else ""),
            name=part,
            kind={CORRECTION: "correction", LIMIT: "limit", WAITING: WAITING}.get(part, "term"),
            **scale.describe_amount(energy, halves.get(part)),
        )
        for part, energy in sums.items()
    ]
    shares.sort(key=lambda share: order.index(share.name) if order else -(share.energy_kwh.value or 0.0))
    rest = scale.describe_amount(measured - sum(sums.values()), halves.get(UNEXPLAINED))
    return GroupEnergy(
        name=name,
        rides=len(rides),
        vehicles=int(rides[VEHICLE].nunique()),
        distance_km=distance,
        measured=EnergyShare(what=MEASURED, name=MEASURED, kind=MEASURED, **scale.describe_amount(measured)),
        shares=[*shares, EnergyShare(what=UNEXPLAINED, name=UNEXPLAINED, kind=UNEXPLAINED, **rest)],
        returned_kwh=-sum(min(energy, 0.0) for energy in sums.values()),
    )


def _compare_siblings(model: LinearModel, chosen: ComparedRides) -> list[CarEnergyFactor]:
    """Return the factor of each car beside the median of its vehicle model, without what the model knows of single cars."""
    usual = forget_cars(model).predict_energy(chosen.rides)
    factors = list[tuple[str, str, int, float, EstimatedValue]]()
    names = chosen.rides[[VEHICLE_MODEL, VEHICLE]].astype(str)
    for kind, car in sorted(set(zip(names[VEHICLE_MODEL], names[VEHICLE], strict=True))):
        rows = np.flatnonzero((names[VEHICLE_MODEL] == kind) & (names[VEHICLE] == car))
        used, expected = chosen.measured[rows], usual[rows]
        if used.sum() > 0.0 and expected.sum() > 0.0:
            factor = hold_estimate(compute_clustered_ratio(used, expected, chosen.clusters[rows]))
            factors.append((kind, car, len(rows), float(used.sum()), factor))
    cars = []
    for kind in dict.fromkeys(kind for kind, *_ in factors):
        of_kind = [each for each in factors if each[0] == kind]
        if len(of_kind) <= LEAST_SIBLINGS:
            continue
        median = float(np.median([factor.value for *_, factor in of_kind]))
        cars += [
            CarEnergyFactor(
                vehicle_id=car,
                vehicle_model=kind,
                rides=count,
                factor=factor,
                median=median,
                saved_kwh=used * (1.0 - median / (factor.value or median)),
            )
            for _, car, count, used, factor in of_kind
        ]
    return sorted(cars, key=lambda car: -car.saved_kwh)


def _save_like_siblings(cars: list[CarEnergyFactor], scale: _Scale) -> EnergySaving | str:
    """Return what the median of the vehicle model would save, or why that is unknown."""
    if not cars:
        return f"{LIKE_SIBLINGS}: unknown, because fewer than {LEAST_SIBLINGS + 1} cars of one vehicle model drove"
    above = sum(max(car.saved_kwh, 0.0) for car in cars)
    return EnergySaving(
        what=LIKE_SIBLINGS,
        assumption=(
            f"Each of {format_count(len(cars), 'car')} takes the median factor of measured over predicted energy of "
            f"its vehicle model, also those below it. The cars above it would save {above:.1f} kWh. The factor does "
            "not separate a car from its drivers."
        ),
        **scale.describe_amount(sum(car.saved_kwh for car in cars)),
    )


def _save_by_slowing(model: LinearModel, fleet: GroupEnergy, scale: _Scale) -> EnergySaving | str:
    """Return what slower driving would save, or why that is unknown."""
    energies = {share.name: share.energy_kwh.value or 0.0 for share in fleet.shares}
    drag = [term.name for term in model.terms if is_air_drag(term)]
    time = [term.name for term in model.terms if acts_over_time(term)]
    if not (drag and time):
        lacking = " and none ".join(["of air drag"] * (not drag) + ["that acts over time"] * (not time))
        return f"{DRIVEN_SLOWER}: unknown, because the model has no term {lacking}"
    saved = (1.0 - SLOWER**2) * sum(energies[name] for name in drag)
    added = (1.0 / SLOWER - 1.0) * sum(energies[name] for name in time)
    longer = "the whole ride takes longer, stops included" if WAITING not in energies else "driving takes longer"
    return EnergySaving(
        what=DRIVEN_SLOWER,
        assumption=(
            f"Air drag ({', '.join(drag)}) times 0.81, which is exact in still air, and what acts over time "
            f"({', '.join(time)}) times 1/0.9, because {longer}. All else stays as it is, also speed changes."
        ),
        **scale.describe_amount(saved - added),
    )


def _list_notes(parts: PredictionParts, chosen: ComparedRides, fleet: GroupEnergy) -> list[str]:
    """Return what a reader must know of the model and of the rides."""
    model = parts.model
    notes = [*describe_implausible(model), *describe_limited(model)]
    if limited := model.count_limited(chosen.rides, chosen.predicted[model.name]):
        notes.append(f"{format_count(limited, 'prediction')} stopped at the limit of the model")
    if STANDING not in chosen.rides and any(acts_over_time(term) for term in model.terms):
        notes.append(f"the tables hold no {STANDING}, so waiting is no part of its own: make them again")
    if flat := int(parts.without_heights.sum()):
        notes.append(f"the heights of {format_count(flat, 'ride')} are unknown, so climbing counts as none in them")
    if model.cars:
        notes.append(f"factors of {format_count(len(model.cars), 'car')} are part of each term")
    if all(share.energy_kwh.ci95 is None for share in fleet.shares):
        notes.append("the model holds no standard errors of its coefficients, so there are no intervals")
    return notes
