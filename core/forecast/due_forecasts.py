"""Keep the forecasts that have become due until they are taken, and build their messages."""

from collections import Counter

from socast.core.batch import Floats
from socast.core.forecast.forecast_rows import ForecastRows
from socast.core.forecast.messages import build_forecasts
from socast.core.totals.accumulator import Totals, join_totals
from socast.core.totals.context import RunContext
from socast.core.wire.messages import Message
from socast.core.wire.rides import RideNames


class DueForecasts:
    """Keep the running totals at which forecasts have become due, and the forecasts to publish with them.

    Parameters
    ----------
    rides : RideNames
        Names of the rides in the totals.
    prefix : str
        Chunks before `fleet` in the keys, with a slash at the end.

    Attributes
    ----------
    implausible : Counter of str
        Number of forecasts and answers that were withheld, by cause, see `socast.core.forecast.plausibility`.
    """

    def __init__(self, none: Totals, context: RunContext, rides: RideNames, prefix: str) -> None:
        self.implausible: Counter[str] = Counter()
        self._none, self._context, self._names, self._prefix = none, context, rides, prefix
        self._totals: list[Totals] = []
        self._rows: list[ForecastRows] = []
        self._built: list[Message] = []

    def add(self, totals: Totals, rows: ForecastRows) -> None:
        """Add the forecasts of n rows of running totals."""
        self._totals.append(totals)
        self._rows.append(rows)

    def get_ride_codes(self) -> list[Floats]:
        """Return the codes of the rides that the forecasts name."""
        return [totals.at_last("code") for totals in self._totals]

    def build_all(self) -> None:
        """Build the messages of all forecasts, before lanes are numbered anew."""
        self._built += self._build(newest_only=False)

    def take(self, *, newest_only: bool) -> list[Message]:
        """Return and drop the forecasts in the order in which they became due, or the last one of each vehicle."""
        built, self._built = self._built, []
        if not built:
            return self._build(newest_only=newest_only)
        built += self._build(newest_only=newest_only)
        return list({message.key: message for message in built}.values()) if newest_only else built

    def _build(self, *, newest_only: bool) -> list[Message]:
        """Return and drop the forecasts whose messages are not built yet."""
        if not self._totals:
            return []
        due, rows = join_totals(self._totals, self._none), ForecastRows.join(self._rows)
        self._totals, self._rows = [], []
        if newest_only:
            last = due.newest()
            due, rows = due.rows(last), rows.rows(last)
        names = self._names.names(due.at_last("code").tolist())
        return build_forecasts(due, rows, names, self._context, self._prefix, self.implausible)
