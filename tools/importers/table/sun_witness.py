"""Compare an irradiance with the elevation of the sun, which shows whether a clock has the right time zone."""

from datetime import UTC, datetime, tzinfo
from typing import Final

import numpy as np

from socast.core.batch import Floats
from socast.core.signals.sun import sine_of_elevation
from socast.tools.importers.table.agreement import Check
from socast.tools.importers.table.zone_offsets import LARGEST, spell_offset

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
