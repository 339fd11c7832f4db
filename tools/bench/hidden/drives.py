"""Simulate the drives of a small fleet over a year once, so that any effect can be hidden in them afterwards.

The drive of a car and the faults of its logger do not depend on a hidden effect. So the drives are simulated and
recorded once, with the number of each sample in place of its readings. `socast.tools.bench.hidden.recording` fills in
the readings. The result equals the messages of a simulation with the effect.
"""

import heapq
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from operator import attrgetter
from typing import Final, NamedTuple

import numpy as np

from socast.core.batch import Floats
from socast.core.wire.messages import Message
from socast.tools.simulator import physics
from socast.tools.simulator.fleet import (
    DrivenShift,
    FleetCar,
    drive_shift,
    make_car_messages,
    make_fleet_sky,
    make_members,
)
from socast.tools.simulator.hidden import EffectInputs
from socast.tools.simulator.hidden_shapes import calibrate_effects, get_power, sum_energies
from socast.tools.simulator.settings import PLAIN_PHENOMENA, STEPS_PER_SAMPLE, Faults, Hidden, Phenomena, Simulation
from socast.tools.simulator.weather import merge_weather

BASE: Final = PLAIN_PHENOMENA._replace(payload=True)
"""Physics without hidden effects; passengers have the mass of 75 kg that the product assumes."""
FLEET: Final = Simulation(
    vehicles=8,
    days=312,
    shift_hours=1.1,
    models=("kia-soul-ev-2015", "nissan-leaf-2016"),
    phenomena=BASE,
    faults=Faults(unequipped=0.0, quantised=0.0),
)
"""Simulation of four cars each of two models over ten months."""
TURNS: Final = 8
"""Each car drives on one day out of 8, on a different day than the others.

So each car drives 39 shifts, in all about 1,300 rides with 480,000 samples. If all cars drove on the same 39 days,
there would be only 39 different weathers, with snow on a few of them. Then snow could not be distinguished from the
other conditions of those days.
"""
NO_CLIMATE: Final = BASE._replace(climate=False)
"""Physics for effects that heating and cooling of the cabin would cover."""
VOLTAGE_MARK: Final = 0.01
CURRENT_MARK: Final = 0.01
SOC_MARK: Final = 1e-5
"""Factor by which the number of a sample is encoded as a voltage [V], a current [A] or a state of charge [1]."""


class RecordedShift(NamedTuple):
    """Hold a driven shift and the number of its first sample among the samples of its car."""

    member: FleetCar
    driven: DrivenShift
    first: int

    @property
    def samples(self) -> int:
        """Number of samples of the shift."""
        return len(self.driven.view.trace.time) // STEPS_PER_SAMPLE


class Readings(NamedTuple):
    """Hold the readings of the cars, (cars, samples) each, NaN beyond the last sample of a car.

    Parameters
    ----------
    voltage, current : (cars, samples) float
        At the terminals of the battery. [V], [A]
    soc : (cars, samples) float
        State of charge. [1]
    hvac : (cars, samples) float
        Power of heating and cooling. [W]
    hidden : (effects, cars, samples) float
        Mean power of each hidden effect since the previous sample. [W]
    """

    voltage: Floats
    current: Floats
    soc: Floats
    hvac: Floats
    hidden: Floats


@dataclass(frozen=True)
class Scope:
    """Describe where an effect is hidden: in all cars, in one or in a group, always or from a date on.

    Parameters
    ----------
    since : str, optional
        ISO date; the effect begins at midnight UTC.
    full : str, optional
        ISO date at which an effect that grows from `since` on reaches its size, and beyond which it grows on. Without
        it, the effect has its size from `since` on.
    """

    vehicle: str | None = None
    since: str | None = None
    full: str | None = None
    group: tuple[str, ...] = ()

    def contains(self, leg: RecordedShift) -> bool:
        """Return whether the effect is hidden in a shift."""
        after = self.since is None or leg.driven.shift.time >= get_midnight(self.since)
        name = leg.member.name
        return after and self.vehicle in {None, name} and (not self.group or name in self.group)

    def get_size(self, leg: RecordedShift) -> float:
        """Return the size of the effect in a shift that has it, over its full size. [1]"""
        if self.since is None or self.full is None:
            return 1.0
        begin = get_midnight(self.since)
        return (leg.driven.shift.time - begin) / (get_midnight(self.full) - begin)


def get_midnight(date: str) -> float:
    """Return the Unix time of midnight UTC of an ISO date. [s]"""
    return datetime.fromisoformat(date).replace(tzinfo=UTC).timestamp()


EVERYWHERE: Final = Scope()


@dataclass
class Drives:
    """Hold the drives of one seed.

    Parameters
    ----------
    simulation : Simulation
        Settings without hidden effects and without quantisation of the state of charge.
    messages : list of Message
        All messages, with numbers of samples in place of voltage, current and state of charge.
    """

    simulation: Simulation
    legs: list[RecordedShift]
    messages: list[Message]
    _states: dict[Phenomena, list[physics.State]] = field(default_factory=dict)

    @property
    def vehicles(self) -> list[str]:
        """Identifiers of the cars."""
        return list(dict.fromkeys(leg.member.name for leg in self.legs))

    def views(self, phenomena: Phenomena) -> list[EffectInputs]:
        """Return the shifts with the states of the cars under given physics, without hidden effects."""
        if phenomena not in self._states:
            self._states[phenomena] = [integrate_shift(leg, phenomena) for leg in self.legs]
        states = zip(self.legs, self._states[phenomena], strict=True)
        return [leg.driven.view._replace(state=state) for leg, state in states]

    def measured(
        self, hidden: Sequence[Hidden] = (), where: Scope = EVERYWHERE, phenomena: Phenomena = BASE
    ) -> Readings:
        """Return the readings of the cars with hidden effects.

        Parameters
        ----------
        hidden : sequence of Hidden
            Effects and their shares of the energy of the rides in which they are hidden.
        """
        hidden = tuple(hidden)
        views = self.views(phenomena)
        powers = [self._powers(leg, view, hidden, where) for leg, view in zip(self.legs, views, strict=True)]
        factors = self._factors(views, hidden, where) if hidden else []
        cars, out = self.vehicles, self.make_readings(len(hidden))
        for leg, view, power in zip(self.legs, views, powers, strict=True):
            state = view.state
            scaled = power * where.get_size(leg) * np.array(factors)[:, None] if power is not None else None
            if scaled is not None:
                state = integrate_shift(leg, phenomena, scaled.sum(axis=0))
            enter_readings(out, cars.index(leg.member.name), leg, state, scaled)
        return out

    def make_readings(self, effects: int) -> Readings:
        """Return readings of all cars to be entered, with a number of hidden effects."""
        shape = len(self.vehicles), max(leg.first + leg.samples for leg in self.legs)
        voltage, current, soc, hvac = np.full((4, *shape), np.nan)
        return Readings(voltage, current, soc, hvac, np.zeros((effects, *shape)))

    def _powers(self, leg: RecordedShift, view: EffectInputs, hidden: Sequence[Hidden], where: Scope) -> Floats | None:
        """Return the powers at natural size [W], (effects, steps); None if nothing is hidden in the shift."""
        if not hidden or not where.contains(leg):
            return None
        return np.stack([get_power(effect)(view) for effect, _ in hidden])

    def _factors(self, views: list[EffectInputs], hidden: tuple[Hidden, ...], where: Scope) -> list[float]:
        """Return the factor of each effect."""
        pilot = [
            sum_energies(view, leg.driven.shift.timeline.ride, hidden)
            for leg, view in zip(self.legs, views, strict=True)
            if where.contains(leg)
        ]
        return calibrate_effects(pilot, hidden)


def simulate_drives(simulation: Simulation, turns: int = 1) -> Drives:
    """Simulate the drives of a seed and their messages."""
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
    fleet = list(heapq.merge(*streams, key=attrgetter("receipt_ns")))
    return Drives(simulation, legs, [m for block in merge_weather([fleet], simulation, sky) for m in block])


def _marked(driven: DrivenShift, first: int) -> DrivenShift:
    """Return a shift in which each step measures the number of its sample."""
    view = driven.view
    number: Floats = (first + np.arange(len(view.trace.time)) // STEPS_PER_SAMPLE + 1).astype(np.float64)
    state = view.state._replace(voltage=VOLTAGE_MARK * number, current=CURRENT_MARK * number, soc=SOC_MARK * number)
    return driven._replace(view=view._replace(state=state))


def integrate_shift(leg: RecordedShift, phenomena: Phenomena, hidden: Floats | None = None) -> physics.State:
    """Return the states of a car over a shift."""
    view = leg.driven.view
    return physics.integrate_states(view.trace, view.car, leg.driven.shift.soc, phenomena, hidden)


def enter_readings(out: Readings, car: int, leg: RecordedShift, state: physics.State, hidden: Floats | None) -> None:
    """Write the readings of a car on a shift."""
    n = leg.samples
    at = slice(STEPS_PER_SAMPLE - 1, n * STEPS_PER_SAMPLE, STEPS_PER_SAMPLE)
    rows = slice(leg.first, leg.first + n)
    out.voltage[car, rows], out.current[car, rows] = state.voltage[at], state.current[at]
    out.soc[car, rows], out.hvac[car, rows] = state.soc[at], state.hvac[at]
    if hidden is not None:
        steps = hidden[:, : n * STEPS_PER_SAMPLE].reshape(len(hidden), n, STEPS_PER_SAMPLE)
        out.hidden[:, car, rows] = steps.mean(axis=2)
