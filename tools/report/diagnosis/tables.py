"""Tabulate a diagnosis: where the model fails, the missing effects, all candidates, and the remaining error."""

from typing import Final

from socast.core.diagnose.records import (
    Diagnosis,
    EstimatedCoefficient,
    NamedEffect,
    SliceBias,
    TestedEffect,
    UnknownCause,
)
from socast.core.formatting import format_minus
from socast.tools.report.diagnosis import sentences
from socast.tools.report.diagnosis.finding_words import format_unit
from socast.tools.report.table import FORMATS, UNKNOWN, Cell, ReportTable, Row, format_digits, tabulate_records

BIAS_NOTE: Final = (
    "Bias: mean of predicted less measured energy, less that of all other rides. Slices are found on one half of the "
    "vehicle-days and confirmed on the other half. q: expected share of false slices among this slice "
    "and those above it."
)
UNKNOWN_NOTE: Final = (
    "Form: a load of the car times functions of the conditions. It was chosen among thousands, so it may stand for "
    "another that is like it."
)
"""What the forms outside the library are."""
MISSING_NOTE: Final = (
    "In the order in which to add them. Gain, beside those before it: reduction of the squared error that the terms "
    "of the model cannot explain, on days to which the coefficient was not fitted. ± and ranges are 95 % intervals. "
    "Probability: that the effect is missing, whatever else is. Or else: other effects that explain the same; together "
    "they hold 90 % of the probability."
)
CANDIDATES_NOTE: Final = (
    "z and gain: of each effect alone, with the parameter value that fits best; z has the sign that physics demands. "
    "Probability: that the effect is missing, whatever else is."
)


def tabulate_slices(result: Diagnosis) -> ReportTable:
    """Return the slices of the rides on which the bias of the model differs."""
    return tabulate_records("Where the model fails", result.slices, SliceBias, notes=(BIAS_NOTE,))


def tabulate_missing_effects(result: Diagnosis) -> ReportTable:
    """Return the missing effects, in the order in which to add them."""
    return tabulate_records(
        "Missing effects",
        result.missing,
        NamedEffect,
        notes=(MISSING_NOTE,),
        strong=lambda name, place, _: place == 1 and name in {"gain", "probability"},
        numbered=True,
        formats={**FORMATS, "coefficient": format_coefficient},
    )


def tabulate_candidates(result: Diagnosis) -> ReportTable:
    """Return all candidate effects, the most probable first."""
    return tabulate_records(
        "All candidates",
        result.tested,
        TestedEffect,
        notes=(CANDIDATES_NOTE,),
        strong=lambda name, _, value: name == "status" and value == "missing",
    )


def tabulate_errors(result: Diagnosis) -> ReportTable:
    """Return the errors of the model and the noise floor."""
    part = result.error
    excessive = ", overestimated" if sentences.is_noise_overestimated(result) else ""
    values = (
        ("model as given", part.mae_kwh),
        (
            "same terms refitted to these rides for each car, any curve of temperature (in sample)",
            part.mae_refitted_kwh,
        ),
        (f"measurement noise alone{excessive}", part.noise_floor_kwh),
    )
    rows = tuple(Row(what, (Cell(format_digits(value)),)) for what, value in values if value is not None)
    is_higher = part.mae_kwh is not None and part.mae_refitted_kwh is not None and part.mae_refitted_kwh > part.mae_kwh
    notes = (f"Refitted: {sentences.REFIT_IS_NO_LOWER}",) if is_higher else ()
    return ReportTable("Mean absolute error of a ride", "model", ("kWh",), rows, notes)


def tabulate_unknown(result: Diagnosis) -> ReportTable:
    """Return what is missing and not in the library, by the form that fits best."""
    return tabulate_records(
        "Outside the library",
        result.unknown,
        UnknownCause,
        notes=(UNKNOWN_NOTE,),
        formats={**FORMATS, "coefficient": format_coefficient},
    )


def format_coefficient(coefficient: EstimatedCoefficient) -> str:
    """Return a coefficient with its interval and unit."""
    value, limits = coefficient.value, coefficient.ci95
    if value is None:
        return UNKNOWN
    unit = f" {format_unit(coefficient.unit)}".rstrip()
    half = f" ± {(limits[1] - limits[0]) / 2.0:.2g}" if limits else ""
    doubt = "" if coefficient.plausible else ", NOT plausible"
    return format_minus(f"{value:.3g}{half}{unit}{doubt}")
