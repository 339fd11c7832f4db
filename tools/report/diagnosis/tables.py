"""Tabulate a diagnosis: where the model fails, the missing effects, all candidates, and the remaining error."""

from typing import Any, Final

from socast.core.formatting import format_minus
from socast.tools.report.cells import UNKNOWN, Cell, ReportTable, Row, format_count, format_percent, format_signed
from socast.tools.report.diagnosis import sentences
from socast.tools.report.evaluation.result import Result, get_mapping, get_number

BIAS_NOTE: Final = (
    "Bias: mean of predicted less measured energy, less that of all other rides. Slices are found on one half of the "
    "vehicle-days and confirmed on the other half. q: expected share of false slices among this slice "
    "and those above it."
)
MISSING_NOTE: Final = (
    "Best first, each in the presence of those above it. Gain: reduction of the squared error that the "
    "terms of the model "
    "cannot explain, on days to which the coefficient was not fitted. ± and ranges are 95 % intervals. "
    "Probability: that the effect is the largest of the causes, alone or with others. "
    "Or else: the other causes among which the largest one is with a probability of 90 %."
)
CANDIDATES_NOTE: Final = (
    "Each effect alone before any is added, with the parameter value that fits best. z has the sign that physics "
    "demands."
)


def tabulate_slices(result: Result) -> ReportTable:
    """Return the slices of the rides on which the bias of the model differs."""
    rows = tuple(
        Row(
            str(one.get("where")),
            (
                Cell(format_count(one.get("rides"))),
                Cell(_spread(one.get("bias_kwh"), one.get("ci95"))),
                Cell(sentences.describe_slice(one)),
                Cell(_plain(one.get("mae_kwh"))),
                Cell(_small(one.get("q"))),
            ),
        )
        for one in result.get("slices") or ()
    )
    heads = ("rides", "bias, kWh", "predicts", "error, kWh", "q")
    return ReportTable("Where the model fails", "rides", heads, rows, (BIAS_NOTE,))


def tabulate_missing_effects(result: Result) -> ReportTable:
    """Return the missing effects, the best first."""
    rows = tuple(
        Row(
            f"{place}. {sentences.name_effect(one)}",
            (
                Cell("all" if one.get("scope") in {None, "all"} else str(one["scope"])),
                Cell(format_percent(one.get("gain")), strong=place == 1),
                Cell(format_percent(one.get("energy_share"))),
                Cell(_coefficient(one)),
                Cell("yes" if get_mapping(one, "coefficient").get("plausible") else "NO"),
                Cell(format_percent(one.get("probability"), 0), strong=place == 1),
                Cell(", ".join(str(e) for e in one.get("credible_set") or () if e != one.get("effect")) or "–"),
            ),
        )
        for place, one in enumerate(result.get("missing") or (), start=1)
    )
    heads = ("for", "gain", "of energy", "coefficient", "plausible", "probability", "or else")
    return ReportTable("Missing effects", "effect", heads, rows, (MISSING_NOTE,))


def tabulate_candidates(result: Result) -> ReportTable:
    """Return all candidate effects, as they rank before any is added."""
    rows = tuple(
        Row(
            str(one.get("variant") or one.get("effect")),
            (
                Cell("all" if one.get("scope") in {None, "all"} else str(one["scope"])),
                Cell(_fixed(one.get("z"))),
                Cell(_small(one.get("q"))),
                Cell(format_percent(one.get("gain"), 2)),
                Cell(str(one.get("status")), strong=one.get("status") == "missing"),
            ),
        )
        for one in result.get("candidates") or ()
    )
    heads = ("for", "z", "q", "gain", "result")
    return ReportTable("All candidates", "effect", heads, rows, (CANDIDATES_NOTE,))


def tabulate_errors(result: Result) -> ReportTable:
    """Return the errors of the model and the noise floor."""
    part = get_mapping(result, "error")
    excessive = ", overestimated" if sentences.is_noise_overestimated(result) else ""
    values = (
        ("model as given", part.get("mae_kwh")),
        (
            "same terms refitted to these rides for each car, any curve of temperature (in sample)",
            part.get("mae_refitted_kwh"),
        ),
        (f"measurement noise alone{excessive}", part.get("noise_floor_kwh")),
    )
    rows = tuple(Row(what, (Cell(_plain(value)),)) for what, value in values if get_number(value) is not None)
    return ReportTable("Mean absolute error of a ride", "model", ("kWh",), rows)


def tabulate_structure(result: Result) -> ReportTable:
    """Return the predictable share of the error before and after the missing effects, and that of a plain pattern."""
    part = get_mapping(result, "structure")
    values = (
        ("predictable before the missing effects", part.get("before")),
        ("predictable after them", part.get("after")),
        ("explained by them", part.get("taken")),
        ("required for them to explain it all", part.get("least")),
        (
            "explained by a plain pattern that remains",
            part.get("shape_taken") if "shape" in (part.get("signs") or ()) else None,
        ),
    )
    rows = tuple(Row(what, (Cell(format_percent(value)),)) for what, value in values if get_number(value) is not None)
    note = "Predictable: share of the variance that boosted trees predict on days to which they were not fitted."
    return ReportTable("Remaining error", "structure", ("share",), rows, (note,))


def _coefficient(part: Any) -> str:
    """Return a coefficient with its interval and unit."""
    coefficient = get_mapping(part, "coefficient")
    value, limits = get_number(coefficient.get("value")), sentences.read_interval(coefficient.get("ci95"))
    if value is None:
        return UNKNOWN
    unit = f" {sentences.format_unit(str(coefficient.get('unit') or '1'))}".rstrip()
    half = f" ± {(limits[1] - limits[0]) / 2.0:.2g}" if limits else ""
    return format_minus(f"{value:.3g}{half}{unit}")


def _spread(value: Any, ci95: Any) -> str:
    """Return a bias with half the width of its interval, which is given as such or by two ends."""
    limits = sentences.read_interval(ci95)
    half = (limits[1] - limits[0]) / 2.0 if limits else get_number(ci95)
    return format_signed(value) + ("" if half is None else f" ± {half:.2g}")


def _plain(value: Any) -> str:
    known = get_number(value)
    return UNKNOWN if known is None else format_minus(f"{known:.3g}")


def _small(value: Any) -> str:
    known = get_number(value)
    return UNKNOWN if known is None else f"{known:.2g}"


def _fixed(value: Any) -> str:
    return format_signed(value, 1)
