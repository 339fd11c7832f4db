"""Read a CSV file of weather stations, and put its observations between the messages of cars."""

import re
from collections.abc import Sequence
from datetime import UTC, datetime, tzinfo
from pathlib import Path
from typing import Final, NamedTuple

import msgspec
import numpy as np

from socast.core.batch import Floats
from socast.core.errors import ImportFileError, read_input
from socast.core.signals.sun import sine_of_elevation
from socast.core.wire.keys import join_chunks
from socast.core.wire.messages import Message, Weather
from socast.tools.importers.drive import make_message
from socast.tools.importers.table.agreement import Check
from socast.tools.importers.table.cells import to_numbers
from socast.tools.importers.table.clock_witness import read_clock
from socast.tools.importers.table.column_map import FileFormat
from socast.tools.importers.table.guess_names import OTHER_TIME, TIME, NamedColumn, guess_name
from socast.tools.importers.table.guess_sources import find_times
from socast.tools.importers.table.guess_time import Blocks, GuessedTime, list_clocks
from socast.tools.importers.table.table_file import TableFile, open_table
from socast.tools.importers.table.text_stream import RowFaults
from socast.tools.importers.table.time_words import LARGEST, spell_offset
from socast.tools.importers.table.units import FIELD_UNITS, OF_WEATHER, find_conversion

SHIFTS: Final = np.arange(-LARGEST, LARGEST + 1.0, 1800.0)
"""Times by which a clock may be wrong. [s]"""
APART: Final = 60.0
"""Time of which one row of a car counts. [s]"""
FEWEST: Final = 60
"""Minutes with an irradiance from which a clock is judged."""
CLOUDS: Final = 0.3
"""Difference from the sun up to which a clock passes: broken clouds make as much. [1]"""
BETTER: Final = 2.0
"""Ratio of the difference from the sun to that of another zone from which the other one is right. [1]"""
_NOON: Final = int(np.argmin(np.abs(SHIFTS)))
BEFORE: Final = 86400.0
"""Time before the first row from which observations are kept, for what rain and snow left on the road. [s]"""
OLDEST: Final = 3 * 3600.0
"""Age up to which an observation is the weather of a row. [s]"""
LEAST_COVERED: Final = 0.9
"""Share of the rows with such an observation."""
LARGEST_FILE: Final = 1 << 28
"""Largest file of weather. [B]"""
HOT: Final = 48.0
"""Median temperature above which degrees are Fahrenheit. [degC]"""
_TEMPERATURE: Final = "ambient_c"
_BARE: Final = re.compile(
    r"(air[ _]?)?(temp|temperature)([ _]?(2m|air|c|f|degc|degf))?|tmp[cf]|lufttemperatur", re.IGNORECASE
)
"""Names of a temperature that mean the outside air in a file of weather."""
_UNITS: Final = {"tmpf": "degF", "sknt": "knot", "p01i": "inch", "temp_f": "degF"}
"""Name of a column -> unit that it means."""
_PLACES: Final = ("latitude_deg", "longitude_deg")


class SunWitness:
    """Measure how far an irradiance is from one proportional to the sine of the sun's elevation, for each shift.

    Parameters
    ----------
    what : str
        What has the irradiance, such as the name of a file; empty for the rows.
    """

    def __init__(self, what: str = "") -> None:
        self.what = what
        self.count = 0
        self._newest = 0.0
        self._square = 0.0
        self._of_sun, self._of_both = np.zeros(len(SHIFTS)), np.zeros(len(SHIFTS))

    def add_rows(self, rows: np.ndarray) -> None:
        """Add the rows of cars."""
        if not {"solar_w_m2", "latitude_deg", "longitude_deg"} <= set(rows.dtype.names or ()):
            return
        _, first = np.unique(rows["vehicle"] * 1e9 + rows["time"] // APART, return_index=True)
        few = rows[first]
        self.add(few["time"], few["latitude_deg"], few["longitude_deg"], few["solar_w_m2"])

    def add(self, times: Floats, latitudes: Floats, longitudes: Floats, irradiance: Floats) -> None:
        """Add measurements.

        Units: times [Unix s], latitudes [deg], longitudes [deg], irradiance [W/m^2].
        """
        known = np.isfinite(times) & np.isfinite(latitudes) & np.isfinite(longitudes) & np.isfinite(irradiance)
        if not known.any():
            return
        shifted = times[known] + SHIFTS[:, None]
        places = [np.broadcast_to(np.radians(each[known]), shifted.shape) for each in (latitudes, longitudes)]
        sun = np.maximum(sine_of_elevation(shifted, *places), 0.0)
        self.count += int(known.sum())
        self._newest = float(times[known][-1])
        self._square += float(irradiance[known] @ irradiance[known])
        self._of_sun += (sun**2).sum(axis=1)
        self._of_both += sun @ irradiance[known]

    def compute_differences(self) -> Floats:
        """Return the root mean square difference from the sun for each shift, over that of the irradiance. [1]"""
        scale = np.where(self._of_sun > 0.0, self._of_sun, np.inf) * self._square
        found: Floats = np.sqrt(np.maximum(0.0, 1.0 - self._of_both**2 / scale))
        return found

    def check(self, zone: tzinfo) -> Check | None:
        """Return the check of the clock; None where no irradiance is known.

        Parameters
        ----------
        zone : tzinfo
            Time zone with which local times were read.
        """
        if not self.count:
            return None
        name = f"irradiance{' of ' if self.what else ''}{self.what} against sun"
        limit = f"at most {CLOUDS:.0%}, or {BETTER:g} times that with another zone"
        if self.count < FEWEST or self._square <= 0.0:
            return Check(name, f"less than {FEWEST} measurements of an irradiance above 0", limit, None)
        differences = self.compute_differences()
        now, best = float(differences[_NOON]), int(np.argmin(differences))
        found = f"{now:.0%} off the elevation of the sun"
        if now <= max(CLOUDS, BETTER * float(differences[best])):
            return Check(name, found, limit, True)
        shift = float(SHIFTS[best])
        found += (
            f", and {differences[best]:.0%} with times {abs(shift) / 3600:g} h {'later' if shift > 0 else 'earlier'}"
        )
        offset = datetime.fromtimestamp(self._newest, UTC).astimezone(zone).utcoffset()
        right = (offset.total_seconds() if offset else 0.0) - shift
        words = f"set zone = '{spell_offset(right)}' in [time]" if abs(right) <= LARGEST else "correct the clock"
        remedy = "state the offset of its times, such as 2024-05-01T08:00+08:00" if self.what else words
        return Check(name, found, limit, False, f"{remedy}, unless the irradiance has another clock")


class WeatherFile(NamedTuple):
    """Hold the observations of a file in the order of time.

    Parameters
    ----------
    has_place : bool
        Whether the file states where its stations are; otherwise latitude and longitude are 0.
    columns : tuple of (str, str, str)
        Field, column and unit of what was read.
    is_utc_assumed : bool
        Whether times have no offset, so that they were read as UTC.
    """

    path: Path
    observations: list[Weather]
    has_place: bool
    columns: tuple[tuple[str, str, str], ...]
    is_utc_assumed: bool
    sun: SunWitness


def read_weather_file(path: Path) -> WeatherFile:
    """Read a file of weather by the names of its columns."""
    above, stated = _read_head(path)
    table = open_table(path, "csv", FileFormat(skip_lines=above))
    blocks = [(table, block) for block in table.iterate_blocks(table.names, RowFaults())]
    if not blocks:
        raise ImportFileError(f"{path}: has a header and no rows; name another file")
    chosen = _choose_columns(table)
    if not set(chosen) - set(_PLACES):
        raise ImportFileError(
            f"{path}: no column looks like weather; it has {', '.join(table.names[:12])}; name columns as the contract "
            f"does: temperature_c, {', '.join(OF_WEATHER)}"
        )
    clock = _find_clock(table, blocks)
    times = read_clock(clock.to_source(), blocks) - stated.get("utc_offset_seconds", 0.0)
    values = {field: _read(each, field, blocks) for field, each in chosen.items()}
    has_place = all(name in values or name.removesuffix("_deg") in stated for name in _PLACES)
    for name in _PLACES:
        values.setdefault(
            name, np.full(len(times), stated.get(name.removesuffix("_deg"), np.nan if has_place else 0.0))
        )
    sun = SunWitness(path.name)
    if has_place and "solar_w_m2" in values:
        sun.add(times, values["latitude_deg"], values["longitude_deg"], values["solar_w_m2"])
    observations = _list_observations(times, _name_stations(table, blocks), values)
    if not observations:
        raise ImportFileError(f"{path}: none of its {len(times):,} rows has a time, a place and a value; correct them")
    listed = tuple((field, each.name, each.unit or FIELD_UNITS[field]) for field, each in chosen.items())
    is_assumed = not clock.has_zone and "utc_offset_seconds" not in stated
    return WeatherFile(path, observations, has_place, listed, is_assumed, sun)


def _read_head(path: Path) -> tuple[int, dict[str, float]]:
    """Return the number of lines above the header, and what Open-Meteo states there: place and offset from UTC."""
    lines = read_input(path, LARGEST_FILE)[:4096].decode("utf-8", "replace").splitlines()
    if len(lines) < 4 or not lines[0].lower().startswith("latitude,") or lines[2].strip(" ,"):
        return 0, {}
    stated = {}
    for name, cell in zip(lines[0].lower().split(","), lines[1].split(","), strict=False):
        if re.fullmatch(r"-?\d+(\.\d+)?", cell.strip()):
            stated[name.strip()] = float(cell)
    return 3, stated


def _choose_columns(table: TableFile) -> dict[str, NamedColumn]:
    """Return the first column of each field by its name."""
    chosen: dict[str, NamedColumn] = {}
    units = dict(zip(table.names, table.units, strict=False))
    for name in table.names:
        bare = re.sub(r"\s*[\[(].*", "", name).strip()
        bracketed = re.search(r"[\[(]([^\])]+)", name)
        given = units.get(name) or (bracketed[1] if bracketed else None)
        found = guess_name(re.sub(r"_\d+c?m$", "", bare), given)
        if _BARE.fullmatch(bare):
            unit = given or ("degF" if bare.lower().endswith("f") else None)
            found = NamedColumn(name, _TEMPERATURE, unit)
        if found is not None and found.role in {_TEMPERATURE, *_PLACES, *OF_WEATHER}:
            chosen.setdefault(found.role, NamedColumn(name, found.role, found.unit or _UNITS.get(bare.lower())))
    return chosen


def _find_clock(table: TableFile, blocks: Blocks) -> GuessedTime:
    """Return the first clock of a file that states dates."""
    named = [each for name in table.names if (each := guess_name(name)) and each.role in {TIME, OTHER_TIME}]
    by_cells = [each for each in find_times(table.names, blocks) if each.name not in {one.name for one in named}]
    candidates = [*named, *by_cells]
    clocks = [clock for clock in (list_clocks(candidates, blocks) if candidates else []) if clock.is_absolute]
    if not clocks:
        raise ImportFileError(
            f"{table.path}: no column holds dates with times; it has {', '.join(table.names[:12])}; add a column "
            "'time' such as 2024-05-01T08:00Z"
        )
    return clocks[0]


def _read(column: NamedColumn, field: str, blocks: Blocks) -> Floats:
    """Return the values of a column in the unit of the contract, NaN where unknown."""
    parts = [to_numbers(block[column.name], table.decimal)[0] for table, block in blocks]
    values = np.concatenate(parts)
    unit = column.unit
    if unit is None and field == _TEMPERATURE and float(np.nanmedian(values)) > HOT:
        unit = "degF"
    return find_conversion(unit or FIELD_UNITS[field], field).apply(values)


def _name_stations(table: TableFile, blocks: Blocks) -> list[str]:
    """Return the station of each row."""
    column = next(
        (name for name in table.names if re.fullmatch(r"station([ _]?(id|name))?", name, re.IGNORECASE)), None
    )
    names: list[str] = []
    for _, block in blocks:
        count = len(next(iter(block.values())))
        cells = block[column].to_pylist() if column else [table.stem] * count
        names += [join_chunks(str(cell or table.stem)) for cell in cells]
    return names


def _list_observations(times: Floats, stations: Sequence[str], values: dict[str, Floats]) -> list[Weather]:
    """Return the observations with a time, a place and a value, in the order of time."""
    of_air = {name.replace(_TEMPERATURE, "temperature_c"): each for name, each in values.items() if name not in _PLACES}
    known = np.isfinite(times) & np.logical_or.reduce([np.isfinite(each) for each in of_air.values()])
    known &= np.isfinite(values["latitude_deg"]) & np.isfinite(values["longitude_deg"])
    rows = np.flatnonzero(known)
    return [
        Weather(
            stations[at],
            round(float(times[at]), 3),
            *(float(values[name][at]) for name in _PLACES),
            **{name: round(float(each[at]), 3) for name, each in of_air.items() if np.isfinite(each[at])},
        )
        for at in rows[np.argsort(times[rows], kind="stable")].tolist()
    ]


class StationMessages:
    """Put the observations of a file between the messages of cars, and measure how many rows they cover."""

    def __init__(self, file: WeatherFile) -> None:
        self.file = file
        self.put = 0
        self.rows = self.covered = 0
        self._next = 0
        self._times = np.array([each.time_s for each in file.observations])
        self._place: tuple[float, float] | None = None

    def merge(self, rows: np.ndarray, messages: list[Message]) -> list[Message]:
        """Return the messages of rows with the observations up to the last of them."""
        if not len(rows):
            return messages
        if self._place is None:
            self._place = _find_place(rows)
            self._next = int(np.searchsorted(self._times, rows["time"][0] - BEFORE))
        before = np.searchsorted(self._times, rows["time"], "right") - 1
        self.rows += len(rows)
        self.covered += int(np.sum((before >= 0) & (rows["time"] - self._times[before] <= OLDEST)))
        end = max(self._next, int(np.searchsorted(self._times, rows["time"][-1], "right")))
        due = [self._place_at(each) for each in self.file.observations[self._next : end]]
        self._next, self.put = end, self.put + len(due)
        made = [make_message(f"weather/{each.station_id}", each) for each in due]
        return sorted([*made, *messages], key=lambda message: message.receipt_ns)

    def _place_at(self, observation: Weather) -> Weather:
        """Return an observation of a file without places where the cars drive."""
        if self.file.has_place or self._place is None:
            return observation
        return msgspec.structs.replace(observation, latitude_deg=self._place[0], longitude_deg=self._place[1])

    def describe(self) -> str:
        """Return what was read, for the summary."""
        columns = ", ".join(
            f"'{name}'" if unit in name else f"'{name}' in {unit}"
            for field, name, unit in self.file.columns
            if field not in _PLACES
        )
        place = "" if self.file.has_place else "; its place is not stated: it is placed at the first rows"
        zone = "; times without offset are read as UTC" if self.file.is_utc_assumed else ""
        return f"weather of {self.file.path.name}: {self.put:,} observations ({columns}){place}{zone}"

    def check(self) -> Check:
        """Return the check that the observations cover the rows."""
        limit = f"{LEAST_COVERED:.0%} of the rows with an observation at most {OLDEST / 3600:g} h old"
        share = self.covered / max(self.rows, 1)
        days = [f"{datetime.fromtimestamp(float(each), UTC):%Y-%m-%d %H:%M}" for each in self._times[[0, -1]]]
        found = f"{share:.0%}, observations from {days[0]} to {days[1]} UTC"
        remedy = "" if share >= LEAST_COVERED else "give the weather of these days, or correct the times of one of them"
        return Check("weather against rows", found, limit, share >= LEAST_COVERED, remedy)


def _find_place(rows: np.ndarray) -> tuple[float, float]:
    """Return the median position of rows, 0 and 0 where they have none. [deg]"""
    place = [0.0, 0.0]
    if set(_PLACES) <= set(rows.dtype.names or ()):
        known = np.isfinite(rows["latitude_deg"]) & np.isfinite(rows["longitude_deg"])
        if known.any():
            place = [float(np.median(rows[name][known])) for name in _PLACES]
    return place[0], place[1]
