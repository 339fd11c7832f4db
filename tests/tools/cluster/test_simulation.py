"""The recording of a fleet whose cars are driven apart holds the messages of a simulation in memory, in their order."""

from dataclasses import replace

import pytest

from socast.stream.mcap_reader import McapSource
from socast.tools.cluster.runner import InProcessRunner
from socast.tools.cluster.simulation import write_recording
from socast.tools.cluster.workers import Workers
from socast.tools.simulator import car_files
from socast.tools.simulator.car_files import merge_cars, plan_merge
from socast.tools.simulator.conditions import parse_conditions
from socast.tools.simulator.fleet import describe_fleet, drive_car, prepare_fleet
from socast.tools.simulator.settings import Faults, Hidden, Simulation
from socast.tools.simulator.truth import Truth
from tests.support.commands import done, refused
from tests.support.simulated import run_simulation

PLAIN = Simulation(vehicles=3, days=2, shift_hours=0.5, seed=3)


def write(simulation, folder):
    """Return the messages of the recording and its truth."""
    (folder / "scratch").mkdir()
    fleet = prepare_fleet(simulation)
    truth = write_recording(fleet, folder / "a.mcap", Workers(InProcessRunner(), folder / "scratch", lambda *_: None))
    return [message for part in McapSource(folder / "a.mcap") for message in part], truth


@pytest.mark.parametrize(
    "simulation",
    [
        PLAIN,
        replace(PLAIN, hidden=(Hidden("headwind", 0.05),), conditions=parse_conditions("weather_forecasts,waits=0.5")),
        replace(PLAIN, shift_hours=12.0, vehicles=2, faults=Faults(errand=1.0)),
    ],
    ids=["plain", "hidden and conditions", "long shifts"],
)
def test_recording_and_truth_are_those_of_a_simulation_in_memory(simulation, tmp_path, monkeypatch):
    monkeypatch.setattr(car_files, "GROUP_ROWS", 7)
    monkeypatch.setattr(car_files, "GROUPS_AT_A_TIME", 5)
    written, truth = write(simulation, tmp_path)
    messages, expected = run_simulation(simulation)
    assert written == sorted(messages, key=lambda message: message.receipt_ns)
    expected.messages = len(messages)
    assert vars(truth) == vars(expected)
    assert list(truth.rides[0]) == list(expected.rides[0])


def test_merge_holds_a_part_of_the_messages_at_a_time(tmp_path, monkeypatch):
    monkeypatch.setattr(car_files, "GROUP_ROWS", 10)
    monkeypatch.setattr(car_files, "GROUPS_AT_A_TIME", 4)
    fleet, cars, truth = prepare_fleet(PLAIN), [], Truth()
    describe_fleet(fleet, truth)
    for number, member in enumerate(fleet.members):
        writer = car_files.CarWriter(tmp_path / str(number))
        for messages in drive_car(fleet, member, truth):
            writer.write(messages)
        cars.append(car_files.CarFile(member.name, tmp_path / str(number), writer.close(), [], {}))
    sizes = [len(part) for part in merge_cars(cars)]
    assert len(sizes) == len(plan_merge(cars)) > 20
    assert max(sizes) <= 10 * (4 + len(cars))


def test_folder_that_does_not_exist_is_refused_in_one_line(tmp_path, capsys):
    message = refused(capsys, "simulate", "--out", tmp_path / "absent" / "a.mcap", "--vehicles", 1)
    assert "cannot be written: No such file or directory; name a file in an existing folder" in message


def test_command_leaves_nothing_but_recording_and_truth(tmp_path):
    done("simulate", "--out", tmp_path / "a.mcap", "--vehicles", 1, "--shift-hours", 0.25)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.mcap", "a.truth.json"]
