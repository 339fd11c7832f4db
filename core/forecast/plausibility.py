"""Find forecasts and answers that no car on a road can have, which are therefore not published.

A forecast rests on what a car reports. Every value of a sample may lie in its valid range, and the whole may still be
impossible: 1,500 V and 2,000 A for half an hour are 1.5 MWh. A forecast that is withheld is counted by its first cause:

- `not_finite`: a number is infinite;
- `ride`: the distance or duration of the ride is negative, or their ratio faster than any car;
- `soc`: the state of charge is not from 0 to 100 %, or its standard deviation larger than that;
- `ride_energy`: the energy of the ride is more than its battery holds;
- `range`: the range is negative, or longer than the most economical car with this battery could drive;
- `end_of_shift`: the state of charge at the end of the shift is not from 0 to 100 %;
- `interval_order`: a 5th percentile lies above its mean, or a mean above its 95th percentile;
- `reserve_risk`: the probability is not from 0 to 1.
"""

from collections import Counter
from math import isfinite
from typing import Any, Final

import numpy as np
from msgspec import UNSET
from msgspec.structs import replace

from socast.core.batch import Floats, replace_nan
from socast.core.columns import KMH
from socast.core.forecast.forecast_rows import INTERVALS, NEWEST_COLUMNS, Rows
from socast.core.forecast.soc_filter import SHIFT_GAP
from socast.core.totals.accumulator import Totals
from socast.core.totals.measured_energy import LARGEST_BATTERY, compute_largest_energy
from socast.core.vehicles.catalogue import RATED
from socast.core.vehicles.fleet import Cars
from socast.core.wire.messages import Interval, LegOutlook, Outlook

FASTEST: Final = 300 * KMH
"""Largest mean speed of a ride, the largest limit that the setting `speed_limit` accepts. [m/s]"""
LARGEST_PER_KM: Final = 5.0
"""Largest plausible energy of rides over their kilometres. [kWh/km]"""
LARGEST_POWER: Final = 100.0
"""Largest plausible mean of their power. [kW]"""
CLIMB: Final = 150.0
"""Largest energy of the climb of a leg: 7.5 t by 5,000 m, with losses. [kWh]"""
JUMP: Final = 100_000.0
"""Distance that a ride may add to that at `FASTEST`: by tunnels and by odometers after gaps. [m]"""


def find_implausible(running: Totals, rows: Rows, predicted: Floats, measured: Floats, cars: Cars) -> list[str | None]:
    """Return why each forecast is not plausible.

    Units: predicted [kWh] and measured [kWh] of the ride in progress, NaN where unknown.
    """
    kind = running.kinds
    capacity = replace_nan(cars.capacity[kind], LARGEST_BATTERY)
    distance, duration = running.amount("distance"), running.amount("duration")
    most_kwh = compute_largest_energy(running, cars)
    most_km = capacity / RATED[0]
    intervals = [tuple(map(rows.__getitem__, names)) for names in INTERVALS]
    published = [predicted, measured, *(rows[name] for name in NEWEST_COLUMNS)]
    faults = {
        "not_finite": np.any(np.isinf(published), axis=0),
        "ride": ~((distance >= 0.0) & (duration >= 0.0) & (distance <= FASTEST * duration + JUMP)),
        "soc": (rows["soc"] < 0.0) | (rows["soc"] > 1.0) | (rows["soc_sd"] > 1.0),
        "ride_energy": (np.abs(predicted) > most_kwh) | (np.abs(measured) > most_kwh),
        "range": (rows["range_km_p05"] < 0.0) | (rows["range_km_p95"] > most_km),
        "end_of_shift": (rows["soc_end_of_shift_p05"] < 0.0)
        | (rows["soc_end_of_shift_p95"] > 1.0)
        | ((rows["charge_soc_p05"] < 0.0) | (rows["charge_soc_p95"] > 1.0)),
        "interval_order": np.any([(low > mean) | (mean > high) for mean, low, high in intervals], axis=0),
        "reserve_risk": (rows["reserve_risk"] < 0.0) | (rows["reserve_risk"] > 1.0),
    }
    names, found = list(faults), np.array(list(faults.values()))
    if not found.any():
        return [None] * len(kind)
    first = np.where(found.any(axis=0), found.argmax(axis=0), -1)
    return [None if place < 0 else names[place] for place in first.tolist()]


def withhold_implausible(outlook: Outlook, implausible: Counter[str]) -> Outlook:
    """Return an answer without energies and charges ahead that are not plausible; its `why_not` names the cause."""
    legs = [*outlook.legs, *([outlook.asked] if outlook.asked else [])]
    charges = [outlook.soc_end_of_shift_pct, *(leg.soc_pct for leg in legs)]
    if outlook.next_charge:
        charges.append(outlook.next_charge.soc_pct)
    risk = outlook.reserve_risk
    faults = {
        "leg_energy": not all(map(_is_energy_plausible, legs)),
        "end_of_shift": not all(each is None or _lies_within(each, 0.0, 100.0) for each in charges),
        "interval_order": not all(each is None or each.p05 <= each.mean <= each.p95 for each in charges),
        "reserve_risk": risk is not None and not 0.0 <= risk <= 1.0,
    }
    cause = next((name for name, applies in faults.items() if applies), None)
    if cause is None:
        return outlook
    implausible[cause] += 1
    why = f"what this car and its vehicle model have sent leads to a forecast that is not plausible ({cause})"
    return _withhold(outlook, why, {"energy_kwh": None})


def withhold_charge(outlook: Outlook, silent_s: float) -> Outlook:
    """Return an outlook without charges if the car has been silent for so long that its shift is over.

    The car may have driven on or charged meanwhile, so no charge is published. The energies of rides remain.
    """
    if silent_s <= SHIFT_GAP:
        return outlook
    why = f"the car has been silent for {silent_s / 3600.0:.1f} h while other cars sent data, so its shift is over"
    return _withhold(outlook, why, {"reserve_risk": UNSET}, shift_end_s=None)


def _withhold(outlook: Outlook, why: str, of_legs: dict[str, Any], **also: None) -> Outlook:
    """Return an outlook without charges, and with these changes of it and of its legs."""
    asked, *legs = (leg and replace(leg, soc_pct=None, **of_legs) for leg in (outlook.asked, *outlook.legs))
    unknown: dict[str, Any] = dict.fromkeys(("soc_end_of_shift_pct", "reserve_risk", "waiting_energy_kwh"))
    return replace(outlook, asked=asked, legs=legs, why_not=why, next_charge=UNSET, **unknown, **also)


def _is_energy_plausible(leg: LegOutlook) -> bool:
    """Return whether a car on a road can take the energy of a leg."""
    most = CLIMB + LARGEST_PER_KM * leg.distance_km + LARGEST_POWER * leg.duration_s / 3600.0
    if leg.energy_kwh is None:
        return True
    return _lies_within(leg.energy_kwh, -CLIMB, most) and leg.energy_kwh.p05 <= leg.energy_kwh.p95


def _lies_within(interval: Interval, low: float, high: float) -> bool:
    """Return whether an interval and its mean are finite and within limits."""
    return all(isfinite(each) and low <= each <= high for each in (interval.mean, interval.p05, interval.p95))
