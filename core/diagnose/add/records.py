"""Declare the trial of an effect and the history of a model: the errors of rides before and after, and the outcome."""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Final

from socast.core.diagnose.add.terms import name_scoped
from socast.core.diagnose.records import EstimatedCoefficient
from socast.core.evaluate.records import EstimatedValue
from socast.core.fit.records import read_history_entry
from socast.core.models import LinearModel
from socast.core.models.features import list_scope
from socast.core.records import Record, declare

ADDED: Final = "add"
REFUSED: Final = "refused"
UNDECIDED: Final = "undecided"
"""Outcomes of a trial, and actions in the history of a model."""
ATTEMPTS: Final = (ADDED, REFUSED, UNDECIDED)


class RemovedShare(Record, frozen=True):
    """Hold the share of the error above the noise that a step removed. [1]"""

    value: float | None = None
    low: Annotated[float | None, declare("Lower end of its 95 % interval. [1]")] = None
    high: Annotated[float | None, declare("Upper end of its 95 % interval. [1]")] = None


class ErrorFall(Record, frozen=True):
    """Hold the errors of two models on the same rides, and how far the second one is nearer to the noise."""

    rides: Annotated[int, declare("Number of rides.", "rides", "count")] = 0
    clusters: Annotated[int, declare("Number of vehicle-days.", "vehicle-\ndays", "count")] = 0
    mae_before_kwh: Annotated[
        float | None, declare("Mean absolute error of a ride before. [kWh]", "before,\nkWh", "four decimals")
    ] = None
    mae_after_kwh: Annotated[float | None, declare("The same after. [kWh]", "after,\nkWh", "four decimals")] = None
    fall: Annotated[float | None, declare("Fall of this error as a share of it. [1]")] = None
    change_kwh: Annotated[
        EstimatedValue, declare("After less before. [kWh]", "change,\nkWh", "difference, four decimals")
    ] = EstimatedValue()
    noise_kwh: Annotated[
        float | None, declare("Mean absolute error that measurement noise alone causes on these rides. [kWh]")
    ] = None
    above_before_kwh: Annotated[EstimatedValue, declare("Error above the noise before. [kWh]")] = EstimatedValue()
    above_after_kwh: Annotated[EstimatedValue, declare("Error above the noise after. [kWh]")] = EstimatedValue()
    removed: Annotated[
        RemovedShare,
        declare("Unknown where nothing beyond noise was there before, and where the noise is overestimated."),
    ] = RemovedShare()

    @property
    def relative_change(self) -> Annotated[float | None, declare("Change. [1]", "change", "signed percent")]:
        """Change of the error as a share of the error before. [1]"""
        before, after = self.mae_before_kwh, self.mae_after_kwh
        return None if after is None or not before else after / before - 1.0

    @property
    def is_noise_overestimated(self) -> bool:
        """Whether the error is clearly below the noise, which every error contains."""
        limits = (self.above_before_kwh.interval, self.above_after_kwh.interval)
        return any(each is not None and each[1] < 0.0 for each in limits)

    @property
    def is_noise_reached(self) -> bool:
        """Whether the error after the step is not distinguished from that of measurement noise alone."""
        after = self.above_after_kwh.interval
        return not self.is_noise_overestimated and after is not None and after[0] <= 0.0


class FinalErrorFall(ErrorFall, frozen=True):
    """Hold the errors on the final hold-out days, to which nothing was fitted."""

    dates: Annotated[tuple[str, ...], declare("ISO dates.")] = ()


class ConditionErrorFall(ErrorFall, frozen=True, kw_only=True):
    """Hold the errors of the rides in a bin of a condition."""

    where: Annotated[str, declare("Bin.")]


class EffectAttempt(Record, frozen=True):
    """Hold an effect that was tried on a model, as the history of its file does."""

    action: Annotated[str, declare("`add`, `refused` or `undecided`; `add` also where it was added by force.")] = ""
    effect: str = ""
    columns: Annotated[tuple[str, ...], declare("Columns of its term.")] = ()
    rides: int = 0
    windows: Annotated[int, declare("Number of rows fitted to.")] = 0
    vehicles: int = 0
    first_date: str | None = None
    last_date: str | None = None
    gain: Annotated[
        EstimatedValue, declare("Share of the squared error of rides that it explains on held-out days. [1]")
    ] = EstimatedValue()
    p: Annotated[float | None, declare("p-value of the coefficient. [1]")] = None
    mae_before_kwh: Annotated[float | None, declare("As `of_effect`. [kWh]", "before,\nkWh", "four decimals")] = None
    mae_after_kwh: Annotated[float | None, declare("As `of_effect`. [kWh]", "after,\nkWh", "four decimals")] = None
    change_kwh: Annotated[
        EstimatedValue, declare("As `of_effect`. [kWh]", "change,\nkWh", "difference, four decimals")
    ] = EstimatedValue()
    noise_floor_kwh: Annotated[
        float | None, declare("Error that noise alone causes. [kWh]", "noise,\nkWh", "four decimals")
    ] = None
    of_effect: Annotated[ErrorFall, declare("Held-out days, to which the coefficient is not fitted.")] = ErrorFall()
    on_days: Annotated[ErrorFall, declare("Held-out days, to which nothing is fitted.")] = ErrorFall()
    on_vehicles: Annotated[ErrorFall | None, declare("Held-out vehicles; None for an effect of one vehicle.")] = None
    final: Annotated[
        FinalErrorFall | None, declare("Final hold-out days, if any.", "final,\nkWh", "before and after")
    ] = None
    mae_given_kwh: Annotated[float | None, declare("Error of the model as given on the held-out days. [kWh]")] = None
    outcome: Annotated[str, declare("`add`, `refused` or `undecided`.")] = ""
    accepted: Annotated[bool, declare("Whether the outcome is `add`.")] = False
    reason: Annotated[str, declare("Why.")] = ""
    coefficient: EstimatedCoefficient = EstimatedCoefficient()
    words: Annotated[str, declare("Physical meaning of the coefficient.")] = ""
    by_vehicle_model: Annotated[
        dict[str, EstimatedCoefficient], declare("Vehicle models with a coefficient of their own.")
    ] = {}
    least_gain: Annotated[float | None, declare("Least gain of an accepted effect. [1]")] = None
    seed: int = 0
    fingerprint: Annotated[str, declare("SHA-256 of the columns fitted to.")] = ""
    from_version: Annotated[str, declare("Version of the model to which it was to be added.")] = ""
    forced: Annotated[bool, declare("Whether it was added although the trial did not accept it.")] = False

    @property
    def result(self) -> Annotated[str, declare("What was done.", "result")]:
        """Past participle of what was done with the effect."""
        return "added although not accepted" if self.forced else "added" if self.action == ADDED else self.action

    @property
    def scope(self) -> list[str]:
        """Where it holds, such as `vehicle=taxi-003`; empty for everywhere."""
        return list_scope(self.columns)

    @property
    def name(self) -> str:
        """The effect with its scope, unless it holds everywhere."""
        return name_scoped(self.effect, self.scope)

    def to_json(self) -> dict[str, Any]:
        """Return the record as the JSON values of a history, with its scope; `forced` only where it is true."""
        values = {key: value for key, value in super().to_json().items() if key != "forced" or value}
        return values | {"scope": self.scope}


class EffectTrial(EffectAttempt, frozen=True):
    """Hold the trial of an effect: what its entry in the history of the model has, and more for the reader."""

    conditions: Annotated[
        dict[str, list[ConditionErrorFall]], declare("Condition -> errors on held-out days in its bins.")
    ] = {}
    words_by_vehicle_model: Annotated[dict[str, str], declare("Meanings of `by_vehicle_model`.")] = {}
    warnings: Annotated[list[str], declare("What implausible coefficients may mean.")] = []

    def to_entry(self) -> dict[str, Any]:
        """Return the entry in the history of a model."""
        return {
            key: value for key, value in self.to_json().items() if key in {*EffectAttempt.__struct_fields__, "scope"}
        }


class ModelHistory(Record, frozen=True):
    """Hold the steps of a model, and its errors on held-out days before the first and after the last addition."""

    model: str
    version: str
    recipe: str
    mae_first_kwh: float | None = None
    mae_last_kwh: float | None = None
    noise_floor_kwh: Annotated[float | None, declare("Error that measurement noise alone causes. [kWh]")] = None
    steps: Annotated[list[dict[str, Any]], declare("Entries of the model file, the oldest first.")] = []


def list_attempts(history: Sequence[Mapping[str, Any]]) -> list[EffectAttempt]:
    """Return the effects that were tried on a model, the oldest first; what an entry lacks is unknown."""
    return [read_history_entry(entry, EffectAttempt) for entry in history if entry.get("action") in ATTEMPTS]


def summarise_history(model: LinearModel) -> ModelHistory:
    """Return the steps of a model, and how far its error fell."""
    tried = list_attempts(model.history)
    added = [each for each in tried if each.action == ADDED]
    return ModelHistory(
        model=model.name,
        version=model.version,
        recipe=model.recipe,
        mae_first_kwh=tried[0].mae_before_kwh if tried else None,
        mae_last_kwh=added[-1].mae_after_kwh if added else None,
        noise_floor_kwh=tried[-1].noise_floor_kwh if tried else None,
        steps=list(model.history),
    )
