"""Rows between cleaning and totals: samples with their weather and car, and the sums that they add to."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from core.batch import Floats, Ints
from core.cleaning.kernel import Clean
from core.signals.signals import Signals
from core.signals.weather import Sky
from core.totals.accumulator import Accumulator, Sums, amounts
from core.vehicles.fleet import Cars

PowerOfEffect = tuple[str, Callable[[Signals], Floats]]
"""Whether an effect acts over `distance` or over `time`, and its power per unit of its coefficient. [W]"""


class CleanRows(NamedTuple):
    """Cleaned samples with everything that their signals depend on.

    Parameters
    ----------
    clean : Clean
        Cleaned telemetry, n rows.
    sky : Sky
        Weather at the rows.
    kind : (n,) int
        Kind of car of each row.
    """

    clean: Clean
    sky: Sky
    kind: Ints

    @property
    def size(self) -> int:
        """Number of rows."""
        return len(self.kind)

    def rows(self, start: int, stop: int) -> "CleanRows":
        """Return a view of the rows from `start` up to, not including, `stop`."""
        part = slice(start, stop)
        clean = Clean(*(column[part] for column in self.clean))  # type: ignore[arg-type]
        return CleanRows(clean, Sky(*(column[part] for column in self.sky)), self.kind[part])


def sum_rows(
    rows: CleanRows, cars: Cars, powers: Sequence[PowerOfEffect], accumulator: Accumulator, lanes: int
) -> Sums:
    """Compute signals and effects of cleaned rows, and add them to the totals.

    Parameters
    ----------
    rows : CleanRows
        n rows.
    cars : Cars
        Parameters of the kinds of car.
    powers : sequence of PowerOfEffect
        Effects whose energies are summed, in their order.
    accumulator : Accumulator
        Open totals of every lane, changed in place.
    lanes : int
        Number of lanes so far.

    Returns
    -------
    Sums
        Totals that the rows closed, and running totals at their due samples.
    """
    signals = Signals(rows.clean, rows.sky, cars.parameters_of(rows.kind))
    with np.errstate(all="ignore"):  # a user's effect may divide by a speed that it then masks
        energies = [(per, power(signals)) for per, power in powers]
    return accumulator.add(rows.clean, rows.kind, amounts(signals, energies), lanes)
