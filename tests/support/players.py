"""Players of the recorded shift."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from math import inf
from pathlib import Path

from socast.core.pipeline import Pipeline
from socast.tools.workbench.fleet.board import Board
from socast.tools.workbench.fleet.player import Player
from tests.support.paths import RECORDINGS
from tests.support.zenoh_sessions import eventually

SHIFT = RECORDINGS / "shift.mcap"


@contextmanager
def playing(*recordings: Path, speed: float = inf, make: Callable[[], Pipeline] = Pipeline) -> Iterator[Player]:
    """Give a player of recordings, by default of the shift, that waits for `play`."""
    player = Player(list(recordings) or [SHIFT], lambda _: make(), Board())
    player.set_speed(speed)
    player.start()
    try:
        yield player
    finally:
        player.close()


def wait_until_there(player: Player) -> None:
    """Wait until a player has reached the goal of a seek, or the end of the recording."""
    assert eventually(lambda: not (state := player.describe())["seeking"] and (state["at_end"] or not state["playing"]))


def stand_in_the_middle(player: Player, share: float = 0.5) -> None:
    """Let a player stand after a share of its recording, also when a page is opened."""
    player._has_been_shown = True
    player.set_speed(60.0)
    player.seek((player.begin_ns + share * (player.end_ns - player.begin_ns)) / 1e9)
    wait_until_there(player)
