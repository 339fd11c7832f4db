"""Records of the page about the condition of cars: trends, where the energy goes, and what a repair changed."""

from typing import Any, Final

from socast.core.condition.campaign import Campaign
from socast.core.condition.energy_split import split_energy
from socast.core.condition.records import CarCondition, FleetCondition
from socast.tools.commands.before_after import evaluate_campaign
from socast.tools.workbench.loop.command_lines import before_after_commands, condition_commands
from socast.tools.workbench.loop.model_tree import ModelNode
from socast.tools.workbench.workspace import Workspace

REPAIR_FORM: Final = {"vehicles": "Vehicles", "at": "Date", "until": "Last date", "toggle": "Days on"}
"""Parameters of a campaign, as the form of the page names them."""


def describe_condition(workspace: Workspace, node: ModelNode, found: FleetCondition) -> dict[str, Any]:
    """Return the condition of each car as `socast condition` says it, the parts of the energy, and these commands."""
    from socast.tools.report import condition as report  # noqa: PLC0415 - the report draws with plotly

    energy, frame = split_energy(workspace.tables.rides, node.named), report.find_frame(found)
    table = report.tabulate_cars(found)
    return {
        "words": report.describe_fleet(found),
        "about": report.describe_data(found),
        "note": report.FIGURE_NOTE,
        "frame": frame._asdict(),
        "cars": [{**_describe_car(car, found), "outside": report.count_outside(car, frame)} for car in found.cars],
        "table": {
            "title": table.title,
            "columns": [table.corner, *table.columns],
            "numeric": [False, *table.numeric],
            "rows": [[row.name, *(cell.text for cell in row.cells)] for row in table.rows],
            "notes": table.all_notes,
        },
        "energy": energy.fleet.to_json(),
        "commands": condition_commands(workspace, node),
    }


def complete_days_on(text: str) -> str:
    """Return days on that were typed as the text of a CSV file; a header of the dates is added where there is none.

    Examples
    --------
    >>> complete_days_on(" 2018-11-10, 2018-11-12 ").splitlines()
    ['begin,end', '2018-11-10,2018-11-12']
    """
    lines = [",".join(part.strip() for part in line.split(",")) for line in text.splitlines() if line.strip()]
    return "\n".join(["begin,end", *lines] if lines and lines[0][0].isdigit() else lines)


def compare_repair(workspace: Workspace, node: ModelNode, campaign: Campaign, days_on: str = "") -> dict[str, Any]:
    """Return the report of `socast before-after` with its words, and the placebo campaigns by estimate.

    `days_on` is the text of the file of days on, which the shown commands write.
    """
    from socast.tools.report.before_after import count_placebos, describe_campaign  # noqa: PLC0415 - as above

    result = evaluate_campaign(workspace.tables.rides, node.named, campaign)
    placebos = None
    if result.change and result.placebo.campaigns:
        counts, edges = count_placebos(result, result.change)
        placebos = {"counts": counts.tolist(), "edges_pct": edges.tolist()}
    return {
        "report": result.to_json(),
        "words": describe_campaign(result),
        "placebos": placebos,
        "commands": before_after_commands(workspace, node, result, days_on),
    }


def _describe_car(car: CarCondition, found: FleetCondition) -> dict[str, Any]:
    """Return the record of a car with what is found of it in words, and with the events that its chart marks."""
    from socast.tools.report import condition as report  # noqa: PLC0415 - as above

    marked = [(each, report.describe_event(each), False) for each in car.events]
    marked += [(each, f"{report.describe_event(each)} (all cars)", True) for each in found.events]
    marked.sort(key=lambda one: one[0].date)
    events = [
        {"date": each.date, "what": each.what, "words": words, "of_all": is_of_all} for each, words, is_of_all in marked
    ]
    words = report.describe_car(car, found.last_date) or f"{car.vehicle_id}: {report.CLEAR}"
    known = " ".join(report.describe_known(car, [each for each, _, _ in marked]))
    return {**car.to_json(), "usable_kwh": car.usable_kwh, "words": words, "known": known, "events": events}
