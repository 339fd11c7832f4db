"""Tables of a diagnosis: where the model fails, what is missing, and everything that was asked."""

from typing import Any, Final

from tools.report.cells import UNKNOWN, Cell, ReportTable, Row, format_count, format_percent, format_signed
from tools.report.diagnosis import sentences
from tools.report.evaluation.result import Result, get_mapping, get_number

BIAS_NOTE: Final = (
    "Bias: predicted less measured, less that of all other rides. Slices are found on half of the vehicle-days and "
    "judged on the other half; q is the share of false ones that is allowed down to this one."
)
MISSING_NOTE: Final = (
    "Best first, each given those above it. Gain: fall of the squared error, beyond what the model's own terms could "
    "take up, on days that the coefficient was not fitted to. ± and ranges are 95 % intervals."
)
CANDIDATES_NOTE: Final = (
    "Each effect alone, in the first step, in the parameter that fits best; z with the sign that physics demands."
)


def tabulate_slices(result: Result) -> ReportTable:
    """Return where the model fails."""
    rows = tuple(
        Row(
            str(found.get("where")),
            (
                Cell(format_count(found.get("rides"))),
                Cell(_spread(found.get("bias_kwh"), found.get("ci95"))),
                Cell(sentences.describe_slice(found)),
                Cell(_plain(found.get("mae_kwh"))),
                Cell(_small(found.get("q"))),
            ),
        )
        for found in result.get("slices") or ()
    )
    heads = ("rides", "bias, kWh", "predicts", "error, kWh", "q")
    return ReportTable("Where it fails", "rides", heads, rows, (BIAS_NOTE,))


def tabulate_missing_effects(result: Result) -> ReportTable:
    """Return what is missing, best first."""
    rows = tuple(
        Row(
            f"{place}. {sentences.name_effect(found)}",
            (
                Cell("all" if found.get("scope") in {None, "all"} else str(found["scope"])),
                Cell(format_percent(found.get("gain")), strong=place == 1),
                Cell(format_percent(found.get("energy_share"))),
                Cell(_coefficient(found)),
                Cell("yes" if get_mapping(found, "coefficient").get("plausible") else "NO"),
                Cell(_small(found.get("q"))),
                Cell(", ".join(str(e) for e in found.get("group") or () if e != found.get("effect")) or "–"),
            ),
        )
        for place, found in enumerate(result.get("missing") or (), start=1)
    )
    heads = ("for", "gain", "of energy", "coefficient", "plausible", "q", "not told from")
    return ReportTable("What is missing", "effect", heads, rows, (MISSING_NOTE,))


def tabulate_candidates(result: Result) -> ReportTable:
    """Return everything that was asked."""
    rows = tuple(
        Row(
            str(found.get("variant") or found.get("effect")),
            (
                Cell("all" if found.get("scope") in {None, "all"} else str(found["scope"])),
                Cell(_fixed(found.get("z"))),
                Cell(_small(found.get("q"))),
                Cell(format_percent(found.get("gain"), 2)),
                Cell(str(found.get("status")), strong=found.get("status") == "missing"),
            ),
        )
        for found in result.get("candidates") or ()
    )
    heads = ("for", "z", "q", "gain", "finding")
    return ReportTable("All candidates", "effect", heads, rows, (CANDIDATES_NOTE,))


def tabulate_errors(result: Result) -> ReportTable:
    """Return the errors and the noise floor."""
    found = get_mapping(result, "error")
    told = (
        ("as given", found.get("mae_kwh")),
        ("its terms fitted to these rides", found.get("mae_refitted_kwh")),
        ("measurement noise alone", found.get("noise_floor_kwh")),
    )
    rows = tuple(Row(what, (Cell(_plain(value)),)) for what, value in told if get_number(value) is not None)
    return ReportTable("Mean absolute error of a ride", "model", ("kWh",), rows)


def tabulate_structure(result: Result) -> ReportTable:
    """Return how much of what is left can be predicted, before and after the named effects, or is of a plain shape."""
    found = get_mapping(result, "structure")
    told = (
        ("predictable share before the named effects", found.get("before")),
        ("predictable share after them", found.get("after")),
        ("taken by them", found.get("taken")),
        ("least that they should take", found.get("least")),
        (
            "explained by the plain shape that is left",
            found.get("gain") if "shape" in (found.get("signs") or ()) else None,
        ),
    )
    rows = tuple(Row(what, (Cell(format_percent(value)),)) for what, value in told if get_number(value) is not None)
    note = "Share of the variance of what is left that boosted trees predict on days that they were not fitted to."
    return ReportTable("What remains", "structure", ("share",), rows, (note,))


def _coefficient(found: Any) -> str:
    """Return a coefficient with its interval and unit."""
    own = get_mapping(found, "coefficient")
    value, limits = get_number(own.get("value")), sentences.read_interval(own.get("ci95"))
    if value is None:
        return UNKNOWN
    unit = "" if own.get("unit") in {None, "1"} else f" {own['unit']}"
    return f"{value:.3g}{f' ± {(limits[1] - limits[0]) / 2.0:.1g}' if limits else ''}{unit}"


def _spread(value: Any, ci95: Any) -> str:
    """Return a bias with its interval, which is half a width or two ends."""
    limits = sentences.read_interval(ci95)
    half = (limits[1] - limits[0]) / 2.0 if limits else get_number(ci95)
    return format_signed(value) + ("" if half is None else f" ± {half:.2g}")


def _plain(value: Any) -> str:
    known = get_number(value)
    return UNKNOWN if known is None else f"{known:.3g}"


def _small(value: Any) -> str:
    known = get_number(value)
    return UNKNOWN if known is None else f"{known:.2g}"


def _fixed(value: Any) -> str:
    return format_signed(value, 1)
