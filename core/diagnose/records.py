"""Declare the result of a diagnosis: records of the error, the missing effects, the cars, and what remains."""

from typing import Annotated, Final

import pandas as pd
from msgspec import field

from socast.core.evaluate.records import EstimatedValue
from socast.core.records import ConfidenceInterval, Record, declare, make_frame

NONE: Final = "none"
"""Cause where nothing is missing."""
UNKNOWN: Final = "unknown"
"""Cause that is not in the library."""


class EstimatedCoefficient(Record, frozen=True):
    """Hold the coefficient of an effect."""

    value: Annotated[float | None, declare("Value in `unit`.")] = None
    ci95: Annotated[ConfidenceInterval | None, declare("95 % interval, in `unit`.")] = None
    unit: str = "1"
    low: Annotated[float | None, declare("Lower end of the plausible range, in `unit`.")] = None
    high: Annotated[float | None, declare("Upper end of the plausible range, in `unit`.")] = None
    plausible: Annotated[bool, declare("Whether its interval reaches the plausible range.")] = True


class CauseProbability(Record, frozen=True):
    """Hold a cause of an error: an effect, `unknown` for something outside the library, or `none`."""

    effect: Annotated[str, declare("Name of the cause.", "cause")]
    probability: Annotated[float | None, declare("Probability. [1]", "probability", "chance")] = None
    shown_by: Annotated[str, declare("Data that would distinguish the cause from others.")] = ""


class RivalEffect(Record, frozen=True):
    """Hold an effect that the data do not distinguish from another."""

    effect: str
    correlation: Annotated[float | None, declare("Correlation of their energy in the windows. [1]")] = None
    data: Annotated[str, declare("Data that would distinguish the two.")] = ""


class ResidualBins(Record, frozen=True):
    """Hold the residual in b bins of the regressor of an effect; in W, or in Wh/km where `per` is km."""

    x: Annotated[list[float], declare("Means of the regressor, per unit of the coefficient.")] = []
    before: Annotated[list[float], declare("Mean residual without the effect.")] = []
    after: Annotated[list[float], declare("Mean residual with the effect.")] = []
    ci95: Annotated[list[float | None], declare("Half widths of the 95 % intervals.")] = []
    windows: Annotated[list[int], declare("Numbers of windows.")] = []
    days: Annotated[list[int], declare("Numbers of vehicle-days.")] = []
    slope: Annotated[float | None, declare("Coefficient that these windows show.")] = None
    slope_ci95: Annotated[ConfidenceInterval | None, declare("Its 95 % interval.")] = None


class CarResidual(ResidualBins, frozen=True, kw_only=True):
    """Hold the residual of one car in bins of the regressor of an effect."""

    car: str


class PartialResidual(ResidualBins, frozen=True):
    """Hold the partial residual of an effect: what the model and all missing effects leave, plus the effect."""

    per: Annotated[str, declare("`h` for values in W, `km` for values in Wh/km.")] = "h"
    quantity: Annotated[str, declare("Meaning of the coefficient.")] = "coefficient"
    summary: Annotated[str, declare("What the effect is.")] = ""
    unit: Annotated[str, declare("Unit of the coefficient.")] = "1"
    variant: Annotated[str, declare("Variant of the effect that fits best.")] = ""
    cars: Annotated[list[CarResidual], declare("The same of each car.")] = []


class NamedEffect(Record, frozen=True):
    """Hold an effect that is missing in all cars, beside the other missing ones."""

    effect: str
    variant: Annotated[str, declare("Variant of the effect that fits best.", "effect")] = ""
    scope: Annotated[list[str], declare("Where it is missing, as `--scope` takes it.", "for", "scope")] = []
    gain: Annotated[
        float | None, declare("Reduction of the squared error of rides on held-out days. [1]", "gain", "percent")
    ] = None
    gain_ci95: Annotated[ConfidenceInterval | None, declare("95 % interval of the gain. [1]")] = None
    energy_share: Annotated[
        float | None, declare("Its absolute energy over the measured energy. [1]", "of energy", "percent")
    ] = None
    coefficient: Annotated[EstimatedCoefficient, declare("Coefficient.", "coefficient", "coefficient")] = (
        EstimatedCoefficient()
    )
    probability: Annotated[
        float | None,
        declare("Probability that it is missing, whatever else is. [1]", "probability", "chance"),
    ] = None
    causes: Annotated[
        list[CauseProbability],
        declare("Effects that explain the same, or `none`; their probabilities, the largest first, sum to 1."),
    ] = []
    credible_set: Annotated[list[str], declare("Effects among which the missing one is in nine cases of ten.")] = []
    columns: Annotated[list[str], declare("Columns whose product is its energy per unit of the coefficient.")] = []
    effective_dates: Annotated[
        float | None, declare("Dates that hold its energy, each counted by its share. [1]", "dates", "two digits")
    ] = None
    z: Annotated[float | None, declare("Coefficient in standard errors. [1]")] = None
    words: Annotated[str, declare("Physical meaning of the coefficient.")] = ""
    equivalents: Annotated[list[str], declare("Power, mass and headwind of the same energy.")] = []
    separate: Annotated[list[RivalEffect], declare("Effects that the data do not distinguish from it.")] = []
    partial_residual: PartialResidual = PartialResidual()
    command: Annotated[str | None, declare("Command that adds it.")] = None
    commands: Annotated[list[str], declare("Commands that add it and run it as a shadow.")] = []

    @property
    def has_uncertain_gain(self) -> bool:
        """Whether held-out days do not show that it lowers the error of rides."""
        return self.gain_ci95 is not None and self.gain_ci95[0] <= 0.0

    @property
    def name(self) -> str:
        """Name of the effect, or of the variant of it that fits best."""
        return self.variant or self.effect

    @property
    def others(self) -> Annotated[list[str], declare("Other causes of the credible set.", "or else", "names")]:
        """Other effects among which the missing one is in nine cases of ten."""
        return [name for name in self.credible_set if name != self.effect]


class TestedEffect(Record, frozen=True):
    """Hold the test of an effect in all cars."""

    __test__ = False  # pytest collects classes whose name begins with Test

    effect: str
    variant: Annotated[str, declare("Variant that fits best.", "effect")] = ""
    z: Annotated[float | None, declare("Coefficient of it alone, in standard errors. [1]", "z", "score")] = None
    probability: Annotated[
        float | None, declare("Probability that it is missing, whatever else is. [1]", "probability", "chance")
    ] = None
    gain: Annotated[float | None, declare("Held-out gain of it alone. [1]", "gain", "fine percent")] = None
    status: Annotated[str, declare("Result of the test.", "result")] = ""


class SliceBias(Record, frozen=True):
    """Hold a group of rides on which the bias of a model differs."""

    where: Annotated[str, declare("Conditions in words.", "rides")]
    conditions: list[str] = []
    rides: Annotated[int, declare("Number of rides that confirmed it.", "rides", "count")] = 0
    bias_kwh: Annotated[
        float, declare("Mean error less that of all other rides. [kWh]", "bias, kWh", "signed", "ci95")
    ] = 0.0
    ci95: Annotated[ConfidenceInterval | None, declare("95 % interval of the bias. [kWh]")] = None
    mae_kwh: Annotated[
        float | None, declare("Mean absolute error of these rides. [kWh]", "error, kWh", "three digits")
    ] = None
    q: Annotated[float | None, declare("Rate of false slices up to this one. [1]", "q", "two digits")] = None

    @property
    def words(self) -> Annotated[str, declare("How the predictions compare with those for other rides.", "predicts")]:
        """How the predictions for these rides compare with those for all other rides."""
        return f"{abs(self.bias_kwh):.3g} kWh {'more' if self.bias_kwh > 0.0 else 'less'} than for other rides"


class BiasedBin(Record, frozen=True):
    """Hold a bin of rides whose bias differs from zero, as `socast compare` marks it."""

    condition: str
    bin: str
    rides: int = 0
    bias_kwh: Annotated[EstimatedValue, declare("Mean of predicted less measured. [kWh]")] = EstimatedValue()


class ErrorAfterEffect(Record, frozen=True):
    """Hold the error of rides with the missing effects up to one."""

    effect: Annotated[str | None, declare("Effect that this step adds; None for none.")] = None
    scope: Annotated[list[str], declare("Where it is missing, as `--scope` takes it.")] = []
    mae_kwh: Annotated[float | None, declare("Mean absolute error of a ride. [kWh]")] = None
    mae_ci95_kwh: Annotated[float | None, declare("Half width of its 95 % interval. [kWh]")] = None
    change_kwh: Annotated[float | None, declare("Change from the step before. [kWh]")] = None
    change_ci95_kwh: Annotated[float | None, declare("Half width of its 95 % interval. [kWh]")] = None
    noise_floor_kwh: Annotated[float | None, declare("Error that measurement noise causes. [kWh]")] = None


class ResidualProfile(Record, frozen=True):
    """Hold the mean remaining power in bins of a feature, or by the names of a category."""

    feature: str
    unit: Annotated[str, declare("Unit of `x`, empty for a category.")] = ""
    x: Annotated[list[float | str], declare("Means of bins, or names.")] = []
    before_w: Annotated[list[float], declare("Without what is named. [W]")] = []
    after_w: Annotated[list[float], declare("With what is named. [W]")] = []
    ci95_w: Annotated[list[float | None], declare("Half widths of the 95 % intervals of `after_w`. [W]")] = []
    windows: list[int] = []
    days: Annotated[list[int], declare("Numbers of vehicle-days.")] = []


class ShiftSize(Record, frozen=True):
    """Hold what one shift shows of a deviation by itself."""

    start_s: Annotated[float, declare("Begin of the shift. [Unix s]")] = 0.0
    share: Annotated[float, declare("Share of the energy of the shift. [1]")] = 0.0
    error: Annotated[float, declare("Standard error of the share. [1]")] = 0.0
    size: Annotated[float, declare("Size of the change in this shift, 1 for all of it. [1]")] = 0.0


class CarDeviation(Record, frozen=True):
    """Hold how a car or a group deviates from its siblings, or what changed since a date."""

    who: str
    of: Annotated[str, declare("`car`, `group` or `all`.")] = "car"
    kind: Annotated[str, declare("`always`, `step` or `ramp`.")] = "always"
    effect: Annotated[str, declare("Most probable cause.")] = ""
    causes: Annotated[
        list[CauseProbability],
        declare("Causes of the credible set, if the deviation is real; the most probable first."),
    ] = []
    q: Annotated[float | None, declare("Probability that it is not real. [1]")] = None
    z: Annotated[float | None, declare("Coefficient of `effect` in standard errors. [1]")] = None
    evidence: Annotated[float | None, declare("Logarithm of the Bayes factor, averaged over causes and dates. [1]")] = (
        None
    )
    tests: Annotated[int, declare("Number of tests.")] = 1
    coefficient: EstimatedCoefficient = EstimatedCoefficient()
    words: Annotated[str, declare("Physical meaning of the coefficient.")] = ""
    since: Annotated[str | None, declare("Date of the change; None for what was always so. [UTC]")] = None
    since_ci90: Annotated[tuple[str, str] | None, declare("90 % range of the date. [UTC]")] = None
    columns: Annotated[list[str], declare("Columns of the term that holds it; empty where none can.")] = []
    days: Annotated[float | None, declare("Time from the first to the last shift that it concerns. [days]")] = None
    share: Annotated[float | None, declare("Net energy over the energy of these rides. [1]")] = None
    share_ci95: Annotated[ConfidenceInterval | None, declare("95 % interval of `share`. [1]")] = None
    kwh_per_km: Annotated[float | None, declare("Net energy per distance. [kWh/km]")] = None
    kwh_per_km_ci95: Annotated[ConfidenceInterval | None, declare("95 % interval of `kwh_per_km`. [kWh/km]")] = None
    kwh_per_month: Annotated[float | None, declare("Net energy per month. [kWh/month]")] = None
    kwh_per_month_ci95: Annotated[ConfidenceInterval | None, declare("95 % interval. [kWh/month]")] = None
    share_per_month: Annotated[float | None, declare("Growth of a ramp. [1/month]")] = None
    share_per_month_ci95: Annotated[ConfidenceInterval | None, declare("95 % interval. [1/month]")] = None
    shifts: Annotated[list[ShiftSize], declare("What each shift of a car shows by itself.")] = []
    command: Annotated[str | None, declare("Command that adds it.")] = None
    commands: Annotated[list[str], declare("Commands that add it and run it as a shadow.")] = []


class DirectionSpread(Record, frozen=True):
    """Hold how far a car deviates in one direction, in standard deviations between cars."""

    direction: str
    value: Annotated[float, declare("Deviation. [spreads]")] = 0.0
    error: Annotated[float, declare("Its standard error. [spreads]")] = 0.0


class RankedCar(Record, frozen=True):
    """Hold how a car compares with its siblings."""

    car: str
    siblings: int = 0
    evidence: Annotated[float | None, declare("Logarithm of the Bayes factor for a deviation. [1]")] = None
    share: Annotated[float | None, declare("Energy beyond that of the siblings, by its random effects. [1]")] = None
    share_ci95: Annotated[ConfidenceInterval | None, declare("95 % interval of `share`. [1]")] = None
    share_spread: Annotated[float | None, declare("Standard deviation of `share` between cars. [1]")] = None
    spreads: list[DirectionSpread] = []


class FoundEpisode(Record, frozen=True):
    """Hold hours of a few dates in which the power is off beyond every effect of the library."""

    dates: Annotated[list[str], declare("Dates. [UTC]")] = []
    hours_utc: Annotated[tuple[int, int] | None, declare("First and last hour. [h UTC]")] = None
    whole_dates: Annotated[bool, declare("Whether all hours are concerned.")] = False
    car: Annotated[str | None, declare("The only car that shows it, if any.")] = None
    cars: list[str] = []
    cars_driving: Annotated[int, declare("Number of cars that drove then.")] = 0
    windows: int = 0
    rides: Annotated[list[str], declare("Keys of the rides, the largest part first.")] = []
    power_kw: Annotated[float | None, declare("Mean power beyond the model. [kW]")] = None
    power_ci95_kw: Annotated[ConfidenceInterval | None, declare("95 % interval of the power. [kW]")] = None
    share: Annotated[float | None, declare("Share of the squared error of rides after refitting. [1]")] = None
    chance: Annotated[float | None, declare("Probability of so clear an episode by chance. [1]")] = None
    command: Annotated[str | None, declare("Command that shows the ride with the largest part of it.")] = None


class LocatedLoad(Record, frozen=True):
    """Hold a load that differs between the units of a level."""

    level: Annotated[str, declare("`car`, `driver`, `date`, `day` (of one vehicle) or `ride`.")]
    kind: Annotated[str, declare("Name of the kind, see `socast.core.diagnose.error_location.kinds`.")]
    size: Annotated[float, declare("Standard deviation between the units, in `unit`.")] = 0.0
    low: Annotated[float, declare("Lower end of its 95 % interval, in `unit`.")] = 0.0
    high: Annotated[float, declare("Upper end of its 95 % interval, in `unit`.")] = 0.0
    unit: Annotated[str, declare("W, or % of the energy of the kind by catalogue.")] = "W"
    size_w: Annotated[float, declare("`size` as a mean power. [W]")] = 0.0
    low_w: Annotated[float, declare("`low` as a mean power. [W]")] = 0.0
    high_w: Annotated[float, declare("`high` as a mean power. [W]")] = 0.0
    gain: Annotated[float, declare("Loss of minus twice the log likelihood without it; 0 if not selected.")] = 0.0
    claimed: Annotated[bool, declare("Whether the interval lies above the floor.")] = False
    other_kinds: Annotated[tuple[str, ...], declare("Kinds that explain the data about as well.")] = ()
    other_levels: Annotated[tuple[str, ...], declare("Levels that explain the data about as well.")] = ()
    floor_w: Annotated[float, declare("Size that drives show without such a load, as a mean power. [W]")] = 0.0


class ErrorLocation(Record, frozen=True):
    """Hold between which units, and by which kind of load, the error of a model varies."""

    loads: Annotated[tuple[LocatedLoad, ...], declare("Claimed loads, the largest first.")] = ()
    estimates: Annotated[tuple[LocatedLoad, ...], declare("All levels and kinds that the data can tell.")] = ()
    shares: Annotated[
        dict[str, float],
        declare(
            "Shares of the squared error of refitted rides: `measurement`, `scatter` within rides beyond it, and each "
            "level with a claimed load. [1]"
        ),
    ] = {}
    levels: Annotated[tuple[str, ...], declare("Levels that the data can tell.")] = ()
    absent_kinds: Annotated[tuple[str, ...], declare("Kinds without energy in these drives.")] = ()
    absent_signals: Annotated[tuple[str, ...], declare("Signals that most rides lack.")] = ()
    partial_signals: Annotated[
        dict[str, tuple[int, int]], declare("Absent signals -> number of rides that have them, and of all rides.")
    ] = {}
    noise_limited: Annotated[bool, declare("Whether the share of the measurement noise is an upper limit.")] = False


class UnknownCause(Record, frozen=True):
    """Hold what is missing and not in the library: a form in all cars, or what an implausible effect stands for."""

    formula: Annotated[
        str, declare("Power of the form that fits best, or an effect with an implausible coefficient.", "form")
    ]
    probability: Annotated[
        float | None,
        declare("Probability that something like it is missing. [1]", "probability", "chance"),
    ] = None
    energy_share: Annotated[
        float | None,
        declare("Its energy over the measured energy. [1]", "of energy", "percent", "energy_share_ci95"),
    ] = None
    energy_share_ci95: Annotated[ConfidenceInterval | None, declare("95 % interval of this share. [1]")] = None
    coefficient: Annotated[EstimatedCoefficient, declare("Coefficient c.", "c", "coefficient")] = EstimatedCoefficient()
    resembles: Annotated[
        str | None, declare("Effect of the library on the same load with a similar energy.", "resembles")
    ] = None
    forms: Annotated[
        dict[str, float], declare("Forms that fit the same -> share of the probability, the largest first. [1]")
    ] = {}
    symbols: Annotated[dict[str, str], declare("Symbols of the formula -> their meanings.")] = {}
    file: Annotated[str, declare("Source of an effect of this form.")] = ""


class DiagnosedModel(Record, frozen=True):
    """Identify the model that was diagnosed."""

    name: str = ""
    version: str = ""
    recipe: str | None = None
    implausible: Annotated[list[str], declare("Coefficients outside their plausible ranges, in words.")] = []


class HeldOutRides(Record, frozen=True):
    """Hold which rides a diagnosis did not use."""

    dates: list[str] = []
    rides: int = 0
    final: Annotated[bool, declare("Whether they are kept for the last evaluation of an added effect.")] = False
    in_history: Annotated[bool, declare("Whether the history of the model names these dates.")] = False


class DiagnosedData(Record, frozen=True):
    """Hold which rides were diagnosed, and how their energy was measured."""

    rides: int = 0
    windows: int = 0
    vehicles: int = 0
    days: Annotated[int, declare("Number of vehicle-days.")] = 0
    first_date: str | None = None
    last_date: str | None = None
    measured: Annotated[str, declare("`vi` (voltage and current), `soc` or `mixed`.")] = ""
    resolution_s: Annotated[float | None, declare("Median length of a window. [s]")] = None
    resolution: Annotated[str, declare("How the energy was measured, in words.")] = ""
    left_out: Annotated[dict[str, int], declare("Reason -> number of rides left out.")] = {}
    dated: Annotated[bool, declare("Whether the dates are known, not invented.")] = True
    held_out: HeldOutRides = HeldOutRides()


class ErrorSummary(Record, frozen=True):
    """Hold the error of a model per ride."""

    mae_kwh: Annotated[float | None, declare("Mean absolute error. [kWh]")] = None
    relative: Annotated[float | None, declare("Mean absolute error over mean energy. [1]")] = None
    bias_kwh: Annotated[float | None, declare("Mean of predicted less measured. [kWh]")] = None
    mae_refitted_kwh: Annotated[float | None, declare("The same terms refitted to these rides, in sample. [kWh]")] = (
        None
    )
    noise_floor_kwh: Annotated[float | None, declare("Error that measurement noise alone causes. [kWh]")] = None


class Diagnosis(Record, frozen=True):
    """Hold where a model errs, which effects it lacks, how certain that is, and what error remains."""

    model: DiagnosedModel = DiagnosedModel()
    data: DiagnosedData = DiagnosedData()
    episodes: Annotated[list[FoundEpisode], declare("Hours of a few dates, the clearest first.")] = []
    error: ErrorSummary = ErrorSummary()
    error_location: ErrorLocation = ErrorLocation()
    slices: Annotated[list[SliceBias], declare("Groups of rides with another bias, the most certain first.")] = []
    biased_bins: Annotated[list[BiasedBin], declare("Bins whose bias differs from zero, the largest first.")] = []
    missing: Annotated[
        list[NamedEffect], declare("Effects missing in all cars, in the order in which to add them.")
    ] = []
    tested: Annotated[list[TestedEffect], declare("All effects, the most probable first.")] = field(
        name="candidates", default_factory=list
    )
    verdict: Annotated[str | None, declare("The effect to add first, if any.")] = None
    causes: Annotated[
        list[CauseProbability],
        declare(
            "Effects that explain what the first missing one does, or `none`; without one, those that may be missing."
        ),
    ] = []
    credible_set: Annotated[list[str], declare("Causes among which the missing one is in nine cases of ten.")] = []
    further: Annotated[
        list[CauseProbability], declare("Effects that may be missing beside the named ones, or `none`.")
    ] = []
    further_credible_set: list[str] = []
    unknown: Annotated[
        list[UnknownCause], declare("What is missing and not in the library, the most probable first.")
    ] = []
    steps: Annotated[list[ErrorAfterEffect], declare("How the error falls, effect by effect.")] = []
    profiles: Annotated[list[ResidualProfile], declare("Mean residual along each feature.")] = []
    deviations: Annotated[list[CarDeviation], declare("Cars and groups that deviate or changed.")] = []
    cars: Annotated[list[RankedCar], declare("All cars, the one that deviates most first.")] = []
    headline: Annotated[list[str], declare("Sentences with which the report begins.")] = []
    next_step: Annotated[list[str], declare("What to do next, with commands.")] = []

    @property
    def leading(self) -> NamedEffect | None:
        """The missing effect that the verdict names, if any; `find_leading` tells whether a deviation comes first."""
        return next((one for one in self.missing if one.effect == self.verdict), None)

    @property
    def errors(self) -> pd.DataFrame:
        """How the error of rides falls, one row for each effect that is added. [kWh]"""
        frame = make_frame(self.steps)
        frame.insert(1, "scope", [step.scope for step in self.steps])
        return frame

    @property
    def candidates(self) -> pd.DataFrame:
        """All effects that were tested, one row each, with z, probability and held-out gain."""
        return make_frame(self.tested)

    @property
    def coefficients(self) -> pd.DataFrame:
        """Coefficients of the missing effects, one row each, with interval, unit and plausible range."""
        frame = make_frame([one.coefficient for one in self.missing])
        limits = [one.coefficient.ci95 or (None, None) for one in self.missing]
        frame["ci95_low"], frame["ci95_high"] = [low for low, _ in limits], [high for _, high in limits]
        frame.insert(0, "effect", [one.name for one in self.missing])
        return frame
