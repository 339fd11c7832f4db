"""Records of the page about the condition of cars: each car's trend, and where the energy goes."""

from typing import Any

from socast.core.condition.energy_split import split_energy
from socast.core.condition.records import CarCondition, FleetCondition
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
        "cars": [_describe_car(car) for car in found.cars],
        "energy": energy.fleet.to_json(),
        "commands": condition_commands(workspace, node),
    }


def _describe_car(car: CarCondition) -> dict[str, Any]:
    """Return the record of a car with what is found of it in words."""
    from socast.tools.report.condition import describe_car  # noqa: PLC0415 - as above

    return {**car.to_json(), "usable_kwh": car.usable_kwh, "words": describe_car(car)}
