"""Declare the result of a campaign: how much the consumption of cars changed, beside campaigns that were none."""

from typing import Annotated

from socast.core.records import ConfidenceInterval, Record, declare

INTERVAL = "interval of percent"
"""Format of the intervals below in tables."""


class CarChange(Record, frozen=True):
    """Hold the change of the consumption of a car, or of several together, at equal conditions."""

    vehicle_id: Annotated[str, declare("Vehicle, or `all` of several together.", "car")]
    change: Annotated[float, declare("Consumption after over before, less one. [1]", "change", "signed percent")]
    ci90: Annotated[ConfidenceInterval, declare("90 % interval of the change. [1]", "90 % interval", INTERVAL)]
    ci95: Annotated[ConfidenceInterval, declare("95 % interval of the change. [1]", "95 % interval", INTERVAL)]
    ratio: Annotated[float, declare("Logarithm of the factor over its standard error by the model. [1]")]
    days_before: Annotated[int, declare("Days with measurements before, or off.", "days before", "count")]
    days_after: Annotated[int, declare("Days with measurements after, or on.", "days after", "count")]
    siblings: Annotated[int, declare("Cars of the same vehicle model to compare with.", "siblings", "count")]
    per_100km_kwh: Annotated[
        float | None, declare("Measured energy of the days after over their distance. [kWh/100 km]")
    ] = None

    @property
    def is_shown(self) -> bool:
        """Whether the 90 % interval excludes zero."""
        return self.ci90[0] > 0.0 or self.ci90[1] < 0.0

    @property
    def extra_per_100km_kwh(self) -> tuple[float, float, float] | None:
        """What the change makes of the consumption of the days after, with its 90 % interval. [kWh/100 km]"""
        if self.per_100km_kwh is None:
            return None
        extra, low, high = (self.per_100km_kwh * each / (1.0 + each) for each in (self.change, *self.ci90))
        return extra, low, high


class PlaceboCampaign(Record, frozen=True):
    """Hold the estimate of a campaign that was none."""

    vehicle_id: str
    shift_days: Annotated[int, declare("Days by which its date is later than that of the campaign. [d]")]
    change: Annotated[float, declare("Estimated change. [1]")]
    ratio: Annotated[float, declare("Logarithm of the factor over its standard error by the model. [1]")]


class PlaceboSpread(Record, frozen=True):
    """Hold what the placebo campaigns say of the standard error."""

    campaigns: list[PlaceboCampaign]
    independent: Annotated[float, declare("Number of independent campaigns with as uncertain a spread.")]
    spread: Annotated[float | None, declare("Root mean square of their ratios. [1]")]
    scale: Annotated[float, declare("Factor by which the standard error of the model is multiplied. [1]")]
    freedom: Annotated[float, declare("Degrees of freedom of the interval.")]
    as_large: Annotated[int, declare("Number of campaigns with a ratio as large as that of the campaign.")]


class DetectionTime(Record, frozen=True):
    """Hold how long a change of some size takes to be seen."""

    size: Annotated[float, declare("Size of the change. [1]")]
    days: Annotated[int | None, declare("Days after the date, None for more than a year. [d]")]


class LevelPath(Record, frozen=True):
    """Hold the smoothed level of a car before the campaign, or after its begin, beside the estimated level before."""

    date: Annotated[list[str], declare("ISO dates.")]
    level: Annotated[list[float], declare("Level. [1]")]
    low: Annotated[list[float], declare("Lower end of its 90 % interval. [1]")]
    high: Annotated[list[float], declare("Upper end of its 90 % interval. [1]")]


class CarSeries(Record, frozen=True):
    """Hold the days of a car beside its siblings."""

    vehicle_id: str
    date: Annotated[list[str], declare("ISO dates.")]
    deviation: Annotated[list[float], declare("Consumption over that of the siblings and before, less one. [1]")]
    after: Annotated[list[bool], declare("Whether the day is after the begin of the campaign, or on.")]
    level_before: LevelPath
    level_after: LevelPath


class BeforeAfter(Record, frozen=True):
    """Hold the answer to the question whether the consumption of cars changed with a campaign."""

    vehicles: list[str]
    model: Annotated[str, declare("Model whose prediction stands for equal conditions.")]
    at: Annotated[str | None, declare("ISO date of the campaign, None for days on and off.")]
    until: Annotated[str | None, declare("ISO date of the last day that counts, None for all.")]
    what: Annotated[str, declare("What was done, in the words of the user.")]
    last_date: Annotated[str, declare("ISO date of the last rides.")]
    change: Annotated[CarChange | None, declare("Change of all cars together, None before the campaign.")]
    cars: list[CarChange]
    placebo: PlaceboSpread
    detection: list[DetectionTime]
    series: list[CarSeries]
    notes: Annotated[list[str], declare("What limits the answer.")]
