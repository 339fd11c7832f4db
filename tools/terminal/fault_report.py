"""What the logger of each car sends wrong, how often and at what cost, mean powers among it: a record, and tables."""

from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any, Final

import msgspec
import numpy as np
import pandas as pd
from rich.console import Console

from socast.core.batch import Floats, Ints, Lanes
from socast.core.cleaning.faults import FAULTS, LoggerFault
from socast.core.cleaning.quality import CAUSES, Quality
from socast.core.columns import KMH
from socast.core.formatting import format_count
from socast.core.wire.decoder import Decoder
from socast.core.wire.messages import Message
from socast.tools.importers.table.row_messages import ONE_SIDED, measure_span
from socast.tools.terminal.rich_table import Column, make_table

MOST_SHOWN: Final = 12
"""Largest number of cars with a table of their own, those that lose most first."""
RARE: Final = 0.001
"""Share of the samples of a car up to which a fault leaves it among the clean ones. [1]"""
RIDE_COLUMNS: Final = ("vehicle_id", "duration_s", "distance_km", "fit_for_training", "unfit_reason")
"""Columns of the ride table that the report is made of."""
_OF_THE_RIDE: Final = {
    "too_short": "too short",
    "too_long": "too long; --longest-ride-min sets the limit",
    "too_little_distance": "too little distance; --least-distance-km sets the limit",
}
"""Reasons for which a ride is unfit whatever the logger does, in words."""
_FAULT_OF: Final[dict[str, LoggerFault]] = {cause: FAULTS[Quality[cause.upper()]] for cause in CAUSES}


class LostRides(msgspec.Struct, frozen=True):
    """Count rides that are unfit for training for one reason."""

    rides: int
    hours: float
    km: float


class CarFaults(msgspec.Struct, frozen=True):
    """Hold what the logger of a car sends wrong.

    Parameters
    ----------
    faults : dict of str to int
        Samples with each quality bit that occurs, the most frequent first.
    hours, km : float
        Duration and distance of all its rides.
    unfit : dict of str to LostRides
        Rides that are unfit for training, by reason, the one that costs the longest distance first.
    facts : tuple of str
        Sentences about the logger as a whole, such as that its current has the wrong sign.
    """

    vehicle_id: str
    samples: int
    faults: dict[str, int]
    rides: int
    hours: float
    km: float
    unfit: dict[str, LostRides]
    facts: tuple[str, ...] = ()

    @property
    def lost_hours(self) -> float:
        """Return the duration of the unfit rides. [h]"""
        return sum(lost.hours for lost in self.unfit.values())

    @property
    def lost_km(self) -> float:
        """Return the distance of the unfit rides. [km]"""
        return sum(lost.km for lost in self.unfit.values())

    @property
    def is_clean(self) -> bool:
        """Return whether no fault of the logger is frequent, or costs a ride."""
        return not (self.facts or any(map(self.is_frequent, self.logger_faults)) or self.unfit.keys() - _OF_THE_RIDE)

    def is_frequent(self, name: str) -> bool:
        """Return whether more than `RARE` of the samples have a quality bit."""
        return self.faults[name] > RARE * self.samples

    @property
    def logger_faults(self) -> dict[str, int]:
        """Return the samples with each quality bit that a logger can avoid."""
        return {name: count for name, count in self.faults.items() if _FAULT_OF[name].is_of_logger}


def report_cars(
    vehicle_ids: Sequence[str],
    samples: Ints,
    faults: Ints,
    rides: pd.DataFrame,
    facts: Mapping[str, Sequence[str]] | None = None,
) -> list[CarFaults]:
    """Return what the logger of each car sends wrong, those that lose most first."""
    of_car = dict(iter(rides.groupby("vehicle_id", sort=False)))
    none = rides.iloc[:0]
    cars = [
        CarFaults(
            name,
            int(count),
            {CAUSES[at]: int(bits[at]) for at in np.argsort(-bits, kind="stable") if bits[at]},
            len(own := of_car.get(name, none)),
            float(own["duration_s"].sum() / 3600.0),
            float(own["distance_km"].sum()),
            _count_unfit(own),
            tuple((facts or {}).get(name, ())),
        )
        for name, count, bits in zip(vehicle_ids, samples, faults, strict=True)
    ]
    return sorted(cars, key=lambda car: (car.is_clean, not car.facts, -car.lost_km, -_share(car), car.vehicle_id))


def describe_car(car: CarFaults) -> dict[str, Any]:
    """Return the report of a car as a JSON record."""
    faults = {
        name: {"samples": count, "share": count / car.samples, **_FAULT_OF[name]._asdict()}
        for name, count in car.faults.items()
    }
    lost = {"lost_hours": car.lost_hours, "lost_km": car.lost_km, "is_clean": car.is_clean}
    own: dict[str, Any] = msgspec.to_builtins(car)
    return own | lost | {"faults": faults}


def choose_next_step(cars: Sequence[CarFaults]) -> str:
    """Return the most useful thing to do: the fact, the reason or the fault that costs most."""
    for car in cars:
        if car.facts:
            return f"First mend the logger of {car.vehicle_id}: {car.facts[0]}"
    lost: Counter[str] = Counter()
    counts: Counter[str] = Counter()
    for car in cars:
        lost.update({reason: of_reason.km for reason, of_reason in car.unfit.items() if reason not in _OF_THE_RIDE})
        counts.update({} if car.is_clean else car.logger_faults)
    if lost:
        ((reason, km),) = lost.most_common(1)
        return f"Most is lost by rides that are unfit because of {_spell(reason)}, {km:,.1f} km: mend this first."
    if counts:
        fault = _FAULT_OF[counts.most_common(1)[0][0]]
        return f"No fault of a logger makes a ride unfit. The most frequent: {fault.title}. Remedy: {fault.remedy}."
    return "Nothing is to be mended: make tables with `socast tables`."


def show_cars(cars: Sequence[CarFaults], console: Console) -> None:
    """Print a table for each car with faults, those that are clean in one line, and a remedy for each fault."""
    faulty = [car for car in cars if not car.is_clean]
    for car in faulty[:MOST_SHOWN]:
        _show_car(car, console)
    if others := faulty[MOST_SHOWN:]:
        _print(console, f"{format_count(len(others), 'more car')} with faults, which lose less; --json lists them.")
    clean = [car.vehicle_id for car in cars if car.is_clean]
    if clean:
        names = ", ".join(clean[:MOST_SHOWN]) + (f" and {len(clean) - MOST_SHOWN:,} more" * (len(clean) > MOST_SHOWN))
        _print(
            console, f"Clean (no fault in more than {100.0 * RARE:g} % of the samples, no ride lost by one): {names}."
        )
    _show_limits([car for car in cars if car.is_clean], console)
    shown = {name for car in faulty[:MOST_SHOWN] for name in car.logger_faults if car.is_frequent(name)}
    if shown:
        rows = [(_FAULT_OF[name].title, _FAULT_OF[name].remedy) for name in CAUSES if name in shown]
        console.print(
            make_table([Column("fault"), Column("remedy, for the maker of the logger")], "Remedies", rows=rows)
        )


def _show_limits(cars: Sequence[CarFaults], console: Console) -> None:
    """Print which rides of clean cars are unfit by their length."""
    rides, km = sum(car.rides for car in cars), sum(car.km for car in cars)
    for reason, words in _OF_THE_RIDE.items():
        lost = [car.unfit[reason] for car in cars if reason in car.unfit]
        if lost:
            count, of = sum(each.rides for each in lost), sum(each.km for each in lost)
            _print(
                console,
                f"Unfit for training: {count:,} of {format_count(rides, 'ride')}, {of:,.1f} of {km:,.1f} km, {words}.",
            )


def _show_car(car: CarFaults, console: Console) -> None:
    """Print the table of a car, and what it loses."""
    columns = [Column("fault"), Column("samples", number=True), Column("%", number=True), Column("costs")]
    title = f"{car.vehicle_id}: {format_count(car.samples, 'sample')}"
    rows = []
    for name in filter(car.is_frequent, car.faults):
        count, fault = car.faults[name], _FAULT_OF[name]
        rows.append((fault.title, f"{count:,}", f"{100.0 * count / car.samples:.1f}", fault.cost))
    console.print(make_table(columns, title, rows=rows) if rows else title, markup=False, highlight=False)
    if rare := [_FAULT_OF[name].title for name in car.faults if not car.is_frequent(name)]:
        _print(console, f"In at most {100.0 * RARE:g} % of the samples: {'; '.join(rare)}.")
    for fact in car.facts:
        console.print(fact, style="yellow", markup=False, highlight=False)
    unfit = sum(lost.rides for lost in car.unfit.values())
    _print(
        console,
        f"{unfit:,} of {format_count(car.rides, 'ride')} {'is' if unfit == 1 else 'are'} unfit for training"
        + (f": {car.lost_hours:.2f} of {car.hours:.2f} h, {car.lost_km:,.1f} of {car.km:,.1f} km." if unfit else "."),
    )
    for reason, lost in car.unfit.items():
        _print(
            console, f"  {_spell(reason)}: {format_count(lost.rides, 'ride')}, {lost.hours:.2f} h, {lost.km:,.1f} km"
        )
    console.print()


def _count_unfit(rides: pd.DataFrame) -> dict[str, LostRides]:
    """Return the unfit rides of a car by reason, the one that costs the longest distance first."""
    unfit = rides[~rides["fit_for_training"].astype(bool)]
    lost = {
        str(reason): LostRides(len(own), float(own["duration_s"].sum() / 3600.0), float(own["distance_km"].sum()))
        for reason, own in unfit.groupby("unfit_reason")
    }
    return dict(sorted(lost.items(), key=lambda each: -each[1].km))


def _share(car: CarFaults) -> float:
    """Return the share of the most frequent fault of the logger of a car. [1]"""
    return max(car.logger_faults.values(), default=0) / max(car.samples, 1)


def _spell(reason: str) -> str:
    """Return the reason for which rides are unfit in words."""
    return _OF_THE_RIDE.get(reason) or reason.replace("_", " ")


def _print(console: Console, line: str) -> None:
    """Print a line as it is."""
    console.print(line, markup=False, highlight=False)


MOST_SAMPLES: Final = 5000
"""Samples of a car by which its power is judged."""


def find_mean_powers(blocks: Iterable[Sequence[Message]], announced: Collection[str]) -> dict[str, str]:
    """Return a sentence for each car that has a mean power and does not announce what its power covers.

    Parameters
    ----------
    announced : collection of str
        Cars that announce it, whatever it is.
    """
    lanes = Lanes()
    decoder = Decoder(lanes)
    parts: dict[int, list[Floats]] = {}
    counts: dict[int, int] = {}
    for messages in blocks:
        batch, _ = decoder.decode(messages)
        rows = np.column_stack([batch.stamp, batch.speed, batch.voltage * batch.current])
        for lane in np.unique(batch.lane).tolist():
            if counts.get(lane, 0) < MOST_SAMPLES:
                of_car = rows[batch.lane == lane]
                parts.setdefault(lane, []).append(of_car)
                counts[lane] = counts.get(lane, 0) + len(of_car)
    found = {}
    for lane, some in parts.items():
        name = lanes.names[lane]
        times, speed, power = np.concatenate(some)[:MOST_SAMPLES].T
        evidence = None if name in announced else measure_span(times, speed / KMH, power)
        if evidence is not None and evidence.span is not None:
            share = evidence.share if evidence.span == "before" else 1.0 - evidence.share
            found[name] = (
                f"voltage times current is probably the mean over the time {evidence.span} each sample, where "
                f"{share:.0%} of its kinetic power is (limit: {ONE_SIDED[0]:.0%}): announce power_covers "
                f"'{evidence.span}', else the noise of the measured energy is stated too large"
            )
    return found
