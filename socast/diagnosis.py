"""Find the physical effect that a model lacks, add it, and test whether it helps."""

from collections.abc import Collection, Sequence

import pandas as pd
from msgspec.structs import asdict as _asdict

from socast.core.diagnose.add.add import add_effect as _add
from socast.core.diagnose.add.terms import build_term_columns as _build_term_columns
from socast.core.diagnose.diagnosis import diagnose as _diagnose
from socast.core.diagnose.gains import LEAST_GAIN
from socast.core.fit.measured_rows import join_tables as _join
from socast.core.models import LinearModel
from socast.results import AdditionTrial, Diagnosis, _show
from socast.tools.commands.diagnose import word_result as _word_result

__all__ = ["AdditionTrial", "Diagnosis", "add_effect", "diagnose"]


def diagnose(
    rides: pd.DataFrame,
    windows: pd.DataFrame,
    model: LinearModel,
    *,
    leave_out: Collection[str] | None = None,
    least_gain: float = 0.0,
) -> Diagnosis:
    """Return where a model errs, which physical effects it lacks, and what remains unexplained.

    Parameters
    ----------
    rides, windows : DataFrame
        The two tables of the same rides, with every candidate effect as a column.
    model : LinearModel
        The model to diagnose.
    leave_out : collection of str, optional
        ISO dates whose rides are not used. By default those on which `add_effect` evaluates once it has decided (every
        fifth of twenty dates or more, or those in the history of the model); `()` for none.
    least_gain : float
        Share of the squared error of rides on held-out days below which an effect is not reported; 0 for no limit. [1]

    Returns
    -------
    Diagnosis
        `headline` and `next_step` in sentences, and the parts that `socast diagnose --json` writes, as attributes;
        DataFrames `errors`, `candidates` and `coefficients`; `to_json()` for plain values.

    Raises
    ------
    ModelError
        Where a column is missing, or the model is not a sum of terms.
    """
    result = _word_result(_diagnose(rides, windows, model, leave_out=leave_out, least_gain=least_gain))
    return _show(Diagnosis, result)


def add_effect(
    model: LinearModel,
    effect: str,
    rides: pd.DataFrame,
    windows: pd.DataFrame,
    *,
    scope: Sequence[str] = (),
    least_gain: float = LEAST_GAIN,
) -> AdditionTrial:
    """Add an effect to a model, refit the model, and test it on held-out days and vehicles.

    Parameters
    ----------
    model : LinearModel
        A sum of terms. It is not changed.
    effect : str
        Name of an effect, or of a variant such as `cold_rolling@reference=283.15`.
    rides, windows : DataFrame
        The two tables of the same rides.
    scope : sequence of str
        Where the effect holds: `vehicle=ID`, `since=YYYY-MM-DD`, or both; by default everywhere.
    least_gain : float
        Fall of the error below which the effect is not accepted. [1]

    Returns
    -------
    AdditionTrial
        `accepted` tells whether the effect helps, and `reason` why; `errors` are those before and after. `model` has
        the effect, refitted, if it was accepted, and is unchanged otherwise.

    Raises
    ------
    EffectError
        Where the effect is unknown.
    ModelError
        Where the effect is in the model already or nowhere at work in these rides.
    """
    columns = _build_term_columns(effect, scope)
    added = _add(model, effect, columns, _join(rides, windows), rides=rides, least=least_gain)
    kept = added.model if added.trial.accepted else model
    return AdditionTrial(model=kept, refitted=added.model, **_asdict(added.trial))
