"""Each condition changes what it names and nothing else, and none is on by default."""

from collections import defaultdict
from dataclasses import replace
from datetime import UTC, datetime

import msgspec
import numpy as np
import pytest

from socast.core.errors import SettingsError
from socast.core.wire.messages import address
from socast.tools.simulator.conditions import (
    ABSENT,
    DISPLAY_FAULTS,
    FROZEN,
    JUMPING,
    NO_CONDITIONS,
    Conditions,
    DisplayFault,
    Newcomers,
    Spell,
    parse_conditions,
)
from socast.tools.simulator.displays import spoil_display
from socast.tools.simulator.fleet import make_members
from socast.tools.simulator.settings import ALL_PHENOMENA, FLEETS, NO_FAULTS, Simulation, get_fleet
from socast.tools.simulator.weather import make_sky
from tests.support.simulated import decode_samples, run_simulation

START = datetime(2018, 11, 5, tzinfo=UTC)
FLEET = Simulation(
    vehicles=2, days=1, start=START, shift_hours=1.5, seed=5, faults=NO_FAULTS, models=("nissan-leaf-2013",)
)
LONG = replace(FLEET, vehicles=1, shift_hours=9.0)


def simulate(fleet=FLEET, **conditions):
    """Return the messages and the truth of a fleet with conditions."""
    return run_simulation(replace(fleet, conditions=Conditions(**conditions)))


def list_plans(messages):
    """Return the plans as JSON objects."""
    return [msgspec.json.decode(m.payload) for m in messages if address(m.key).kind == "plan"]


@pytest.fixture(scope="module")
def usual():
    return run_simulation(FLEET)


@pytest.fixture(scope="module")
def long_day():
    return run_simulation(LONG)


def test_without_conditions_truth_is_as_before(usual):
    _, truth = usual
    assert "conditions" not in truth.settings
    assert truth.displays == []


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", NO_CONDITIONS),
        ("heater_habits,waits=0.2", Conditions(heater_habits=True, waits=0.2)),
        ("spell=30:-15:3,spell=40:10:1", Conditions(spells=(Spell(30, -15.0, 3), Spell(40, 10.0, 1)))),
        ("display_fault=2:frozen:10:5", Conditions(display_faults=(DisplayFault(2, FROZEN, 10, 5),))),
        ("battery_size=24,battery_size=40", Conditions(battery_sizes=(24.0, 40.0))),
        ("newcomers=1:20", Conditions(newcomers=Newcomers(1, 20))),
        ("period=10,period=0", Conditions(periods=(10.0, 0.0))),
    ],
)
def test_text_gives_conditions(text, expected):
    assert parse_conditions(text) == expected


@pytest.mark.parametrize(
    "text",
    [
        "thaw",
        "waits=2",
        "waits=often",
        "heater_habits=1",
        "spell=30:-15",
        "spell=0:-15:3",
        "display_fault=1:melted:1:1",
        "battery_size=1",
        "period=90",
        "period=0.7",
    ],
)
def test_wrong_text_raises_with_remedy(text):
    with pytest.raises(SettingsError, match=r"choose from|give|write it"):
        parse_conditions(text)


def test_conditions_of_own_cars_do_not_apply_to_preset():
    with pytest.raises(SettingsError, match="has its own cars and drivers"):
        Simulation(preset="teo", conditions=Conditions(heater_habits=True))
    with pytest.raises(SettingsError, match="newcomers 2:0"):
        replace(FLEET, conditions=Conditions(newcomers=Newcomers(2, 0)))


@pytest.mark.parametrize(("kelvin", "find"), [(-15.0, np.min), (10.0, np.max)])
def test_spell_goes_beyond_all_hours_before_it_by_so_much(kelvin, find):
    start = START.timestamp()
    usual, spell = (make_sky(start, 12, 3, spells=spells) for spells in ((), (Spell(8, kelvin, 2),)))
    first = start + 8 * 86400 + 5 * 3600
    before, inside = (usual.time >= start) & (usual.time < first), (usual.time >= first) & (usual.time < first + 172800)
    assert find(spell.temperature[inside]) == pytest.approx(find(usual.temperature[before]) + kelvin)
    apart = (usual.time < first - 6 * 3600) | (usual.time > first + 172800 + 6 * 3600)
    np.testing.assert_array_equal(spell.temperature[apart], usual.temperature[apart])


def test_heater_habits_give_few_drivers_who_heat_differently():
    _, truth = simulate(replace(FLEET, vehicles=4, days=4), heater_habits=True)
    drivers = {car: {ride["driver_id"] for ride in truth.rides if ride["vehicle_id"] == car} for car in truth.cars}
    assert all(1 <= len(each) <= 4 for each in drivers.values())
    assert len(set.union(*drivers.values())) <= 7


def test_waits_lengthen_the_time_between_rides():
    def count_rides(truth):
        return len(truth.rides) / (truth.rides[-1]["end_s"] - truth.rides[0]["start_s"])

    assert count_rides(simulate(LONG, waits=1.0)[1]) < 0.6 * count_rides(run_simulation(LONG)[1])


def test_passengers_who_do_not_come_vanish_from_the_plan(long_day):
    messages, truth = simulate(LONG, no_shows=0.5)
    planned = len(list_plans(messages)[0]["legs"])
    assert planned > len(truth.rides) > 0
    assert list_plans(messages)[-1]["legs"] == []
    assert len(list_plans(long_day[0])[0]["legs"]) == len(long_day[1].rides)


def test_plan_spread_makes_planned_distances_wrong_by_so_much():
    messages, truth = simulate(replace(LONG, vehicles=4, days=2), plan_spread=0.5)
    every, ratios = list_plans(messages), []
    for car in truth.cars:
        rides = iter([ride["distance_km"] for ride in truth.rides if ride["vehicle_id"] == car])
        plans = [plan for plan in every if plan["vehicle_id"] == car]
        firsts = [plan for last, plan in zip([None, *plans], plans, strict=False) if not last or not last["legs"]]
        ratios += [leg["distance_km"] / km for first in firsts for leg, km in zip(first["legs"], rides, strict=False)]
    assert len(ratios) > 200
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.15)
    assert 0.3 < np.std(ratios) < 0.7


def test_replans_replace_what_is_far_ahead(long_day):
    messages, truth = simulate(LONG, replans=0.3)
    driven = list_plans(long_day[0])[0]["legs"]
    first, later = list_plans(messages)[0]["legs"], list_plans(messages)[-4]["legs"]
    assert first != driven
    assert all(leg in driven for leg in later[:1])
    assert [ride["distance_km"] for ride in truth.rides] == [ride["distance_km"] for ride in long_day[1].rides]


def test_without_plan_no_plan_is_sent(usual):
    messages, _ = simulate(no_plan=1.0)
    assert list_plans(usual[0])
    assert list_plans(messages) == []


def test_planned_charges_are_legs_until_they_are_over(long_day):
    messages, _ = simulate(LONG, planned_charges=True)
    charges = [[leg for leg in plan["legs"] if "charge_to_soc_pct" in leg] for plan in list_plans(messages)]
    assert len(charges[0]) >= 1
    assert charges[-1] == []
    assert all(leg["duration_s"] > 1000 and 30 < leg["charge_to_soc_pct"] <= 90 for leg in charges[0])
    assert not any("charge_to_soc_pct" in leg for plan in list_plans(long_day[0]) for leg in plan["legs"])


def test_aged_packs_hold_14_to_17_kwh_of_24():
    members = make_members(replace(FLEET, vehicles=3, conditions=Conditions(aged_packs=2 / 3)))
    left = sorted(member.car.capacity * (1 - member.car.wear) / 3.6e6 for member in members)
    assert all(13.5 < kwh < 17.5 for kwh in left[:2])
    assert left[2] > 19.0


def test_cars_announce_their_battery_size():
    messages, truth = simulate(battery_sizes=(24.0, 40.0))
    announced = [msgspec.json.decode(m.payload) for m in messages if address(m.key).kind == "vehicle"]
    assert {each["vehicle_id"]: each["nominal_capacity_kwh"] for each in announced} == {
        "taxi-001": 24.0,
        "taxi-002": 40.0,
    }
    small, large = (car["capacity"] for car in truth.cars.values())
    assert large / small == pytest.approx(40 / 24, rel=0.1)


def test_newcomers_join_with_drivers_of_their_own():
    messages, truth = simulate(replace(FLEET, days=3), newcomers=Newcomers(1, 2), heater_habits=True)
    first = {car: min(s.time_s for s in decode_samples(messages, car)) for car in truth.cars}
    assert first["taxi-001"] < START.timestamp() + 86400 + 6 * 3600 < first["taxi-002"] - 86400
    drivers = [{ride["driver_id"] for ride in truth.rides if ride["vehicle_id"] == car} for car in truth.cars]
    assert not drivers[0] & drivers[1]


def test_coulomb_display_differs_smoothly_from_the_true_charge():
    _, truth = simulate(LONG, coulomb_display=True)
    (display,) = truth.displays
    gap = np.array(display["shown_pct"]) - display["soc_pct"]
    assert 0.2 < np.abs(gap).max() < 15.0
    assert np.abs(np.diff(gap)).max() < 1.0


@pytest.mark.parametrize("kind", DISPLAY_FAULTS)
def test_faulty_display_concerns_one_car_and_leaves_the_truth(kind):
    healthy, truth = simulate(coulomb_display=True)
    faulty, same = simulate(coulomb_display=True, display_faults=(DisplayFault(1, kind, 0, 1),))
    assert [m for m in healthy if "taxi-002" in m.key] == [m for m in faulty if "taxi-002" in m.key]
    assert [each["shown_pct"] for each in truth.displays] == [each["shown_pct"] for each in same.displays]
    assert [each["fault"] for each in same.displays] == [kind, None]
    shown, sent = (np.array([s.soc_pct for s in decode_samples(m, "taxi-001")], float) for m in (healthy, faulty))
    assert not np.array_equal(shown, sent, equal_nan=True)


def test_kinds_of_display_faults():
    shown, rng = np.linspace(90.0, 30.0, 40_000), np.random.default_rng(1)
    assert np.isnan(spoil_display(shown, ABSENT, rng)[7200:]).all()
    assert len(np.unique(spoil_display(shown, FROZEN, rng)[7200:])) == 1
    jumps = spoil_display(shown, JUMPING, rng) - shown
    assert 0.02 < np.mean(np.abs(jumps) >= 5.0) < 0.9


@pytest.mark.parametrize("name", FLEETS)
def test_named_fleets_depend_on_the_seed(name):
    fleet = get_fleet(name, 4)
    assert fleet.seed == 4
    assert fleet.phenomena == ALL_PHENOMENA._replace(foreign=True)
    with pytest.raises(SettingsError, match="choose from autumn"):
        get_fleet("spring", 1)


def test_loggers_have_the_periods_given_on_the_same_drives(usual):
    messages, truth = simulate(periods=(10.0, 0.0))
    assert truth.rides == usual[1].rides
    times, announced = defaultdict(list), {}
    for message in messages:
        _, vehicle, kind = f"{message.key}/".split("/")[:3]
        content = msgspec.json.decode(message.payload)
        if kind == "telemetry":
            times[vehicle].append(content["time_s"])
        elif kind == "vehicle":
            announced[vehicle] = content.get("period_s")
    assert np.diff(times["taxi-001"]) == pytest.approx(10.0)
    steps = np.diff(times["taxi-002"])
    assert steps.min() == 1.0
    assert steps.max() == 60.0
    assert len(set(steps)) > 10
    assert announced == {"taxi-001": None, "taxi-002": 0.0}
    assert [truth.cars[name]["logger_period_s"] for name in announced] == [10.0, 0.0]


def test_way_home_follows_the_last_ride_and_is_not_planned(long_day):
    (before, _), (messages, truth) = long_day, simulate(LONG, way_home=1.0)
    rest = []
    for sent in (before, messages):
        samples = list(decode_samples(sent))
        last = max(i for i, sample in enumerate(samples) if sample.ride_id is not None)
        rest.append((samples[-1].odometer_km or 0.0) - (samples[last].odometer_km or 0.0))
    assert rest[0] < 0.1
    assert 1.0 < rest[1] < 10.0
    assert len(list_plans(messages)[0]["legs"]) == len(truth.rides)
