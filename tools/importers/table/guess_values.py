"""Guess units and signs from the values of a table: by their ranges, and by the physics of a car."""

from collections.abc import Mapping
from typing import Final, NamedTuple

import numpy as np

from socast.core.batch import Floats
from socast.tools.importers.table.agreement_sums import AgreementSums, CarSums, sum_cars
from socast.tools.importers.table.guess_contents import Source
from socast.tools.importers.table.sign_evidence import SignEvidence, judge_sign
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
