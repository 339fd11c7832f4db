"""Build the tables of a comparison: models, pairs of models, conditions, the worst rides, and two sets of rides."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Final

import msgspec

from socast.core.evaluate.compare.models import MOST_RELATIVE_SD
from socast.core.evaluate.compare.records import (
    Comparison,
    ConditionBin,
    ContrastBin,
    DatasetContrast,
    PairDifference,
    PropertyContrast,
    TermContrast,
    WorstRide,
)
from socast.core.evaluate.records import EstimatedValue
from socast.core.formatting import format_range
from socast.core.stats.multiple_testing import SIGNIFICANCE
from socast.core.stats.scores import BANDS
from socast.tools.report.cells import (
    Cell,
    ReportTable,
    Row,
    format_count,
    format_difference,
    format_energy,
    format_percent,
    mark_least,
)
from socast.tools.report.evaluation.result import get_vehicle_name
from socast.tools.report.record_table import FORMATS, tabulate_records

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
    models = result.models.values()
    first = mark_least(
        [Cell(f"{format_energy(one.mae_kwh)} ({format_percent(one.relative)})") for one in models],
        [one.mae_kwh.value for one in models],
    )
    rows = tuple(
        Row(
            name,
            (
                Cell(format_count(one.rides)),
                error,
                Cell(f"{format_difference(one.bias_kwh)} ({format_percent(one.relative_bias)})"),
                Cell(format_energy(one.rmse_kwh)),
                *(Cell(format_percent(one.within.get(str(band)))) for band in BANDS),
            ),
        )
        for (name, one), error in zip(result.models.items(), first, strict=True)
    )
    heads = ("rides", "MAE, kWh", "bias, kWh", "RMSE, kWh", *(f"±{band} %" for band in BANDS))
    notes = (
        "MAE: mean absolute error. Bias: mean of predicted less measured. In parentheses, shares of mean consumption.",
        f"{' '.join(f'±{band} %' for band in BANDS)}: share of rides with a relative error within that band.",
        INTERVAL_NOTE,
    )
    return ReportTable("Errors of the models", "model", heads, rows, notes)


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


def list_biased_conditions(result: Comparison) -> list[str]:
    """Return the conditions with a bin in which a model has a significant bias."""
    models = result.models.values()
    return [
        name
        for name in list_varying_conditions(result)
        if any(entry.is_significant for one in models for entry in one.by.get(name, ()))
    ]


def describe_unbiased_conditions(names: Sequence[str]) -> str:
    """Return a sentence on conditions whose tables are not shown; empty where there are none."""
    return f"No significant bias by {', '.join(names)}; --html and --json have these tables." if names else ""


def tabulate_errors_by_condition(result: Comparison, name: str) -> ReportTable:
    """Return bias and error of all models in the bins of a condition."""
    by_model = {model: index_bins(one.by.get(name, ())) for model, one in result.models.items()}
    first = next(iter(by_model.values()))
    shown = select_most_significant(
        [{label: entry.bias_kwh for label, entry in bins.items()} for bins in by_model.values()]
    )
    rows = tuple(
        Row(
            format_bin(name, label),
            (
                Cell(format_count(first[label].n)),
                Cell(format_count(first[label].vehicle_days)),
                *(_bias_and_error(bins.get(label), share=len(by_model) <= FEW) for bins in by_model.values()),
            ),
        )
        for label in shown
    )
    notes = [SURE_NOTE, INTERVAL_NOTE]
    if name == "time of day":
        notes.append(HOUR_NOTE)
    if len(shown) < len(first):
        notes.append(
            f"{len(shown)} of {len(first)} bins are shown, those with the most significant bias; --json has all."
        )
    heads = ("rides", "vehicle-days", *(f"{model}: bias (MAE), kWh" for model in by_model))
    return ReportTable(f"Errors by {name}", format_condition(name), heads, rows, tuple(notes))


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


def _bias_and_error(entry: ConditionBin | None, *, share: bool) -> Cell:
    """Return the figures of a bin, with the error's share of consumption where there is room."""
    if entry is None:
        return Cell("")
    mark = " *" if entry.is_significant else ""
    error = format_energy(entry.mae_kwh) + (f", {format_percent(entry.relative, 0)}" if share else "")
    return Cell(f"{format_difference(entry.bias_kwh)}{mark} ({error})", strong=bool(mark))


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
    tables = [
        tabulate_records(
            f"{model}: the largest errors{scale}, kWh",
            rides,
            WorstRide,
            fields=fields,
            notes=notes,
            formats={**FORMATS, "vehicle model": get_vehicle_name},
        )
        for scale, rides, notes in (
            ("", worst.absolute, (unknown,) if some_unknown else ()),
            (" relative to measured energy", worst.relative, (f"Only rides {within}.",)),
        )
    ]
    return [
        table._replace(rows=tuple(row._replace(link=links.get(row.name, "")) for row in table.rows)) for table in tables
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
    table = tabulate_records(
        f"{model}: terms of the difference, kWh per 100 km",
        entries,
        TermContrast,
        fields=("name", *SIDE_FIELDS),
        notes=(note, INTERVAL_NOTE),
    )
    return table._replace(rows=tuple(row._replace(total=row.name in sums) for row in table.rows))


def _errors(against: DatasetContrast) -> ReportTable:
    """Return bias and error of each model on both sets."""
    rows = []
    for model, one in against.models.items():
        for name, entry, shown in (("bias", one.bias_kwh, format_difference), ("MAE", one.mae_kwh, format_energy)):
            sure = entry.p is not None and entry.p < SIGNIFICANCE
            cells = (
                Cell(shown(entry.first)),
                Cell(shown(entry.second)),
                Cell(format_difference(entry.difference), strong=sure),
            )
            rows.append(Row(f"{model}: {name}", cells))
    heads = ("first", "second", "second less first")
    note = "Bold: p below 0.05, not adjusted for the number of rows."
    return ReportTable("Errors on both sets, kWh per ride", "model", heads, tuple(rows), (note, INTERVAL_NOTE))


def tabulate_datasets_by_condition(against: DatasetContrast, model: str) -> list[ReportTable]:
    """Return the bias of a model on both sets of rides by each condition."""
    heads = (
        "rides",
        "bias: first",
        "second",
        "second less first",
        "MAE: second less first",
        "kWh/100 km: second less first",
    )
    tables = []
    for name, bins in against.models[model].by.items():
        shown = select_most_significant([{entry.bin: entry.bias_kwh.difference for entry in bins}])
        rows = tuple(_both(entry) for entry in bins if entry.bin in shown)
        title, notes = f"{model}: by {name}, kWh per ride", (SURE_NOTE, INTERVAL_NOTE)
        tables.append(ReportTable(title, format_condition(name), heads, rows, notes))
    return tables


def _both(entry: ContrastBin) -> Row:
    mark = " *" if entry.is_significant else ""
    cells = (
        Cell(" / ".join(format_count(n) for n in entry.n)),
        Cell(format_difference(entry.bias_kwh.first)),
        Cell(format_difference(entry.bias_kwh.second)),
        Cell(format_difference(entry.bias_kwh.difference) + mark, strong=bool(mark)),
        Cell(format_difference(entry.mae_kwh.difference)),
        Cell(format_difference(entry.consumption.difference, 1)),
    )
    return Row(entry.bin, cells)
