"""Compare the forecasts of a replay with those of an earlier one, car by car and field by field."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from math import isnan, nan
from pathlib import Path
from typing import Any, Final, NamedTuple

import msgspec
from rich.console import Console

from socast.core.errors import SettingsError
from socast.core.formatting import format_count
from socast.stream.mcap_reader import McapSource

ROUNDING: Final = 1e-9
"""Difference of a number that counts as none where no tolerance is given, absolute and relative."""
MOST_ROWS: Final = 12
"""Number of cars and fields that are listed."""
Values = Mapping[str, Any]


class FieldDifference(NamedTuple):
    """Hold how a field of the forecasts of a car differs.

    Parameters
    ----------
    vehicle, field : str
        Car, and field of the payload, such as `range_km.mean`.
    differing, compared : int
        Forecasts in which it differs, and that were compared.
    time : float
        First of these. [Unix s]
    expected, found : object
        Values there; None where the field is unknown or absent.
    largest : float
        Largest absolute difference, NaN where the values are no numbers.
    """

    vehicle: str
    field: str
    differing: int
    compared: int
    time: float
    expected: Any
    found: Any
    largest: float


class ForecastComparison(NamedTuple):
    """Hold how the forecasts of a replay differ from those that were expected.

    Parameters
    ----------
    compared : int
        Forecasts in both.
    missing, additional : dict of str to int
        Forecasts of each car that were expected and not found, and found and not expected.
    differences : tuple of FieldDifference
        Fields that differ, by the time at which they first do.
    """

    compared: int
    missing: dict[str, int]
    additional: dict[str, int]
    differences: tuple[FieldDifference, ...]

    @property
    def is_equal(self) -> bool:
        """Whether nothing differs."""
        return not (self.missing or self.additional or self.differences)

    def describe(self) -> str:
        """Return in one line how many forecasts were compared, and what differs."""
        if self.is_equal:
            return f"{format_count(self.compared, 'forecast')} as expected"
        parts = [
            f"{format_count(sum(counts.values()), 'forecast')} {what} ({', '.join(sorted(counts))})"
            for what, counts in (("missing", self.missing), ("not expected", self.additional))
            if counts
        ]
        if self.differences:
            cars = len({each.vehicle for each in self.differences})
            fields = len({each.field for each in self.differences})
            parts.append(f"{format_count(fields, 'field')} of {format_count(cars, 'car')} differ")
        return f"{'; '.join(parts)}; {format_count(self.compared, 'forecast')} compared"


def parse_tolerances(words: Sequence[str]) -> dict[str, float]:
    """Return tolerances by field, from words such as `soc_pct=0.1` or `range_km=2`.

    Raises
    ------
    SettingsError
        A word has another form, or its number is not 0 or more.
    """
    tolerances = {}
    for word in words:
        name, equals, text = word.partition("=")
        try:
            number = float(text)
        except ValueError:
            number = -1.0
        if not (name and equals and number >= 0.0):
            raise SettingsError(f"tolerance {word!r}: give FIELD=NUMBER, a number of 0 or more, such as soc_pct=0.1")
        tolerances[name] = number
    return tolerances


def compare_recordings(
    expected: Path, found: Path, tolerances: Mapping[str, float] | None = None
) -> ForecastComparison:
    """Compare the forecasts in two recordings.

    Parameters
    ----------
    expected, found : Path
        Recordings that hold forecasts, as `socast replay --out` writes them.
    tolerances : mapping of str to float, optional
        Largest difference of a field, in its unit. A name such as `range_km` holds for all its parts. By default a
        number may differ by `ROUNDING`, and nothing else.

    Returns
    -------
    ForecastComparison

    Raises
    ------
    SettingsError
        A tolerance names a field that no forecast has.
    """
    wanted, made = _read_forecasts(expected), _read_forecasts(found)
    fields = {field for values in (*wanted.values(), *made.values()) for field in values}
    allowed = dict(tolerances or {})
    if unknown := [name for name in allowed if not any(_is_part(field, name) for field in fields)]:
        known = ", ".join(sorted({field.partition(".")[0] for field in fields}))
        raise SettingsError(f"tolerance of {unknown[0]}: no forecast has this field; the fields are {known}")
    both = [key for key in wanted if key in made]
    counts: dict[str, int] = defaultdict(int)
    for vehicle, _, _ in both:
        counts[vehicle] += 1
    found_in: dict[tuple[str, str], FieldDifference] = {}
    for key in both:
        vehicle, time, _ = key
        for field in wanted[key].keys() | made[key].keys():
            one, other = wanted[key].get(field), made[key].get(field)
            size = _find_difference(one, other, _find_tolerance(field, allowed))
            if size is None:
                continue
            first = found_in.get((vehicle, field))
            if first is None:
                first = FieldDifference(vehicle, field, 0, counts[vehicle], time, one, other, size)
            found_in[vehicle, field] = first._replace(
                differing=first.differing + 1, largest=size if isnan(first.largest) else max(first.largest, size)
            )
    order = sorted(found_in.values(), key=lambda each: (each.time, each.vehicle, each.field))
    return ForecastComparison(len(both), _count_absent(wanted, made), _count_absent(made, wanted), tuple(order))


def show_comparison(comparison: ForecastComparison, console: Console) -> None:
    """Print what differs first, a line for each car and field, and how much differs in all."""
    rows = _join_cars(comparison.differences)
    cars = max((len(each.vehicle) for each in rows), default=0)
    fields = max((len(each.field) for each in rows), default=0)
    if rows:
        console.print("What differs first, expected -> found:", style="bold")
    for each in rows[:MOST_ROWS]:
        at = datetime.fromtimestamp(each.time, UTC)
        size = "" if isnan(each.largest) else f" by up to {each.largest:.3g}"
        values = f"{_format_value(each.expected)} -> {_format_value(each.found)}"
        where = f"at {at:%Y-%m-%dT%H:%M:%SZ}, in {each.differing:,} of {each.compared:,}{size}"
        line = f"{each.vehicle:{cars}}  {each.field:{fields}}  {values} {where}"
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    if (more := len(rows) - MOST_ROWS) > 0:
        console.print(f"and {format_count(more, 'more pair')} of car and field", highlight=False)
    console.print(comparison.describe(), markup=False, highlight=False, soft_wrap=True)


def _join_cars(differences: Sequence[FieldDifference]) -> list[FieldDifference]:
    """Return differences, with one row for all cars whose field has the same two values, such as the model."""
    groups: dict[tuple[str, str, str], list[FieldDifference]] = defaultdict(list)
    for each in differences:
        groups[each.field, str(each.expected), str(each.found)].append(each)
    return [
        first
        if not others
        else first._replace(
            vehicle=format_count(1 + len(others), "car"),
            differing=sum(each.differing for each in (first, *others)),
            compared=sum(each.compared for each in (first, *others)),
        )
        for first, *others in groups.values()
    ]


def _read_forecasts(path: Path) -> dict[tuple[str, float, int], dict[str, Any]]:
    """Return the fields of each forecast by car, time and number among those of this time."""
    forecasts: dict[tuple[str, float, int], dict[str, Any]] = {}
    for messages in McapSource(path):
        for message in messages:
            if not message.key.endswith("/forecast"):
                continue
            payload = msgspec.json.decode(message.payload)
            vehicle, time, number = str(payload.pop("vehicle_id")), float(payload.pop("time_s")), 0
            while (vehicle, time, number) in forecasts:
                number += 1
            forecasts[vehicle, time, number] = dict(list_fields(payload))
    return forecasts


def list_fields(value: Mapping[str, Any], before: str = "") -> list[tuple[str, Any]]:
    """Return the fields of a payload and their values; those of an object have its name before them."""
    fields: list[tuple[str, Any]] = []
    for name, each in value.items():
        fields += list_fields(each, f"{before}{name}.") if isinstance(each, dict) else [(f"{before}{name}", each)]
    return fields


def _is_part(field: str, name: str) -> bool:
    return field == name or field.startswith(f"{name}.")


def _find_tolerance(field: str, tolerances: Mapping[str, float]) -> float | None:
    """Return the tolerance of a field, the one of the longest name that holds for it."""
    names = [name for name in tolerances if _is_part(field, name)]
    return tolerances[max(names, key=len)] if names else None


def _find_difference(expected: Any, found: Any, tolerance: float | None) -> float | None:
    """Return the absolute difference of two values, NaN of others than numbers, None where they agree."""
    if isinstance(expected, int | float) and isinstance(found, int | float):
        size = abs(float(found) - float(expected))
        most = ROUNDING * (1.0 + abs(expected)) if tolerance is None else tolerance
        return None if size <= most else size
    return None if expected == found else nan


def _count_absent(forecasts: Mapping[tuple[str, float, int], Values], others: Mapping[Any, Values]) -> dict[str, int]:
    """Return how many forecasts of each car are not among others."""
    counts: dict[str, int] = defaultdict(int)
    for key in forecasts.keys() - others.keys():
        counts[key[0]] += 1
    return dict(counts)


def _format_value(value: Any) -> str:
    return "–" if value is None else f"{value:.5g}" if isinstance(value, float) else str(value)
