"""The simulator is deterministic, follows the wire contract, and hides effects of the requested size."""

import hashlib
import json
import os
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from datetime import UTC, datetime
from itertools import pairwise

import msgspec
import pytest

from socast.core.errors import SettingsError
from socast.core.wire.messages import KINDS, address
from socast.stream.mcap_reader import McapSource
from socast.tools.commands.simulate import simulate as simulate_command
from socast.tools.commands.simulate import write_simulation
from socast.tools.simulator.fleet import simulate
from socast.tools.simulator.settings import (
    NO_FAULTS,
    Hidden,
    Simulation,
)
from tests.support.paths import ROOT
from tests.support.simulated import PERFECT, SMALL, WINTER, decode_samples, run_simulation

DIGEST = """
from hashlib import sha256
from datetime import UTC, datetime
from socast.tools.simulator import Simulation, simulate
digest = sha256()
for message in simulate(Simulation(vehicles=3, start=datetime(2018, 1, 16, 12, tzinfo=UTC), shift_hours=1.0, seed=11)):
    digest.update(repr(message).encode())
print(digest.hexdigest())
"""


NIGHT = Simulation(
    vehicles=6, start=WINTER, shift_hours=10.0, seed=3, faults=NO_FAULTS, models=("nissan-leaf-2016",), charging="night"
)


@pytest.fixture(scope="module")
def night():
    return run_simulation(NIGHT)


@pytest.fixture(scope="module")
def faulty():
    return run_simulation(Simulation(vehicles=8, days=2, start=datetime(2018, 1, 15, tzinfo=UTC), seed=7))


@pytest.fixture(scope="module")
def perfect():
    return run_simulation(PERFECT)


class TestStream:
    def test_same_seed_gives_same_bytes_with_any_hash_seed(self):
        environment = os.environ | {"PYTHONHASHSEED": "4242"}
        other = subprocess.run(
            [sys.executable, "-c", DIGEST], env=environment, capture_output=True, text=True, check=True
        )
        digest = hashlib.sha256()
        for message in simulate(SMALL):
            digest.update(repr(message).encode())
        assert other.stdout.strip() == digest.hexdigest()

    def test_other_seed_gives_other_messages(self):
        assert run_simulation(SMALL)[0] != run_simulation(replace(SMALL, seed=12))[0]

    def test_messages_of_a_car_are_independent_of_other_cars(self, perfect):
        alone = run_simulation(replace(PERFECT, vehicles=1))[0]
        assert [m for m in alone if "taxi-001" in m.key] == [m for m in perfect[0] if "taxi-001" in m.key]

    def test_longer_simulation_begins_with_the_messages_of_a_shorter_one(self, perfect):
        two, _ = run_simulation(replace(PERFECT, days=2))
        assert two[: len(perfect[0])] == perfect[0]

    def test_messages_are_in_order_of_receipt_and_follow_the_contract(self, faulty):
        messages, truth = faulty
        assert all(a.receipt_ns <= b.receipt_ns for a, b in pairwise(messages))
        undecodable = 0
        for message in messages:
            try:
                value = msgspec.json.decode(message.payload, type=KINDS[address(message.key).kind])
            except (msgspec.MsgspecError, UnicodeDecodeError):
                undecodable += 1
                continue
            assert address(message.key).identity in {getattr(value, "vehicle_id", ""), getattr(value, "station_id", "")}
        injected = truth.summary()["faults"]["undecodable"]
        assert injected <= undecodable <= injected + 2  # a broken payload may be sent twice

    def test_messages_include_rides_plans_and_weather(self, perfect):
        messages, truth = perfect
        kinds = Counter(address(m.key).kind for m in messages)
        assert kinds["vehicle"] == 3
        assert kinds["ride"] == 2 * len(truth.rides)
        assert kinds["plan"] == len(truth.rides) + 3
        assert kinds["weather"] >= 6
        assert address(messages[0].key).kind == "weather"  # so that the first sample has weather
        first = next(json.loads(m.payload) for m in messages if "taxi-001/plan" in m.key)
        rides = [ride for ride in truth.rides if ride["vehicle_id"] == "taxi-001"]
        assert len(first["legs"]) == len(rides)
        assert [leg["distance_km"] for leg in first["legs"]] == pytest.approx(
            [ride["distance_km"] for ride in rides], rel=0.25
        )

    def test_command_writes_recording_and_truth(self, tmp_path, capsys):
        out = tmp_path / "small.mcap"
        simulate_command(
            out=out, vehicles=2, start="2018-01-16T12:00", shift_hours=0.5, seed=3, hidden=["headwind:0.05"]
        )
        source = McapSource(out)
        assert source.metadata["command"] == "simulate"
        assert json.loads(source.metadata["settings"]) == {
            "vehicles": 2,
            "start": "2018-01-16T12:00:00Z",
            "shift_hours": 0.5,
            "seed": 3,
        }
        truth = json.loads((tmp_path / "small.truth.json").read_text())
        messages = [message for block in source for message in block]
        again = Simulation(vehicles=2, start=WINTER, shift_hours=0.5, seed=3, hidden=(Hidden("headwind", 0.05),))
        assert messages == list(simulate(again))
        assert truth["total"]["messages"] == len(messages)
        assert truth["simulation"]["hidden"] == {"headwind": 0.05}
        write_simulation(again, tmp_path / "again.mcap")
        assert (tmp_path / "again.mcap").read_bytes() == out.read_bytes()
        assert "headwind" in capsys.readouterr().out

    def test_wrong_settings_write_no_file(self, tmp_path):
        with pytest.raises(SettingsError, match="no car model is called 'trabant'"):
            write_simulation(replace(SMALL, models=("trabant",)), tmp_path / "x.mcap")
        assert not list(tmp_path.iterdir())


class TestNight:
    """Cars charge between shifts only."""

    def test_no_car_charges_in_a_shift_and_empty_cars_stop(self, night):
        samples = {name: decode_samples(night[0], name) for name in night[1].cars}
        assert not any(one.charging for samples_of_car in samples.values() for one in samples_of_car)
        by_day = run_simulation(replace(NIGHT, charging="low"))[0]
        assert any(one.charging for one in decode_samples(by_day))
        empty = {name: samples_of_car[-1].soc_pct < 0.1 for name, samples_of_car in samples.items()}
        assert any(empty.values())
        for name, samples_of_car in samples.items():
            planned = next(json.loads(m.payload)["shift_end_s"] for m in night[0] if m.key == f"fleet/{name}/plan")
            assert (planned - samples_of_car[-1].time_s > 60.0) == empty[name], name
            assert min(one.soc_pct for one in samples_of_car[:-10]) > 0.0

    def test_plan_stays_unchanged_when_a_car_stops(self, night):
        messages, truth = night
        remaining_legs = 0
        for name in truth.cars:
            plans = [json.loads(m.payload) for m in messages if m.key == f"fleet/{name}/plan"]
            done = sum(ride["vehicle_id"] == name for ride in truth.rides)
            assert {plan["shift_end_s"] for plan in plans} == {plans[0]["shift_end_s"]}
            assert [len(plan["legs"]) for plan in plans] == [len(plans[0]["legs"]) - i for i in range(done + 1)]
            remaining_legs += len(plans[-1]["legs"])
        assert remaining_legs > 0


class TestShippedRecording:
    FOLDER = ROOT / "recordings"

    def test_recording_agrees_with_its_truth_and_its_page(self):
        truth = json.loads((self.FOLDER / "shift.truth.json").read_text())
        messages = [message for block in McapSource(self.FOLDER / "shift.mcap") for message in block]
        counts, page = truth["total"]["faults"], (self.FOLDER / "README.md").read_text()
        assert len(messages) == truth["total"]["messages"]
        kinds = Counter(address(message.key).kind for message in messages)
        assert kinds["telemetry"] == counts["samples_sent"] + counts["duplicate"]
        assert kinds["ride"] == 2 * truth["total"]["rides"]
        assert min(counts[fault] for fault in ("tunnel", "jitter", "duplicate", "gap")) > 4
        for figure in ("messages", "rides", "distance_km", "energy_kwh"):
            value = truth["total"][figure]
            assert (f"{value:,}" if isinstance(value, int) else f"{value:.1f}") in page, figure
        assert f"--seed {truth['simulation']['seed']}" in page

    def test_recording_is_small_and_short(self):
        assert (self.FOLDER / "shift.mcap").stat().st_size < 3_000_000
        truth = json.loads((self.FOLDER / "shift.truth.json").read_text())
        hours = (max(ride["end_s"] for ride in truth["rides"]) - min(ride["start_s"] for ride in truth["rides"])) / 3600
        assert 2 < hours < 4
