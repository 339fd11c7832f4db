"""Hold what the cleaning made of each drive against the truth.

A ride is right within 3 % of distance and energy and 5 % of duration, beyond what its samples cannot show:

- No sample shows where a drive began before its first sample in motion, and a ride without a name ends with up to
  `STOP` at standstill. The truth is therefore an interval: from first to last sample in motion, to the whole drive with
  that standstill.
- Samples every 60 s do not determine an integral to 3 %. The error of the best simple integral of the true values at
  the times of the samples is added: the trapezoid or the hold of power, and for the distance that of speed, fixes or
  odometer, as far as the faults leave them.
- Energy by the state of charge, or of a logger that samples every `SLOW` or more, is right within `SDS` of its own
  standard uncertainty too. That of a fast logger by voltage and current is then `vague`.
- The ride begins when the drive did, by the logger's clock, with weeks that it lost, or truly. If the clock is days
  wrong, a bit says so.
- Where silence cuts a drive, each part that is fit is held against what the car truly did in its time.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

import numpy as np
import pandas as pd

from socast.core.batch import Floats, Ints
from socast.core.cleaning import clock, quality
from socast.core.settings import Settings
from socast.tools.bench.league.drives import JOULES
from socast.tools.bench.league.loggers import CAUSES, FIRST_LABEL, Fault, Log, find_spoiled

DISTANCE, ENERGY, DURATION = 0.03, 0.03, 0.05
"""Tolerances. [1]"""
LEAST_KWH_KM: Final = 0.05
"""Energy per distance below which the tolerance of energy does not shrink further. [kWh/km]"""
SDS: Final = 3.0
"""Tolerance of energy by the state of charge, or of a slow logger. [own standard uncertainties]"""
SLOW: Final = 10.0
"""Time between samples of a slow logger. [s]"""
STOP: Final = Settings().stop_time
"""Standstill that ends a ride. [s]"""
START: Final = 150.0
"""Tolerance of the time at which a ride begins, beyond two periods. [s]"""
DAYS: Final = 86_400.0
"""Error of a date that must not go without a quality bit. [s]"""
NO_FAULTS: Final = ("ambient_filled", "ambient_assumed")
"""Quality bits that mark no fault of a logger."""
CLOCK_BITS: Final = ("repaired_time", "clock_step")
"""Quality bits that tell of a wrong clock."""
OF_PARTS: Final = " of parts"
"""Ends the reason of a drive that is cut."""
AMOUNTS: Final = ("distance_km", "energy_kwh", "duration_s")
QUALITY: Final = tuple(f"quality_{cause}" for cause in quality.CAUSES)
COLUMNS: Final = (
    *("vehicle_id", "start_s", *AMOUNTS, "energy_sd_kwh", "energy_source", "fit_for_training", "unfit_reason"),
    *("battery_temperature_c", "occupants", *QUALITY),
)
"""Columns of the ride table that are judged."""
RIGHT, REPAIRED, VAGUE, UNFIT, ODD, WRONG = WORDS = ("right", "repaired", "vague", "unfit", "odd", "wrong")
"""What becomes of a drive; `odd` is unfit for a reason that no fault of its car explains."""

Sampling = Callable[[Ints], tuple[float, float]]


@dataclass
class Span:
    """Hold an amount that is right from `low` to `high`."""

    low: float
    high: float

    def widen(self, share: float, more: float, least: float = 0.0) -> None:
        """Widen it by a share of its ends, or of `least` where they are smaller, and by an amount."""
        self.low -= share * max(abs(self.low), least) + more
        self.high += share * max(abs(self.high), least) + more

    def find_miss(self, value: float) -> float:
        """Return how far a value is outside; 0 inside."""
        return 0.0 if self.low <= value <= self.high else max(self.low - value, value - self.high)


Truth = dict[str, Span]
"""Amounts of a drive by their columns, and the time of its first sample in motion as `start_s`."""


@dataclass
class Verdict:
    """Hold what became of a drive.

    Parameters
    ----------
    car, drive : int
        Number of the car, and of the drive in it.
    word, why : str
        One of `WORDS`; the reason of an unfit ride, or what is wrong.
    found : dict
        What the rides of the drive say.
    """

    car: int
    drive: int
    faults: tuple[str, ...]
    word: str
    why: str
    found: dict[str, Any]
    truth: dict[str, tuple[float, float]]


def find_truths(log: Log, faults: Sequence[Fault]) -> list[Truth]:
    """Return the true amounts of each drive of a car, before its clock and its order of arrival are spoiled.

    A drive without two samples in motion has no truth.
    """
    track, step = log.car.track, log.car.period
    spoiled, truths = find_spoiled(faults), list[Truth]()
    for number, (begin, end) in enumerate(track.drives):
        rows = np.flatnonzero(log.drive == number)
        moving = rows[track.at("speed", log.true[rows]) > 1.5]
        named = log.true[log.ride == number]
        if len(moving) < 2 or (log.car.names and len(named) < 2):
            truths.append({})
            continue
        first, last = log.true[moving[0]], log.true[moving[-1]]
        after = log.true[(log.true >= end) & (log.true <= end + STOP + 2.0 * step)]
        late = after[-1] if len(after) else end
        if log.car.names:
            first, last, late = max(first, named[0]), min(last, named[-1]), named[-1]
        inside = np.flatnonzero((log.true >= first) & (log.true <= last))
        distance_error, energy_error = _find_sampling_errors(log, inside, spoiled)
        distance = _span(track, "distance", ((first, last), (begin, end)), 1e-3)
        energies = [(one, other) for one in (begin, first) for other in (last, end, late)]
        energy = _span(track, "energy", energies, 1.0 / JOULES)
        duration = Span(last - first, late - begin + 2.0 * step)
        distance.widen(DISTANCE, distance_error * 1e-3)
        energy.widen(ENERGY, energy_error / JOULES, LEAST_KWH_KM * distance.high)
        duration.widen(DURATION, step)
        truths.append({"distance_km": distance, "energy_kwh": energy, "duration_s": duration})
    return truths


def _span(track: Any, name: str, times: Sequence[tuple[float, float]], unit: float) -> Span:
    """Return the interval of what a sum of the track gains between pairs of times."""
    gains = [float(track.at(name, other) - track.at(name, one)) * unit for one, other in times]
    return Span(min(gains), max(gains))


def _find_sampling_errors(log: Log, rows: Ints, spoiled: set[str]) -> tuple[float, float]:
    """Return the errors of distance [m] and energy [J] that the best simple integral of the true values has."""
    track, time = log.car.track, log.true[rows]
    steps, witnesses = np.diff(time), log.car.sends - spoiled

    def find_error(rate: str, total: str) -> float:
        values, true = track.at(rate, time), float(np.diff(track.at(total, time[[0, -1]]))[0])
        trapezoid, hold = (0.5 * (values[1:] + values[:-1]) * steps).sum(), (values[:-1] * steps).sum()
        return min(abs(float(trapezoid) - true), abs(float(hold) - true))

    errors = [find_error("speed", "distance")] if "speed" in witnesses else []
    if "position" in witnesses:
        fixed = time[~np.isnan(log.columns["latitude_deg"][rows])]
        chords = np.hypot(np.diff(track.at("north", fixed)), np.diff(track.at("east", fixed)))
        errors.append(float(np.diff(track.at("distance", time[[0, -1]]))[0] - chords.sum()))
    if "odometer" in witnesses:
        errors.append(1e3 * log.car.odometer_step)
    return min(errors, default=0.0), find_error("power", "energy")


def find_starts(log: Log) -> list[tuple[float, float]]:
    """Return the true time of the first sample of each drive, and its stamp; NaN without samples."""
    starts, stamps = [], find_stamps(log)
    for number in range(len(log.car.track.drives)):
        rows = np.flatnonzero(log.drive == number)[:1]
        starts.append((float(log.true[rows[0]]), float(stamps[rows[0]])) if len(rows) else (np.nan,) * 2)
    return starts


def judge(
    number: int,
    log: Log,
    truths: Sequence[Truth],
    starts: Sequence[tuple[float, float]],
    faults: Sequence[Fault],
    rides: pd.DataFrame,
) -> list[Verdict]:
    """Return what became of each drive of a car, by its rides in the table."""
    first = np.round(rides["battery_temperature_c"].to_numpy() - FIRST_LABEL)
    last = np.round(rides["occupants"].to_numpy() - 1.0)
    names, out = tuple(each.name for each in faults), list[Verdict]()
    measure_sampling = partial(_find_sampling_errors, log, spoiled=find_spoiled(faults))
    for drive, (truth, start) in enumerate(zip(truths, starts, strict=True)):
        if truth:
            of_drive = (first <= drive) & (drive <= last)
            found = _describe(rides[of_drive], merged=(first != last)[of_drive])
            word, why = _judge_drive(rides[of_drive], found, truth, start, log.car.period, faults)
            sds = SDS if log.car.period >= SLOW or "soc" in found["source"] else 0.0
            of_parts = why.endswith(OF_PARTS) and "start" not in why
            if of_parts and are_right(log, rides[of_drive], measure_sampling, DISTANCE, sds):
                word, why = REPAIRED, ""
            spans = {name: (span.low, span.high) for name, span in truth.items()}
            out.append(Verdict(number, drive, names, word, why, found, spans))
    return out


def _describe(rides: pd.DataFrame, merged: Any) -> dict[str, Any]:
    """Return what the rides of a drive say."""
    fit = rides["fit_for_training"].to_numpy(bool)
    counts = rides[list(QUALITY)].to_numpy().sum(axis=0).tolist()
    return {
        **{name: float(rides[name].sum()) for name in AMOUNTS},
        "start_s": float(rides["start_s"].iloc[0]) if len(rides) else None,
        "energy_sd_kwh": float(np.sqrt((rides["energy_sd_kwh"] ** 2).sum())),
        "source": sorted(set(rides["energy_source"].dropna())),
        "rides": len(rides),
        "merged": bool((merged & fit).any()),
        "unfit": sorted(set(rides["unfit_reason"].dropna())),
        "bits": {n: count for n, count in zip(quality.CAUSES, counts, strict=True) if count and n not in NO_FAULTS},
    }


def _judge_drive(
    rides: pd.DataFrame,
    found: Mapping[str, Any],
    truth: Truth,
    start: tuple[float, float],
    period: float,
    faults: Sequence[Fault],
) -> tuple[str, str]:
    """Return the word and the reason of a drive."""
    fit = rides["fit_for_training"].to_numpy(bool)
    if not fit.any():
        why = str(rides["unfit_reason"].iloc[int(rides["distance_km"].argmax())]) if len(rides) else "no_ride"
        known = any(word in why for each in faults for word in CAUSES[each.family])
        return (UNFIT if known else ODD), why
    if found["merged"]:
        return WRONG, "merged"
    by_sd = period >= SLOW or "soc" in found["source"]
    misses = _find_misses(found, truth)
    if misses and not fit.all():  # what is unfit is not used
        used = {**found, **{name: float(rides.loc[fit, name].sum()) for name in AMOUNTS}}
        misses = min(misses, _find_misses(used, truth), key=len)
    is_vague = misses.get("energy", 0.0) <= SDS * found["energy_sd_kwh"]
    if "energy" in misses and is_vague:
        del misses["energy"]
    if not any(abs(found["start_s"] - each) <= START + 2.0 * period for each in start):
        misses["start"] = found["start_s"] - start[0]
    elif abs(found["start_s"] - start[0]) > DAYS and not any(bit in found["bits"] for bit in CLOCK_BITS):
        misses["date"] = found["start_s"] - start[0]
    if misses:
        return WRONG, "+".join(misses) + (OF_PARTS if len(rides) > 1 else "")
    if is_vague and not by_sd and _find_misses(found, truth):
        return VAGUE, "energy"
    return (REPAIRED if found["bits"] else RIGHT), ""


def _find_misses(found: Mapping[str, Any], truth: Truth) -> dict[str, float]:
    """Return the amounts that miss the truth, and by how much."""
    missed = {name.partition("_")[0]: span.find_miss(found[name]) for name, span in truth.items()}
    return {name: by for name, by in missed.items() if by != 0.0}


def find_stamps(log: Log) -> Floats:
    """Return the stamps of samples, with the weeks that a receiver has lost, (n,). [s]"""
    stamps = log.columns["time_s"]
    return np.where(stamps < clock.FIRST_LOGGER, stamps + clock.ROLLOVER, stamps)


def are_right(log: Log, rides: pd.DataFrame, sampling: Sampling, share: float, sds: float) -> bool:
    """Return whether every ride that is fit is right in its own time.

    Parameters
    ----------
    log : Log
        Samples of the car. The first sample of a ride is that whose stamp is nearest to its beginning.
    sampling : callable
        Function of rows of the log that returns the errors of distance [m] and energy [J] that no cleaning can avoid.
    share, sds : float
        Tolerance of distance and energy, as a share [1] and in standard uncertainties of the energy.
    """
    stamps, track = find_stamps(log), log.car.track
    columns = ["start_s", "duration_s", "distance_km", "energy_kwh", "energy_sd_kwh"]
    for start, duration, km, kwh, sd in rides.loc[rides["fit_for_training"], columns].to_numpy(float).tolist():
        at = int(np.nanargmin(np.abs(stamps - start)))
        if abs(stamps[at] - start) > log.car.period:
            return False
        first = float(log.true[at])
        last = first + duration
        rows = np.flatnonzero((log.true >= first - 0.5 * log.car.period) & (log.true <= last + 0.5 * log.car.period))
        distance_error, energy_error = sampling(rows[np.argsort(log.true[rows])])
        distance = 1e-3 * float(track.at("distance", last) - track.at("distance", first))
        energy = float(track.at("energy", last) - track.at("energy", first)) / JOULES
        energy_slack = max(share * abs(energy) + energy_error / JOULES, sds * sd)
        if abs(km - distance) > share * distance + 1e-3 * distance_error:
            return False
        if abs(kwh - energy) > energy_slack:
            return False
    return True
