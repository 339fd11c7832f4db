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

from core.errors import SettingsError
from core.wire.messages import KINDS, address
from stream.mcap_reader import McapSource
from tests.support.paths import ROOT
from tests.support.simulated import PERFECT, SMALL, SUMMER, WINTER, decode_samples, run_simulation
from tools.commands.simulate import simulate as simulate_command
from tools.commands.simulate import write_simulation
from tools.simulator.fleet import simulate
from tools.simulator.hidden import EFFECTS
from tools.simulator.physics import PARTS, WHEEL
from tools.simulator.settings import (
    ALL_PHENOMENA,
    NO_FAULTS,
    PLAIN_PHENOMENA,
    Faults,
    Hidden,
    Simulation,
    parse_faults,
    parse_hidden,
    parse_models,
    parse_phenomena,
    parse_start,
)

DIGEST = """
from hashlib import sha256
from datetime import UTC, datetime
from tools.simulator import Simulation, simulate
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
        truth = json.loads((tmp_path / "small.truth.json").read_text())
        messages = [message for block in McapSource(out) for message in block]
        again = Simulation(vehicles=2, start=WINTER, shift_hours=0.5, seed=3, hidden=(Hidden("headwind", 0.05),))
        assert messages == list(simulate(again))
        assert truth["total"]["messages"] == len(messages)
        assert truth["simulation"]["hidden"] == {"headwind": 0.05}
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


class TestHidden:
    @pytest.mark.parametrize("effect", sorted(EFFECTS))
    def test_effect_takes_its_share_of_the_energy(self, effect):
        warm = {"cabin_cooling", "solar_load", "wet_road", "humidity"}
        start = SUMMER if effect in warm else WINTER
        simulation = Simulation(
            vehicles=5, start=start, shift_hours=1.5, seed=1, faults=NO_FAULTS, hidden=(Hidden(effect, 0.04),)
        )
        _, truth = run_simulation(simulation)
        effect_total = truth.summary()["hidden"][effect]
        assert effect_total["absolute_share"] == pytest.approx(0.04, rel=0.02)
        assert effect_total["energy_kwh"] == pytest.approx(sum(r["hidden_kwh"][effect] for r in truth.rides), abs=1e-3)

    def test_hidden_energy_comes_from_the_battery(self):
        plain = Simulation(vehicles=2, start=WINTER, shift_hours=1.5, seed=1, faults=NO_FAULTS)
        both = replace(plain, hidden=(Hidden("standby", 0.05), Hidden("roof_load", 0.02)))
        (_, before), (_, after) = run_simulation(plain), run_simulation(both)
        hidden = sum(sum(ride["hidden_kwh"].values()) for ride in after.rides)
        assert hidden / after.summary()["energy_kwh"] == pytest.approx(0.07, rel=0.05)
        gain = after.summary()["energy_kwh"] - before.summary()["energy_kwh"]
        assert gain == pytest.approx(hidden, rel=0.03)
        assert after.summary()["parts_kwh"]["hidden"] == pytest.approx(hidden, rel=1e-3)

    def test_effect_that_never_acts_is_rejected(self):
        with pytest.raises(SettingsError, match=r"cabin_cooling.*choose other dates"):
            simulate(replace(SMALL, hidden=(Hidden("cabin_cooling"),)))

    def test_unknown_effect_is_rejected(self):
        with pytest.raises(SettingsError, match="no hidden effect is called 'magic'; choose from age"):
            simulate(replace(SMALL, hidden=(Hidden("magic"),)))


class TestSettings:
    @pytest.mark.parametrize(
        ("parse", "text", "message"),
        [
            (parse_faults, "fog=0.1", "no fault is called 'fog'; choose from jitter"),
            (parse_faults, "gap=2", "fault gap has rate '2'; give gap=0 to gap=1"),
            (parse_faults, "gap", "fault gap has rate ''"),
            (parse_phenomena, "all,-fog", "no phenomenon is called 'fog'"),
            (parse_hidden, "headwind:x", "has size 'x'"),
            (parse_start, "yesterday", "'yesterday' is not a date"),
            (parse_models, " , ", "names none"),
        ],
    )
    def test_error_names_the_unknown_name(self, parse, text, message):
        with pytest.raises(SettingsError, match=message):
            parse(text)

    @pytest.mark.parametrize(
        "change",
        [
            {"vehicles": 0},
            {"days": 0},
            {"day_step": 0},
            {"shift_hours": 30.0},
            {"seed": -1},
            {"hidden": (Hidden("age", 0.0),)},
            {"hidden": (Hidden("age"), Hidden("age"))},
            {"days": 100, "day_step": 100},
            {"start": datetime(1970, 1, 1, tzinfo=UTC)},
            {"charging": "never"},
        ],
    )
    def test_settings_out_of_bounds_are_rejected(self, change):
        with pytest.raises(SettingsError, match=r"give|choose"):
            replace(SMALL, **change)

    def test_text_selects_phenomena_faults_and_start(self):
        assert parse_phenomena("plain") == PLAIN_PHENOMENA
        assert parse_phenomena("all") == ALL_PHENOMENA
        assert parse_phenomena("plain,-climate") == PLAIN_PHENOMENA._replace(climate=False)
        assert parse_faults("none") == NO_FAULTS
        assert parse_faults("default") == Faults()
        assert parse_start("2018-01-15T07:00-05:00") == datetime(2018, 1, 15, 12, tzinfo=UTC)
        assert set(WHEEL) < set(PARTS)


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
