"""Build the tables of a comparison: models, pairs of models, conditions, the worst rides, and two sets of rides."""

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, Final

from socast.core.evaluate.compare.models import MOST_RELATIVE_SD
from socast.core.formatting import format_minus, format_range
from socast.core.stats.multiple_testing import SIGNIFICANCE
from socast.core.stats.scores import BANDS
from socast.tools.report.cells import (
    UNKNOWN,
    Cell,
    ReportTable,
    Row,
    format_count,
    format_energy,
    format_percent,
    format_signed,
    mark_least,
)
from socast.tools.report.evaluation.result import (
    Result,
    get_half_width,
    get_mapping,
    get_number,
    get_part,
    get_vehicle_name,
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


def list_models(result: Result) -> list[str]:
    """Return the names of the models, in order."""
    return list(get_mapping(result, "models"))


def format_difference(estimate: Any, digits: int = 3) -> str:
    """Return a difference with its sign, and its interval where it has one.

    Examples
    --------
    >>> format_difference({"value": 0.0123, "ci95": 0.004}), format_difference({"value": -1.25, "ci95": None}, 1)
    ('+0.012 ± 0.004', '−1.2')
    """
    width = get_half_width(estimate)
    return format_signed(estimate, digits) + ("" if width is None else f" ± {width:.{digits}f}")


def format_estimate(estimate: Any, digits: int = 1) -> str:
    """Return a figure, and its interval where it has one."""
    known, width = get_number(estimate), get_half_width(estimate)
    if known is None:
        return UNKNOWN
    return format_minus(f"{known:.{digits}f}") + ("" if width is None else f" ± {width:.{digits}f}")


def tabulate_models(result: Result) -> ReportTable:
    """Return the errors of each model."""
    by_model = get_mapping(result, "models")
    errors = [get_number(get_part(scores, "mae_kwh")) for scores in by_model.values()]
    first = mark_least(
        [Cell(_share(format_energy, scores, "mae_kwh", "relative")) for scores in by_model.values()], errors
    )
    rows = tuple(
        Row(
            name,
            (
                Cell(format_count(get_part(scores, "rides"))),
                error,
                Cell(_share(format_difference, scores, "bias_kwh", "relative_bias")),
                Cell(format_energy(get_part(scores, "rmse_kwh"))),
                *(Cell(format_percent(get_part(scores, "within", str(band)))) for band in BANDS),
            ),
        )
        for (name, scores), error in zip(by_model.items(), first, strict=True)
    )
    heads = ("rides", "MAE, kWh", "bias, kWh", "RMSE, kWh", *(f"±{band} %" for band in BANDS))
    notes = (
        "MAE: mean absolute error. Bias: mean of predicted less measured. In parentheses, shares of mean consumption.",
        f"{' '.join(f'±{band} %' for band in BANDS)}: share of rides with a relative error within that band.",
        INTERVAL_NOTE,
    )
    return ReportTable("Errors of the models", "model", heads, rows, notes)


def _share(shown: Callable[[Any], str], scores: Mapping[str, Any], name: str, relative: str) -> str:
    """Return a figure and its share of consumption."""
    return f"{shown(scores.get(name))} ({format_percent(scores.get(relative))})"


def tabulate_pairs(result: Result) -> ReportTable:
    """Return the differences of errors between models, on the same rides."""
    rows = tuple(
        Row(
            f"{pair['a']} less {pair['b']}",
            (
                Cell(
                    format_difference(pair["difference_kwh"]), strong=(get_number(pair["p_holm"]) or 0.0) < SIGNIFICANCE
                ),
                Cell(format_probability(pair["p_holm"])),
                Cell(_better(pair)),
            ),
        )
        for pair in get_part(result, "pairs") or ()
    )
    note = "Mean over rides of the difference of absolute errors. p: adjusted for all pairs (Holm). Bold: significant."
    heads = ("difference of MAE, kWh", "p", "less error")
    return ReportTable("Models on the same rides, pair by pair", "pair", heads, rows, (note, INTERVAL_NOTE))


def format_probability(value: Any) -> str:
    """Return a probability.

    Examples
    --------
    >>> format_probability(0.0000001), format_probability(0.034), format_probability(None)
    ('< 0.001', '0.034', '–')
    """
    known = get_number(value)
    least = 0.001
    return UNKNOWN if known is None else f"< {least}" if known < least else f"{known:.3f}"


def _better(pair: Mapping[str, Any]) -> str:
    """Return the model of a pair with the smaller error, where the difference is significant."""
    chance, apart = get_number(pair["p_holm"]), get_number(pair["difference_kwh"])
    if chance is None or apart is None or chance >= SIGNIFICANCE:
        return "not distinguishable"
    return str(pair["a"] if apart < 0.0 else pair["b"])


def list_varying_conditions(result: Result) -> list[str]:
    """Return the conditions in which the rides differ: those with more than one bin."""
    by_model = [get_mapping(scores, "by") for scores in get_mapping(result, "models").values()]
    return list(dict.fromkeys(name for by in by_model for name, bins in by.items() if len(bins) > 1))


def list_biased_conditions(result: Result) -> list[str]:
    """Return the conditions with a bin in which a model has a significant bias."""
    models = get_mapping(result, "models").values()
    return [
        name
        for name in list_varying_conditions(result)
        if any(is_significant(entry) for scores in models for entry in get_part(scores, "by", name) or ())
    ]


def describe_unbiased_conditions(names: Sequence[str]) -> str:
    """Return a sentence on conditions whose tables are not shown; empty where there are none."""
    return f"No significant bias by {', '.join(names)}; --html and --json have these tables." if names else ""


def tabulate_errors_by_condition(result: Result, name: str) -> ReportTable:
    """Return bias and error of all models in the bins of a condition."""
    by_model = {model: index_bins(get_part(bins, "by", name)) for model, bins in get_mapping(result, "models").items()}
    first = next(iter(by_model.values()))
    shown = select_most_significant(
        [{label: get_part(e, "bias_kwh") for label, e in bins.items()} for bins in by_model.values()]
    )
    rows = tuple(
        Row(
            format_bin(name, label),
            (
                Cell(format_count(first[label].get("n"))),
                Cell(format_count(first[label].get("vehicle_days"))),
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


def index_bins(bins: Any) -> dict[str, Mapping[str, Any]]:
    """Return bins by name."""
    return {str(entry["bin"]): entry for entry in bins or ()}


def format_bin(condition: str, name: str) -> str:
    """Return the name of a bin of a condition for readers.

    Examples
    --------
    >>> format_bin("distance", "0-5"), format_bin("driver", "0-5")
    ('0 to 5', '0-5')
    """
    return format_range(name) if condition in UNITS else name


def select_most_significant(by_model: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the bins that are shown, in order."""
    labels = list(dict.fromkeys(label for bins in by_model for label in bins))

    def sure(label: str) -> float:
        known = [(get_number(get_part(bins, label)), get_half_width(get_part(bins, label))) for bins in by_model]
        return max((abs(bias) / width for bias, width in known if bias is not None and width), default=0.0)

    kept = set(sorted(labels, key=sure, reverse=True)[:MOST_BINS])
    return [label for label in labels if label in kept]


def is_significant(entry: Mapping[str, Any] | None) -> bool:
    """Return whether a difference is significant among all that were tested."""
    q = get_number(get_part(entry, "q"))
    return q is not None and q < SIGNIFICANCE


def _bias_and_error(entry: Mapping[str, Any] | None, *, share: bool) -> Cell:
    """Return the figures of a bin, with the error's share of consumption where there is room."""
    if entry is None:
        return Cell("")
    mark = " *" if is_significant(entry) else ""
    error = format_energy(entry.get("mae_kwh")) + (f", {format_percent(entry.get('relative'), 0)}" if share else "")
    return Cell(f"{format_difference(entry.get('bias_kwh'))}{mark} ({error})", strong=bool(mark))


def name_ride(place: int) -> str:
    """Return the key of the figure of the ride at a place among the traced rides, from 0."""
    return f"ride-{place}"


def tabulate_worst_rides(result: Result, model: str, *, commands: bool) -> list[ReportTable]:
    """Return the rides of a model's largest errors, with the car and the command that traces each if there is room.

    A ride whose trace is in the result is a link to its figure.
    """
    worst = get_mapping(result, "models", model, "worst")
    links = {key: f"figure-{name_ride(i)}" for i, key in enumerate(get_mapping(result, "traces"))}
    return [
        _worst(f"{model}: the largest errors, kWh", get_part(worst, "absolute") or (), links, commands=commands),
        _worst(
            f"{model}: the largest errors relative to measured energy, kWh",
            get_part(worst, "relative") or (),
            links,
            commands=commands,
        )._replace(notes=(f"Only rides whose energy is measured to within {format_percent(MOST_RELATIVE_SD, 0)}.",)),
    ]


def _worst(title: str, rides: Sequence[Mapping[str, Any]], links: Mapping[str, str], *, commands: bool) -> ReportTable:
    rows = tuple(
        Row(
            str(ride["ride"]),
            (
                *([Cell(get_vehicle_name(str(ride.get("vehicle_model"))))] if commands else []),
                Cell(str(ride.get("date"))),
                *(Cell(format_estimate(ride.get(name))) for name in ("distance_km", "average_speed_kmh", "ambient_c")),
                *(Cell(format_estimate(ride.get(name), 3)) for name in ("measured_kwh", "predicted_kwh")),
                Cell(format_signed(ride.get("error_kwh"))),
                Cell(format_percent(ride.get("relative"), 0)),
                *([Cell(str(ride.get("command", "")))] if commands else []),
            ),
            link=links.get(str(ride["ride"]), ""),
        )
        for ride in rides
    )
    heads = ("date", "km", "km/h", "°C", "measured", "pre-\ndicted", "error", "relative")
    return ReportTable(title, "ride", ("car", *heads, "its trace") if commands else heads, rows)


def tabulate_datasets(result: Result) -> list[ReportTable]:
    """Return the differences between two sets of rides: rides, consumption, and the account of each model."""
    against = get_mapping(result, "against")
    if not against:
        return []
    rides = _sides("How the rides differ", "what", get_part(against, "properties") or (), _property, format_estimate)
    accounts = [tabulate_difference_terms(against, model) for model in get_mapping(against, "models")]
    errors = _errors(against)
    note = "*: significant; 1 in 20 of the marked rows is expected to be a false finding. Most different first."
    return [rides._replace(notes=(note, INTERVAL_NOTE)), *accounts, errors]


def _property(entry: Mapping[str, Any]) -> str:
    unit = "" if entry["unit"] == "1" else f", {entry['unit']}"
    return f"{entry['name']}{unit}{' *' if is_significant(entry) else ''}"


def _sides(
    title: str,
    corner: str,
    entries: Sequence[Mapping[str, Any]],
    named: Callable[[Mapping[str, Any]], str],
    shown: Callable[[Any], str],
) -> ReportTable:
    """Return a table of both sets and their difference."""
    rows = tuple(
        Row(
            named(entry),
            (
                Cell(shown(entry["first"])),
                Cell(shown(entry["second"])),
                Cell(format_difference(entry["difference"], 1), strong=is_significant(entry)),
            ),
        )
        for entry in entries
    )
    return ReportTable(title, corner, ("first", "second", "second less first"), rows)


def tabulate_difference_terms(against: Result, model: str) -> ReportTable:
    """Return the difference in consumption as a model explains it, term by term."""
    difference = get_mapping(against, "models", model)
    sums = [
        ("predicted", get_mapping(difference, "explained")),
        ("measured", get_mapping(against, "consumption")),
        ("measured less predicted", get_mapping(difference, "unexplained")),
    ]
    entries = [
        *({**entry, "name": f"of it {entry['name']}"} for entry in get_part(difference, "terms") or ()),
        *({**entry, "name": name} for name, entry in sums),
    ]
    table = _sides(
        f"{model}: terms of the difference, kWh per 100 km",
        "part",
        entries,
        lambda e: str(e["name"]),
        format_estimate,
    )
    rows = tuple(row._replace(total=not row.name.startswith("of it ")) for row in table.rows)
    note = (
        "The terms add up to the predicted difference. The last row is the part that the model does not "
        "explain, or chance."
    )
    return table._replace(rows=rows, notes=(note, INTERVAL_NOTE))


def _errors(against: Result) -> ReportTable:
    """Return bias and error of each model on both sets."""
    rows = []
    for model, estimates in get_mapping(against, "models").items():
        bias, error = get_mapping(estimates, "bias_kwh"), get_mapping(estimates, "mae_kwh")
        for name, entry, shown in (("bias", bias, format_difference), ("MAE", error, format_energy)):
            sure = (get_number(entry.get("p")) or 1.0) < SIGNIFICANCE
            cells = (
                Cell(shown(entry["first"])),
                Cell(shown(entry["second"])),
                Cell(format_difference(entry["difference"]), strong=sure),
            )
            rows.append(Row(f"{model}: {name}", cells))
    heads = ("first", "second", "second less first")
    note = "Bold: p below 0.05, not adjusted for the number of rows."
    return ReportTable("Errors on both sets, kWh per ride", "model", heads, tuple(rows), (note, INTERVAL_NOTE))


def tabulate_datasets_by_condition(result: Result, model: str) -> list[ReportTable]:
    """Return the bias of a model on both sets of rides by each condition."""
    by_condition = get_mapping(result, "against", "models", model, "by")
    tables = []
    for name, bins in by_condition.items():
        shown = select_most_significant(
            [{str(entry["bin"]): get_part(entry, "bias_kwh", "difference") for entry in bins}]
        )
        rows = tuple(_both(entry) for entry in bins if str(entry["bin"]) in shown)
        heads = (
            "rides",
            "bias: first",
            "second",
            "second less first",
            "MAE: second less first",
            "kWh/100 km: second less first",
        )
        tables.append(
            ReportTable(
                f"{model}: by {name}, kWh per ride", format_condition(name), heads, rows, (SURE_NOTE, INTERVAL_NOTE)
            )
        )
    return tables


def _both(entry: Mapping[str, Any]) -> Row:
    bias = entry["bias_kwh"]
    mark = " *" if is_significant(entry) else ""
    cells = (
        Cell(" / ".join(format_count(n) for n in entry["n"])),
        Cell(format_difference(bias["first"])),
        Cell(format_difference(bias["second"])),
        Cell(format_difference(bias["difference"]) + mark, strong=bool(mark)),
        Cell(format_difference(get_part(entry, "mae_kwh", "difference"))),
        Cell(format_difference(get_part(entry, "consumption", "difference"), 1)),
    )
    return Row(str(entry["bin"]), cells)
