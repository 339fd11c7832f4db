"""Draw the pictures of the workbench: `python -m tests.support.workbench_pictures` writes them to `docs`."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np
from PIL import Image

from socast.tools.workbench.fleet.player import Player
from socast.tools.workbench.jobs import Jobs
from socast.tools.workbench.json_routes import Workbench
from socast.tools.workbench.workspace import Workspace
from tests.support.browsers import Visit, open_browser
from tests.support.evening_shift import EVENING, make_evening_pipeline
from tests.support.paths import ROOT
from tests.support.players import playing, stand_in_the_middle
from tests.support.workbenches import serve

DOCS: Final = ROOT / "docs"
SIZE: Final = {"width": 1280, "height": 860}
PICTURES: Final = {
    "workbench-fleet.png": ("#/fleet", ".fleet-table tr.car"),
    "workbench-car.png": ("#/car/taxi-003?km=18&min=25", ".answer .chip"),
}
"""Picture -> address of its page, and what shows that the page is complete."""


@contextmanager
def playing_the_evening() -> Iterator[Player]:
    """Give a player that stands at the first minutes after midnight UTC, when the finding has been published."""
    with playing(EVENING, make=make_evening_pipeline) as player:
        stand_in_the_middle(player, 0.66)
        yield player


def take_pictures(browser: Any, server: Any, folder: Path) -> None:
    """Write the pictures of a server, whose player stands still, to a folder."""
    visit = Visit(browser, server, SIZE)
    for name, (address, complete) in PICTURES.items():
        visit.go(address)
        visit.page.wait_for_selector(complete)
        visit.page.wait_for_load_state("networkidle")
        visit.page.screenshot(path=folder / name)
        with Image.open(folder / name) as picture:
            whole = picture.convert("RGB")
        whole.save(folder / name, optimize=True)  # a palette would lose the colours of small marks
    visit.close()


def measure_difference(one: Path, other: Path) -> float:
    """Return the mean difference of two pictures of the same size, from 0 to 1."""
    pixels = [np.asarray(Image.open(path).convert("RGB"), float) for path in (one, other)]
    return float(np.abs(pixels[0] - pixels[1]).mean()) / 255.0


if __name__ == "__main__":
    with (
        playing_the_evening() as player,
        serve(Workbench(Workspace(), Jobs(), fleet=player)) as server,
        open_browser() as browser,
    ):
        take_pictures(browser, server, DOCS)
