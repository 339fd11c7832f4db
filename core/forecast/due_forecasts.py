"""Keep the forecasts that have become due until they are taken."""

from core.batch import Floats
from core.forecast.forecast_rows import ForecastRows
from core.totals.accumulator import Totals, join_totals


class DueForecasts:
    """Keep the running totals at which forecasts have become due, and the forecasts to publish with them.

    Parameters
    ----------
    none : Totals
        Totals of no rows.
    """

    def __init__(self, none: Totals) -> None:
        self._none = none
        self._totals: list[Totals] = []
        self._rows: list[ForecastRows] = []

    def __bool__(self) -> bool:
        return bool(self._totals)

    def add(self, totals: Totals, rows: ForecastRows) -> None:
        """Add the forecasts of n rows of running totals."""
        self._totals.append(totals)
        self._rows.append(rows)

    def get_ride_codes(self) -> list[Floats]:
        """Return the codes of the rides that the forecasts name."""
        return [totals.at_last("code") for totals in self._totals]

    def take(self, *, newest_only: bool) -> tuple[Totals, ForecastRows]:
        """Return and drop the forecasts in the order in which they became due, or the last one of each vehicle."""
        due, rows = join_totals(self._totals, self._none), ForecastRows.join(self._rows)
        self._totals, self._rows = [], []
        if newest_only:
            last = due.newest()
            due, rows = due.rows(last), rows.rows(last)
        return due, rows
