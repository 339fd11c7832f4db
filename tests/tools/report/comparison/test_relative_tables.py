"""Test the table of errors in percent and over the noise floor."""

import msgspec

from socast.core.evaluate.compare.records import Comparison
from socast.tools.report.comparison.tables import tabulate_relative_errors

RESULT = msgspec.convert(
    {
        "about": {"noise_floor_kwh": 0.05, "below_least": 0.25},
        "models": {
            "basic": {"wmape": {"value": 0.5, "ci95": 0.02}, "mape": {"value": 0.6, "ci95": 0.03}, "over_floor": 9.0},
            "fitted": {
                "wmape": {"value": 0.1, "ci95": 0.01},
                "mape": {"value": None, "ci95": None},
                "over_floor": None,
            },
        },
    },
    Comparison,
)


def test_each_model_has_its_percentages_and_the_least_is_emphasised():
    table = tabulate_relative_errors(RESULT)
    assert [[cell.text for cell in row.cells] for row in table.rows] == [
        ["50.0 ± 2.0 %", "60.0 ± 3.0 %", "9.00 ×"],
        ["10.0 ± 1.0 %", "–", "–"],
    ]
    assert [row.cells[0].strong for row in table.rows] == [False, True]


def test_notes_state_noise_and_rides_left_out():
    notes = " ".join(tabulate_relative_errors(RESULT).notes)
    assert "causes 0.050 kWh" in notes
    assert "below 0.1 kWh, 25.0 % of all" in notes
