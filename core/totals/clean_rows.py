"""Rows between cleaning and totals: samples with their weather and car, and what each adds to the totals."""

from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from socast.core.batch import Floats, Ints
from socast.core.cleaning.clean_columns import Clean
from socast.core.cleaning.quality import Quality
from socast.core.signals.signals import Signals
from socast.core.signals.weather import Sky
from socast.core.totals.accumulator import AMOUNTS, NO_ENDS

WITNESSES: Final = (
    *("mistimed", "unseen", "disputed", "stale_fall"),
    *("path", "path_run", "straight", "straight_run", "ticked", "ticked_run", "slow", "slow_run"),
)
"""Columns of a row that are summed as they are, to tell whether a ride is right."""
PowerOfEffect = tuple[str, Callable[[Signals], Floats]]
"""Whether an effect acts over `distance` or over `time`, and its power per unit of its coefficient. [W]"""


class CleanRows(NamedTuple):
    """Cleaned samples with everything that their signals depend on.

    Parameters
    ----------
    kind : (n,) int
        Kind of car of each row.
    place : (n,) int, optional
        Place of each row among the messages of the batch; its number without it.
    ends : (ends,) RIDE_END
        Rides that ended between two rows. Without them, such a ride is closed at the next row of its car.
    """

    clean: Clean
    sky: Sky
    kind: Ints
    place: Ints | None = None
    ends: NDArray[np.void] = NO_ENDS

    @property
    def size(self) -> int:
        """Number of rows."""
        return len(self.kind)

    def rows(self, start: int, stop: int) -> "CleanRows":
        """Return a view of the rows from `start` up to, not including, `stop`, with the ends after each of them."""
        part = slice(start, stop)
        clean = Clean(*(column[part] for column in self.clean))  # type: ignore[arg-type]
        sky = Sky(*(column[part] for column in self.sky))
        first = start if start > 0 else -1
        ends = self.ends[(self.ends["row"] > first) & (self.ends["row"] <= stop)].copy()
        ends["row"] -= start
        return CleanRows(clean, sky, self.kind[part], None if self.place is None else self.place[part], ends)


def compute_amounts(signals: Signals, powers: Sequence[tuple[str, Floats]]) -> Floats:
    """Return what each row adds to the totals.

    Parameters
    ----------
    powers : sequence of (per, (n,) float)
        Power of each effect per unit of its coefficient [W], which acts over distance or over time.
    """
    clean, sky = signals.clean, signals.sky
    dt = clean.dt
    table = np.zeros((len(AMOUNTS) + len(powers), len(dt)))
    row = dict(zip(AMOUNTS, table, strict=False))
    row["samples"][:] = 1.0
    row["duration"][:], row["distance"][:], row["stops"][:] = dt, clean.distance, clean.stop
    np.multiply(clean.stopped, dt, out=row["standing"])
    for name in WITNESSES:
        row[name][:] = getattr(clean, name)
    row["energy"][:], row["metered"][:], row["energy_variance"][:] = clean.energy, clean.metered, clean.energy_variance
    for climb, gained, lost in ((clean.climb, "gained", "lost"), (clean.causal_climb, "gained_causal", "lost_causal")):
        np.maximum(climb, 0.0, out=row[gained])
        np.maximum(-climb, 0.0, out=row[lost])
    unresolved = signals["braking_force"] - np.maximum(-signals["traction"], 0.0)
    np.multiply(unresolved * clean.speed, clean.travel, out=row["unresolved_braking"])
    np.multiply(signals["ambient"], dt, out=row["ambient"])
    np.multiply(signals["precipitation"], dt, out=row["precipitation"])
    for name, known in (("wind_known", sky.wind_speed), ("hvac_known", clean.hvac)):
        np.copyto(row[name], dt, where=~np.isnan(known))
    for name, value in (
        ("wind", sky.wind_speed),
        ("wind_north", sky.wind_north),
        ("wind_east", sky.wind_east),
        ("hvac", clean.hvac),
    ):
        np.multiply(value, dt, out=row[name], where=~np.isnan(value))
    for name, causes, counted in (
        ("speed_rejected", Quality.SPEED_REJECTED, dt),
        ("speed_missing", Quality.SPEED_MISSING, dt),
        ("bridged", Quality.BRIDGED, clean.distance),
        ("soc_faults", Quality.SOC_JUMP | Quality.SOC_FROZEN | Quality.SOC_STALE, 1.0),
    ):
        np.copyto(row[name], counted, where=(clean.quality & causes) != 0)
    for row_of_effect, (per, power) in zip(table[len(AMOUNTS) :], powers, strict=True):
        np.multiply(power, clean.travel if per == "distance" else dt, out=row_of_effect)
    return table
