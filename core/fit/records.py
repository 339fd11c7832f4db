"""Declare what a fit tells: the entry in the history of a model, and its coefficients with intervals and errors."""

from collections.abc import Mapping
from typing import Annotated, Any, TypeVar

import msgspec

from socast.core.errors import ModelError
from socast.core.models import LinearModel
from socast.core.models.limit import EnergyLimit
from socast.core.models.linear import Training
from socast.core.records import ConfidenceInterval, PartialRecord, Record, declare

_Step = TypeVar("_Step", bound=Record)


class FitStep(PartialRecord, frozen=True):
    """Hold how a model was fitted or adapted, as the history of its file does."""

    action: Annotated[str, declare("`fit` or `adapt`.")] = ""
    recipe: str = ""
    mae_in_sample_kwh: Annotated[
        dict[str, float] | None, declare("Vehicle model -> mean absolute error of the rides fitted to. [kWh]")
    ] = None
    rows: Annotated[str, declare("`windows` or `rides`, where the recipe can be fitted to both.")] = ""
    rides: Annotated[dict[str, int] | None, declare("Vehicle model -> number of rides adapted to.")] = None


class FittedCoefficient(Record, frozen=True):
    """Hold a coefficient of a fit. The interval of a fit to windows ends where the plausible range does."""

    term: str
    unit: str
    value: float
    ci95: Annotated[
        float | None, declare("Half width of the 95 % interval; None without one, or if it ends at a limit.")
    ] = None
    low: Annotated[float | None, declare("Lower end of the interval.")] = None
    high: Annotated[float | None, declare("Upper end of the interval.")] = None
    at_limit: Annotated[bool, declare("Whether the coefficient stopped at a limit.")] = False
    range: Annotated[ConfidenceInterval | None, declare("Plausible range.")] = None
    plausible: Annotated[bool, declare("Whether the value lies in it.")] = True


class Determination(Record, frozen=True):
    """Hold how far the rides of a fit determine a coefficient, and what would determine it.

    A coefficient is determined where its standard deviation is at most half that of its prior.
    """

    name: Annotated[str, declare("Term of the model, or level of the accessory curve.")]
    sd_over_prior: Annotated[float, declare("Standard deviation over that of the prior. [1]")]
    determined: bool
    days: Annotated[
        int | None, declare("Number of more days like those of the fit that determine it; None for more than 200.")
    ] = None
    drive: Annotated[str, declare("Kind of a drive of 30 min that determines it soonest; empty for none.")] = ""
    drives: Annotated[int | None, declare("Number of such drives; None for more than 10.")] = None
    missing: Annotated[str, declare("What the rides lack, so that no drive determines it.")] = ""


class FittedCurve(Record, frozen=True):
    """Hold the accessory power of a fit over the outside temperature."""

    heating_full_c: Annotated[float, declare("Temperature below which heating is full. [°C]", "heating full")]
    heating_off_c: Annotated[float, declare("Temperature from which heating is off. [°C]", "heating off")]
    cooling_on_c: Annotated[float, declare("Temperature from which cooling is on. [°C]", "cooling on")]
    cooling_full_c: Annotated[float, declare("Temperature from which cooling is full. [°C]", "cooling full")]
    heating_w: Annotated[float, declare("Power of full heating. [W]", "heating", "count")]
    standby_w: Annotated[float, declare("Power without either. [W]", "standby", "count")]
    cooling_w: Annotated[float, declare("Power of full cooling. [W]", "cooling", "count")]


class VehicleModelFit(Record, frozen=True):
    """Hold the fit of a model to the rides of one vehicle model, or of all."""

    rides: int
    mae_in_sample_kwh: Annotated[float | None, declare("Mean absolute error of the rides fitted to. [kWh]")]
    residual_sd_kwh: Annotated[float | None, declare("Standard deviation of their residuals. [kWh]")]
    clusters: Annotated[int | None, declare("Number of groups within which errors may depend on each other.")]
    held: Annotated[tuple[str, ...], declare("Terms that the data do not determine.")]
    dropped: Annotated[tuple[str, ...], declare("Terms whose column does not vary.")]
    limit: Annotated[EnergyLimit | None, declare("Largest energy that it predicts.")]
    converged: bool
    limited: Annotated[tuple[str, ...], declare("What stopped at an end of its plausible range.")]
    curve: FittedCurve | None
    coefficients: list[FittedCoefficient]
    determined: Annotated[
        list[Determination], declare("How far the rides determine each coefficient, for recipes with priors.")
    ] = []


class FitSummary(Record, frozen=True):
    """Hold the fits of a model, and the rides that it was fitted to."""

    recipe: str
    title: str
    version: str
    rows: Annotated[str, declare("What it was fitted to, `rides` or `windows`.")]
    training: Training | None
    fits: Annotated[dict[str, VehicleModelFit], declare("Vehicle model, `*` for any other -> its fit.")]


def read_history_entry(entry: Mapping[str, Any], kind: type[_Step]) -> _Step:
    """Return an entry in the history of a model as a record; what it lacks is unknown."""
    try:
        return msgspec.convert({key: value for key, value in entry.items() if value is not None}, kind)
    except msgspec.ValidationError as error:
        raise ModelError(f"the history of the model is damaged: {error}: fit the model again") from error


def read_fit_step(entry: Mapping[str, Any]) -> FitStep:
    """Return an entry in the history of a model that fitted or adapted it; an empty step for any other."""
    return read_history_entry(entry, FitStep) if entry.get("action") in {"fit", "adapt"} else FitStep()


def find_fit_step(model: LinearModel) -> FitStep:
    """Return how a model was fitted, an empty step where its history does not hold that."""
    return next((read_fit_step(entry) for entry in model.history if entry.get("action") == "fit"), FitStep())
