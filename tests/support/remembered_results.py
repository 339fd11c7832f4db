"""Results of a long computation, kept so that the same call, on another page, does not compute them again."""

import hashlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from inspect import signature
from typing import Any

import pandas as pd
import pytest
from msgspec.structs import replace

from socast.core import effects
from socast.core.diagnose.add import add, refit
from socast.core.diagnose.add.holdout import select_final_days
from socast.core.diagnose.records import Diagnosis
from socast.core.fit.ride_blocks import get_names
from socast.core.models import LinearModel, encode_model
from tests.support import own_car_figure, picture_figure


@contextmanager
def diagnosing_once() -> Iterator[None]:
    """Diagnose the same tables and model once, and try to add an effect to them once, in this process.

    Trials of several effects share the fits without them. A diagnosis is reproducible: `tests/core/diagnose` tests it.
    """
    from socast import diagnosis as public  # noqa: PLC0415 - it takes a second to import
    from socast.core.diagnose import diagnosis  # noqa: PLC0415

    diagnose_once, add_effect = _remember(diagnosis.diagnose), _remember(add.add_effect)

    def diagnose(rides: pd.DataFrame, windows: pd.DataFrame, model: LinearModel, **options: Any) -> Diagnosis:
        """Diagnose models that differ by name alone once: the name is in the result, and affects nothing else."""
        found = diagnose_once(rides, windows, replace(model, name=""), **options)
        return replace(found, model=replace(found.model, name=model.name))

    with pytest.MonkeyPatch.context() as patch:
        for module in (diagnosis, picture_figure, own_car_figure):
            patch.setattr(module, "diagnose", diagnose)
        patch.setattr(add, "add_effect", add_effect)
        patch.setattr(public, "_diagnose", diagnose)
        patch.setattr(public, "_add", add_effect)
        patch.setattr(refit, "fit_rows", _remember(refit.fit_rows))
        yield


def _remember(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that computes each result once; what it reports meanwhile is no part of it."""
    known: dict[str, Any] = {}
    of_function = signature(function)

    def call(*args: Any, **kwargs: Any) -> Any:
        given = of_function.bind(*args, **kwargs)
        given.apply_defaults()
        values = dict(given.arguments)
        values.pop("report", None)
        if "leave_out" in values:
            dates = get_names(values["rides"], "date")
            left_out = values["leave_out"]
            final = select_final_days(values["model"].history, dates) if left_out is None else left_out
            values["leave_out"] = sorted(final)
        key = hashlib.sha256()
        for part in (*values.values(), *effects.list_tabulated()):
            key.update(_encode(part))
        place = key.hexdigest()
        if place not in known:
            known[place] = function(*args, **kwargs)
        return known[place]

    return call


def _encode(value: Any) -> bytes:
    """Return bytes that differ where values do."""
    if isinstance(value, pd.DataFrame):
        return repr(list(value)).encode() + pd.util.hash_pandas_object(value).to_numpy().tobytes()
    if isinstance(value, LinearModel):
        return encode_model(value)
    return repr(tuple(value) if isinstance(value, list) else value).encode()
