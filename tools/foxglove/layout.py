"""A layout for Foxglove: a map of all cars, and a tab of plots and warnings for each car."""

from collections.abc import Sequence
from typing import Any, Final

from socast.tools.foxglove.schemas import INFO, LOCATION, LOG

MOST_CARS: Final = 20
"""Largest number of cars that have a tab."""
BLUE, ORANGE, GREY = "#0072b2", "#d55e00", "#999999"
"""Colours that colour-blind people distinguish."""
PLOTS: Final = {
    "State of charge [%]": (
        ("telemetry.soc_pct", "displayed", GREY),
        ("forecast.soc_pct", "filtered", BLUE),
        ("forecast.soc_end_of_shift_pct.mean", "end of shift", ORANGE),
        ("forecast.soc_end_of_shift_pct.p05", "end of shift, 5th percentile", ORANGE),
        ("forecast.soc_end_of_shift_pct.p95", "end of shift, 95th percentile", ORANGE),
    ),
    "Energy of the ride [kWh]": (
        ("forecast.ride_energy_predicted_kwh", "predicted", ORANGE),
        ("forecast.ride_energy_measured_kwh", "measured", BLUE),
    ),
    "Speed [km/h]": (("telemetry.speed_kmh", "speed", BLUE),),
}
"""Title of a plot -> kind of message and field, label and colour of each line."""


def make_layout(cars: Sequence[str]) -> dict[str, Any]:
    """Return a layout as Foxglove imports it.

    Parameters
    ----------
    cars : sequence of str
        Topics of cars without their last chunk, such as `montreal/fleet/taxi-7`. The first `MOST_CARS` have a tab.
    """
    panels: dict[str, Any] = {
        "map!fleet": {
            "foxglovePanelTitle": "Cars",
            "customTileUrl": "",
            "disabledTopics": [],
            "followTopic": f"{cars[0]}/{LOCATION}" if cars else "",
            "layer": "map",
            "topicColors": {},
            "zoomLevel": 11,
        }
    }
    tabs = [
        {"title": car.rpartition("/")[2], "layout": _add_car(panels, f"car{number}", car)}
        for number, car in enumerate(cars[:MOST_CARS], 1)
    ]
    panels["Tab!cars"] = {"activeTabIdx": 0, "tabs": tabs}
    return {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": _split("row", "map!fleet", "Tab!cars", 40),
    }


def _add_car(panels: dict[str, Any], name_of_car: str, car: str) -> dict[str, Any]:
    """Add the panels of a car, and return how they divide its tab."""
    soc, energy, speed = (f"Plot!{name_of_car}{kind}" for kind in ("soc", "energy", "speed"))
    for name, (title, lines) in zip((soc, energy, speed), PLOTS.items(), strict=True):
        panels[name] = _make_plot(car, title, lines)
    log = f"RosOut!{name_of_car}log"
    panels[log] = {"topicToRender": f"{car}/{LOG}", "minLogLevel": INFO, "searchTerms": []}
    return _split("column", _split("column", soc, energy, 60), _split("column", speed, log, 50), 60)


def _make_plot(car: str, title: str, lines: Sequence[tuple[str, str, str]]) -> dict[str, Any]:
    """Return a plot over time; topics are in quotes because names of cars may have hyphens and dots."""
    paths = []
    for field, label, colour in lines:
        kind, _, rest = field.partition(".")
        value = f'"{car}/{kind}".{rest}'
        paths.append(
            {"value": value, "label": label, "color": colour, "enabled": True, "timestampMethod": "receiveTime"}
        )
    return {
        "foxglovePanelTitle": title,
        "paths": paths,
        "xAxisVal": "timestamp",
        "isSynced": True,
        "showLegend": True,
        "legendDisplay": "floating",
        "showXAxisLabels": True,
        "showYAxisLabels": True,
    }


def _split(direction: str, first: Any, second: Any, percentage: float) -> dict[str, Any]:
    """Return two parts of the window side by side (`row`) or one above the other (`column`)."""
    return {"direction": direction, "first": first, "second": second, "splitPercentage": percentage}
