"""Declare the results of comparisons: errors of models, worst rides, two sets of rides, and the trace of one ride."""

from typing import Annotated

import pandas as pd

from socast.core.evaluate.records import EstimatedValue, RelativeErrors, make_estimate_frame
from socast.core.records import PartialRecord, Record, declare, make_frame
from socast.core.stats.multiple_testing import SIGNIFICANCE

Values = list[float | None]
"""One value for each ride, window or bin; None where it is unknown."""


class RideSample(Record, frozen=True):
    """Hold which rides were compared."""

    read: Annotated[int, declare("Number of rides read.")] = 0
    rides: Annotated[int, declare("Number of rides compared.")] = 0
    left_out: Annotated[dict[str, int], declare("Reason -> number of rides left out.")] = {}
    vehicles: int = 0
    vehicle_days: Annotated[int, declare("Number of pairs of vehicle and date.")] = 0
    vehicle_models: list[str] = []
    first_date: str = ""
    last_date: str = ""
    measured: Annotated[dict[str, float | None], declare("Instrument -> share of rides. [1]")] = {}
    noise_floor_kwh: Annotated[float | None, declare("Error that measurement noise alone causes. [kWh]")] = None
    below_least: Annotated[float | None, declare("Share of rides that MAPE leaves out. [1]")] = None
    consumption_kwh: Annotated[EstimatedValue, declare("Mean measured energy of a ride. [kWh]")] = EstimatedValue()
    per_100km_kwh: Annotated[EstimatedValue, declare("Measured energy per distance. [kWh/100 km]")] = EstimatedValue()


class PredictionErrors(RelativeErrors, frozen=True):
    """Hold the errors of the predictions of a model."""

    rides: Annotated[int, declare("Number of rides.")] = 0
    bias_kwh: Annotated[EstimatedValue, declare("Mean of predicted less measured. [kWh]")] = EstimatedValue()
    rmse_kwh: Annotated[float | None, declare("Root mean square error. [kWh]")] = None
    relative: Annotated[float | None, declare("Mean absolute error over mean consumption. [1]")] = None
    relative_bias: Annotated[float | None, declare("Bias over mean consumption. [1]")] = None
    within: Annotated[dict[str, float | None], declare("Relative error in % -> share of rides within it. [1]")] = {}


class TestedBin(Record, frozen=True):
    """Hold a bin of a condition in which a difference was tested, with all bins of all conditions."""

    __test__ = False  # pytest collects classes whose name begins with Test

    bin: str
    q: Annotated[float | None, declare("Rate of false findings among all bins at least as different. [1]")] = None

    @property
    def is_significant(self) -> bool:
        """Whether the bias differs significantly: from zero, or between two sets of rides."""
        return self.q is not None and self.q < SIGNIFICANCE


class ConditionBin(TestedBin, frozen=True, kw_only=True):
    """Hold the errors of the rides in a bin of a condition."""

    n: Annotated[int, declare("Number of rides.")] = 0
    vehicle_days: int = 0
    bias_kwh: Annotated[EstimatedValue, declare("Mean of predicted less measured. [kWh]")] = EstimatedValue()
    mae_kwh: Annotated[float | None, declare("Mean absolute error. [kWh]")] = None
    mae_ci95_kwh: Annotated[float | None, declare("Half width of its 95 % interval. [kWh]")] = None
    relative: Annotated[float | None, declare("Mean absolute error over mean consumption. [1]")] = None
    relative_bias: Annotated[float | None, declare("Bias over mean consumption. [1]")] = None


class WorstRide(PartialRecord, frozen=True):
    """Hold a ride of large error."""

    ride: Annotated[str, declare("Name of the ride.", "ride")]
    vehicle_id: str | None
    vehicle_model: Annotated[str | None, declare("Key of the vehicle model.", "car", "vehicle model")]
    date: Annotated[str | None, declare("ISO date.", "date")]
    distance_km: Annotated[float | None, declare("Distance. [km]", "km", "estimate")]
    ambient_c: Annotated[float | None, declare("Outside temperature. [°C]", "°C", "estimate")]
    average_speed_kmh: Annotated[float | None, declare("Average speed. [km/h]", "km/h", "estimate")]
    measured_kwh: Annotated[float | None, declare("Measured energy. [kWh]", "measured", "energy")]
    predicted_kwh: Annotated[float | None, declare("Predicted energy. [kWh]", "pre-\ndicted", "energy")]
    error_kwh: Annotated[float | None, declare("Predicted less measured. [kWh]", "error", "signed")]
    relative: Annotated[float | None, declare("Error over size of energy. [1]", "relative", "whole percent")]
    command: Annotated[str, declare("Command that shows its trace.", "its trace")] = ""


class WorstRides(Record, frozen=True):
    """Hold the rides of largest error."""

    absolute: Annotated[list[WorstRide], declare("By error in kWh, the largest first.")] = []
    relative: Annotated[list[WorstRide], declare("By error over energy, the largest first.")] = []


class ComparedModel(PredictionErrors, frozen=True):
    """Hold the errors of a model: over all rides, by condition, and its worst rides."""

    by: Annotated[dict[str, list[ConditionBin]], declare("Condition -> errors in its bins.")] = {}
    worst: WorstRides = WorstRides()


class PairDifference(Record, frozen=True):
    """Hold the difference between the mean absolute errors of two models on the same rides."""

    a: str
    b: str
    difference_kwh: Annotated[
        EstimatedValue, declare("Error of a less error of b. [kWh]", "difference of MAE, kWh", "difference")
    ]
    p: Annotated[float | None, declare("p-value. [1]")]
    p_holm: Annotated[float | None, declare("p-value adjusted for all pairs (Holm). [1]", "p", "probability")]

    @property
    def is_significant(self) -> bool:
        """Whether the models differ significantly."""
        return self.p_holm is not None and self.p_holm < SIGNIFICANCE

    @property
    def name(self) -> Annotated[str, declare("The pair.", "pair")]:
        """Name of the difference."""
        return f"{self.a} less {self.b}"

    @property
    def better(self) -> Annotated[str, declare("Model of significantly smaller error.", "less error")]:
        """Model with the smaller error, where the difference is significant."""
        if not self.is_significant or self.difference_kwh.value is None:
            return "not distinguishable"
        return self.a if self.difference_kwh.value < 0.0 else self.b


class RideEnergies(Record, frozen=True):
    """Hold the energies of n rides."""

    key: Annotated[list[str], declare("Names of the rides.")] = []
    vehicle_model: list[str] = []
    measured_kwh: Annotated[list[float], declare("Measured energy. [kWh]")] = []
    predicted_kwh: Annotated[dict[str, list[float]], declare("Model -> predicted energy. [kWh]")] = {}


class SetContrast(Record, frozen=True):
    """Hold a figure of two sets of rides, and its difference."""

    first: Annotated[EstimatedValue, declare("Of the first set.", "first", "estimate")] = EstimatedValue()
    second: Annotated[EstimatedValue, declare("Of the second set.", "second", "estimate")] = EstimatedValue()
    difference: Annotated[
        EstimatedValue, declare("Second less first.", "second less first", "difference, one decimal")
    ] = EstimatedValue()
    p: Annotated[float | None, declare("p-value of the difference. [1]")] = None


class PropertyContrast(SetContrast, frozen=True, kw_only=True):
    """Hold a property of the rides of two sets."""

    name: str
    unit: Annotated[str, declare("Unit of the property, `1` for none.")]
    q: Annotated[float | None, declare("Rate of false findings among all at least as different. [1]")]
    in_spreads: Annotated[float | None, declare("Size of the difference over the spread between rides. [1]")]

    @property
    def is_significant(self) -> bool:
        """Whether the sets differ significantly in this property."""
        return self.q is not None and self.q < SIGNIFICANCE

    @property
    def label(self) -> Annotated[str, declare("Name, unit and mark of significance.", "what")]:
        """Name with the unit, marked where the difference is significant."""
        return f"{self.name}{'' if self.unit == '1' else f', {self.unit}'}{' *' if self.is_significant else ''}"


class TermContrast(SetContrast, frozen=True, kw_only=True):
    """Hold the contribution of a term of a model to the consumption of two sets of rides. [kWh/100 km]"""

    name: Annotated[str, declare("Name of the term.", "part")]


class ContrastBin(TestedBin, frozen=True, kw_only=True):
    """Hold the errors of a model on the rides of two sets in a bin of a condition."""

    n: Annotated[list[int], declare("Numbers of rides of both sets.")] = []
    bias_kwh: Annotated[SetContrast, declare("Mean of predicted less measured. [kWh]")] = SetContrast()
    mae_kwh: Annotated[SetContrast, declare("Mean absolute error. [kWh]")] = SetContrast()
    consumption: Annotated[SetContrast, declare("Measured energy per distance. [kWh/100 km]")] = SetContrast()


class ModelContrast(Record, frozen=True):
    """Hold the errors of a model on two sets of rides, and how much of their difference it explains."""

    bias_kwh: Annotated[SetContrast, declare("Mean of predicted less measured. [kWh]")] = SetContrast()
    mae_kwh: Annotated[SetContrast, declare("Mean absolute error. [kWh]")] = SetContrast()
    explained: Annotated[SetContrast, declare("Predicted consumption. [kWh/100 km]")] = SetContrast()
    unexplained: Annotated[SetContrast, declare("Measured less predicted consumption. [kWh/100 km]")] = SetContrast()
    terms: Annotated[list[TermContrast], declare("Terms of the prediction, the largest difference first.")] = []
    by: Annotated[dict[str, list[ContrastBin]], declare("Condition -> errors in its bins.")] = {}


class DatasetContrast(Record, frozen=True):
    """Hold how two sets of rides differ, and how much of the difference models explain."""

    first: Annotated[str, declare("Name of the first set.")] = ""
    second: Annotated[str, declare("Name of the second set.")] = ""
    about: Annotated[RideSample, declare("Rides of the second set.")] = RideSample()
    second_models: Annotated[dict[str, ComparedModel], declare("Model -> its errors on the second set.")] = {}
    shared: Annotated[int, declare("Number of rides in both sets.")] = 0
    properties: Annotated[list[PropertyContrast], declare("Properties of the rides, the most different first.")] = []
    consumption: Annotated[SetContrast, declare("Measured energy per distance. [kWh/100 km]")] = SetContrast()
    models: dict[str, ModelContrast] = {}


class ChartColumn(Record, frozen=True):
    """Hold a column along which residuals are averaged."""

    key: str
    label: str
    unit: str
    number: Annotated[bool, declare("Whether it holds numbers, not names.")]

    @property
    def title(self) -> str:
        """Name of the column with its unit."""
        return f"{self.label} [{self.unit}]" if self.unit else self.label


class ChartBins(Record, frozen=True):
    """Hold the mean residual of windows in bins of a column; ends are empty for names."""

    x: Annotated[list[float | str], declare("Means of the column, or names.")]
    low: list[float]
    high: list[float]
    mean: Annotated[list[float], declare("Predicted less measured power. [W]")]
    ci95: Annotated[Values, declare("Half widths of the 95 % intervals. [W]")]
    q: Annotated[Values, declare("Rates of false findings among the bins of all columns. [1]")]
    rows: Annotated[list[int], declare("Numbers of windows.")]
    days: Annotated[list[int], declare("Numbers of vehicle-days.")]

    @property
    def known(self) -> dict[int, float]:
        """Half widths of the intervals, by place, of the bins that have one. [W]"""
        return {i: half for i, half in enumerate(self.ci95) if half is not None}

    def is_off_zero(self, place: int) -> bool:
        """Return whether the mean of a bin differs from zero beyond chance, among all bins of all columns."""
        q = self.q[place]
        return q is not None and q < SIGNIFICANCE


class ResidualChart(Record, frozen=True):
    """Hold the mean residual of windows along a column."""

    column: ChartColumn
    bins: ChartBins
    of: Annotated[int, declare("Number of bins with an interval.")]
    outside: Annotated[int, declare("Number of them off zero.")]
    spread: Annotated[float | None, declare("Root mean square of the means beyond their standard errors. [W]")]
    q: Annotated[float | None, declare("Rate of false findings among all columns that vary as much. [1]")]

    @property
    def varies(self) -> bool:
        """Whether the residual varies along the column beyond chance, with bins off zero."""
        return self.outside > 0 and self.q is not None and self.q < SIGNIFICANCE


class ResidualSurvey(PartialRecord, frozen=True):
    """Hold where the windows show that a model fails."""

    charts: Annotated[list[ResidualChart], declare("One for each column, the largest spread first.")] = []
    model: str = ""
    why_not: Annotated[str, declare("Why this is unknown.")] = ""
    unit: str = ""
    windows: int | None = None

    @property
    def failing(self) -> list[ResidualChart]:
        """Columns along which the residual varies beyond chance: numbers first, by spread."""
        return sorted((chart for chart in self.charts if chart.varies), key=lambda chart: not chart.column.number)


class Divergence(PartialRecord, frozen=True):
    """Hold the span of windows in which prediction and measurement of a ride diverge."""

    first: Annotated[int, declare("First window, from 0.")]
    last: Annotated[int, declare("Last window.")]
    minute: Annotated[float, declare("Time at its beginning. [min]")]
    km: Annotated[float, declare("Distance at its beginning. [km]")]
    minutes: Annotated[float, declare("Duration. [min]")]
    kilometres: Annotated[float, declare("Distance driven. [km]")]
    error_kwh: Annotated[float, declare("Predicted less measured. [kWh]")]
    share: Annotated[float, declare("Share of the error of the ride. [1]")]
    share_of_time: Annotated[float, declare("Share of the duration of the ride. [1]")]
    speed_kmh: Annotated[float, declare("Average speed. [km/h]")]
    ambient_c: Annotated[float | None, declare("Outside temperature. [°C]")] = None
    uphill_pct: Annotated[float | None, declare("Mean slope. [%]")] = None


class TracedRide(PartialRecord, frozen=True):
    """Hold what is known of a ride."""

    ride_key: str = ""
    ride_id: str = ""
    vehicle_id: str = ""
    vehicle_model: str = ""
    date: str = ""
    distance_km: float | None = None
    ambient_c: float | None = None
    average_speed_kmh: float | None = None
    duration_s: float | None = None
    energy_kwh: Annotated[float | None, declare("Measured energy. [kWh]")] = None
    energy_sd_kwh: Annotated[float | None, declare("Its standard uncertainty. [kWh]")] = None
    unfit_reason: Annotated[str, declare("Why it is unfit for training.")] = ""


class TraceWindows(PartialRecord, frozen=True):
    """Hold the windows of a ride: where they end, their energy and their conditions, as far as the table has them."""

    end_min: Annotated[list[float], declare("Time since the start. [min]")]
    end_km: Annotated[list[float], declare("Distance since the start. [km]")]
    duration_s: list[float]
    distance_km: list[float]
    measured_kwh: Annotated[list[float], declare("Measured energy. [kWh]")]
    ambient_c: Values | None = None
    gained_m: Values | None = None
    lost_m: Values | None = None
    stops: Values | None = None
    wind_speed_kmh: Values | None = None
    latitude_start_deg: Values | None = None
    longitude_start_deg: Values | None = None
    latitude_end_deg: Values | None = None
    longitude_end_deg: Values | None = None
    headwind_kmh: Annotated[Values | None, declare("Wind against the car, negative from behind. [km/h]")] = None


class TracedModel(Record, frozen=True):
    """Hold the prediction of a model along a ride."""

    predicted_kwh: Annotated[float, declare("Prediction of the ride. [kWh]", "predicted, kWh", "energy")] = 0.0
    error_kwh: Annotated[float, declare("Predicted less measured. [kWh]", "error, kWh", "signed")] = 0.0
    start_kwh: Annotated[float, declare("Energy predicted before the first window. [kWh]")] = 0.0
    energy_kwh: Annotated[list[float], declare("Energy that each window adds. [kWh]")] = []
    terms: Annotated[dict[str, list[float]], declare("Term -> its part of `energy_kwh`. [kWh]")] = {}
    start_terms: Annotated[dict[str, float], declare("Term -> its part of `start_kwh`. [kWh]")] = {}
    place: Annotated[Divergence | None, declare("Where it diverges from the measurement, if anywhere.")] = None
    words: Annotated[str, declare("Sentence on the divergence, without its subject.")] = ""

    @property
    def relative(
        self,
    ) -> Annotated[float | None, declare("Error over size of energy.", "of measured", "whole percent")]:
        """Error over the size of the measured energy, None where that is zero. [1]"""
        measured = abs(self.predicted_kwh - self.error_kwh)
        return self.error_kwh / measured if measured else None


class RideTrace(Record, frozen=True):
    """Hold the measured energy of a ride and the predictions of models, window by window."""

    windows: TraceWindows
    ride: TracedRide = TracedRide()
    models: dict[str, TracedModel] = {}
    notes: list[str] = []


class Comparison(PartialRecord, frozen=True):
    """Hold how models compare with measured energies on the same rides."""

    about: RideSample = RideSample()
    models: dict[str, ComparedModel] = {}
    pairs: Annotated[list[PairDifference], declare("Differences between the models.")] = []
    rides: RideEnergies = RideEnergies()
    notes: Annotated[list[str], declare("Notes for the reader.")] = []
    failures: Annotated[ResidualSurvey, declare("Where the first model fails.")] = ResidualSurvey()
    against: Annotated[DatasetContrast | None, declare("Differences from another set of rides.")] = None
    traces: Annotated[dict[str, RideTrace] | None, declare("Traces of the worst rides.")] = None

    @property
    def errors(self) -> pd.DataFrame:
        """Errors of the models, one row each; `_ci95` ends the half widths of 95 % intervals. [kWh], [1]"""
        names = PredictionErrors.__struct_fields__
        rows = [{"model": label} | {n: one.to_json()[n] for n in names} for label, one in self.models.items()]
        return make_estimate_frame(rows)

    @property
    def worst_rides(self) -> pd.DataFrame:
        """Rides of largest error of each model, one row each, the largest first. [kWh]"""
        parts = {name: make_frame(one.worst.absolute) for name, one in self.models.items()}
        return pd.concat(parts, names=["model"]).reset_index("model").reset_index(drop=True)
