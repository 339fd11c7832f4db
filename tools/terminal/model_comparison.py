"""Several models in live operation: their options on the command line, and their errors as a table and as JSON."""

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Final

import msgspec
import pandas as pd
import typer
from msgspec.structs import replace
from rich.console import Console
from rich.table import Table
from rich.text import Text

from socast.core import models
from socast.core.formatting import format_count, format_minus
from socast.core.models import BUILT_IN_MODELS, LinearModel
from socast.core.wire.messages import Gain, ModelErrors, RideErrors
from socast.tools.terminal.output import print_plain
from socast.tools.terminal.rich_table import Column, make_table

DEFAULT_MODEL: Final = "extended_physical"
"""The model if the command line names none."""
FITTED: Final = "fitted.json"
"""Name of the model file that commands look for in the folder of the recordings."""
VERDICT_NOTE: Final = (
    "better or worse: the 95 % interval of the difference excludes zero; it holds for all models "
    "together, however often the table is read; only ended vehicle-days count"
)
"""Explanation below the table."""
WIDE: Final = 112
"""Width of a terminal from which tables have all their columns. [characters]"""
COURSE: Final = 20
"""Number of characters of the course of an error."""
_NARROW: Final = (("rides", 5), ("MAE\nkWh", 6), ("better by\nkWh per ride", 22))
_WIDE: Final = (
    ("rides", 5),
    ("not pre-\ndicted", 8),
    ("MAE\nkWh", 6),
    ("MAE\n%", 5),
    ("bias\nkWh", 7),
    ("better by\nkWh per ride", 22),
    ("vehicle-\ndays", 8),
)

LEVELS: Final = "▁▂▃▄▅▆▇█"
"""Characters of the course of a value, from low to high."""
ModelNames = Annotated[
    list[str] | None,
    typer.Option(
        "--model",
        metavar="M",
        help="Model: a name, or a model file. May be repeated: the first makes the forecasts, the others run in its "
        f"shadow. [default: {DEFAULT_MODEL}; of serve, live and demo a {FITTED} beside the recordings, if it exists]",
    ),
]


def load_models(names: Sequence[str] | None) -> list[LinearModel]:
    """Load the models of the given names or files, or `DEFAULT_MODEL` without names."""
    return [models.load(name) for name in names or [DEFAULT_MODEL]]


def name_as_given(given: str) -> str:
    """Return the name of a model in reports: that of a built-in model, or of the file that was given.

    Examples
    --------
    >>> name_as_given("extended_physical"), name_as_given("models/base.json")
    ('extended_physical', 'base')
    """
    return given if given in BUILT_IN_MODELS else Path(given).stem


def load_as_given(given: str) -> LinearModel:
    """Load a model for a report, which names it as the user does; it is not to be saved under this name."""
    return replace(models.load(given), name=name_as_given(given))


def find_models(names: Sequence[str] | None, folder: Path | None) -> list[str]:
    """Return the names of the models to run: those given, else the fitted one in the folder of the recordings."""
    if names or folder is None or not (fitted := folder / FITTED).is_file():
        return list(names or ())
    return [str(fitted)]


def advise_fit(model: LinearModel, data: str, folder: str = "") -> str | None:
    """Return what fitting would bring where a model knows only the catalogue, None for a fitted model."""
    if model.training is not None:
        return None
    return (
        f"{model.name} knows only the catalogue. A model fitted to measured rides has a mean error near zero "
        f"and calibrated intervals: socast fit {data} --recipe road_load -o {folder}{FITTED}"
    )


class ErrorCourses:
    """Keep how the mean absolute error of each model changed from ride to ride."""

    def __init__(self) -> None:
        self._of: dict[str, list[float]] = {}
        self._rides: dict[str, int] = {}

    def add(self, errors_of_models: Sequence[ModelErrors]) -> None:
        """Add the present errors of models, where a ride has ended since the last time."""
        for model in errors_of_models:
            rides, mae = model.overall.rides, model.overall.mae_kwh
            if mae is not None and rides != self._rides.get(model.model):
                self._rides[model.model] = rides
                self._of.setdefault(model.model, []).append(mae)

    def draw(self, model: str) -> str:
        """Return the course of the error of a model, as a picture of `COURSE` characters at most."""
        return draw_course(self._of.get(model, ()), COURSE)


def draw_course(values: Sequence[float], width: int) -> str:
    """Return the course of values from 0 to the largest, the newest last.

    Examples
    --------
    >>> draw_course([4.0, 3.0, 2.0, 1.0], 4)
    '█▆▄▂'
    >>> draw_course([], 4)
    ''
    """
    if not values:
        return ""
    count = min(width, len(values))
    edges = [len(values) * place // count for place in range(count + 1)]
    means = [sum(values[a:b]) / (b - a) for a, b in pairwise(edges)]
    most = max(*means, 1e-12)
    return "".join(LEVELS[min(max(round(value / most * len(LEVELS)) - 1, 0), len(LEVELS) - 1)] for value in means)


def make_models_table(
    errors_of_models: Sequence[ModelErrors],
    *,
    wide: bool,
    by_vehicle_model: bool = False,
    courses: ErrorCourses | None = None,
) -> Table:
    """Return a table of the errors of models, one row per model."""
    columns = [
        Column("model", fixed=True, min_width=None if wide else 18),
        *(Column(head, number=True, fixed=True, min_width=width) for head, width in (_WIDE if wide else _NARROW)),
        Column("against\nfirst", fixed=True, min_width=8),
        *((Column("MAE from\nride to ride", fixed=True, min_width=COURSE),) if wide and courses else ()),
    ]
    table = make_table(columns, "Models, over rides fit for training")
    for place, model in enumerate(errors_of_models, 1):
        drawn = (courses.draw(model.model),) if wide and courses else ()
        table.add_row(Text(f"{place} {model.model}"), *_cells(model.overall, wide=wide), *drawn)
        for errors in model.by_vehicle_model if by_vehicle_model else ():
            table.add_row(Text(f"    {errors.vehicle_model}"), *_cells(errors, wide=wide))
    return table


def describe_gain(gain: Gain) -> str:
    """Return a sentence on how a shadow model compares with the first model."""
    over = f"{format_count(gain.rides, 'ride')} of {format_count(gain.vehicle_days, 'vehicle-day')}"
    if gain.mean_kwh is None or gain.lower_kwh is None or gain.upper_kwh is None or gain.verdict == "undecided":
        return f"undecided: {over}"
    low, high = sorted((abs(gain.lower_kwh), abs(gain.upper_kwh)))
    span = f"{abs(gain.mean_kwh):.3f} kWh per ride ({low:.3f} to {high:.3f})"
    return f"{gain.verdict} than the first by {span}, over {over}"


def show_models(
    console: Console, errors_of_models: Sequence[ModelErrors], known: Sequence[LinearModel], rides: pd.DataFrame
) -> None:
    """Print the errors of models on rides, and warn of rides that a model may have been fitted to."""
    console.print(make_models_table(errors_of_models, wide=console.width >= WIDE, by_vehicle_model=True))
    verdicts = [
        f"{model.model}: {describe_gain(model.overall.gain)}" for model in errors_of_models if model.overall.gain
    ]
    print_plain(console, *(*verdicts, VERDICT_NOTE, *warn_of_training_days(known, rides)), wraps=True)


def warn_of_training_days(known: Sequence[LinearModel], rides: pd.DataFrame) -> list[str]:
    """Return a warning for each model whose training dates include dates of these rides.

    Such a model may have been fitted to these rides.
    """
    lines = []
    for model in known:
        if model.training is None:
            continue
        first, last = model.training.first_date, model.training.last_date
        seen = int(((rides["date"] >= first) & (rides["date"] <= last)).sum())
        if seen:
            lines.append(
                f"{model.name}/{model.version} was fitted to rides from {first} to {last}; {seen:,} of "
                f"these {len(rides):,} rides are from those days, and its error on them is too low if it "
                "was fitted to them"
            )
    return lines


def make_records(errors_of_models: Sequence[ModelErrors]) -> list[Any]:
    """Return the errors of each model in the form of their wire message, for JSON."""
    return [msgspec.to_builtins(model) for model in errors_of_models]


def make_log_fields(model: ModelErrors) -> dict[str, Any]:
    """Return the fields of a log line on a model, without unknown values."""
    overall = model.overall
    gain = overall.gain
    fields: dict[str, Any] = {"model": model.model} | msgspec.to_builtins(overall)
    fields |= {} if gain is None else {f"gain_{name}": value for name, value in msgspec.to_builtins(gain).items()}
    return {name: value for name, value in fields.items() if value is not None and name != "gain"}


def _cells(errors: RideErrors, *, wide: bool) -> tuple[str | Text, ...]:
    """Return the cells of a row after the model's name."""
    gain = errors.gain
    rides, mae = f"{errors.rides:,}", _number(errors.mae_kwh, ".3f")
    by = days = ""
    verdict = Text()
    if gain:
        by, days = _number(gain.mean_kwh, ".3f"), f"{gain.vehicle_days:,}"
        if gain.lower_kwh is not None and gain.upper_kwh is not None:
            by += format_minus(f" ({gain.lower_kwh:.3f} to {gain.upper_kwh:.3f})")
        verdict = Text(gain.verdict, style={"better": "green", "worse": "red"}.get(gain.verdict, ""))
    if not wide:
        return (rides, mae, by, verdict)
    unpredicted, share = f"{errors.unpredicted_rides:,}", _number(errors.mae_pct, ".1f")
    return (rides, unpredicted, mae, share, _number(errors.bias_kwh, "+.3f"), by, days, verdict)


def _number(value: float | None, spec: str) -> str:
    """Return the text of a number, a dash if it is unknown."""
    return "–" if value is None else format_minus(format(value, spec))
