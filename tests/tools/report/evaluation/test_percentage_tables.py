"""Test the tables of percentage errors, of reductions below the baselines, and of the literature."""

from io import StringIO

import pytest
from rich.console import Console

from socast.core.evaluate.literature import LITERATURE
from socast.core.evaluate.paper.records import RecipeEvaluation
from socast.core.evaluate.records import EstimatedValue
from socast.core.fit.recipes import BASELINES, RECIPES
from socast.tools.report.document import Section, print_section
from socast.tools.report.evaluation.page import tabulate_headline, tabulate_overview
from socast.tools.report.evaluation.percentage_tables import (
    BASELINE_HEADS,
    BASELINE_NOTES,
    find_best_on_new_vehicles,
    format_share,
    get_new_vehicle_reductions,
    tabulate_baseline_reductions,
    tabulate_literature,
    tabulate_percentages,
    tabulate_percentages_of,
)
from tests.support.evaluation_result import evaluation, hold


@pytest.fixture(scope="module")
def result():
    return hold(evaluation())


def test_every_baseline_has_a_recipe_and_a_heading():
    assert tuple(BASELINE_HEADS) == tuple(BASELINE_NOTES) == BASELINES
    assert set(BASELINES) <= set(RECIPES)


def test_reductions_stand_beside_each_other_for_every_baseline(result):
    table = tabulate_baseline_reductions(result)
    assert table.columns == tuple(f"below {head}" for head in BASELINE_HEADS.values())
    rows = {row.name: [cell.text for cell in row.cells] for row in table.rows}
    shares = result.reduction_by_baseline
    best = [f"{100 * shares[name]['hybrid_trees']['average']:.1f} %" for name in BASELINES]
    assert rows["Hybrid Model with Boosted Trees"] == best
    assert rows["Basic Physical Model, Rescaled"][1] == ""
    assert "Basic Physical Model" not in rows


def test_table_without_rows_is_not_printed(result):
    console = Console(width=100, file=StringIO())
    empty = tabulate_headline(result)._replace(rows=())
    print_section(Section("glance", "At a glance", "", [empty, tabulate_overview(result)]), console)
    assert empty.title not in console.file.getvalue()
    assert "At a glance" in console.file.getvalue()


def test_reductions_on_unseen_vehicle_models_have_their_own_table(result):
    table = tabulate_baseline_reductions(result, new_vehicles=True)
    assert table.title == "Error below each baseline, vehicle model unseen"
    shares = get_new_vehicle_reductions(result, "hybrid_trees")
    cells = next(row.cells for row in table.rows if row.name == "Hybrid Model with Boosted Trees")
    assert [cell.text for cell in cells] == [f"{100 * shares[name]:.1f} %".replace("-", "−") for name in BASELINES]


@pytest.mark.parametrize("tabulate", [tabulate_baseline_reductions, tabulate_headline])
def test_tables_show_and_explain_only_the_baselines_of_the_evaluation(tabulate):
    result = evaluation()
    for of_baselines in (result["reduction_by_baseline"], result["new_vehicle"]):
        for name in ("basic_rescaled_power", "telematics_regression"):
            of_baselines.pop(name)
    table = tabulate(hold(result))
    assert table.columns == ("below basic", "below basic, rescaled")
    assert all(len(row.cells) == 2 for row in table.rows)
    assert "Basic, rescaled: one factor" in table.notes[1]
    assert "constant power" not in table.notes[1]
    assert "Telematics" not in table.notes[1]


def test_headline_states_the_reduction_below_every_baseline(result):
    table = tabulate_headline(result)
    assert [row.name for row in table.rows] == [
        "Hybrid Model (Interaction Terms)",
        "Hybrid Model with Boosted Trees",
        "Fitted Extended Physical Model (Linear Regression), vehicle model unseen",
        f"{result.recipes[find_best_on_new_vehicles(result)]}, vehicle model unseen",
    ]
    assert all(cell.text for row in table.rows for cell in row.cells)
    assert [row.cells[0].paper for row in table.rows] == ["51.75 %", "", "30.75 %", ""]
    assert "below that of the basic" not in " ".join(row.name for row in tabulate_overview(result).rows)


def test_reductions_on_unseen_vehicle_models_follow_from_their_errors():
    errors = {"basic_physical": (1.0, 2.0), "basic_rescaled": (0.5, 0.8), "hybrid": (0.25, 0.2)}
    found = {r: {"leaf": {"mae": a}, "soul": {"mae": b}} for r, (a, b) in errors.items()}
    result = hold({"about": {"vehicle_models": ["leaf", "soul"]}, "new_vehicle": found})
    shares = get_new_vehicle_reductions(result, "hybrid")
    assert shares["basic_physical"] == pytest.approx((0.75 + 0.9) / 2)
    assert shares["basic_rescaled"] == pytest.approx((0.5 + 0.75) / 2)
    assert shares["telematics_regression"] is None
    assert find_best_on_new_vehicles(result) == "hybrid"


def test_errors_are_shown_in_kwh_percent_and_over_noise(result):
    table = tabulate_percentages_of(result, "ride")
    assert table.columns == ("MAE, kWh", "wMAPE", "MAPE", "over noise")
    cells = {row.name: [cell.text for cell in row.cells] for row in table.rows}
    assert cells["Basic Physical Model"] == ["0.600 ± 0.020", "30.0 ± 1.0 %", "40.0 ± 1.5 %", "12.00 ×"]
    assert [row.name for row in table.rows if row.cells[0].strong] == ["Hybrid Model with Boosted Trees"]
    assert any("below 0.1 kWh, 1.3 % of all" in note for note in table.notes)


def test_literature_stands_beside_the_best_model_of_each_split(result):
    table = tabulate_literature(result)
    assert len(table.rows) == len(LITERATURE) + 3
    assert table.rows[0].cells[0].text == "5.0 %"
    assert any(note.startswith("Zhu et al. 2024: ") and "10.1109/TTE.2024.3416532" in note for note in table.notes)
    assert table.rows[-1].name == "here, unseen dates"
    assert table.rows[-1].cells[-1].text == "Hybrid Model with Boosted Trees"


def test_result_without_percentages_has_no_tables():
    assert tabulate_percentages(RecipeEvaluation()) == []
    gone = {"percentage": {}, "reduction_by_baseline": {}, "new_vehicle": {}}
    (only,) = tabulate_percentages(hold(evaluation() | gone))
    assert only.columns == ("below basic",)


def test_share_without_interval_is_shown_without_one():
    assert format_share(EstimatedValue(value=0.05)) == "5.0 %"
