"""Results as objects: attributes, DataFrames, a figure, and how a notebook shows them."""

from typing import TYPE_CHECKING, Any

import pandas as pd

from socast.core.diagnose.add.error_fall import read_step as _read_step
from socast.core.diagnose.records import Diagnosis as _Diagnosis
from socast.core.models import LinearModel

if TYPE_CHECKING:
    import plotly.graph_objects as go

__all__ = ["AdditionTrial", "Diagnosis"]


class Diagnosis(_Diagnosis, frozen=True):
    """Hold where a model errs, which effects it lacks, how certain that is, and what error remains.

    `headline` and `next_step` are sentences. `errors`, `candidates` and `coefficients` are DataFrames. All other parts
    are records with the fields that `socast diagnose --json` writes; `to_json()` returns them as plain values.
    """

    def plot(self) -> "go.Figure":
        """Return the error of a ride against the measurement noise, as given and with each missing effect. [kWh]"""
        from socast.tools.report.diagnosis.figures import draw_errors  # noqa: PLC0415 - figures take a second to import

        return draw_errors(self)[0].figure

    def _repr_html_(self) -> str:
        from socast.tools.report.diagnosis.page import build_sections  # noqa: PLC0415 - figures take a second to import
        from socast.tools.report.page import render_tables  # noqa: PLC0415

        lines = [*self.headline, *self.next_step]
        tables = [table for section in build_sections(self) for table in section.tables]
        return render_tables(f"Diagnosis of {self.model.name}", lines, tables)


class AdditionTrial:
    """Hold the trial of an effect that was added to a model.

    Parameters
    ----------
    model : LinearModel
        The refitted model with the effect if the trial accepts it, otherwise the model as it was.
    refitted : LinearModel
        The refitted model with the effect, also if the trial refuses it.
    trial : dict
        What `socast add --json` writes.
    """

    def __init__(self, model: LinearModel, refitted: LinearModel, trial: dict[str, Any]) -> None:
        self.model, self.refitted, self.trial = model, refitted, trial

    @property
    def outcome(self) -> str:
        """`add`, `refused` or `undecided`."""
        return str(self.trial["outcome"])

    @property
    def accepted(self) -> bool:
        """Whether the error of held-out rides falls beyond doubt."""
        return bool(self.trial["accepted"])

    @property
    def reason(self) -> str:
        """Why the effect was accepted or not."""
        return str(self.trial["reason"])

    @property
    def errors(self) -> pd.DataFrame:
        """Mean absolute error of a ride before and after, one row for each way of holding rides out. [kWh]"""
        from socast.tools.report.history import HELD_OUT  # noqa: PLC0415 - figures take a second to import

        rows = [{"evaluated_on": words, **self.trial[key]} for key, words in HELD_OUT.items() if self.trial.get(key)]
        names = ("evaluated_on", "rides", "days", "mae_before_kwh", "mae_after_kwh", "change_kwh")
        return pd.DataFrame(rows, columns=[name for name in names if any(name in row for row in rows)])

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
        return f"AdditionTrial({self.trial['effect']}: {self.outcome}, {self.reason})"

    def _repr_html_(self) -> str:
        from socast.tools.report.error_fall import draw_error_fall  # noqa: PLC0415
        from socast.tools.report.history import build_trial_sections  # noqa: PLC0415 - figures take a second to import
        from socast.tools.report.page import render_tables  # noqa: PLC0415

        tables = [table for section in build_trial_sections(self.trial) for table in section.tables]
        shown = render_tables(repr(self), [], tables[:1])
        return f"{draw_error_fall([_read_step(self.trial)])}{shown}"
