"""Infer what is missing from the model of synthetic drives, for tests of the inference and of what is made of it."""

from collections.abc import Collection, Mapping

import pandas as pd
from threadpoolctl import threadpool_limits

from socast.core import effects
from socast.core.diagnose.dataset import Windows
from socast.core.diagnose.inference.form_search import FormSearch
from socast.core.diagnose.inference.groups import list_groups
from socast.core.diagnose.inference.posterior import Inference, infer_missing
from socast.core.diagnose.inference.window_columns import gather_window_columns
from socast.core.models import LinearModel
from tests.support.synthetic_windows import gather_with_model


def infer(
    tables: tuple[pd.DataFrame, pd.DataFrame],
    *,
    groups: Mapping[str, str] | None = None,
    without: Collection[str] = (),
    scopes: bool = True,
) -> tuple[Windows, LinearModel, Inference]:
    """Return windows, their model, and what the inference finds missing in it."""
    windows, model = gather_with_model(tables)
    columns = gather_window_columns(windows, model, without)
    inside = [effects.get(name).base for name in model.effects]
    forms = FormSearch(windows)
    with threadpool_limits(1):
        found = infer_missing(columns, inside, list_groups(windows, columns, groups or {}), scopes=scopes, forms=forms)
    return windows, model, found
