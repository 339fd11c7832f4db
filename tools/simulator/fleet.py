"""Simulate the shifts of every car of a fleet, and merge their messages with the weather in order of receipt."""

import heapq
from collections import Counter
from collections.abc import Iterator
from itertools import chain, islice
from operator import attrgetter, itemgetter
from typing import Final, NamedTuple

import numpy as np

from socast.core.batch import Floats
from socast.core.columns import SECONDS_PER_DAY
from socast.core.wire.messages import Message
from socast.tools.simulator import displays, habits, physics
from socast.tools.simulator import preset as presets
from socast.tools.simulator.cars import Car, make_car
from socast.tools.simulator.conditions import NO_CONDITIONS
from socast.tools.simulator.dispatch import make_dispatch
from socast.tools.simulator.hidden import EffectInputs
from socast.tools.simulator.hidden_shapes import calibrate_effects, check_effects, get_power, sum_energies
from socast.tools.simulator.logger import Equipment, log_shift, make_equipment
from socast.tools.simulator.preset import Fleet, PlannedCar, PlannedShift
from socast.tools.simulator.settings import NIGHT, UTC_OFFSET, Simulation
from socast.tools.simulator.shift import Orders, Shift, draw_orders, make_shift, stop_shift
from socast.tools.simulator.trace import Trace, make_trace
from socast.tools.simulator.truth import Truth
from socast.tools.simulator.weather import Sky, make_sky, merge_weather

PILOT: Final = 240
"""Largest number of shifts, evenly spread, that are driven to calibrate hidden effects."""
BLOCK: Final = 4096
"""Number of messages that are merged with the weather at a time."""


class FleetCar(NamedTuple):
    """Hold a car of the fleet.

    Parameters
    ----------
    number : int
        Index of the car, which selects its random streams.
    name, model : str
        Identifier of the car and key of its model in the vehicle catalogue.
    equipment : Equipment
        What the logger lacks, and how often it samples.
    planned_shifts : list of PlannedShift, optional
        Shifts that a preset has planned; None draws them.
    first : int
        Number of the days before the first shift.
    nominal_kwh : float, optional
        Nominal capacity that the car announces. [kWh]
    """

    number: int
    name: str
    model: str
    car: Car
    equipment: Equipment
    planned_shifts: list[PlannedShift] | None = None
    first: int = 0
    nominal_kwh: float | None = None

    def count_shifts(self, simulation: Simulation) -> int:
        """Return the number of shifts that the car drives."""
        return simulation.days - self.first if self.planned_shifts is None else len(self.planned_shifts)


class PreparedFleet(NamedTuple):
    """Hold what all cars of a simulation share.

    Parameters
    ----------
    factors : tuple of float
        Factor of each hidden effect. [1]
    """

    simulation: Simulation
    members: list[FleetCar]
    sky: Sky
    factors: tuple[float, ...]

    def name_factors(self) -> dict[str, float]:
        """Return the factor of each hidden effect by its name."""
        return {hidden.effect: factor for hidden, factor in zip(self.simulation.hidden, self.factors, strict=True)}


class DrivenShift(NamedTuple):
    """Hold a shift that was driven without hidden effects."""

    shift: Shift
    view: EffectInputs


def simulate(simulation: Simulation, truth: Truth | None = None) -> Iterator[Message]:
    """Yield all messages of a fleet and its weather stations in order of receipt.

    Notes
    -----
    The messages depend on the settings and the seed alone. Each shift of each car has its own random stream. Memory
    holds a shift of every car; `socast.tools.cluster.simulation` writes fleets of any size.
    """
    record = Truth() if truth is None else truth
    fleet = prepare_fleet(simulation)
    describe_fleet(fleet, record)
    streams = [chain.from_iterable(drive_car(fleet, member, record)) for member in fleet.members]
    merged = heapq.merge(*streams, key=attrgetter("receipt_ns"))
    blocks = iter(lambda: list(islice(merged, BLOCK)), [])
    return chain.from_iterable(merge_weather(blocks, simulation, fleet.sky))


def prepare_fleet(simulation: Simulation) -> PreparedFleet:
    """Draw the cars and the weather, and calibrate the hidden effects."""
    check_effects(simulation.hidden)
    members, sky = make_members(simulation), make_fleet_sky(simulation)
    return PreparedFleet(simulation, members, sky, tuple(_factors(simulation, members, sky)))


def describe_fleet(fleet: PreparedFleet, truth: Truth) -> None:
    """Record the settings of a simulation and its cars."""
    truth.describe(fleet.simulation, fleet.name_factors())
    for member in fleet.members:
        truth.add_car(member.name, member.model, member.car, member.equipment)


def make_members(simulation: Simulation) -> list[FleetCar]:
    """Return the cars of the fleet and their loggers."""
    if simulation.preset is None:
        health = habits.find_pack_health(simulation.seed, simulation.vehicles, simulation.conditions.aged_packs)
        return [_member(simulation, index, left) for index, left in enumerate(health)]
    preset = presets.load_preset(simulation.preset)
    places = presets.plan_cars(preset, simulation.rides, simulation.seed)
    return [_placed(simulation, index, place, preset.fleet) for index, place in enumerate(places)]


def _member(simulation: Simulation, index: int, health: float) -> FleetCar:
    """Draw a car, with the capacity that its pack has left, and its logger."""
    rng = np.random.default_rng([simulation.seed, 3, index])
    model = simulation.models[index % len(simulation.models)]
    car = make_car(model, rng)
    equipment = make_equipment(simulation.faults, rng)
    if periods := simulation.conditions.periods:
        equipment = equipment._replace(period=periods[index % len(periods)])
    car, nominal = habits.resize_pack(car, model, index, simulation.conditions)
    if health < 1.0:
        car = car._replace(wear=1.0 - health)
    cars, day = simulation.conditions.newcomers
    first = -(-day // simulation.day_step) if index >= simulation.vehicles - cars else 0
    return FleetCar(index, f"taxi-{index + 1:03d}", model, car, equipment, first=first, nominal_kwh=nominal)


def _placed(simulation: Simulation, index: int, place: PlannedCar, fleet: Fleet) -> FleetCar:
    """Draw a car of a preset and its logger."""
    rng = np.random.default_rng([simulation.seed, 3, index])
    car = make_car(place.model, rng, place.traits)
    lacks = [field for field in make_equipment(simulation.faults, rng).lacks if field in fleet.may_lack]
    equipment = Equipment((*fleet.never_sends, *lacks))
    return FleetCar(index, f"taxi-{index + 1:03d}", place.model, car, equipment, place.planned_shifts)


def make_fleet_sky(simulation: Simulation) -> Sky:
    """Return the weather of all days and of the nights after the last one."""
    first = simulation.start.timestamp()
    if simulation.preset is None:
        days = simulation.days * simulation.day_step
        return make_sky(first, days, simulation.seed, spells=simulation.conditions.spells)
    fleet = presets.load_preset(simulation.preset).fleet
    return make_sky(first, presets.YEAR, simulation.seed, (fleet.coldest, fleet.hottest), simulation.conditions.spells)


def _factors(simulation: Simulation, members: list[FleetCar], sky: Sky) -> list[float]:
    """Return the factor of each hidden effect from a pilot over shifts of the fleet."""
    if not simulation.hidden:
        return []
    most = max(member.count_shifts(simulation) for member in members)
    all_of = [
        (member, member.first + number)
        for number in range(most)
        for member in members
        if number < member.count_shifts(simulation)
    ]
    spread = np.unique(np.linspace(0, len(all_of) - 1, min(PILOT, len(all_of))).astype(int))
    pilot = []
    for index in spread:
        member, number = all_of[index]
        driven = drive_shift(simulation, member, number, sky)
        pilot.append(sum_energies(driven.view, driven.shift.timeline.ride, simulation.hidden))
    return calibrate_effects(pilot, simulation.hidden)


def drive_shift(simulation: Simulation, member: FleetCar, number: int, sky: Sky) -> DrivenShift:
    """Drive one shift of a car without hidden effects."""
    rng = np.random.default_rng([simulation.seed, 4, member.number, number])
    begin, orders, car = _called(simulation, member, number, rng)
    wanted = simulation.conditions
    if wanted.aged_packs:  # of which dispatch knows
        orders = orders._replace(estimate_factor=orders.estimate_factor / (1.0 - car.wear))
    orders = orders._replace(
        waits=wanted.waits,
        no_shows=wanted.no_shows,
        plan_spread=wanted.plan_spread,
        way_home=wanted.way_home,
        hills=simulation.phenomena.hills,
    )
    ambient = float(np.interp(begin, sky.time, sky.temperature))
    if simulation.charging == NIGHT:
        orders = orders._replace(charge_below=-np.inf)
    shift = make_shift(f"{member.name}-{number:03d}", begin, orders, car, ambient, simulation.faults, rng)
    trace = make_trace(shift, sky, hills=orders.hills)
    driven = DrivenShift(
        shift, EffectInputs(trace, physics.integrate_states(trace, car, shift.soc, simulation.phenomena), car)
    )
    return cut_when_empty(driven) if simulation.charging == NIGHT or wanted != NO_CONDITIONS else driven


def cut_when_empty(driven: DrivenShift) -> DrivenShift:
    """Return a shift up to the step at which its battery is empty, where the car stops."""
    shift, view = driven
    empty = np.flatnonzero(view.state.soc <= 0.0)
    if not len(empty):
        return driven
    steps = int(empty[0]) + 1
    trace = Trace._make(column[:steps] for column in view.trace)
    state = physics.State._make(column[:steps] for column in view.state)
    return DrivenShift(stop_shift(shift, steps), view._replace(trace=trace, state=state))


def _called(
    simulation: Simulation, member: FleetCar, number: int, rng: np.random.Generator
) -> tuple[float, Orders, Car]:
    """Return the begin of a shift [s], the orders of dispatch, and the car with its age and tyres at that time."""
    if simulation.preset is None or member.planned_shifts is None:
        day = number * simulation.day_step
        begin, orders, car = (
            _begin(simulation, day, (5.5, 14.0), rng),
            draw_orders(simulation.shift_hours, rng),
            member.car,
        )
        if simulation.conditions.aged_packs and car.wear >= 1.0 - habits.AGED[1]:
            car = car._replace(wear=car.wear + habits.FADE * day)
        if simulation.conditions.heater_habits:
            own = np.random.default_rng([simulation.seed, 11, member.number, number])
            driver = habits.choose_driver(member.number, simulation.vehicles, simulation.conditions.newcomers, own)
            return begin, *habits.apply_habit(orders, car, habits.draw_habit(simulation.seed, driver))
        return begin, orders, car
    fleet, duty = presets.load_preset(simulation.preset).fleet, member.planned_shifts[number]
    begin = _begin(simulation, duty.day, fleet.begin_h, rng)
    return begin, presets.make_orders(fleet, duty), presets.adapt_car(fleet, member.car, duty, begin)


def _begin(simulation: Simulation, day: int, hours: tuple[float, float], rng: np.random.Generator) -> float:
    """Return the begin of a shift of a day: between two hours of the day, or near the given time. [s]"""
    start = simulation.start.timestamp() + SECONDS_PER_DAY * day
    into = rng.uniform(0, 300) if start % SECONDS_PER_DAY else rng.uniform(*hours) * 3600 - UTC_OFFSET
    return float(np.floor(start + into))


def drive_car(fleet: PreparedFleet, member: FleetCar, truth: Truth) -> Iterator[list[Message]]:
    """Yield the messages of one car, shift after shift.

    The cars of a fleet share the weather and the factors of hidden effects, and nothing else.
    """
    odometer = member.car.odometer
    for number in range(member.first, member.first + member.count_shifts(fleet.simulation)):
        messages, odometer = _shift_messages(fleet, member, number, odometer, truth)
        yield messages


def _shift_messages(
    fleet: PreparedFleet, member: FleetCar, number: int, odometer: float, truth: Truth
) -> tuple[list[Message], float]:
    """Return the messages of one car on a shift and its odometer [m] after it; record the truth."""
    simulation, factors = fleet.simulation, fleet.factors
    shift, view = drive_shift(simulation, member, number, fleet.sky)
    state, energies = view.state, None
    if factors:
        scaled = zip(factors, simulation.hidden, strict=True)
        hidden = sum((factor * get_power(effect)(view) for factor, (effect, _) in scaled), np.zeros(len(state.soc)))
        energies = sum_energies(view, shift.timeline.ride, simulation.hidden)
        energies = energies._replace(effects=energies.effects * factors)
        state = physics.integrate_states(view.trace, view.car, shift.soc, simulation.phenomena, hidden)
    messages, reading, faults = make_car_messages(
        simulation, member, number, DrivenShift(shift, view._replace(state=state)), odometer, truth
    )
    truth.add_shift(member.name, shift, state, energies, faults)
    return messages, reading


def make_car_messages(
    simulation: Simulation,
    member: FleetCar,
    number: int,
    driven: DrivenShift,
    odometer: float,
    truth: Truth | None = None,
) -> tuple[list[Message], float, Counter[str]]:
    """Return the messages of a car on a shift, its odometer after it, and the faults of its logger.

    Units: odometer [m].

    Notes
    -----
    The faults of a logger do not depend on the values that it measures. So the same simulation with another state of
    the car gives the same messages with other values.
    """
    shift, view = driven
    rng = np.random.default_rng([simulation.seed, 5, member.number, number])
    car = view.car._replace(odometer=max(odometer, view.car.odometer))
    shown = None
    if simulation.conditions != NO_CONDITIONS:
        shown = _show_charge(simulation, member, number, driven, truth)
    logged, faults = log_shift(
        member.name, shift, view.trace, view.state, car, member.equipment, simulation.faults, rng, shown
    )
    sent = make_dispatch(
        member.name,
        member.model,
        member.car,
        shift,
        simulation.conditions,
        np.random.default_rng([simulation.seed, 9, member.number, number]),
        member.nominal_kwh,
        None if member.equipment.period else 0.0,
    )
    reading = car.odometer + float(shift.timeline.moved.sum()) * car.speedometer
    return sorted([*sent, *logged], key=itemgetter(2)), reading, faults


def _show_charge(
    simulation: Simulation, member: FleetCar, number: int, driven: DrivenShift, truth: Truth | None
) -> Floats:
    """Return what the display of a car sends, NaN for nothing, and record what it shows without a fault. [%]"""
    shift, view = driven
    display = None
    if simulation.conditions.coulomb_display:
        display = displays.make_display(np.random.default_rng([simulation.seed, 12, member.number]))
    capacity = view.car.capacity * (1.0 - view.car.wear * simulation.phenomena.age)
    shown = displays.compute_display(view.state, shift.soc, view.car, capacity, display)
    day = int((shift.time + UTC_OFFSET - simulation.start.timestamp()) // SECONDS_PER_DAY)
    fault = simulation.conditions.find_display_fault(member.number, day)
    if truth is not None:
        truth.add_display(member.name, shift.time, view.state, shown, fault)
    if fault is None:
        return shown
    return displays.spoil_display(shown, fault, np.random.default_rng([simulation.seed, 13, member.number, number]))
