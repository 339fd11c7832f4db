"""Build the tables of a comparison: models, pairs of models, conditions, the worst rides, and two sets of rides."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from types import MappingProxyType
from typing import Any, Final

import msgspec

from socast.core.evaluate.compare.models import MOST_RELATIVE_SD
from socast.core.evaluate.compare.records import (
    ComparedModel,
    Comparison,
    ConditionBin,
    ContrastBin,
    DatasetContrast,
    PairDifference,
    PropertyContrast,
    SetContrast,
    TermContrast,
    WorstRide,
)
from socast.core.evaluate.records import EstimatedValue
from socast.core.evaluate.relative_errors import LEAST_ENERGY
from socast.core.formatting import format_range
from socast.core.stats.multiple_testing import SIGNIFICANCE
from socast.core.stats.scores import BANDS
from socast.tools.report.evaluation.percentage_tables import FLOOR_NOTE, PERCENT_NOTE, format_ratio, format_share
from socast.tools.report.evaluation.result import get_vehicle_name
from socast.tools.report.table import (
    FORMATS,
    Cell,
    ReportTable,
    format_count,
    format_difference,
    format_energy,
    format_percent,
    tabulate,
    tabulate_records,
)

UNITS: Final[Mapping[str, str]] = MappingProxyType(
    {"distance": "km", "temperature": "°C", "speed": "km/h", "time of day": "h"}
)
"""Units of conditions that have one."""
MOST_BINS: Final = 20
"""Largest number of bins in a table; of more, the most significantly biased are shown."""
FEW: Final = 2
"""Largest number of models whose cells have room for the relative error."""
INTERVAL_NOTE: Final = (
    "± is half of the 95 % interval, clustered by vehicle-day (the rides of one car on one day). One "
    "vehicle-day alone has no interval."
)
SURE_NOTE: Final = (
    "* and bold: significant bias; 1 in 20 of the marked bins of a model is expected to be a false "
    "finding. In parentheses: the mean absolute error and its share of consumption."
)
HOUR_NOTE: Final = "Time of day is mean solar time: UTC + longitude / 15°, rounded to hours."
WORST_FIELDS: Final = (
    *("ride", "vehicle_model", "date", "distance_km", "average_speed_kmh", "ambient_c"),
    *("measured_kwh", "predicted_kwh", "error_kwh", "relative", "command"),
)
"""Columns of the tables of worst rides."""
WIDE_FIELDS: Final = frozenset({"vehicle_model", "command"})
"""Columns of these tables for which only a page has room."""
SIDE_FIELDS: Final = ("first", "second", "difference")
"""Columns of the tables of two sets of rides."""


def tabulate_models(result: Comparison) -> ReportTable:
    """Return the errors of each model."""
    notes = (
        "MAE: mean absolute error. Bias: mean of predicted less measured. In parentheses, shares of mean consumption.",
        f"{' '.join(f'±{band} %' for band in BANDS)}: share of rides with a relative error within that band.",
        INTERVAL_NOTE,
    )
    return tabulate(
        "Errors of the models",
        "model",
        list(result.models.items()),
        [
            ("rides", lambda one: format_count(one.rides)),
            ("MAE, kWh", _show_error),
            ("bias, kWh", lambda one: f"{format_difference(one.bias_kwh)} ({format_percent(one.relative_bias)})"),
            ("RMSE, kWh", lambda one: format_energy(one.rmse_kwh)),
            *((f"±{band} %", lambda one, band=str(band): format_percent(one.within.get(band))) for band in BANDS),
        ],
        notes,
    )


def _show_error(one: ComparedModel) -> Cell:
    """Return the mean absolute error of a model, and its share of the consumption."""
    return Cell(f"{format_energy(one.mae_kwh)} ({format_percent(one.relative)})", value=one.mae_kwh.value)


def tabulate_relative_errors(result: Comparison) -> ReportTable:
    """Return the errors of each model in percent of the energy, and over the noise floor."""
    least = min((one.wmape.value for one in result.models.values() if one.wmape.value is not None), default=None)
    floor, below = format_energy(result.about.noise_floor_kwh), format_percent(result.about.below_least)
    measured = (
        f"Measurement noise alone causes {floor} kWh. MAPE leaves out rides below {LEAST_ENERGY} kWh, {below} of all."
    )
    return tabulate_records(
        "Errors in percent",
        result.models,
        ComparedModel,
        corner="model",
        fields=("wmape", "mape", "over_floor"),
        notes=(PERCENT_NOTE, measured, FLOOR_NOTE),
        strong=lambda name, _, value: name == "wmape" and least is not None and value.value == least,
        formats={"share": format_share, "ratio": format_ratio},
    )


def tabulate_pairs(result: Comparison) -> ReportTable:
    """Return the differences of errors between models, on the same rides."""
    note = "Mean over rides of the difference of absolute errors. p: adjusted for all pairs (Holm). Bold: significant."
    return tabulate_records(
        "Models on the same rides, pair by pair",
        result.pairs,
        PairDifference,
        fields=("name", "difference_kwh", "p_holm", "better"),
        notes=(note, INTERVAL_NOTE),
        strong=lambda name, place, _: name == "difference_kwh" and result.pairs[place - 1].is_significant,
    )


def list_varying_conditions(result: Comparison) -> list[str]:
    """Return the conditions in which the rides differ: those with more than one bin."""
    return list(dict.fromkeys(name for one in result.models.values() for name, bins in one.by.items() if len(bins) > 1))


def tabulate_errors_by_condition(result: Comparison, name: str) -> ReportTable:
    """Return bias and error of all models in the bins of a condition."""
    by_model = {model: index_bins(one.by.get(name, ())) for model, one in result.models.items()}
    first = next(iter(by_model.values()))
    shown = select_most_significant(
        [{label: entry.bias_kwh for label, entry in bins.items()} for bins in by_model.values()]
    )
    notes = [SURE_NOTE, INTERVAL_NOTE]
    if name == "time of day":
        notes.append(HOUR_NOTE)
    if len(shown) < len(first):
        notes.append(
            f"{len(shown)} of {len(first)} bins are shown, those with the most significant bias; --json has all."
        )

    def make_cell(model: str, label: str) -> Cell:
        if (entry := by_model[model].get(label)) is None:
            return Cell("")
        share = f", {format_percent(entry.relative, 0)}" if len(by_model) <= FEW else ""
        return _mark(entry.bias_kwh, f" ({format_energy(entry.mae_kwh)}{share})", is_sure=entry.is_significant)

    rows = [(format_bin(name, label), label) for label in shown]
    return tabulate(
        f"Errors by {name}",
        format_condition(name),
        rows,
        [
            ("rides", lambda label: format_count(first[label].n)),
            ("vehicle-days", lambda label: format_count(first[label].vehicle_days)),
            *((f"{model}: bias (MAE), kWh", partial(make_cell, model)) for model in by_model),
        ],
        tuple(notes),
    )


def _mark(bias: EstimatedValue, more: str = "", *, is_sure: bool) -> Cell:
    """Return a bias, emphasised and with a star where it is significant."""
    return Cell(f"{format_difference(bias)}{' *' if is_sure else ''}{more}", strong=is_sure)


def format_condition(name: str) -> str:
    """Return a condition with its unit."""
    return f"{name}, {UNITS[name]}" if name in UNITS else name


def index_bins(bins: Sequence[ConditionBin]) -> dict[str, ConditionBin]:
    """Return bins by name."""
    return {entry.bin: entry for entry in bins}


def format_bin(condition: str, name: str) -> str:
    """Return the name of a bin of a condition for readers.

    Examples
    --------
    >>> format_bin("distance", "0-5"), format_bin("driver", "0-5")
    ('0 to 5', '0-5')
    """
    return format_range(name) if condition in UNITS else name


def select_most_significant(by_model: Sequence[Mapping[str, EstimatedValue]]) -> list[str]:
    """Return the bins that are shown, in order."""
    labels = list(dict.fromkeys(label for bins in by_model for label in bins))

    def sure(label: str) -> float:
        known = [bins[label] for bins in by_model if label in bins]
        return max((abs(bias.value) / bias.ci95 for bias in known if bias.value is not None and bias.ci95), default=0.0)

    kept = set(sorted(labels, key=sure, reverse=True)[:MOST_BINS])
    return [label for label in labels if label in kept]


def name_ride(place: int) -> str:
    """Return the key of the figure of the ride at a place among the traced rides, from 0."""
    return f"ride-{place}"


def tabulate_worst_rides(result: Comparison, model: str, *, commands: bool) -> list[ReportTable]:
    """Return the rides of a model's largest errors, with the car and the command that traces each if there is room.

    A ride whose trace is in the result is a link to its figure.
    """
    worst = result.models[model].worst
    links = {key: f"figure-{name_ride(i)}" for i, key in enumerate(result.traces or ())}
    within = f"whose energy is measured to within {format_percent(MOST_RELATIVE_SD, 0)}"
    unknown = f"–: unknown; a relative error is given only of rides {within}."
    fields = [name for name in WORST_FIELDS if commands or name not in WIDE_FIELDS]
    some_unknown = any(getattr(ride, name) is None for ride in worst.absolute for name in fields)
    return [
        tabulate_records(
            f"{model}: the largest errors{scale}, kWh",
            rides,
            WorstRide,
            fields=fields,
            notes=notes,
            formats={**FORMATS, "vehicle model": get_vehicle_name},
            links=links,
        )
        for scale, rides, notes in (
            ("", worst.absolute, (unknown,) if some_unknown else ()),
            (" relative to measured energy", worst.relative, (f"Only rides {within}.",)),
        )
    ]


def tabulate_datasets(against: DatasetContrast) -> list[ReportTable]:
    """Return the differences between two sets of rides: rides, consumption, and the account of each model."""
    note = "*: significant; 1 in 20 of the marked rows is expected to be a false finding. Most different first."
    properties = tabulate_records(
        "How the rides differ",
        against.properties,
        PropertyContrast,
        fields=("label", *SIDE_FIELDS),
        notes=(note, INTERVAL_NOTE),
        strong=lambda name, place, _: name == "difference" and against.properties[place - 1].is_significant,
    )
    return [properties, *(tabulate_difference_terms(against, model) for model in against.models), _errors(against)]


def tabulate_difference_terms(against: DatasetContrast, model: str) -> ReportTable:
    """Return the difference in consumption as a model explains it, term by term."""
    difference = against.models[model]
    sums = {
        "predicted": difference.explained,
        "measured": against.consumption,
        "measured less predicted": difference.unexplained,
    }
    entries = [
        *(msgspec.structs.replace(term, name=f"of it {term.name}") for term in difference.terms),
        *(TermContrast(name=name, **msgspec.structs.asdict(contrast)) for name, contrast in sums.items()),
    ]
    note = (
        "The terms add up to the predicted difference. The last row is the part that the model does not "
        "explain, or chance."
    )
    return tabulate_records(
        f"{model}: terms of the difference, kWh per 100 km",
        entries,
        TermContrast,
        fields=("name", *SIDE_FIELDS),
        notes=(note, INTERVAL_NOTE),
        totals=sums,
    )


def _errors(against: DatasetContrast) -> ReportTable:
    """Return bias and error of each model on both sets."""
    rows: list[tuple[str, tuple[SetContrast, Callable[[EstimatedValue], str]]]] = []
    for model, one in against.models.items():
        rows.append((f"{model}: bias", (one.bias_kwh, format_difference)))
        rows.append((f"{model}: MAE", (one.mae_kwh, format_energy)))

    def show_difference(of: tuple[SetContrast, Any]) -> Cell:
        return Cell(format_difference(of[0].difference), strong=of[0].p is not None and of[0].p < SIGNIFICANCE)

    columns = [
        ("first", lambda of: of[1](of[0].first)),
        ("second", lambda of: of[1](of[0].second)),
        ("second less first", show_difference),
    ]
    note = "Bold: p below 0.05, not adjusted for the number of rows."
    return tabulate("Errors on both sets, kWh per ride", "model", rows, columns, (note, INTERVAL_NOTE))


def tabulate_datasets_by_condition(against: DatasetContrast, model: str) -> list[ReportTable]:
    """Return the bias of a model on both sets of rides by each condition."""
    columns: list[tuple[str, Callable[[ContrastBin], Cell | str]]] = [
        ("rides", lambda entry: " / ".join(format_count(n) for n in entry.n)),
        ("bias: first", lambda entry: format_difference(entry.bias_kwh.first)),
        ("second", lambda entry: format_difference(entry.bias_kwh.second)),
        ("second less first", lambda entry: _mark(entry.bias_kwh.difference, is_sure=entry.is_significant)),
        ("MAE: second less first", lambda entry: format_difference(entry.mae_kwh.difference)),
        ("kWh/100 km: second less first", lambda entry: format_difference(entry.consumption.difference, 1)),
    ]
    tables = []
    for name, bins in against.models[model].by.items():
        shown = select_most_significant([{entry.bin: entry.bias_kwh.difference for entry in bins}])
        rows = [(entry.bin, entry) for entry in bins if entry.bin in shown]
        title, notes = f"{model}: by {name}, kWh per ride", (SURE_NOTE, INTERVAL_NOTE)
        tables.append(tabulate(title, format_condition(name), rows, columns, notes))
    return tables
