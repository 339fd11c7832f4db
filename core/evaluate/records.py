"""Declare what the results of several evaluations have in common: estimates, and errors relative to the energy."""

from collections.abc import Iterable
from typing import Annotated, Any

import pandas as pd

from socast.core.records import ConfidenceInterval, Record, declare
from socast.core.stats.scores import Estimate


class EstimatedValue(Record, frozen=True):
    """Hold a value with its uncertainty."""

    value: float | None = None
    ci95: Annotated[float | None, declare("Half width of the 95 % interval.")] = None

    @property
    def interval(self) -> ConfidenceInterval | None:
        """Ends of the 95 % interval, None where it is unknown."""
        if self.value is None or self.ci95 is None:
            return None
        return self.value - self.ci95, self.value + self.ci95


class RelativeErrors(Record, frozen=True):
    """Hold the errors of predictions in kWh, as shares of the energy, and over the noise floor."""

    mae_kwh: Annotated[EstimatedValue, declare("Mean absolute error. [kWh]", "MAE, kWh", "energy")] = EstimatedValue()
    wmape: Annotated[EstimatedValue, declare("Sum of errors over energy. [1]", "wMAPE", "share")] = EstimatedValue()
    mape: Annotated[EstimatedValue, declare("Mean of errors over energy. [1]", "MAPE", "share")] = EstimatedValue()
    over_floor: Annotated[float | None, declare("Error over the noise floor. [1]", "over noise", "ratio")] = None


def hold_estimate(estimate: Estimate) -> EstimatedValue:
    """Return an estimate as a record."""
    return EstimatedValue(value=estimate.value, ci95=estimate.ci95)


def make_estimate_frame(rows: Iterable[dict[str, Any]]) -> pd.DataFrame:
    """Return rows of JSON values as a DataFrame: the column `mae` of an estimate's value, `mae_ci95` of its half width.

    Examples
    --------
    >>> make_estimate_frame([{"hours": 2, "mae": {"value": 1.5, "ci95": 0.2}}]).to_dict("records")
    [{'hours': 2, 'mae': 1.5, 'mae_ci95': 0.2}]
    """
    return pd.json_normalize(list(rows), sep="_").rename(columns=lambda name: name.removesuffix("_value"))
