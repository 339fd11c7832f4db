"""The routes of the pages about the fleet."""

from math import inf
from typing import Any, Final

from socast.core.errors import SettingsError
from socast.tools.workbench.fleet.cars import answer_question, describe_car, get_fleet
from socast.tools.workbench.fleet.player import Player
from socast.tools.workbench.json_routes import JsonRequest, JsonRoute, Workbench


def describe_density(workbench: Workbench, _: JsonRequest) -> dict[str, Any]:
    """Return where the fleet has driven."""
    board = get_fleet(workbench).board
    with board.lock:
        return board.density.describe()


def control_player(workbench: Workbench, request: JsonRequest) -> dict[str, Any]:
    """Control the player: `{"action": "play"}`, `{"action": "pause"}`, `{"speed": 60}`, `{"time_s": 1.7e9}`."""
    player = get_fleet(workbench)
    if not isinstance(player, Player):
        raise SettingsError("a live service cannot be paused: give recordings to replay")
    body = request.body
    if "speed" in body:
        player.set_speed(inf if body["speed"] == "max" else _read_number(body, "speed"))
    if "time_s" in body:
        player.seek(_read_number(body, "time_s"))
    if (action := body.get("action")) in {"play", "pause"}:
        player.play() if action == "play" else player.pause()
    elif action is not None:
        raise SettingsError(f"the action is {str(action)[:40]!r}; give play or pause")
    return player.describe()


def _read_number(body: Any, name: str) -> float:
    """Return a number of a request."""
    if not isinstance(value := body[name], int | float) or isinstance(value, bool):
        raise SettingsError(f"{name} is {str(value)[:40]!r}, must be a number")
    return float(value)


ROUTES: Final = (
    JsonRoute("/fleet/density", describe_density),
    JsonRoute("/fleet/source", lambda workbench, _: get_fleet(workbench).describe()),
    JsonRoute("/player", control_player, changes=True),
    JsonRoute("/cars/{car}", describe_car),
    JsonRoute("/cars/{car}/answer", answer_question),
)
"""Routes of these pages, under `/api`."""
