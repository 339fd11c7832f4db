"""Guess from the values of a table units and signs, by the physics of a car, and how its rows become samples."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final, NamedTuple

import numpy as np

from socast.core.batch import Floats
from socast.tools.importers.table.agreement import SignEvidence, judge_sign
from socast.tools.importers.table.agreement_sums import AgreementSums, CarSums, sum_cars
from socast.tools.importers.table.cells import Bools
from socast.tools.importers.table.column_map import FieldSource
from socast.tools.importers.table.sampling import HOLD, STAND
from socast.tools.importers.table.units import FIELD_UNITS, POWER, Conversion, find_conversion

NEAR: Final = 0.15
"""Largest logarithm of the ratio of a distance to that by speed in the right unit."""
CANDIDATES: Final = {"speed_kmh": ("km/h", "mph", "m/s"), "odometer_km": ("km", "mi")}
"""Field -> units among which distances decide."""
FASTEST: Final = 0.1
"""Speed above which an odometer cannot count in kilometres. [km/s]"""
USUAL: Final = (0.05, 1.0)
POSSIBLE: Final = (0.003, 15.0)
"""Consumptions of road vehicles, and those that a unit in a name may give before it is doubted. [kWh/km]"""
_COMPARISONS: Final = (
    ("speed_kmh", "fixes", None),
    ("odometer_km", "odometer", "speed_kmh"),
    ("speed_kmh", "odometer", "odometer_km"),
)
"""Field, the sum that its distance is compared with, and the field whose unit must be known for it."""


_WITNESSES: Final = frozenset({"time", "vehicle", "speed_kmh", "soc_pct", "charging", "elevation_m"})
"""Columns beside a power that say something of its sign."""
_WORDS: Final = {
    "acceleration": ("acceleration discharges the battery", "acceleration would charge the battery"),
    "charge": ("the charge falls as energy is drawn", "the charge would rise as energy is drawn"),
    "power at stops": ("stops discharge the battery", "stops would charge the battery"),
    "energy per km": ("driving discharges the battery", "driving would charge the battery"),
}
"""Witness of a sign -> what it says of a right sign, and of an inverted one."""
PERIODS: Final = (1.0, 2.0, 3.0, 5.0, 10.0, 15.0, 20.0, 30.0, 60.0)
"""Periods that are proposed. [s]"""
TOGETHER: Final = 0.5
"""Share of the rows with speed that hold power, or the reverse, below which rows carry only what changed. [1]"""
LONGEST_STEP: Final = 300.0
"""Longest time between two values that counts as one step. [s]"""
FAST: Final[tuple[str, ...]] = ("speed_kmh", "battery_current_a", POWER)
"""Fields of which it matters how long a value holds."""
LEAST_VALUES: Final = 20
"""Values of a field from which its way of sending is learned."""
FEW: Final = 0.03
"""Share of values that repeat the one before up to which a field is sent on change alone. [1]"""
HEARTBEAT: Final = 3.0
"""Ratio of the time to a repeated value to that to a changed one from which repetitions are heartbeats. [1]"""
LATE: Final = 1.5
"""Heartbeats after which a value is unknown. [1]"""
SILENT: Final = 3.0
"""Ratio of a silence after which the values of a driving car are unknown to the longest usual one. [1]"""
LONGEST_SILENCE: Final = 120.0
"""Longest such silence. [s]"""
PAUSE: Final = 10.0
"""Time without rows from which the odometer is asked whether the car stood. [s]"""
MOVED: Final = 0.05
"""Distance by the odometer from which it did not. [km]"""
MOST_MOVED: Final = 0.2
"""Share of silences over which the car moved, of a sender on change. [1]"""
THROTTLE: Final = 1.8
"""Shortest time between two values of a power from which they may be too few for its energy. [s]"""
WHOLE: Final = 0.12
"""Deviation of a time from whole shortest times up to which it is one. [1]"""
MOST_WHOLE: Final = 0.75
"""Share of such times of a sender that looks in periods. [1]"""
FEWEST_LONGER: Final = 10
"""Times longer than the shortest one from which this is judged."""


class Source(NamedTuple):
    """Hold the column or signal that a field is read from, and what is known of it: unit, sign, and the reasons."""

    field: str
    column: str | None
    signal: str | None
    unit: str | None
    sign: int | None = None
    true: tuple[str, ...] = ()
    reasons: tuple[str, ...] = ()

    def to_field_source(self) -> FieldSource:
        """Return a source whose values keep the unit of the contract where the unit is not known."""
        unit = self.unit if self.unit is not None else FIELD_UNITS[self.field]
        factor, offset = find_conversion(unit, self.field) if unit else Conversion(1.0)
        sign = self.sign or 1
        return FieldSource(self.column, self.signal, Conversion(sign * factor, sign * offset), frozenset(self.true))


class GuessedUnit(NamedTuple):
    """Hold unit and sign of a field with the reasons for them, and the places of cars that have the other sign."""

    unit: str | None
    sign: int
    reasons: tuple[str, ...]
    other: tuple[int, ...] = ()


def guess_values(rows: np.ndarray, known: Mapping[str, Source]) -> dict[str, GuessedUnit]:
    """Return unit and sign of each field.

    Parameters
    ----------
    rows : structured array
        Rows in the order of time. A field whose unit is not known is as it stands in the file.
    """
    rows = rows.copy()
    found: dict[str, GuessedUnit] = {}
    units = {field: each.unit for field, each in known.items()}
    settled = {field for field, unit in units.items() if unit is not None}
    for field, each in known.items():
        unit, source = each.unit, "; ".join(each.reasons)
        if unit is not None or not FIELD_UNITS[field]:
            reason = source or (f"unit in the name: {unit}" if unit else "")
            found[field] = GuessedUnit(unit, 1, (reason,) if reason else ())
            if unit is not None and not source.startswith("preset") and FIELD_UNITS[field]:
                found[field] = _correct_unit(field, unit, rows) or found[field]
            continue
        guessed, reason = _guess_by_range(field, rows)
        if guessed == "m" and field == "odometer_km":
            settled.add(field)
        found[field] = GuessedUnit(guessed, 1, tuple(filter(None, (reason, source))))
        rows[field] = _convert(field, guessed, rows[field])
    for field, measured, beside in _COMPARISONS:
        if field not in units or field in settled or (beside is not None and beside not in settled):
            continue
        unit = _guess_by_distance(field, measured, rows)
        if unit is not None:
            by = "positions" if measured == "fixes" else "speed" if field == "odometer_km" else "the odometer"
            found[field] = GuessedUnit(unit, 1, (f"{unit}, because distances agree with {by}",))
            rows[field] = _convert(field, unit, rows[field])
            settled.add(field)
    return found | _guess_signs(rows, found, {field: each.sign for field, each in known.items()})


def _correct_unit(field: str, unit: str, rows: np.ndarray) -> GuessedUnit | None:
    """Return another unit than that in the name, with which values become possible, and scale the rows; else None."""
    values = rows[field][np.isfinite(rows[field])]
    size = float(np.percentile(np.abs(values), 99)) if len(values) else 0.0
    limits = {"battery_voltage_v": 2000.0, "battery_current_a": 5000.0, "hvac_w": 50e3, POWER: 5000.0}
    named = find_conversion(unit, field)
    shown = f"the name says {unit}, and values up to {size / named.factor:.4g} {unit} are impossible"
    other = None
    if size > limits.get(field, np.inf):
        base = FIELD_UNITS[field]
        other = {POWER: "W", "hvac_w": "W"}.get(field, f"m{base}")
    elif field == "soc_pct" and named.factor == 1.0 and 0.0 < values.max(initial=0.0) <= 1.0 and np.ptp(values) > 0.02:
        other, shown = "1", f"the name says {unit}, and all values are at most 1"
    elif field == POWER and (used := _measure_consumption(rows)) and not POSSIBLE[0] <= used <= POSSIBLE[1]:
        scales = {each: find_conversion(each, field).factor / named.factor for each in ("W", "kW")}
        other = next((each for each, scale in scales.items() if USUAL[0] <= used * scale <= USUAL[1]), None)
        shown = f"the name says {unit}, and driving would take {used:.3g} kWh/km"
    if other is None or (changed := find_conversion(other, field)) == named:
        return None
    rows[field] *= changed.factor / named.factor
    return GuessedUnit(other, 1, (f"{other} by the values: {shown}; check it",))


def _measure_consumption(rows: np.ndarray) -> float | None:
    """Return the energy by power per distance [kWh/km], None where less than 1 km has power and speed."""
    if "speed_kmh" not in (rows.dtype.names or ()):
        return None
    total = _sum(rows[["time", "vehicle", "speed_kmh", POWER]])
    return abs(total["energy"]) / total["distance"] / 3600.0 if total["distance"] > 1000.0 else None


def _convert(field: str, unit: str | None, values: Floats) -> Floats:
    """Return values in the unit of the contract."""
    conversion = find_conversion(unit, field) if unit is not None and FIELD_UNITS[field] else Conversion(1.0)
    return conversion.apply(values)


def _guess_by_range(field: str, rows: np.ndarray) -> tuple[str | None, str]:
    """Return the unit that the range of values suggests, and the reason."""
    values = rows[field]
    known = values[np.isfinite(values)]
    usual = FIELD_UNITS[field]
    if not len(known) or not usual:
        return None, ""
    low, middle, high = np.percentile(known, [1, 50, 99]).tolist()
    size = max(abs(low), abs(high))
    shown = f"values from {low:.4g} to {high:.4g}"
    rules = (
        ("1", field == "soc_pct" and min(low, 1.0 - high) >= 0.0, "a fraction"),
        ("K", usual == "degC" and middle > 200.0, "kelvin"),
        ("degF", usual == "degC" and middle > 48.0, "degrees Fahrenheit"),
        ("m", field == "odometer_km" and _measure_growth(rows) > FASTEST, "it grows faster than any car drives in km"),
        ("kW", field == POWER and size <= 1000.0, "kW"),
        ("W", field == POWER, "W"),
        ("kW", field == "hvac_w" and size <= 20.0, "kW"),
        ("W", field == "hvac_w", "W"),
        (f"m{usual}", field in {"battery_voltage_v", "battery_current_a"} and size > 2000.0, f"m{usual}"),
        ({"percent": "%", "degree": "deg"}.get(usual, usual), True, "assumed"),
    )
    unit, reason = next((unit, reason) for unit, fits, reason in rules if fits)
    return unit, f"{shown}: {reason}"


def _measure_growth(rows: np.ndarray) -> float:
    """Return the usual growth of the odometer between rows in which it grows, per second."""
    known = rows[np.isfinite(rows["odometer_km"])]
    known = known[np.argsort(known["vehicle"], kind="stable")]
    step, growth = np.diff(known["time"]), np.diff(known["odometer_km"])
    grows = (step > 0) & (growth > 0) & (np.diff(known["vehicle"]) == 0)
    return float(np.median(growth[grows] / np.maximum(step[grows], 1.0))) if grows.any() else 0.0


def _guess_by_distance(field: str, measured: str, rows: np.ndarray) -> str | None:
    """Return the unit with which the distance by speed agrees with another one."""
    total = _sum(rows)
    beside = total[f"speed_beside_{measured}"]
    if beside < 500.0 or total[measured] <= 0.0:
        return None
    factors = {unit: find_conversion(unit, field).factor for unit in CANDIDATES[field]}
    ratio = total[measured] / beside
    wanted = ratio if field == "speed_kmh" else 1.0 / ratio
    best = min(factors, key=lambda unit: abs(np.log(wanted / factors[unit])))
    return best if abs(np.log(wanted / factors[best])) < NEAR else None


def _guess_signs(
    rows: np.ndarray, found: Mapping[str, GuessedUnit], signs: Mapping[str, int | None]
) -> dict[str, GuessedUnit]:
    """Return the current and the power with their signs, inverted where the witnesses of most cars say so."""
    judged = {}
    pairs = (("battery_current_a", "battery_voltage_v"), (POWER, POWER))
    for field, beside in pairs:
        if field not in found or (beside not in found and field != POWER):
            continue
        names = [name for name in rows.dtype.names or () if name in {*_WITNESSES, field, beside}]
        evidence = {place: judge_sign(car) for place, car in _list_cars(rows[names]).items()}
        known = [each.sign for each in evidence.values() if each.sign]
        sign = -1 if sum(known) < 0 else 1
        other = tuple(place for place, each in evidence.items() if each.sign == -sign)
        reason = _explain_sign(list(evidence.values()), sign, is_given=signs[field] is not None)
        judged[field] = found[field]._replace(
            sign=sign * (signs[field] or 1), reasons=(*found[field].reasons, reason), other=other
        )
    return judged


def _explain_sign(evidence: list[SignEvidence], sign: int, *, is_given: bool) -> str:
    """Return why a sign was chosen."""
    deciding = next((each for each in evidence if each.sign == sign), None)
    if deciding is not None:
        witness = (deciding.right if sign > 0 else deciding.inverted)[0]
        does, would = _WORDS[witness]
        if sign > 0:
            return f"sign: {does}"
        how = "against the preset: with its sign" if is_given else "as it stands"
        return f"sign inverted {how}, {would}" if is_given else f"sign inverted: {how}, {would}"
    contradiction = next((each for each in evidence if each.is_contradictory), None)
    if contradiction is not None:
        pro, con = " and ".join(contradiction.right), " and ".join(contradiction.inverted)
        return f"sign not decided: {pro} for this sign, {con} against it; check it"
    if is_given:
        return "sign of the preset: too little driving to check"
    return "sign: too little driving to check; positive must mean discharging"


def _list_cars(rows: np.ndarray) -> dict[int, CarSums]:
    """Return the sums of each car by its place."""
    sums = AgreementSums()
    sums.add(rows)
    names = [str(place) for place in range(int(rows["vehicle"].max()) + 1)]
    return {int(car.vehicle): car for car in sums.list_cars(names, {}, None)}


def _sum(rows: np.ndarray) -> dict[str, float]:
    """Return the sums of all cars."""
    return sum_cars(list(_list_cars(rows).values()))


class GuessedRows(NamedTuple):
    """Hold how rows become samples.

    Parameters
    ----------
    period, hold : float
        Time between samples, and the age up to which a value stays known. [s]
    silence : float, optional
        Time without any row after which the values of a driving car are unknown, where values are sent on change. [s]
    holds : mapping of str to float
        Ages of single fields. [s]
    unresolved : mapping of str to str
        Fields that are sent too seldom to show what happened between two values, with the reason.
    """

    period: float
    hold: float
    reason: str
    silence: float | None = None
    holds: Mapping[str, float] = MappingProxyType({})
    unresolved: Mapping[str, str] = MappingProxyType({})


class _Sending(NamedTuple):
    """Hold how a field is sent: whether on change, and after which time a value is repeated all the same [s]."""

    on_change: bool
    heartbeat: float | None


def guess_rows(rows: np.ndarray, on_change: bool = False) -> GuessedRows | None:
    """Return how rows become samples; None where each row is a sample.

    Parameters
    ----------
    on_change : bool
        Whether the sender is known to send on change, where the rows are too few to show it.
    """
    names = rows.dtype.names or ()
    energy: list[str] = [name for name in ("battery_current_a", POWER) if name in names]
    if "speed_kmh" not in names or not energy:
        return None
    speed = np.isfinite(rows["speed_kmh"])
    power = np.logical_or.reduce([np.isfinite(rows[name]) for name in energy])
    fewer, both = int(min(speed.sum(), power.sum())), int((speed & power).sum())
    if not fewer or both >= TOGETHER * fewer:
        return None
    step = max(_measure_step(rows, speed), _measure_step(rows, power))
    period = next((each for each in PERIODS if each >= 0.9 * step), PERIODS[-1])
    share = f"{both / fewer:.0%} of the rows with the one of speed and power hold the other"
    reason = f"{share}; each changes every {step:.2g} s"
    ways = {name: way for name in FAST if name in names and (way := _learn_sending(rows, name)) is not None}
    way = ways.get("speed_kmh")
    if not (way.on_change if way else on_change) or _moves_in_silence(rows):
        return GuessedRows(period, max(HOLD, 3.0 * period), reason)
    holds = {name: max(LATE * each.heartbeat, 3.0 * period) for name, each in ways.items() if each.heartbeat}
    # a field that is repeated in any case is known no longer than usual
    holds |= {name: max(HOLD, 3.0 * period) for name, each in ways.items() if not each.on_change}
    silence = _measure_silence(rows)
    found = "unchanged values are " + (
        f"repeated after {way.heartbeat:.3g} s" if way and way.heartbeat else "not repeated"
    )
    unresolved = {name: words for name in energy if (words := _find_throttle(rows, name))}
    return GuessedRows(period, STAND, f"{reason}; {found}", silence, holds, unresolved)


def _take_series(rows: np.ndarray, known: Bools) -> tuple[np.ndarray, Floats, Bools]:
    """Return rows by car and time, the times between them, and which of these are of one car. [s]"""
    chosen = rows[known]
    chosen = chosen[np.argsort(chosen["vehicle"], kind="stable")]
    return chosen, np.diff(chosen["time"]), np.diff(chosen["vehicle"]) == 0


def _measure_step(rows: np.ndarray, known: Bools) -> float:
    """Return the usual time between two rows in which a field is known. [s]"""
    _, step, same = _take_series(rows, known)
    step = step[same & (step > 0) & (step <= LONGEST_STEP)]
    return float(np.median(step)) if len(step) else HOLD


def _learn_sending(rows: np.ndarray, name: str) -> _Sending | None:
    """Return how a field is sent, None where it has too few values.

    A sender in periods repeats a value that does not change, such as the speed at a stop. A sender on change does not,
    or only as a heartbeat, which takes much longer than a change.
    """
    chosen, step, same = _take_series(rows, np.isfinite(rows[name]))
    same &= (step > 0) & (step <= LONGEST_STEP)
    repeats = np.diff(chosen[name]) == 0
    again, changed = step[same & repeats], step[same & ~repeats]
    if len(again) + len(changed) < LEAST_VALUES or not len(changed):
        return None
    if len(again) <= FEW * (len(again) + len(changed)):
        return _Sending(True, None)
    heartbeat = float(np.median(again))
    if heartbeat >= HEARTBEAT * np.median(changed) and np.percentile(again, 20) >= 0.5 * heartbeat:
        return _Sending(True, heartbeat)
    return _Sending(False, None)


def _find_throttle(rows: np.ndarray, name: str) -> str:
    """Return why values of a power do not show its energy, empty where they do.

    A sender that sends each first change, and then nothing for some seconds, sees the beginnings of braking and
    accelerating more often than their ends: the energy would be wrong by some 10 %. A sender that looks in periods sees
    all of it alike; its times are whole periods apart.
    """
    _, step, same = _take_series(rows, np.isfinite(rows[name]))
    step = step[same & (step > 0) & (step <= LONGEST_STEP)]
    if len(step) < LEAST_VALUES:
        return ""
    shortest = float(np.percentile(step, 10))
    longer = step[step > 1.3 * shortest] / shortest
    is_whole = np.abs(longer - np.round(longer)) <= WHOLE
    if shortest < THROTTLE or len(longer) < FEWEST_LONGER or np.mean(is_whole) > MOST_WHOLE:
        return ""
    return f"it is sent when it changes, at most every {shortest:.3g} s: too seldom for the energy"


def _hold_last(values: Floats, same: Bools) -> Floats:
    """Return values with the last known one of the same car in place of unknown ones."""
    places = np.where(np.isfinite(values), np.arange(len(values)), -1)
    places[0] = max(places[0], 0)
    first = np.append(0, np.flatnonzero(~same) + 1)
    places[first] = np.maximum(places[first], first)
    held: Floats = values[np.maximum.accumulate(places)]
    return held


def _measure_silence(rows: np.ndarray) -> float:
    """Return the time without any row after which the values of a driving car are unknown. [s]"""
    by_car, step, same = _take_series(rows, np.ones(len(rows), bool))
    driving = _hold_last(by_car["speed_kmh"], same)[:-1] > 0.0
    step = step[same & driving & (step > 0) & (step <= LONGEST_STEP)]
    usual = float(np.percentile(step, 99)) if len(step) else 0.0
    return max(HOLD, min(LONGEST_SILENCE, SILENT * usual))


def _moves_in_silence(rows: np.ndarray) -> bool:
    """Return whether the odometer advances in silences in which the car stands by its last speed: rows are lost.

    The distance between two readings of the odometer is compared with that of the speed, held until its next value.
    """
    if "odometer_km" not in (rows.dtype.names or ()):
        return False
    by_car, step, same = _take_series(rows, np.ones(len(rows), bool))
    speed = np.nan_to_num(_hold_last(by_car["speed_kmh"], same))
    held = np.append(0.0, np.cumsum(np.where(same, speed[:-1] * step / 3600.0, 0.0)))
    silent = same & (speed[:-1] == 0.0) & (step > PAUSE) & (step <= LONGEST_STEP)
    silences = np.append(0, np.cumsum(silent))
    read = np.flatnonzero(np.isfinite(by_car["odometer_km"]))
    if len(read) < 2:
        return False
    driven, by_speed = np.diff(by_car["odometer_km"][read]), np.diff(held[read])
    asked = (np.diff(by_car["vehicle"][read]) == 0) & (np.diff(silences[read]) > 0) & (driven >= 0.0)
    if not asked.any():
        return False
    resolution = float(np.min(driven[driven > 0.0], initial=1.0))
    return float(np.mean((driven - by_speed)[asked] > MOVED + resolution)) > MOST_MOVED
