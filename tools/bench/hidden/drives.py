"""Drives of a small fleet over a year, simulated once; any effect can then be hidden in them.

What a car does and what its logger does to samples depend on nothing that a hidden effect changes. So the drives are
simulated and recorded once, with the number of each sample in place of what it measures, and what it measures is filled
in afterwards (`tools.bench.hidden.recording`): exactly what a simulation with the effect would have sent.
"""

import heapq
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from operator import attrgetter
from typing import Final, NamedTuple

import numpy as np

from core.batch import Floats
from core.wire.messages import Message
from tools.simulator import calibration, physics
from tools.simulator.fleet import (
    DrivenShift,
    FleetCar,
    drive_shift,
    make_car_messages,
    make_fleet_sky,
    make_members,
    merge_weather,
)
from tools.simulator.hidden import EffectInputs
from tools.simulator.hidden_shapes import POWERS
from tools.simulator.settings import PLAIN_PHENOMENA, STEPS_PER_SAMPLE, Faults, Hidden, Phenomena, Simulation

BASE: Final = PLAIN_PHENOMENA._replace(payload=True)
"""Physics that nothing is hidden in: passengers weigh the 75 kg that the product counts of each."""
FLEET: Final = Simulation(
    vehicles=8,
    days=312,
    shift_hours=1.1,
    models=("kia-soul-ev-2015", "nissan-leaf-2016"),
    phenomena=BASE,
    faults=Faults(unequipped=0.0, quantised=0.0),
)
"""Four cars each of two models, through ten months."""
TURNS: Final = 8
"""Cars take turns, each drives on a day of its own in 8: so 39 shifts a car, some 1,300 rides, 480,000 samples.

Were they all out on the same 39 days, there would be no more than 39 different weathers, snow on a few of them,
and nobody could tell what snow does from what else there was on that day.
"""
NO_CLIMATE: Final = BASE._replace(climate=False)
"""Physics for effects that the cabin's own heating and cooling would cover."""
VOLTAGE_MARK: Final = 0.01
CURRENT_MARK: Final = 0.01
SOC_MARK: Final = 1e-5
"""What a sample's number is multiplied with to travel as a voltage [V], a current [A], a state of charge [1]."""


class RecordedShift(NamedTuple):
    """A shift as it was driven, and the number that its first sample has among its car's."""

    member: FleetCar
    driven: DrivenShift
    first: int

    @property
    def samples(self) -> int:
        """How many samples were taken."""
        return len(self.driven.view.trace.time) // STEPS_PER_SAMPLE


class Readings(NamedTuple):
    """What cars measure, by sample: (cars, samples) float each, NaN beyond a car's last.

    Parameters
    ----------
    voltage, current : [V], [A]
    soc : [1]
    hvac : [W]
    hidden : (effects, cars, samples) float. Mean power of each hidden effect over the time since the sample before. [W]
    """

    voltage: Floats
    current: Floats
    soc: Floats
    hvac: Floats
    hidden: Floats


@dataclass(frozen=True)
class Scope:
    """Where an effect is hidden: in all cars or one, always or from a time on.

    Parameters
    ----------
    vehicle : str, optional
    since : str, optional
        ISO date, from its midnight UTC on.
    """

    vehicle: str | None = None
    since: str | None = None

    def contains(self, leg: RecordedShift) -> bool:
        """Say whether it is hidden in a shift."""
        begins = leg.driven.shift.time
        after = self.since is None or begins >= datetime.fromisoformat(self.since).replace(tzinfo=UTC).timestamp()
        return after and self.vehicle in {None, leg.member.name}


EVERYWHERE: Final = Scope()


@dataclass
class Drives:
    """Drives of one seed.

    Parameters
    ----------
    simulation : Simulation
        Without hidden effects; with a state of charge that is not quantised.
    legs : list of Leg
        By car and day.
    messages : list of Message
        All that is sent, with numbers of samples in place of voltage, current and state of charge.
    """

    simulation: Simulation
    legs: list[RecordedShift]
    messages: list[Message]
    _states: dict[Phenomena, list[physics.State]] = field(default_factory=dict)

    @property
    def vehicles(self) -> list[str]:
        """Names of the cars."""
        return list(dict.fromkeys(leg.member.name for leg in self.legs))

    def views(self, phenomena: Phenomena) -> list[EffectInputs]:
        """Return the shifts with the states that the cars have under some physics, without hidden effects."""
        if phenomena not in self._states:
            self._states[phenomena] = [_state(leg, phenomena) for leg in self.legs]
        states = zip(self.legs, self._states[phenomena], strict=True)
        return [leg.driven.view._replace(state=state) for leg, state in states]

    def measured(
        self, hidden: Sequence[Hidden] = (), where: Scope = EVERYWHERE, phenomena: Phenomena = BASE
    ) -> Readings:
        """Return what the cars measure with effects hidden in them.

        The share of an effect is that of the energy of the rides in which it is hidden.

        Raises
        ------
        SettingsError
            For an effect that has nothing to act on there.
        """
        hidden = tuple(hidden)
        views = self.views(phenomena)
        powers = [self._powers(leg, view, hidden, where) for leg, view in zip(self.legs, views, strict=True)]
        factors = self._factors(views, hidden, where) if hidden else []
        cars, most = self.vehicles, max(leg.first + leg.samples for leg in self.legs)
        voltage, current, soc, hvac = np.full((4, len(cars), most), np.nan)
        out = Readings(voltage, current, soc, hvac, np.zeros((len(hidden), len(cars), most)))
        for leg, view, power in zip(self.legs, views, powers, strict=True):
            state = view.state
            scaled = power * np.array(factors)[:, None] if power is not None else None
            if scaled is not None:
                state = _state(leg, phenomena, scaled.sum(axis=0))
            _enter(out, cars.index(leg.member.name), leg, state, scaled)
        return out

    def _powers(self, leg: RecordedShift, view: EffectInputs, hidden: Sequence[Hidden], where: Scope) -> Floats | None:
        """Return the powers at natural size, (effects, steps) [W]; None where nothing is hidden."""
        if not hidden or not where.contains(leg):
            return None
        return np.stack([POWERS[effect](view) for effect, _ in hidden])

    def _factors(self, views: list[EffectInputs], hidden: tuple[Hidden, ...], where: Scope) -> list[float]:
        """Return the factor of each effect."""
        pilot = [
            calibration.sum_energies(view, leg.driven.shift.timeline.ride, hidden)
            for leg, view in zip(self.legs, views, strict=True)
            if where.contains(leg)
        ]
        return calibration.calibrate_effects(pilot, hidden)


def simulate_drives(simulation: Simulation, turns: int = 1) -> Drives:
    """Simulate the drives of a seed, and what is sent of them.

    Parameters
    ----------
    simulation : Simulation
    turns : int
        Cars take turns: each drives on one of so many days.
    """
    members, sky = make_members(simulation), make_fleet_sky(simulation)
    legs: list[RecordedShift] = []
    streams: list[list[Message]] = []
    for member in members:
        first, odometer, stream = 0, member.car.odometer, list[Message]()
        for number in range(member.number % turns, member.count_shifts(simulation), turns):
            driven = drive_shift(simulation, member, number, sky)
            legs.append(RecordedShift(member, driven, first))
            messages, odometer, _ = make_car_messages(simulation, member, number, _marked(driven, first), odometer)
            stream += messages
            first += legs[-1].samples
        streams.append(stream)
    fleet = heapq.merge(*streams, key=attrgetter("receipt_ns"))
    return Drives(simulation, legs, list(merge_weather(fleet, simulation, sky)))


def _marked(driven: DrivenShift, first: int) -> DrivenShift:
    """Return a shift whose every step measures the number of the sample that it belongs to."""
    view = driven.view
    number: Floats = (first + np.arange(len(view.trace.time)) // STEPS_PER_SAMPLE + 1).astype(np.float64)
    state = view.state._replace(voltage=VOLTAGE_MARK * number, current=CURRENT_MARK * number, soc=SOC_MARK * number)
    return driven._replace(view=view._replace(state=state))


def _state(leg: RecordedShift, phenomena: Phenomena, hidden: Floats | None = None) -> physics.State:
    """Return a car's states over a shift."""
    view = leg.driven.view
    return physics.integrate_states(view.trace, view.car, leg.driven.shift.soc, phenomena, hidden)


def _enter(out: Readings, car: int, leg: RecordedShift, state: physics.State, hidden: Floats | None) -> None:
    """Write what a car measures on a shift."""
    n = leg.samples
    at = slice(STEPS_PER_SAMPLE - 1, n * STEPS_PER_SAMPLE, STEPS_PER_SAMPLE)
    rows = slice(leg.first, leg.first + n)
    out.voltage[car, rows], out.current[car, rows] = state.voltage[at], state.current[at]
    out.soc[car, rows], out.hvac[car, rows] = state.soc[at], state.hvac[at]
    if hidden is not None:
        steps = hidden[:, : n * STEPS_PER_SAMPLE].reshape(len(hidden), n, STEPS_PER_SAMPLE)
        out.hidden[:, car, rows] = steps.mean(axis=2)
