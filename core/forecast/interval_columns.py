"""Columns of intervals and of charges ahead, which an outlook lists by leg."""

from typing import Final, NamedTuple

import numpy as np

from socast.core.batch import Floats
from socast.core.forecast.soc_ahead import SocForecast
from socast.core.wire.messages import Interval

_ROUNDING_KWH: Final = 1e-9


class IntervalColumns(NamedTuple):
    """Hold mean, 5th and 95th percentile of a quantity, (n,) float each."""

    mean: Floats
    p05: Floats
    p95: Floats

    def list_intervals(self) -> list[Interval | None]:
        """Return the intervals, None where one is unknown."""
        rows = zip(self.mean.tolist(), self.p05.tolist(), self.p95.tolist(), strict=True)
        return [Interval(mean, p05, p95) if np.isfinite([mean, p05, p95]).all() else None for mean, p05, p95 in rows]


class ChargeColumns(NamedTuple):
    """Hold charges ahead and the probability that each is below the reserve, (n,) float each. [%], [1]"""

    mean: Floats
    p05: Floats
    p95: Floats
    risk: Floats

    @classmethod
    def from_forecast(cls, soc: SocForecast) -> "ChargeColumns":
        """Return the charges of a forecast."""
        return cls(100.0 * soc.mean, 100.0 * soc.p05, 100.0 * soc.p95, soc.risk)

    def list_intervals(self) -> list[Interval | None]:
        """Return the intervals, None where one is unknown."""
        return IntervalColumns(*self[:3]).list_intervals()

    def lead_to(self, end: "ChargeColumns", spent: Floats) -> "ChargeColumns":
        """Return the charges followed by the last one, none of them below it nor at a larger risk.

        `spent` is the energy until each of them and until the last one. [kWh]
        """
        mean, p05, p95 = (
            make_consistent(np.append(of_legs, last), spent) for of_legs, last in zip(self[:3], end[:3], strict=True)
        )
        return ChargeColumns(mean, p05, p95, -make_consistent(-np.append(self.risk, end.risk), spent))


def make_consistent(charge: Floats, spent: Floats) -> Floats:
    """Return charges ahead that do not rise while energy is spent.

    Intervals are learned for each distance separately, so that a later one may be narrower. The last charge stays as it
    is. The ones before are raised to it where necessary, because a car below it earlier is also below it later.

    Parameters
    ----------
    charge : (n,) or (n, m) float
        Means or percentiles, one point after another; NaN where unknown.
    spent : (n,) float
        Energy until each point. It falls where a descent returns more than the leg takes. [kWh]

    Examples
    --------
    >>> make_consistent(np.array([50.0, 40.0, 42.0, 41.0]), np.array([1.0, 2.0, 3.0, 2.5])).tolist()
    [50.0, 42.0, 42.0, 41.0]
    """
    out = charge.copy()
    for i in reversed(range(len(out) - 1)):
        if spent[i + 1] >= spent[i] - _ROUNDING_KWH:
            out[i] = np.where(np.isnan(out[i]), out[i], np.fmax(out[i], out[i + 1]))
    return out
