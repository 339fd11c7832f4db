"""The JSON record of a car: newest values, history of its shift, outlook, energy by term, and its rides."""

import shlex
from collections.abc import Mapping, Sequence
from math import nan
from typing import Any, Final

import msgspec
import numpy as np

from socast.core.errors import SocastError
from socast.core.forecast.soc_filter import SHIFT_GAP
from socast.core.wire.plan_checks import ShownParameter, ShownParameters, parse_leg
from socast.tools.commands.ask import figures, verdict
from socast.tools.terminal.time_zone import parse_zone
from socast.tools.workbench.fleet.board import POINT, Board
from socast.tools.workbench.fleet.frames import OF_SHIFT
from socast.tools.workbench.fleet.source import FleetSource
from socast.tools.workbench.json_routes import JsonRequest, NotFoundError, Workbench

MOST_SHOWN: Final = 600
"""Largest number of points of a history that a page receives; more are thinned out."""
MOST_RIDES: Final = 50
"""Largest number of rides of a car that a page receives, the newest."""
RIDE_FORM: Final[ShownParameters] = {
    "distance_km": ShownParameter("Distance", "kilometres"),
    "duration_s": ShownParameter("Duration", "minutes", 60.0),
    "gained_m": ShownParameter("Climb", "metres"),
    "lost_m": ShownParameter("Descent", "metres"),
}
"""Parameters of the ride of a question, as the form of the page names them."""


def get_fleet(workbench: Workbench) -> FleetSource:
    """Return the source of the fleet."""
    if workbench.fleet is None:
        raise NotFoundError("no recording and no live service was given: start `socast serve` with one")
    return workbench.fleet


def describe_car(workbench: Workbench, request: JsonRequest) -> dict[str, Any]:
    """Return the record of a car."""
    vehicle_id = request.path["car"]
    fleet = get_fleet(workbench)
    board = fleet.board
    with board.lock:
        row = board.find(vehicle_id)
        if row is None:
            raise NotFoundError(f"no car {vehicle_id[:64]!r} has sent anything so far: choose one on the page Fleet")
        is_over, values = bool(board.find_over()[row]), board.get_values(vehicle_id)
        record: dict[str, Any] = {
            "car": vehicle_id,
            "is_shift_over": is_over,
            "vehicle_model": board.models.get(vehicle_id),
            "ride_id": board.get_ride(vehicle_id),
            "age_s": float(board.get_ages()[row]),
            "values": values | dict.fromkeys(OF_SHIFT, nan) if is_over else values,
            "quality": board.quality.get(vehicle_id, {}),
            "history": make_history(board, vehicle_id),
            "rides": [ride for ride in board.rides if ride["vehicle_id"] == vehicle_id][-MOST_RIDES:],
            "parts": fleet.get_parts(vehicle_id),
        }
    try:
        record["outlook"] = fleet.ask(vehicle_id, {})
    except SocastError as error:
        record["outlook"], record["why_no_outlook"] = None, " ".join(str(error).split())
    return record


def make_history(board: Board, vehicle_id: str) -> dict[str, list[float]]:
    """Return the history of a car since its last long silence, as columns."""
    time, values = board.get_history(vehicle_id).tabulate()
    breaks = np.flatnonzero(np.diff(time) > SHIFT_GAP)
    begin = int(breaks[-1]) + 1 if len(breaks) else 0
    time, values = time[begin:], values[begin:]
    step = -(-len(time) // MOST_SHOWN) if len(time) else 1
    chosen = np.arange(len(time) - 1, -1, -step)[::-1]  # the newest point is always one of them
    columns = {name: np.round(values[chosen, i].astype(float), 3).tolist() for i, name in enumerate(POINT)}
    return {"time": np.round(time[chosen], 1).tolist(), **columns}


def answer_question(workbench: Workbench, request: JsonRequest) -> dict[str, Any]:
    """Return the answer to the question whether a car can take a ride, as `socast ask` prints it.

    The times in it are in the zone of the parameter `zone`.
    """
    given = {name: request.parameters[name] for name in RIDE_FORM if request.parameters.get(name)}
    vehicle_id = request.path["car"]
    parse_leg(given, RIDE_FORM)  # report mistakes in the words of the form
    outlook = get_fleet(workbench).ask(vehicle_id, given)
    word, sentence = verdict(outlook)
    zone = request.parameters.get("zone") or "UTC"
    return {
        "word": word,
        "sentence": sentence,
        "figures": [{"name": name, "text": text} for name, text in figures(outlook, parse_zone(zone))],
        "outlook": msgspec.to_builtins(outlook),
        "command": _find_command(vehicle_id, given, zone, get_fleet(workbench).list_ask_options()),
    }


def _find_command(vehicle_id: str, ride: Mapping[str, str], zone: str, options: Sequence[str] | None) -> str | None:
    """Return the command that gives the same answer, None where no command does."""
    if options is None:
        return None
    words = ["socast", "ask", vehicle_id]
    for name, value in ride.items():
        is_time = name == "duration_s"
        words += ["--duration-min" if is_time else f"--{name.replace('_', '-')}"]
        words += [f"{float(value) / 60.0:.12g}" if is_time else value]
    return shlex.join([*words, *options, "--time-zone", zone])
