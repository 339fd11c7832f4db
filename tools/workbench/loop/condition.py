"""Records of the page about the condition of cars: each car's trend, and where the energy goes."""

from collections.abc import Sequence
from typing import Any

from socast.core.condition.energy_split import split_energy
from socast.core.condition.records import CarCondition, CarEvent, FleetCondition
from socast.tools.workbench.loop.command_lines import condition_commands
from socast.tools.workbench.loop.model_tree import ModelNode
from socast.tools.workbench.workspace import Workspace


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


def _describe_car(car: CarCondition, of_all: Sequence[CarEvent]) -> dict[str, Any]:
    """Return the record of a car with what is found of it in words, and with the events that its chart marks."""
    from socast.tools.report.condition import describe_car, describe_event  # noqa: PLC0415 - as above

    marked = [(each, describe_event(each)) for each in car.events]
    marked += [(each, f"{describe_event(each)} (all cars)") for each in of_all]
    marked.sort(key=lambda pair: pair[0].date)
    events = [{"date": each.date, "what": each.what or "event", "words": words} for each, words in marked]
    return {**car.to_json(), "usable_kwh": car.usable_kwh, "words": describe_car(car), "events": events}
