"""Results as objects: attributes, DataFrames, a figure, and how a notebook shows them.

Each result has the attributes of the record that the command of the same purpose writes with `--json`. Figures and
tables are those of its HTML page; their modules take a second to import, so they are imported on first use.
"""

from importlib import import_module as _import
from typing import TYPE_CHECKING, Any, TypeVar

import pandas as pd
from msgspec.structs import asdict as _asdict

from socast.core.diagnose.add.records import EffectTrial as _EffectTrial
from socast.core.diagnose.records import Diagnosis as _Diagnosis
from socast.core.evaluate.compare.records import Comparison as _Comparison
from socast.core.evaluate.paper.records import RecipeEvaluation as _RecipeEvaluation
from socast.core.evaluate.records import make_estimate_frame as _make_estimate_frame
from socast.core.evaluate.soc.records import SocEvaluation as _SocEvaluation
from socast.core.models import LinearModel
from socast.core.records import Record as _Record

if TYPE_CHECKING:
    import plotly.graph_objects as go

__all__ = ["AdditionTrial", "Comparison", "Diagnosis", "RecipeEvaluation", "SocEvaluation"]

_Result = TypeVar("_Result", bound=_Record)


def _show(kind: type[_Result], record: _Record) -> _Result:
    """Return a record of the core as the result of the same fields that has figures and tables."""
    return kind(**_asdict(record))


def _render(title: str, lines: list[str], sections: list[Any]) -> str:
    """Return sentences and the tables of sections that are not folded, for a notebook."""
    tables = [table for section in sections if not (section.folded or section.closed) for table in section.tables]
    html: str = _import("socast.tools.report.page").render_tables(title, lines, tables)
    return html


class Diagnosis(_Diagnosis, frozen=True):
    """Hold where a model errs, which effects it lacks, how certain that is, and what error remains.

    `headline` and `next_step` are sentences. `errors`, `candidates` and `coefficients` are DataFrames. `to_json()`
    returns everything as plain values.
    """

    def plot(self) -> "go.Figure":
        """Return the error of a ride against the measurement noise, as given and with each missing effect. [kWh]"""
        return _import("socast.tools.report.diagnosis.figures").draw_errors(self)[0].figure

    def _repr_html_(self) -> str:
        sections = _import("socast.tools.report.diagnosis.page").build_sections(self)
        return _render(f"Diagnosis of {self.model.name}", [*self.headline, *self.next_step], sections)


class Comparison(_Comparison, frozen=True):
    """Hold the errors of models on the same rides, by condition, and their worst rides.

    `errors` and `worst_rides` are DataFrames. `to_json()` returns everything as plain values.
    """

    def plot(self) -> "go.Figure":
        """Return predicted against measured energy of each ride, for the first model. [kWh]"""
        return _import("socast.tools.report.comparison.figures").draw_scatter(self, next(iter(self.models)))

    def _repr_html_(self) -> str:
        sections = _import("socast.tools.report.comparison.page").build_sections(self, commands=False)
        return _render(f"Comparison of {', '.join(self.models)}", [], sections)


class RecipeEvaluation(_RecipeEvaluation, frozen=True):
    """Hold the errors of recipes on rides that were held out, by ride, vehicle and date, as in the paper.

    `errors` and `percentages` are DataFrames. `to_json()` returns everything as plain values.
    """

    def plot(self) -> "go.Figure":
        """Return the average error of each recipe on each vehicle model. [kWh]"""
        return _import("socast.tools.report.evaluation.page").build_illustrations(self, "summary")[0].figure

    def _repr_html_(self) -> str:
        sections = _import("socast.tools.report.evaluation.page").build_sections(self)
        return _render("Evaluation of recipes", [], sections)


class SocEvaluation(_SocEvaluation, frozen=True):
    """Hold errors and coverage, in percent of charge, of forecasts of the state of charge at the end of the shift.

    `errors` is a DataFrame. `to_json()` returns everything as plain values.
    """

    def plot(self) -> "go.Figure":
        """Return the mean absolute error by the time before the end of the shift, with baselines. [%]"""
        return _import("socast.tools.report.soc.page").draw_errors(self)

    def _repr_html_(self) -> str:
        return _render(
            "Forecasts of the state of charge", [], _import("socast.tools.report.soc.page").build_sections(self)
        )


class AdditionTrial(_EffectTrial, frozen=True, kw_only=True):
    """Hold the trial of an effect that was added to a model.

    `outcome` is `add`, `refused` or `undecided`, and `reason` says why. `errors` is a DataFrame. `to_json()` returns
    everything but the models as plain values.

    Parameters
    ----------
    model : LinearModel
        The refitted model with the effect if the trial accepts it, otherwise the model as it was.
    refitted : LinearModel
        The refitted model with the effect, also if the trial refuses it.
    """

    model: LinearModel
    refitted: LinearModel

    @property
    def errors(self) -> pd.DataFrame:
        """Mean absolute error of a ride before and after, one row for each way of holding rides out. [kWh]"""
        return _make_estimate_frame(
            {"evaluated_on": what, **fall.to_json()}
            for field, what in _import("socast.tools.report.history").HELD_OUT.items()
            if (fall := getattr(self, field)) is not None
        )[["evaluated_on", "rides", "clusters", "mae_before_kwh", "mae_after_kwh", "change_kwh", "change_kwh_ci95"]]

    def to_json(self) -> dict[str, Any]:
        """Return the trial as the JSON values that `socast add --json` writes."""
        return {name: value for name, value in super().to_json().items() if name in _EffectTrial.__struct_fields__}

    def plot(self) -> "go.Figure":
        """Return the error of a ride before and after, for each way of holding rides out. [kWh]"""
        from socast.tools.report.figure_style import draw_bars, get_style, make_figure  # noqa: PLC0415

        errors = self.errors
        bars = [
            draw_bars(when, get_style(place), list(errors["evaluated_on"]), list(errors[f"mae_{when}_kwh"]))
            for place, when in enumerate(("before", "after"), start=2)
        ]
        made = make_figure(bars, 120 + 60 * len(errors))
        made.update_xaxes(title_text="Mean absolute error of a ride [kWh]", rangemode="tozero")
        made.update_yaxes(title_text="Evaluated on", type="category", autorange="reversed")
        return made

    def __repr__(self) -> str:
        return f"AdditionTrial({self.effect}: {self.outcome}, {self.reason})"

    def _repr_html_(self) -> str:
        table = _import("socast.tools.report.history").tabulate_errors(self)
        shown = _import("socast.tools.report.page").render_tables(repr(self), [], [table])
        return f"{_import('socast.tools.report.error_fall').draw_error_fall([self])}{shown}"
