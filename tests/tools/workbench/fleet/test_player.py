"""The player drives the pipeline of a replay; a seek leads to the state of an uninterrupted run."""

from itertools import islice
from math import inf, nan

import numpy as np
import pytest

from socast.core.errors import AskError, SettingsError, SocastError
from socast.core.pipeline import Pipeline
from socast.stream.mcap_reader import McapSource
from socast.tools.workbench.fleet.board import Board
from socast.tools.workbench.fleet.player import Player
from tests.support.batched_recordings import write_batched
from tests.support.players import SHIFT, playing, wait_until_there
from tests.support.zenoh_sessions import eventually


@pytest.fixture(scope="module")
def player():
    """Return a player that has played the shift to its end."""
    with playing() as player:
        player.play()
        wait_until_there(player)
        player.pause()
        yield player


def state_of(player):
    """Return everything that pages show, in a form that can be compared."""
    board = player.board
    histories = [board.get_history(name).tabulate() for name in board.vehicle_ids]
    return (
        player.pipeline.snapshot(),
        board.vehicle_ids.copy(),
        [board.get_values(name) for name in board.vehicle_ids],
        [(time.tobytes(), values.tobytes()) for time, values in histories],
        sorted(str(ride) for ride in board.rides),
        board.quality.copy(),
    )


def run_until(time_ns):
    """Return the snapshot of a pipeline that took all messages up to a time at once."""
    pipeline = Pipeline()
    pipeline.take([message for block in McapSource(SHIFT) for message in block if message.receipt_ns <= time_ns])
    return pipeline.snapshot()


def at(player, share):
    return (player.begin_ns + share * (player.end_ns - player.begin_ns)) * 1e-9


def seek(player, time_s):
    player.seek(time_s)
    wait_until_there(player)
    assert player.describe()["time_s"] == pytest.approx(time_s, abs=0.01)


def test_play_to_the_end_gives_the_state_of_a_replay(player):
    seek(player, at(player, 1.0))
    assert player.pipeline.snapshot() == run_until(player.end_ns)
    assert len(player.board.rides) > 30
    assert all(ride["predicted_kwh"] is not None for ride in player.board.rides)


@pytest.mark.parametrize("share", [0.71, 0.3, 0.0])
def test_seek_back_and_forth_gives_the_state_of_an_uninterrupted_run(player, share):
    seek(player, at(player, share))
    there = state_of(player)
    assert there[0] == run_until(round(at(player, share) * 1e9))
    seek(player, at(player, 0.9))
    assert state_of(player)[0] != there[0]
    seek(player, at(player, share))
    assert str(state_of(player)) == str(there)


def test_epoch_of_the_board_tells_pages_that_rows_have_changed(player):
    seek(player, at(player, 0.5))
    before = player.board.epoch
    seek(player, at(player, 0.6))
    assert player.board.epoch == before
    seek(player, at(player, 0.2))
    assert player.board.epoch == before + 1


def test_player_names_the_model_that_makes_the_forecasts(player):
    assert player.describe()["model"] == "extended_physical/1"


def test_play_at_the_end_begins_again(player):
    seek(player, at(player, 1.0))
    player.play()
    assert eventually(lambda: player.describe()["time_s"] < player.end_ns * 1e-9 - 60.0 or player.describe()["at_end"])
    wait_until_there(player)
    player.pause()
    assert player.pipeline.snapshot() == run_until(player.end_ns)


def test_paced_play_takes_what_has_fallen_due_and_shortens_silences():
    clock = [0.0]
    with playing() as first:
        begin = first.begin_ns
    player = Player([SHIFT], lambda _: Pipeline(), Board(), clock=lambda: clock[0])
    player._begin()
    player.set_speed(10.0)
    player.play()
    player._play_on()
    clock[0] = 30.0
    player._play_on()
    position = player.describe()["time_s"] - begin * 1e-9
    assert position >= 300.0 - 1.0
    assert player._following_ns > player._position_ns
    player.pause()


def test_question_is_answered_as_by_the_command(player):
    seek(player, at(player, 0.6))
    name = player.board.vehicle_ids[0]
    outlook = player.ask(name, {"distance_km": "12", "duration_s": "1200"})
    assert outlook.asked.distance_km == 12.0
    with pytest.raises(AskError, match="must be"):
        player.ask(name, {"distance_km": "-1", "duration_s": "1200"})
    with pytest.raises(AskError, match="has sent nothing"):
        player.ask("horse", {})


def test_cars_of_batches_have_the_values_and_histories_of_the_same_samples_in_json(player, tmp_path):
    path = tmp_path / "batches.mcap"
    write_batched(McapSource(SHIFT), path, 100)
    seek(player, at(player, 1.0))
    with playing(path) as batched:
        batched.play()
        wait_until_there(batched)
        assert batched.board.counts["batch"] > 200
        for name in player.board.vehicle_ids:
            assert repr(batched.board.get_values(name)) == repr(player.board.get_values(name))
            for one, other in zip(
                *(each.board.get_history(name).tabulate() for each in (batched, player)), strict=True
            ):
                assert np.array_equal(one, other, equal_nan=True)
        assert np.isfinite(batched.board.column("latitude")).all()


def test_player_takes_a_limited_size_of_batches_at_once(monkeypatch, tmp_path):
    path, sizes = tmp_path / "batches.mcap", []
    write_batched(islice(McapSource(SHIFT), 2), path, 1000)
    messages = [message for block in McapSource(path) for message in block]
    largest = max(len(message.payload) for message in messages)
    monkeypatch.setattr("socast.tools.workbench.fleet.player.BLOCK_BYTES", 2 * largest)
    with playing(path) as player:
        monkeypatch.setattr(player.board, "take", lambda taken: sizes.append(sum(len(each.payload) for each in taken)))
        player.play()
        wait_until_there(player)
        assert sum(sizes) >= sum(len(message.payload) for message in messages)
    assert max(sizes) < 3 * largest


def test_parts_of_a_ride_sum_to_its_prediction(player):
    seek(player, at(player, 0.5))
    board = player.board
    riding = [name for name in board.vehicle_ids if board.get_values(name)["riding"]]
    assert riding
    for status in player.pipeline.status():
        parts = player.get_parts(status.forecast.vehicle_id)
        if parts is not None and status.forecast.ride_energy_predicted_kwh is not None:
            assert sum(parts.values()) == pytest.approx(status.forecast.ride_energy_predicted_kwh)
    assert any(player.get_parts(name) for name in riding)


@pytest.mark.parametrize("speed", [0.0, -1.0, nan, 1e9])
def test_impossible_speed_is_refused(player, speed):
    with pytest.raises(SettingsError, match="the speed is"):
        player.set_speed(speed)


@pytest.mark.parametrize("time", [0.0, -inf, inf, nan, 1e300])
def test_time_outside_the_recording_is_refused(player, time):
    with pytest.raises(SettingsError, match="outside the recording"):
        player.seek(time)


def test_player_that_cannot_begin_tells_pages_why():
    def refuse(_):
        raise SettingsError("the warm-up recording ends too late: give an earlier one")

    player = Player([SHIFT], refuse, Board())
    player.start()
    assert eventually(lambda: player.describe()["problem"])
    assert player.describe()["problem"].startswith("the warm-up recording")
    with pytest.raises(SocastError, match="loads the recording"):
        player.ask("taxi-001", {})
    player.close()
