"""Build the table of errors in percent and over the noise floor, of the models that a comparison holds."""

from socast.core.evaluate.relative_errors import LEAST_ENERGY
from socast.tools.report.cells import Cell, ReportTable, Row, format_energy, format_percent, mark_least
from socast.tools.report.evaluation.percentage_tables import FLOOR_NOTE, PERCENT_NOTE, format_ratio, format_share
from socast.tools.report.evaluation.result import Result, get_mapping, get_number, get_part


def tabulate_relative_errors(result: Result) -> ReportTable:
    """Return the errors of each model in percent of the energy, and over the noise floor."""
    models, about = get_mapping(result, "models"), get_mapping(result, "about")
    errors = [get_number(get_part(errors, "wmape")) for errors in models.values()]
    first = mark_least([Cell(format_share(get_part(errors, "wmape"))) for errors in models.values()], errors)
    rows = tuple(
        Row(
            name,
            (wmape, Cell(format_share(get_part(errors, "mape"))), Cell(format_ratio(get_part(errors, "over_floor")))),
        )
        for (name, errors), wmape in zip(models.items(), first, strict=True)
    )
    floor, below = format_energy(about.get("noise_floor_kwh")), format_percent(about.get("below_least"))
    measured = (
        f"Measurement noise alone causes {floor} kWh. MAPE leaves out rides below {LEAST_ENERGY} kWh, {below} of all."
    )
    notes = (PERCENT_NOTE, measured, FLOOR_NOTE)
    return ReportTable("Errors in percent", "model", ("wMAPE", "MAPE", "over noise"), rows, notes)
