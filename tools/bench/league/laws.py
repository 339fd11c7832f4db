"""Hold what the cleaning made of each drive against the truth.

A ride is right within 3 % of distance and energy and 5 % of duration, beyond what its samples cannot show:

- Nobody sees where a drive began before its first sample in motion, and a ride may end with up to `stop_time` at
  standstill. So the truth is an interval: from the first sample in motion to the last one, to the whole drive with
  this standstill.
- Samples every 60 s do not determine an integral to 3 %. The error of the best simple integral of the true values at
  the times of the samples is added: the trapezoid or the hold of power, and of distance that of speed, fixes or odometer.
- Energy by the state of charge, or of a logger that samples every `SLOW` or more, is right within `SDS` of its own
  standard uncertainty too.
"""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import pandas as pd

from core.settings import Settings
from tools.bench.league.drives import JOULES
from tools.bench.league.faults import CAUSES, Fault
from tools.bench.league.loggers import FIRST_LABEL, Log

DISTANCE, ENERGY, DURATION = 0.03, 0.03, 0.05
"""Tolerances. [1]"""
SDS: Final = 3.0
"""Tolerance of energy by the state of charge, or of a slow logger. [own standard uncertainties]"""
SLOW: Final = 10.0
"""Time between samples of a slow logger. [s]"""
STOP: Final = Settings().stop_time
"""Standstill that ends a ride. [s]"""
REPAIRS: Final = ("ambient_filled", "ambient_assumed")
"""Quality columns that mark no fault of a logger."""
AMOUNTS: Final = ("distance_km", "energy_kwh", "duration_s")


@dataclass
class Truth:
    """Hold an amount of a drive that is right between two values, [low, high]."""

    low: float
    high: float

    def misses(self, value: float) -> float:
        """Return how far a value is from the interval; 0 inside it."""
        return max(self.low - value, value - self.high, 0.0)


@dataclass
class Verdict:
    """Hold what became of a drive.

    Parameters
    ----------
    car, drive : int
        Number of the car and of the drive in it.
    faults : tuple of str
    word : str
        `right`, `repaired`, `unfit`, `odd` (unfit for a cause that is not that of its faults), `wrong`.
    why : str
        Reason of an unfit ride, or the amounts that are wrong.
    found, truth : dict
        Amounts of the rides, and their intervals.
    """

    car: int
    drive: int
    faults: tuple[str, ...]
    word: str
    why: str
    found: dict[str, Any]
    truth: dict[str, Any]


def find_truth(log: Log) -> list[dict[str, Truth]]:
    """Return the true amounts of each drive of a car, before its clock and its order of arrival are spoiled."""
    car, track, truths = log.car, log.car.track, list[dict[str, Truth]]()
    for number, (begin, end) in enumerate(track.drives):
        rows = np.flatnonzero(log.drive == number)
        moving = rows[track.at("speed", log.true[rows]) > 1.5]
        if len(moving) < 2:
            truths.append({})
            continue
        first, last = log.true[moving[[0, -1]]]
        step = car.period
        after = log.true[(log.true >= end) & (log.true <= end + STOP + 2.0 * step)]
        late = after[-1] if len(after) else end
        if car.names:
            named = log.true[log.ride == number]
            first, last = max(first, named[0]), min(last, named[-1])
            late = named[-1]
        early = begin - step
        rows = np.flatnonzero((log.true >= first) & (log.true <= last))
        truths.append(
            {
                "distance_km": _span(track.at("distance", [first, last]), track.at("distance", [begin, end]), 1e-3),
                "energy_kwh": _span(
                    *(track.at("energy", [a, b]) for a in (begin, first) for b in (last, end, late)), 1.0 / JOULES
                ),
                "duration_s": Truth(last - first, late - early + step),
            }
        )
        distance, energy = _find_sampling_errors(log, rows)
        _widen(truths[-1]["distance_km"], DISTANCE, distance * 1e-3)
        least = 0.05 * truths[-1]["distance_km"].high
        _widen(truths[-1]["energy_kwh"], ENERGY, energy / JOULES, least)
        _widen(truths[-1]["duration_s"], DURATION, step)
    return truths


def _span(*parts: Any) -> Truth:
    """Return the interval of the differences of pairs, times the last argument."""
    spans = [float(pair[1] - pair[0]) * parts[-1] for pair in parts[:-1]]
    return Truth(min(spans), max(spans))


def _widen(truth: Truth, share: float, more: float, least: float = 0.0) -> None:
    """Widen an interval by a share of its ends, at least of a value, and by an amount."""
    truth.low -= share * max(abs(truth.low), least) + more
    truth.high += share * max(abs(truth.high), least) + more


def _find_sampling_errors(log: Log, rows: Any) -> tuple[float, float]:
    """Return the errors of distance [m] and energy [J] that the best simple integral of the true values has."""
    track, time, car = log.car.track, log.true[rows], log.car
    steps = np.diff(time)

    def err(name: str, of: str) -> float:
        values, true = track.at(name, time), track.at(of, time)
        integrals = ((0.5 * (values[1:] + values[:-1]) * steps).sum(), (values[:-1] * steps).sum())
        return min(abs(float(each) - float(true[-1] - true[0])) for each in integrals)

    driven = float(np.diff(track.at("distance", time[[0, -1]]))[0])
    distance = []
    if "speed" in car.sends:
        distance.append(err("speed", "distance"))
    if "position" in car.sends:
        chords = np.hypot(np.diff(track.at("north", time)), np.diff(track.at("east", time)))
        distance.append(abs(driven - float(chords.sum())))
    if "odometer" in car.sends:
        distance.append(1e3 * car.odometer_step)
    return min(distance, default=0.0), err("power", "energy")


def judge(
    number: int, log: Log, truths: list[dict[str, Truth]], faults: list[Fault], rides: pd.DataFrame
) -> list[Verdict]:
    """Return what became of each drive of a car, by its rides in the table."""
    first = np.round(rides["battery_temperature_c"].to_numpy() - FIRST_LABEL)
    last = np.round(rides["occupants"].to_numpy() - 1.0)
    names = tuple(each.name for each in faults)
    out = list[Verdict]()
    for drive, truth in enumerate(truths):
        if not truth:
            continue
        mine = rides[(first <= drive) & (drive <= last)]
        merged = bool((mine["fit_for_training"] & ((first != last)[(first <= drive) & (drive <= last)])).any())
        word, why, found = _judge_drive(mine, truth, faults, merged=merged, slow=log.car.period >= SLOW)
        out.append(Verdict(number, drive, names, word, why, found, {k: (t.low, t.high) for k, t in truth.items()}))
    return out


def _judge_drive(
    rides: pd.DataFrame, truth: dict[str, Truth], faults: list[Fault], *, merged: bool, slow: bool
) -> tuple[str, str, dict[str, Any]]:
    """Return the word, the reason and the amounts of a drive."""
    if not len(rides):
        return "unfit", "no_ride", {}
    fit = rides["fit_for_training"].to_numpy(bool)
    found: dict[str, Any] = {name: float(rides[name].sum()) for name in AMOUNTS}
    sd = float(np.sqrt((rides["energy_sd_kwh"] ** 2).sum()))
    found |= {"energy_sd_kwh": sd, "rides": len(rides), "source": "/".join(rides["energy_source"].fillna("-").unique())}
    found["by_sd"] = slow or "soc" in found["source"]
    bits = {
        column.removeprefix("quality_"): int(rides[column].sum())
        for column in rides
        if column.startswith("quality_") and column.removeprefix("quality_") not in REPAIRS and rides[column].any()
    }
    found["bits"] = bits
    found["unfit"] = sorted(set(rides["unfit_reason"].dropna()))
    if not fit.any():
        main = rides.loc[rides["distance_km"].idxmax()]
        why = str(main["unfit_reason"])
        words = [word for each in faults for word in CAUSES[each.family]]
        return ("unfit" if any(word in why for word in words) else "odd"), why, found
    if merged:
        return "wrong", "merged", found
    wrong = _find_wrong(found, truth, sd)
    if wrong and not fit.all():  # what is unfit is not used
        used = found | {name: float(rides.loc[fit, name].sum()) for name in AMOUNTS}
        wrong = [] if not _find_wrong(used, truth, sd) else wrong
    if wrong:
        return "wrong", "+".join(wrong) + (" of parts" if len(rides) > 1 else ""), found
    return ("repaired" if bits else "right"), "", found


def _find_wrong(found: dict[str, Any], truth: dict[str, Truth], sd: float) -> list[str]:
    """Return the amounts that miss the truth."""
    missed = {name: truth[name].misses(found[name]) for name in AMOUNTS}
    if found["by_sd"] and missed["energy_kwh"] <= SDS * sd:
        missed["energy_kwh"] = 0.0
    return [name.partition("_")[0] for name, by in missed.items() if by != 0.0]
