"""Declare the result of an evaluation of state-of-charge forecasts. All errors are in percent of charge."""

from typing import Annotated

import pandas as pd
from msgspec import field

from socast.core.evaluate.records import EstimatedValue, make_estimate_frame
from socast.core.records import Record, declare, to_json_values
from socast.core.stats.clustered import FEWEST_CLUSTERS, LEAST_CLUSTERS, count_independent_cases

Numbers = list[float | None]
"""One value for each forecast; None where it is unknown."""


class ClusteredShare(Record, frozen=True):
    """Hold a share of cases with Wilson's 95 % interval, clustered by vehicle-day. [1]"""

    value: float | None
    low: float | None
    high: float | None
    clusters: Annotated[int, declare("Number of vehicle-days.")]

    @property
    def is_firm(self) -> bool:
        """Whether there are enough vehicle-days, or independent cases of them, to show the share as a figure."""
        if self.clusters < FEWEST_CLUSTERS or self.value is None or self.low is None or self.high is None:
            return False
        enough = count_independent_cases(self.value, self.low, self.high) >= LEAST_CLUSTERS
        return enough or self.clusters >= LEAST_CLUSTERS


class RegressionIntervals(Record, frozen=True):
    """Hold the intervals of the regression, and those of the forecasts (`forecast_...`) on the same cases."""

    n: Annotated[int, declare("Number of forecasts.", "n", "count")]
    forecast_coverage: Annotated[ClusteredShare, declare("Share inside. [1]", "coverage", "clustered share")]
    coverage: Annotated[ClusteredShare, declare("Share inside. [1]", "regression", "clustered share")]
    forecast_width_pct: Annotated[EstimatedValue, declare("Mean width. [%]", "width", "value")]
    width_pct: Annotated[EstimatedValue, declare("Mean width. [%]", "regression", "value")]
    forecast_interval_score_pct: Annotated[EstimatedValue, declare("Mean score. [%]", "interval score", "value")]
    interval_score_pct: Annotated[EstimatedValue, declare("Mean score. [%]", "regression", "value")]


class BaselineErrors(Record, frozen=True):
    """Hold the errors of a baseline, and those of the forecasts (`forecast_...`) on the same cases."""

    n: Annotated[int, declare("Number of forecasts.")]
    mae_pct: Annotated[EstimatedValue, declare("Mean absolute error. [%]")]
    bias_pct: Annotated[EstimatedValue, declare("Mean of expected less outcome. [%]")]
    forecast_mae_pct: Annotated[EstimatedValue, declare("Mean absolute error. [%]")]
    less_pct: Annotated[EstimatedValue, declare("Error of the baseline less that of the forecasts. [%]")]
    share_less: Annotated[float | None, declare("Share by which the error of the forecasts is below it. [1]")]


class BestBaseline(Record, frozen=True):
    """Hold the baseline of a person with the least error on cases that all of them cover."""

    name: str
    n: Annotated[int, declare("Number of forecasts.")]
    vehicle_days: int
    mae_pct: Annotated[float, declare("Its mean absolute error. [%]")]
    forecast_mae_pct: Annotated[float, declare("That of the forecasts. [%]")]
    share_less: Annotated[float | None, declare("Share by which the error of the forecasts is below it. [1]")]


class ForecastFigures(Record, frozen=True):
    """Hold error, coverage and width of forecasts, and the errors of baselines on the same cases."""

    n: Annotated[int, declare("Number of forecasts.", "n", "count")]
    shifts: int
    vehicle_days: Annotated[int, declare("Number of vehicle-days.", "vehicle-days", "count")]
    mae_pct: Annotated[EstimatedValue, declare("Mean absolute error. [%]", "MAE", "charge")]
    bias_pct: Annotated[EstimatedValue, declare("Mean of forecast less outcome. [%]", "bias", "difference")]
    coverage: Annotated[ClusteredShare, declare("Share inside the interval. [1]", "coverage", "clustered share")]
    below: Annotated[float, declare("Share of outcomes below the interval. [1]")]
    above: Annotated[float, declare("Share of outcomes above the interval. [1]")]
    width_pct: Annotated[EstimatedValue, declare("Mean width of the 90 % interval. [%]", "width", "value")]
    interval_score_pct: Annotated[EstimatedValue, declare("Mean interval score. [%]")]
    regression: RegressionIntervals
    baselines: dict[str, BaselineErrors]
    best: BestBaseline | None


class ForecastBin(ForecastFigures, frozen=True, kw_only=True):
    """Hold the figures of the forecasts in a bin of the time ahead."""

    bin: str


class FiguresByTime(Record, frozen=True):
    """Hold figures of all forecasts, and by the time ahead."""

    pooled: Annotated[ForecastFigures, declare("All times ahead.")]
    hours: Annotated[dict[str, ForecastFigures], declare("Time ahead in h -> its figures.")]


class ConditionFigures(FiguresByTime, frozen=True, kw_only=True):
    """Hold the figures in a bin of a condition."""

    bin: str


class AlarmFigures(Record, frozen=True):
    """Hold the performance of alarms on cases that fell below a level and cases that did not."""

    caught: Annotated[int, declare("Number of cases that fell with an alarm.")]
    missed: Annotated[int, declare("Number of cases that fell without an alarm.")]
    false_alarms: Annotated[int, declare("Number of cases that did not fall with an alarm.")]
    hit_rate: Annotated[ClusteredShare, declare("Share of cases that fell with an alarm. [1]")]
    false_alarm_rate: Annotated[ClusteredShare, declare("Share of the other cases with an alarm. [1]")]


class BaselineRisk(Record, frozen=True):
    """Hold the scores of the risk of a baseline, and of the forecasts (`forecast_...`) on the same cases."""

    n: Annotated[int, declare("Number of cases.", "cases", "count")]
    fell: Annotated[int, declare("Number of cases that fell.", "fell", "count")]
    brier: Annotated[float | None, declare("Brier score. [1]", "Brier, baseline", "four decimals")]
    forecast_brier: Annotated[float | None, declare("Brier score. [1]", "forecast", "four decimals")]
    skill: Annotated[EstimatedValue, declare("Reduction of the baseline's score. [1]", "skill", "skill")]
    alarms: AlarmFigures
    forecast_alarms: AlarmFigures


class RiskFigures(Record, frozen=True):
    """Hold the scores of the risk of falling below a level, and of the alarms that follow from it."""

    n: Annotated[int, declare("Number of cases.", "cases", "count")]
    shifts: int
    fell: Annotated[int, declare("Number of cases that fell.", "fell below", "count")]
    alarms: AlarmFigures
    brier: Annotated[float, declare("Brier score. [1]")]
    brier_base: Annotated[float, declare("That of a constant risk, the share that fell. [1]")]
    skill: Annotated[EstimatedValue, declare("Reduction of `brier_base` by the risk. [1]")]
    baselines: dict[str, BaselineRisk]


class RiskClass(Record, frozen=True):
    """Hold how often cases of a class of risk fell below the level."""

    low: Annotated[float, declare("Lower edge of the class. [1]")]
    high: Annotated[float, declare("Upper edge of the class. [1]")]
    n: Annotated[int, declare("Number of cases.", "cases", "count")]
    shifts: Annotated[int, declare("Number of shifts.", "shifts", "count")]
    told: Annotated[float, declare("Mean forecast risk. [1]", "mean forecast risk", "percent")]
    fell: Annotated[ClusteredShare, declare("Share that fell. [1]", "fell below", "clustered share")]


class ReserveRisk(Record, frozen=True):
    """Hold the reliability of the risk of falling below a reserve, and the performance of alarms."""

    alarm: Annotated[float, declare("Risk from which on an alarm is raised. [1]")]
    reliability: Annotated[dict[str, list[RiskClass]], declare("`plan`, its reserve, and all other `levels`.")]
    told: Annotated[dict[str, list[RiskClass]], declare("All other levels: `risk` of the forecasts, `regression`.")]
    levels: Annotated[dict[str, dict[str, RiskFigures]], declare("Level -> time ahead in h, or `pooled`.")]
    overall: Annotated[dict[str, RiskFigures], declare("The same over all other levels.")]


class ImpossibleBounds(Record, frozen=True):
    """Hold how many upper bounds exceed the present charge although no charge is planned."""

    n: Annotated[int, declare("Number of forecasts without a planned charge ahead.")]
    above: Annotated[int, declare("Number of them above the present charge.")]
    largest: Annotated[float, declare("Largest excess. [%]")]


class EvaluatedShifts(Record, frozen=True):
    """Hold which forecasts were evaluated."""

    shifts: Annotated[int, declare("Number of shifts that ended.")]
    judged_shifts: Annotated[int, declare("Number of them with an evaluated forecast.")]
    warm_up_shifts: Annotated[int, declare("Number of shifts before the first interval.")]
    forecasts: int
    left_out: Annotated[dict[str, int], declare("Reason -> number of forecasts left out.")]
    vehicles: int
    vehicle_days: int
    vehicle_models: list[str]
    first_date: str
    last_date: str


class ForecastColumns(Record, frozen=True):
    """Hold the evaluated forecasts as columns with one entry each. [%]"""

    vehicle_id: list[str]
    shift: list[int]
    hours: Annotated[list[int], declare("Time ahead. [h]")]
    soc: Annotated[Numbers, declare("State of charge when the forecast was made. [%]")]
    soc_mean: Annotated[Numbers, declare("Forecast of the end. [%]")]
    soc_p05: Annotated[Numbers, declare("Lower end of its interval. [%]")]
    soc_p95: Annotated[Numbers, declare("Upper end of its interval. [%]")]
    soc_end: Annotated[Numbers, declare("Outcome. [%]")]
    linear: Numbers
    model_mean: Numbers
    rating: Numbers
    regression: Numbers


class ExampleShift(Record, frozen=True):
    """Hold a shift and its forecasts."""

    why: Annotated[str, declare("Reason of the selection.")]
    vehicle_id: str
    vehicle_model: str
    shift: int
    date: str
    ambient_c: Annotated[float | None, declare("Mean outside temperature. [°C]")]
    soc_end_pct: Annotated[float | None, declare("State of charge at the end. [%]")]
    reserve_soc_pct: Annotated[float | None, declare("Reserve of the plan. [%]")]
    hours_ahead: Annotated[list[float], declare("Time before the end, of each forecast. [h]")]
    soc_pct: Annotated[Numbers, declare("State of charge. [%]")]
    soc_mean_pct: Annotated[Numbers, declare("Forecast of the end. [%]")]
    soc_p05_pct: Annotated[Numbers, declare("Lower end of its interval. [%]")]
    soc_p95_pct: Annotated[Numbers, declare("Upper end of its interval. [%]")]


class SocEvaluation(Record, frozen=True):
    """Hold errors and reliability of the forecasts of the state of charge, against outcomes and baselines."""

    about: EvaluatedShifts
    overall: FiguresByTime
    by: Annotated[dict[str, list[ConditionFigures]], declare("Condition -> figures in its bins.")]
    bounds: ImpossibleBounds
    reserve: ReserveRisk
    legs: Annotated[dict[str, list[ForecastBin]], declare("Single legs by the time until their end, last `all`.")]
    charges: Annotated[dict[str, list[ForecastBin]], declare("Around planned charges, by the time ahead.")]
    columns: Annotated[ForecastColumns, declare("Every forecast.")] = field(name="forecasts")
    examples: list[ExampleShift]
    notes: Annotated[list[str], declare("Remarks for the reader.")]

    @property
    def forecasts(self) -> pd.DataFrame:
        """Every forecast with its outcome and what the baselines expected, one row each. [%]"""
        return pd.DataFrame(self.columns.to_json())

    @property
    def errors(self) -> pd.DataFrame:
        """Figures by the time ahead, one row each; `_ci95` ends half widths of 95 % intervals. [%], [1]"""
        names = ("n", "shifts", "vehicle_days", "mae_pct", "bias_pct", "coverage", "width_pct", "interval_score_pct")
        rows = [
            {"hours": int(hours), **{name: to_json_values(getattr(figures, name)) for name in names}}
            | {name: baseline.mae_pct.to_json() for name, baseline in figures.baselines.items()}
            for hours, figures in self.overall.hours.items()
        ]
        return make_estimate_frame(rows)
