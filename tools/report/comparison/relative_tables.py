"""Build the table of errors in percent and over the noise floor, of the models that a comparison holds."""

from socast.core.evaluate.compare.records import ComparedModel, Comparison
from socast.core.evaluate.relative_errors import LEAST_ENERGY
from socast.tools.report.cells import ReportTable, format_energy, format_percent
from socast.tools.report.evaluation.percentage_tables import FLOOR_NOTE, PERCENT_NOTE, format_ratio, format_share
from socast.tools.report.record_table import tabulate_records


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
