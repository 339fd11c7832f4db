"""Records of the page about the condition of cars: trends, where the energy goes, and what a repair changed."""

from collections.abc import Sequence
from typing import Any, Final

from socast.core.condition.campaign import Campaign
from socast.core.condition.energy_split import split_energy
from socast.core.condition.records import CarCondition, CarEvent, FleetCondition
from socast.tools.commands.before_after import evaluate_campaign
from socast.tools.workbench.loop.command_lines import before_after_commands, condition_commands
from socast.tools.workbench.loop.model_tree import ModelNode
from socast.tools.workbench.workspace import Workspace

REPAIR_FORM: Final = {"vehicles": "Vehicles", "at": "Date", "until": "Last date", "toggle": "Days on"}
"""Parameters of a campaign, as the form of the page names them."""


def describe_condition(workspace: Workspace, node: ModelNode, found: FleetCondition) -> dict[str, Any]:
    """Return the trend of each car, the worst first, the parts of the energy, and the commands that do the same."""
    from socast.tools.report.condition import describe_fleet  # noqa: PLC0415 - the report draws with plotly

    energy = split_energy(workspace.tables.rides, node.model)
    return {
        "words": describe_fleet(found),
        "about": {**found.to_json(), "cars": len(found.cars)},
        "cars": [_describe_car(car, found.events) for car in found.cars],
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

    result = evaluate_campaign(workspace.tables.rides, node.model, campaign)
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


def _describe_car(car: CarCondition, of_all: Sequence[CarEvent]) -> dict[str, Any]:
    """Return the record of a car with what is found of it in words, and with the events that its chart marks."""
    from socast.tools.report.condition import describe_car, describe_event  # noqa: PLC0415 - as above

    marked = [(each, describe_event(each), False) for each in car.events]
    marked += [(each, f"{describe_event(each)} (all cars)", True) for each in of_all]
    marked.sort(key=lambda one: one[0].date)
    events = [
        {"date": each.date, "what": each.what, "words": words, "of_all": is_of_all} for each, words, is_of_all in marked
    ]
    return {**car.to_json(), "usable_kwh": car.usable_kwh, "words": describe_car(car), "events": events}
