"""Check the clock of a table: its unit, its rate, and files that lie on top of each other or are older than rows."""

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

import numpy as np

from socast.core.batch import Floats
from socast.core.errors import ImportFileError
from socast.tools.importers.table.agreement import SUN, Check, check_agreement
from socast.tools.importers.table.agreement_sums import LONGEST_STEP, MOVING, CarSums, measure_fixes
from socast.tools.importers.table.clock_witness import DAY, EARLIEST, ROLLOVER_WEEKS
from socast.tools.importers.table.column_map import ColumnMap
from socast.tools.importers.table.row_order import Overlap
from socast.tools.importers.table.row_reader import SECONDS_PER_WEEK, RowReader
from socast.tools.importers.table.table_file import TableFile
from socast.tools.importers.table.time_words import FIRST_EPOCH, GUESSED_ORIGIN, TIME_UNITS, find_time_unit
from socast.tools.importers.table.units import POWER

SHORTEST_PERIOD: Final = 0.005
"""Mean time between two rows below which a clock is wrong: loggers of drives write at most 100 rows in a second. [s]"""
FEWEST_ROWS: Final = 100
"""Rows from which a clock is judged."""
STEADY: Final = 0.9
"""Share of the steps of a count that are larger than 0. [1]"""
CLOCK_RATE: Final = "clock against rows"
"""Name of the check that the times of rows are far enough apart."""
UNITS: Final = ("ns", "us", "ms", "s", "min", "h", "d")
"""Units that are told from each other by far."""
TICKS: Final = ("0.1 s", "10 ms")
"""Units that are told only by a distance in known units."""
LEAST_DISTANCE: Final = 300.0
"""Distance from which the unit of a clock is judged. [m]"""
LEAST_GROWTHS: Final = 3
"""Changes of an odometer from which a distance is known."""
NEAR_TICK: Final = 0.1
"""Largest logarithm of the ratio of the distance in ticks to the right one."""
FAR: Final = 2.5
"""Logarithm of a ratio of distances from which the unit in a name is doubted."""
USUAL_ACCELERATION: Final = 2.0
"""Acceleration that one of 100 steps of a drive has, about. [m/s^2]"""
LEAST_STEPS: Final = 20
"""Changes of speed from which accelerations are judged."""
LONGEST_GAP: Final = 20.0
"""Longest step over which speed is integrated, in usual steps."""
USUAL_PERIODS: Final = (0.005, 120.0)
"""Times between two rows of a logger. [s]"""
CLOCK_TOLERANCE: Final = 300.0
"""Time by which a row may be later than the last change of its file. [s]"""
MOST_FILES: Final = 6
"""Number of files that a check names."""
UNIT: Final = "unit of the clock"
OVERLAP: Final = "times of rows"
"""Name of the check that no time is covered twice."""
_SPANS: Final = (
    (730.0 * 86400.0, 365.25 * 86400.0, "years"),
    (2.0 * 86400.0, 86400.0, "days"),
    (7200.0, 3600.0, "h"),
    (120.0, 60.0, "min"),
)
"""Time from which a unit is used, the unit, and its name. [s]"""


class ClockRate:
    """Sum the time that rows cover, without gaps, for each car."""

    def __init__(self) -> None:
        self.rows: dict[int, int] = {}
        self.powered: dict[int, int] = {}
        self.covered: dict[int, float] = {}

    def add(self, rows: np.ndarray) -> None:
        """Add rows of one block of a file."""
        for vehicle in np.unique(rows["vehicle"]).tolist():
            of_car = rows[rows["vehicle"] == vehicle]
            times, known = of_car["time"], np.zeros(len(of_car), bool)
            for name in {"battery_current_a", POWER} & set(rows.dtype.names or ()):
                known |= np.isfinite(of_car[name])
            self.powered[vehicle] = self.powered.get(vehicle, 0) + int(known.sum())
            self.rows[vehicle] = self.rows.get(vehicle, 0) + len(times)
            self.covered[vehicle] = self.covered.get(vehicle, 0.0) + sum_close_steps(times)

    def find_power_step(self, vehicle: int) -> float:
        """Return the mean time between two rows of a car with a power, infinite without one. [s]"""
        count = self.powered.get(vehicle, 0)
        return self.covered[vehicle] / count if count else np.inf

    def find_fault(self, vehicles: Mapping[int, str] | list[str], column: str) -> Check | None:
        """Return a failed check of the first car whose rows follow each other too fast, None where there is none."""
        for vehicle, count in self.rows.items():
            covered = self.covered[vehicle]
            if count >= FEWEST_ROWS and covered < SHORTEST_PERIOD * count:
                return Check(
                    CLOCK_RATE,
                    f"{count:,} rows of {vehicles[vehicle]} cover {describe_rate(count, covered)}",
                    f"at least {SHORTEST_PERIOD * 1e3:g} ms between rows",
                    False,
                    f"the times in column '{column}' are wrong: name another column in [time]; where that counts from "
                    f"0, give its unit and origin_column = '{column}'",
                )
        return None


def describe_rate(rows: int, covered: float) -> str:
    """Return how much time rows cover, and how far apart they are on average.

    Units: covered [s].

    Examples
    --------
    >>> describe_rate(30384, 76.0)
    '76 s without gaps, 2.5 ms a row'
    """
    return f"{covered:.3g} s without gaps, {covered / rows * 1e3:.2g} ms a row"


def is_too_fast(times: Floats) -> bool:
    """Return whether rows follow each other faster than any logger writes them.

    Parameters
    ----------
    times : (n,) float
        Times of the rows of a file, in its order, NaN where unknown. [s]
    """
    known = times[np.isfinite(times)]
    return len(known) >= FEWEST_ROWS and sum_close_steps(known) < SHORTEST_PERIOD * len(known)


def is_steady(times: Floats) -> bool:
    """Return whether nearly every row is later than the row before it."""
    known = times[np.isfinite(times)]
    return len(known) > 1 and bool(np.mean(np.diff(known) > 0.0) > STEADY)


def sum_close_steps(times: Floats) -> float:
    """Return the time between rows that lie close together. [s]"""
    steps = np.diff(np.sort(times))
    return float(steps[steps <= LONGEST_STEP].sum())


def judge_unit(parts: Sequence[np.ndarray], named: str | None, units: Mapping[str, str | None]) -> tuple[str, str]:
    """Return the unit of times that count from a start, and why.

    Parameters
    ----------
    units : mapping of str to str or None
        Unit of each field, None where it is not known and the values are as they stand in the file.
    """
    ratio, witness = find_ratio(parts)
    if ratio is not None:
        exact = named is None and all(units.get(field) is not None for field in ("speed_kmh", "odometer_km"))
        unit = find_nearest(ratio, [*UNITS, *TICKS] if exact else UNITS)
        distance = f"distance by speed agrees with {'the odometer' if witness == 'odometer' else 'positions'} in {unit}"
        if named is None or named == unit:
            return unit, distance
        if abs(np.log(ratio / (find_time_unit(named) or 1.0))) > FAR:
            return unit, f"{distance}, not in {named} as the name says; check it"
        return named, f"unit in the name: {named}"
    if (acceleration := _find_acceleration(parts)) is not None:
        unit = find_nearest(acceleration / USUAL_ACCELERATION, UNITS)
        named_acceleration = acceleration / (find_time_unit(named) or 1.0) if named else 0.0
        if named is None or not 0.02 < named_acceleration < 50.0:
            shown = f"in {unit} a car accelerates as speed does here"
            return unit, shown if named is None else f"{shown}, not in {named} as the name says; check it"
    if named is not None:
        return named, f"unit in the name: {named}"
    period = _find_period(parts)
    least, most = USUAL_PERIODS
    unit = next((each for each in ("s", "ms", "us", "ns") if least <= period * TIME_UNITS[each] <= most), "s")
    return unit, f"{unit} by the usual step of {period:.4g}; check it"


def find_ratio(parts: Sequence[np.ndarray]) -> tuple[float | None, str]:
    """Return distance by odometer or fixes over the integral of speed by the numbers of a clock, and the witness."""
    for field, measure in (("odometer", _measure_odometer), ("fixes", _measure_fixes)):
        sums = np.zeros(2)
        for rows in parts:
            for car in _divide(rows):
                sums += measure(car)
        if sums[0] > LEAST_DISTANCE and sums[1] > 0.0:
            return float(sums[0] / sums[1]), field
    return None, ""


def _divide(rows: np.ndarray) -> list[np.ndarray]:
    """Return the rows of each car in the order of time."""
    cars = [rows[rows["vehicle"] == each] for each in np.unique(rows["vehicle"])]
    return [car[np.argsort(car["time"], kind="stable")] for car in cars]


def _take(rows: np.ndarray, field: str) -> tuple[Floats, Floats]:
    """Return times and values where a field is known."""
    if field not in (rows.dtype.names or ()):
        return np.zeros(0), np.zeros(0)
    known = np.isfinite(rows[field]) & np.isfinite(rows["time"])
    return rows["time"][known], rows[field][known]


def _integrate_speed(rows: np.ndarray) -> tuple[Floats, Floats]:
    """Return times, and the integral of speed up to each of them; gaps add nothing."""
    time, speed = _take(rows, "speed_kmh")
    step = np.diff(time)
    usual = float(np.median(step[step > 0])) if np.any(step > 0) else 0.0
    added = np.where(step <= LONGEST_GAP * usual, step * (speed[1:] + speed[:-1]) / 7.2, 0.0)
    return time, np.concatenate(([0.0], np.cumsum(added))) if len(time) else np.zeros(0)


def _measure_odometer(rows: np.ndarray) -> Floats:
    """Return the distance by odometer, and the integral of speed beside it."""
    time, integral = _integrate_speed(rows)
    at, odometer = _take(rows, "odometer_km")
    growth = np.diff(odometer)
    if len(time) < 2 or np.sum(growth > 0) < LEAST_GROWTHS or np.any(growth < -1.0):
        return np.zeros(2)
    first, last = (float(np.interp(at[end], time, integral)) for end in (0, -1))
    return np.array([(odometer[-1] - odometer[0]) * 1000.0, last - first])


def _measure_fixes(rows: np.ndarray) -> Floats:
    """Return the distance by fixes while the car moves, and the integral of speed beside it."""
    time, integral = _integrate_speed(rows)
    speed = _take(rows, "speed_kmh")[1] / 3.6
    at, latitude = _take(rows, "latitude_deg")
    longitude = _take(rows, "longitude_deg")[1]
    if len(time) < 2 or len(at) < 2 or len(longitude) != len(latitude):
        return np.zeros(2)
    distance = measure_fixes(latitude, longitude)
    moves = (np.interp(at[1:], time, speed) > MOVING) & (distance < 5000.0)
    beside = np.diff(np.interp(at, time, integral))
    return np.array([distance[moves].sum(), beside[moves].sum()])


def _find_acceleration(parts: Sequence[np.ndarray]) -> float | None:
    """Return the acceleration per number of the clock that one of 100 steps has, None where speed hardly changes."""
    found = []
    for rows in parts:
        for car in _divide(rows):
            time, speed = _take(car, "speed_kmh")
            step, change = np.diff(time), np.abs(np.diff(speed)) / 3.6
            changes = (step > 0) & (change > 0)
            found.append(change[changes] / step[changes])
    values = np.concatenate(found) if found else np.zeros(0)
    return float(np.percentile(values, 95)) if len(values) >= LEAST_STEPS else None


def _find_period(parts: Sequence[np.ndarray]) -> float:
    """Return the usual step of the clock."""
    steps = np.concatenate([np.diff(np.unique(car["time"])) for rows in parts for car in _divide(rows)] or [np.ones(1)])
    return float(np.median(steps)) if len(steps) else 1.0


def find_nearest(ratio: float, units: Sequence[str] = UNITS) -> str:
    """Return the unit that is nearest to a number of seconds; one of `TICKS` only where it fits exactly."""
    seconds = {unit: find_time_unit(unit) or 1.0 for unit in units}
    exact = [unit for unit in TICKS if unit in seconds and abs(np.log(ratio / seconds[unit])) < NEAR_TICK]
    return exact[0] if exact else min(UNITS, key=lambda unit: abs(np.log(ratio / seconds[unit])))


def refuse_overlap(reader: RowReader, columns: ColumnMap) -> None:
    """Refuse files whose clocks all start at one origin, and which cover the same time of one car."""
    overlap = reader.spans.find_overlap()
    if overlap is None or len(overlap.files) < 2 or not columns.time.is_relative:
        return
    raise ImportFileError(
        f"{_describe_overlap(overlap, reader)}, because their clocks all start at one origin; where their names hold "
        'the start, give [time] of the map origin_from_file_name = "ride_%Y-%m-%d_%H%M%S", else --sequence H invents '
        "dates"
    )


class ClockUnit:
    """Measure, by the first rows, whether the distance by speed has the size of that by odometer or positions."""

    def __init__(self, columns: ColumnMap) -> None:
        self._unit = columns.time.unit_s
        self._found: tuple[float | None, str] | None = None if columns.time.unit_s else (None, "")

    def add(self, rows: np.ndarray) -> None:
        """Add rows in the order of time; only the first ones count."""
        if self._found is None:
            self._found = find_ratio([rows])

    def check(self) -> Check | None:
        """Return the check of the unit, None where nothing shows it to be wrong."""
        ratio, witness = self._found or (None, "")
        if ratio is None or self._unit is None or abs(np.log(ratio)) < FAR:
            return None
        unit = find_nearest(ratio * self._unit)
        if abs(np.log(ratio * self._unit / (find_time_unit(unit) or 1.0))) > FAR:
            return None
        what = "the odometer" if witness == "odometer" else "positions"
        found = f"distance by speed is {1.0 / ratio:.3g} times that by {what}"
        return Check(
            UNIT, found, "as large", False, f"the clock probably counts in {unit}: set unit = '{unit}' in [time]"
        )


def list_checks(
    tables: Sequence[TableFile],
    columns: ColumnMap,
    reader: RowReader,
    cars: list[CarSums],
    span: tuple[float, float],
    faults: Sequence[Check | None] = (),
) -> list[Check]:
    """Return all checks of an import; where times are covered twice, others that need their order are not judged.

    Units: span [Unix s].

    Parameters
    ----------
    faults : sequence of Check
        What is wrong with the clock, the worst first; None where nothing is. Checks that need times are not judged.
    """
    is_assumed = reader.has_local_times and str(columns.time.zone) == "UTC"
    checks = check_agreement(cars, is_zone_assumed=is_assumed)
    if found := [fault for fault in faults if fault is not None]:
        why = "the unit of the clock is wrong" if found[0].name == UNIT else "the clock is wrong"
        checks = [found[0], *(_suspend(check, why) if check.passed is False else check for check in checks)]
    overlap = reader.spans.find_overlap()
    if overlap is not None:
        why = "times are covered twice"
        checks = [_suspend(check, why) if check.passed is False and check.name != SUN else check for check in checks]
        checks.insert(0, _check_overlap(overlap, reader))
    weeks = _check_weeks(tables, columns, span)
    return [*checks, *([weeks] if weeks else []), _check_clock(tables, columns, span[1])]


def describe_span(seconds: float) -> str:
    """Return a time in the largest unit in which it is at least two.

    Examples
    --------
    >>> describe_span(90.0), describe_span(9000.0), describe_span(500_000.0), describe_span(84e6)
    ('90 s', '2.5 h', '5.79 days', '2.66 years')
    """
    for least, unit, name in _SPANS:
        if seconds >= least:
            return f"{seconds / unit:.3g} {name}"
    return f"{seconds:.3g} s"


def _describe_overlap(overlap: Overlap, reader: RowReader) -> str:
    """Return what is covered twice, and where it begins."""
    span, car = describe_span(overlap.duration), reader.vehicles[overlap.vehicle]
    what = (
        f"{len(overlap.files)} files cover the same {span} of {car}: {_name_files(overlap.files)}"
        if len(overlap.files) > 1
        else f"one file covers {span} of {car} twice"
    )
    return f"{what}, first at {datetime.fromtimestamp(overlap.start, UTC):%Y-%m-%d %H:%M:%S} UTC"


def _name_files(files: Sequence[str]) -> str:
    """Return the first names of files, and how many follow."""
    more = f" and {len(files) - MOST_FILES} more" if len(files) > MOST_FILES else ""
    return f"{', '.join(Path(file).name for file in files[:MOST_FILES])}{more}"


def _check_overlap(overlap: Overlap, reader: RowReader) -> Check:
    """Return the check that no time is covered twice, which has failed."""
    if len(overlap.files) > 1:
        remedy = "leave out files that are given twice, or give each car a name of its own in [vehicle]"
    else:
        remedy = "its clock steps back: set zone in [time] where it is local time, or divide the file"
    return Check(OVERLAP, _describe_overlap(overlap, reader), "each time once", False, remedy)


def _suspend(check: Check, why: str) -> Check:
    """Return a check that is not judged, because of what is wrong with the times of the rows."""
    return check._replace(passed=None, found=f"{check.found}, not judged while {why}", remedy="")


def _check_weeks(tables: Sequence[TableFile], columns: ColumnMap, span: tuple[float, float]) -> Check | None:
    """Return a failed check where rows are so early that a count of GPS weeks may have started again, else None."""
    first, last = span
    moved = last + ROLLOVER_WEEKS * SECONDS_PER_WEEK
    if (
        columns.time.is_relative
        or last >= EARLIEST
        or moved > max(table.path.stat().st_mtime for table in tables) + DAY
    ):
        return None
    days = [f"{datetime.fromtimestamp(each, UTC):%Y-%m-%d}" for each in (first, last, moved)]
    remedy = f"if GPS weeks started again, it was {days[2]}: set add_weeks = {ROLLOVER_WEEKS} in [time]"
    return Check("clock against GPS weeks", f"rows from {days[0]} to {days[1]}", "from 2010 on", False, remedy)


def _check_clock(tables: Sequence[TableFile], columns: ColumnMap, last: float) -> Check:
    """Check that no row is later than the last change of the files, which a wrong zone or unit makes."""
    limit = f"at most {CLOCK_TOLERANCE:g} s after the files were written"
    name = "clock against file"
    if columns.time.is_relative and columns.time.origin == FIRST_EPOCH:
        return Check(name, f"the origin {GUESSED_ORIGIN[:10]} is a guess; correct it in [time]", limit, None)
    changed = max(table.path.stat().st_mtime for table in tables)
    late = last - changed
    found = f"last row {describe_span(abs(late))} {'after' if late > 0 else 'before'} the files were written"
    if late <= CLOCK_TOLERANCE:
        return Check(name, found, limit, True)
    return Check(name, found, limit, False, "set zone or unit in [time]")
