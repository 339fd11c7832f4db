"""Declare the result of an evaluation of recipes: Tables 2 to 13 and Figure 1 of the paper, and analyses beyond it."""

from typing import Annotated

import pandas as pd

from socast.core.evaluate.records import EstimatedValue, RelativeErrors, make_estimate_frame
from socast.core.records import PartialRecord, Record, declare

Numbers = dict[str, dict[str, float | None]]
"""Row -> column -> value."""
EstimateTable = dict[str, dict[str, EstimatedValue]]
"""Vehicle model, or `weighted` -> cluster of distance, or `average` -> estimate."""


class EvaluatedTable(PartialRecord, frozen=True):
    """Hold which rides were evaluated, and how they were split."""

    rides: Annotated[int | None, declare("Number of rides read.")] = None
    fit: Annotated[int | None, declare("Number of rides evaluated.")] = None
    unfit: Annotated[dict[str, int], declare("Reason -> number of rides left out.")] = {}
    seed: int | None = None
    repeats: Annotated[int | None, declare("Number of splits by ride.")] = None
    test_share: Annotated[float | None, declare("Share of the rides that a split tests. [1]")] = None
    vehicle_models: list[str] = []
    clusters: Annotated[list[str], declare("Clusters of distance with errors.")] = []
    first_date: str | None = None
    last_date: str | None = None
    energy_source: Annotated[dict[str, float | None], declare("`vi` or `soc` -> share of rides. [1]")] = {}
    vehicles: int | None = None
    left_out_of_training: Annotated[list[str], declare("Vehicle models that predict no new one.")] = []
    notes: Annotated[list[str], declare("Remarks for the reader.")] = []
    seconds: Annotated[float | None, declare("Duration of the evaluation. [s]")] = None


class TestedDifference(EstimatedValue, frozen=True):
    """Hold a difference between the errors of two recipes. [kWh]"""

    __test__ = False  # pytest collects classes whose name begins with Test

    p: Annotated[float | None, declare("p-value, adjusted over all pairs (Holm). [1]")] = None


class DifferenceScore(TestedDifference, frozen=True):
    """Hold the mean over rides of the error of the first recipe of a pair less that of the second. [kWh]"""

    average: Annotated[TestedDifference, declare("Of the average over clusters. [kWh]")] = TestedDifference()


class BinErrors(Record, frozen=True):
    """Hold the errors of a recipe in a bin of a property."""

    bin: str
    n: Annotated[int | None, declare("Number of predictions.")]
    bias: Annotated[float | None, declare("Mean of predicted less measured. [kWh]")]
    mae: Annotated[float | None, declare("Mean absolute error. [kWh]")]
    relative: Annotated[float | None, declare("Mean absolute error over mean consumption. [1]")]


class IntervalCoverage(PartialRecord, frozen=True):
    """Hold the share of rides inside their 90 % interval, in bins with enough rides. [1]"""

    overall: float | None = None
    cluster: dict[str, float | None] = {}
    season: dict[str, float | None] = {}
    vehicle_model: dict[str, float | None] = {}
    width_kwh: Annotated[float | None, declare("Mean width of the interval. [kWh]")] = None
    by_vehicle: Annotated[float | None, declare("The same on unseen cars. [1]", "cars unseen")] = None
    by_date: Annotated[float | None, declare("The same on unseen dates. [1]", "last dates unseen")] = None
    new_vehicle: Annotated[float | None, declare("On unseen vehicle models. [1]", "vehicle model unseen")] = None


class SplitErrors(Record, frozen=True):
    """Hold the percentage errors of recipes on the rides that a kind of split holds out."""

    rides: Annotated[int | None, declare("Number of predictions.")] = None
    energy_kwh: Annotated[float | None, declare("Mean measured energy. [kWh]")] = None
    below_least: Annotated[float | None, declare("Share of rides that MAPE leaves out. [1]")] = None
    noise_floor_kwh: Annotated[float | None, declare("Error that measurement noise alone causes. [kWh]")] = None
    recipes: dict[str, RelativeErrors] = {}


class PercentageErrors(PartialRecord, frozen=True):
    """Hold percentage errors by what was held out; None where nothing was predicted."""

    least_energy_kwh: Annotated[float | None, declare("Least energy of a ride that MAPE counts. [kWh]")] = None
    ride: SplitErrors | None = None
    vehicle: SplitErrors | None = None
    date: SplitErrors | None = None

    def get_split(self, kind: str) -> SplitErrors:
        """Return the errors of a kind of split, `ride`, `vehicle` or `date`."""
        return getattr(self, kind) or SplitErrors()


class NewVehicleErrors(PartialRecord, frozen=True):
    """Hold the errors of a recipe on a vehicle model that was left out of training."""

    mae: Annotated[float | None, declare("Mean absolute error, averaged over clusters. [kWh]")] = None
    relative: Annotated[float | None, declare("Error over consumption. [1]")] = None
    basic: Annotated[float | None, declare("Error of the basic physical model. [kWh]")] = None
    reduction: Annotated[float | None, declare("Share by which the error is below it. [1]")] = None


class LearningPoint(Record, frozen=True):
    """Hold the error of a learner after some rides of a new vehicle model."""

    rides: Annotated[int, declare("Number of its rides seen.")]
    mae: Annotated[float | None, declare("Mean absolute error. [kWh]")]
    ci95: Annotated[float | None, declare("Half width of its 95 % interval. [kWh]")]


class AccessoryPoint(Record, frozen=True):
    """Hold the mean accessory power in a bin of outside temperature."""

    ambient_c: Annotated[float, declare("Mean temperature. [°C]")]
    power_w: Annotated[float, declare("Mean power of a vehicle whose accessory scale is 1. [W]")]
    rides: Annotated[int, declare("Number of rides.")]


class AccessoryPower(Record, frozen=True):
    """Hold the accessory power of a vehicle model, Figure 1 of the paper."""

    points: list[AccessoryPoint] = []
    curve: Annotated[dict[str, float], declare("Numbers of the fitted `AccessoryCurve`. [K], [W]")] = {}


class RemovalLoss(EstimatedValue, frozen=True):
    """Hold the increase of the mean absolute error without some terms. [kWh]"""

    p: Annotated[float | None, declare("p-value. [1]")] = None
    upper95: Annotated[float | None, declare("End of its one-sided 95 % interval. [kWh]")] = None


class EliminationStep(Record, frozen=True):
    """Hold the loss after a term and all before it are removed."""

    term: Annotated[str, declare("Name of the term.", "term")]
    loss: Annotated[RemovalLoss, declare("Increase of the error. [kWh]", "loss, kWh", "loss")] = RemovalLoss()

    @property
    def p(self) -> Annotated[float | None, declare("p-value of the loss. [1]", "p", "probability")]:
        """p-value of the loss. [1]"""
        return self.loss.p


class TermScore(Record, frozen=True):
    """Hold the cross-validated error with a number of terms."""

    terms: Annotated[int, declare("Number of terms left.")]
    mae: Annotated[float | None, declare("Mean absolute error in the half that ranks. [kWh]")]


class TermElimination(PartialRecord, frozen=True):
    """Hold the terms that an elimination removes, and their loss in the half of the rides that did not rank them."""

    removed: Annotated[list[str], declare("Names of the terms.")]
    loss: Annotated[RemovalLoss | None, declare("Loss of all of them; None where there are none. [kWh]")]
    scores: Annotated[list[TermScore] | None, declare("Cross-validated error by number of terms.")] = None
    steps: Annotated[list[EliminationStep] | None, declare("Terms in the order of their removal.")] = None
    share: Annotated[float | None, declare("Margin: largest loss over the error of the full model. [1]")] = None
    largest: Annotated[float | None, declare("Largest loss. [kWh]")] = None
    error: Annotated[float | None, declare("Error of the full model. [kWh]")] = None


class RemovableTerms(PartialRecord, frozen=True):
    """Hold the terms of the hybrid model that can be removed; nothing where there are too few rides."""

    constant: Annotated[list[str] | None, declare("Terms that do not vary within any vehicle model.")] = None
    rfecv: TermElimination | None = None
    rfe: TermElimination | None = None
    margin: TermElimination | None = None


class RecipeEvaluation(Record, frozen=True):
    """Hold the errors of recipes on held-out rides. [kWh] where no other unit is given"""

    about: EvaluatedTable = EvaluatedTable()
    rides: Annotated[dict[str, dict[str, int]], declare("Vehicle model -> cluster or `total` -> rides (Table 2).")] = {}
    consumption: Annotated[Numbers, declare("Vehicle model -> cluster -> mean energy (Table 3). [kWh]")] = {}
    test_consumption: Annotated[EstimateTable, declare("Mean energy in the test sets (Table 4). [kWh]")] = {}
    recipes: Annotated[dict[str, str], declare("Recipe -> title.")] = {}
    mae: Annotated[dict[str, EstimateTable], declare("Recipe -> mean absolute error (Tables 5 to 11). [kWh]")] = {}
    relative: Annotated[Numbers, declare("Recipe -> cluster -> error over consumption (Figure 2). [1]")] = {}
    reduction: Annotated[Numbers, declare("Recipe -> vehicle model -> share below the basic model. [1]")] = {}
    reduction_by_baseline: Annotated[dict[str, Numbers], declare("Baseline -> the same below it. [1]")] = {}
    difference: Annotated[dict[str, dict[str, DifferenceScore]], declare("Vehicle model, `all` -> pair `a|b`.")] = {}
    dominates: Annotated[dict[str, list[str]], declare("Vehicle model -> recipes, by the mean over rides.")] = {}
    dominates_average: Annotated[dict[str, list[str]], declare("The same by the average over clusters.")] = {}
    bias: Annotated[Numbers, declare("Recipe -> vehicle model -> mean of predicted less measured. [kWh]")] = {}
    rmse: Annotated[Numbers, declare("Recipe -> vehicle model -> root mean square error. [kWh]")] = {}
    bands: Annotated[Numbers, declare("Recipe -> error in % -> share of rides within it. [1]")] = {}
    buffer_kwh: Annotated[Numbers, declare("Recipe -> share of rides in % -> buffer that suffices. [kWh]")] = {}
    buffer_by_cluster: Annotated[dict[str, Numbers], declare("Recipe -> cluster -> the same. [kWh]")] = {}
    by: Annotated[dict[str, dict[str, list[BinErrors]]], declare("Property -> recipe -> errors in its bins.")] = {}
    coverage: Annotated[dict[str, IntervalCoverage], declare("Recipe with intervals -> their coverage.")] = {}
    splits: Annotated[dict[str, Numbers], declare("`ride`, `vehicle` or `date` -> recipe -> vehicle model. [kWh]")] = {}
    percentage: PercentageErrors = PercentageErrors()
    new_vehicle: Annotated[dict[str, dict[str, NewVehicleErrors]], declare("Recipe -> model (Tables 12, 13).")] = {}
    few_shot: Annotated[dict[str, dict[str, list[LearningPoint]]], declare("Vehicle model -> learner -> curve.")] = {}
    selection: RemovableTerms = RemovableTerms()
    curve: Annotated[dict[str, AccessoryPower], declare("Vehicle model -> accessory power (Figure 1).")] = {}

    @property
    def errors(self) -> pd.DataFrame:
        """Average error of each recipe on each vehicle model, one row each; `mae_ci95`: half of its interval. [kWh]"""
        others = {"bias": self.bias, "rmse": self.rmse, "reduction": self.reduction}
        others |= {f"mae_by_{kind}": self.splits.get(kind, {}) for kind in ("vehicle", "date")}
        rows = [
            {"recipe": recipe, "vehicle_model": key, "mae": cells["average"].to_json()}
            | {name: other.get(recipe, {}).get(key) for name, other in others.items()}
            for recipe, table in self.mae.items()
            for key, cells in table.items()
            if key != "weighted"
        ]
        return make_estimate_frame(rows)

    @property
    def percentages(self) -> pd.DataFrame:
        """Errors in percent, one row for each kind of split and recipe; `_ci95`: half of an interval. [kWh], [1]"""
        return make_estimate_frame(
            {"held_out": kind, "recipe": recipe, **errors.to_json()}
            for kind in ("ride", "vehicle", "date")
            for recipe, errors in self.percentage.get_split(kind).recipes.items()
        )
