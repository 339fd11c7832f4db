"""Declare the truth of a recording with a known effect in it, and what a diagnosis finds of it."""

from typing import Annotated, Final

from socast.core.diagnose.records import EstimatedCoefficient
from socast.core.records import ConfidenceInterval, Record, declare

VISIBLE: Final = 20.0
"""Likelihood ratio from which data can show an effect. [1]"""


class SpikedDrive(Record, frozen=True):
    """Hold a drive with the effect."""

    vehicle_id: str
    begin_s: Annotated[float, declare("Time of its first sample. [Unix s]")]
    end_s: Annotated[float, declare("Time of its last sample. [Unix s]")]
    energy_kwh: Annotated[float, declare("Energy of the effect. [kWh]")]


class SpikeTruth(Record, frozen=True):
    """Hold what was put into a recording."""

    effect: str
    size: Annotated[float, declare("Energy of the effect over that of the cars and times that have it. [1]")]
    vehicles: Annotated[tuple[str, ...], declare("Cars that have it; empty for all.")]
    since_s: Annotated[float | None, declare("Time from which they have it; null for always. [Unix s]")]
    seed: int
    factor: Annotated[float, declare("Factor of the natural size of the effect. [1]")]
    made_weather: Annotated[bool, declare("Whether a made-up weather station was added.")]
    fields: Annotated[dict[str, str], declare("Car -> field of telemetry that was changed.")]
    samples: Annotated[int, declare("Number of samples that were changed.")]
    drives: list[SpikedDrive]


class PlaceboName(Record, frozen=True):
    """Hold what a diagnosis of the recording as it is names."""

    effect: Annotated[str, declare("Effect.", "effect")]
    where: Annotated[str, declare("Car and date, or all cars.", "where")]
    probability: Annotated[float, declare("Probability that it is missing. [1]", "probability", "chance")]
    coefficient: Annotated[EstimatedCoefficient, declare("Its coefficient.", "coefficient", "coefficient")] = (
        EstimatedCoefficient()
    )
    halves: Annotated[
        int | None, declare("In how many of two halves of the dates it is named; None for a change.", "halves", "count")
    ] = None


class SpikeScore(Record, frozen=True):
    """Hold what a diagnosis finds of one effect that was put in, against the recording without it."""

    effect: Annotated[str, declare("Effect that was put in, with its form.", "put in")]
    size: Annotated[float, declare("Its energy over that of the affected cars and times. [1]", "size", "percent")]
    since: str | None = None
    seed: int = 0
    visible: Annotated[
        bool, declare("Whether the likelihood ratio of the true energies, against the placebo, exceeds 20.")
    ] = False
    evidence: Annotated[float | None, declare("Logarithm of that ratio.", "evidence", "score")] = None
    form_evidence: Annotated[
        float | None,
        declare("The same of the formula of the library that resembles it most.", "evidence of the formula", "score"),
    ] = None
    plausible: Annotated[
        bool, declare("Whether an effect of the library explains it with a coefficient in its plausible range.")
    ] = False
    rank: Annotated[int | None, declare("Place among the names; None if it is not named.", "rank", "count")] = None
    new_rank: Annotated[int | None, declare("Place among the names that the placebo does not have.")] = None
    probability: Annotated[float | None, declare("Probability of its name. [1]", "probability", "chance")] = None
    in_credible_set: Annotated[bool, declare("Whether a credible set of 90 % holds its name.")] = False
    coefficient: Annotated[EstimatedCoefficient | None, declare("Its coefficient.", "coefficient", "coefficient")] = (
        None
    )
    true_coefficient: Annotated[
        float | None, declare("Coefficient of the library that resembles what was put in, in its unit.")
    ] = None
    ratio: Annotated[
        float | None, declare("Spiked less placebo over true coefficient. [1]", "size / truth", "two digits")
    ] = None
    covered: Annotated[bool | None, declare("Whether the 95 % interval, less the placebo, holds the truth.")] = None
    found_since: Annotated[str | None, declare("Date of the change that is named. [UTC]", "since")] = None
    way: Annotated[
        float | None,
        declare("Fall of the error by the named effect over that by the true energies. [1]", "of the way", "percent"),
    ] = None
    methods: Annotated[dict[str, bool], declare("Other method -> whether its first new name is right.")] = {}
    others: Annotated[list[str], declare("Further names that the placebo does not have.", "also", "names")] = []


class FoundShare(Record, frozen=True):
    """Hold how many effects of one size are found."""

    size: Annotated[float, declare("Size of the effects. [1]", "size", "percent")]
    tried: Annotated[int, declare("Number of effects.", "tried", "count")]
    visible: Annotated[int, declare("Number that these data can show.", "visible", "count")]
    named: Annotated[int, declare("Number of visible ones that are named.", "named", "count")]
    first: Annotated[int, declare("Number of visible ones that are the first new name.", "first", "count")]
    share: Annotated[
        float | None, declare("Share of the visible ones that are named. [1]", "share", "whole percent")
    ] = None
    share_ci95: Annotated[ConfidenceInterval | None, declare("95 % interval of the share. [1]")] = None


class SpikeScores(Record, frozen=True):
    """Hold how well a diagnosis finds known effects in the recording of a user."""

    recordings: list[str] = []
    rides: int = 0
    days: Annotated[int, declare("Number of vehicle-days.")] = 0
    cars: int = 0
    recipe: Annotated[str, declare("Recipe of the model that is diagnosed.")] = ""
    placebo: list[PlaceboName] = []
    scores: list[SpikeScore] = []
    found: list[FoundShare] = []
    refused: Annotated[dict[str, str], declare("Effect -> why it cannot be put in.")] = {}
