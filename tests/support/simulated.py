"""Simulate shifts for the tests of the simulator."""

from dataclasses import replace
from datetime import UTC, datetime

import msgspec
import numpy as np

from socast.core.wire.messages import Telemetry, address
from socast.tools.simulator import physics
from socast.tools.simulator.cars import make_car
from socast.tools.simulator.fleet import simulate
from socast.tools.simulator.settings import (
    ALL_PHENOMENA,
    NO_FAULTS,
    Simulation,
)
from socast.tools.simulator.shift import draw_orders, make_shift
from socast.tools.simulator.trace import make_trace
from socast.tools.simulator.truth import Truth
from socast.tools.simulator.weather import make_sky

WINTER = datetime(2018, 1, 16, 12, tzinfo=UTC)
SUMMER = datetime(2018, 7, 16, 15, tzinfo=UTC)
SMALL = Simulation(vehicles=3, start=WINTER, shift_hours=1.0, seed=11)
PERFECT = replace(SMALL, faults=NO_FAULTS)


def run_simulation(simulation):
    """Return the messages of a simulation and its truth."""
    truth = Truth()
    return list(simulate(simulation, truth)), truth


def decode_samples(messages, vehicle=None):
    """Return the telemetry of all cars or of one."""
    telemetry = [m for m in messages if address(m.key).kind == "telemetry" and (vehicle is None or vehicle in m.key)]
    return [msgspec.json.decode(m.payload, type=Telemetry) for m in telemetry]


def drive_one_shift(start=WINTER, hours=2.0, seed=5, phenomena=ALL_PHENOMENA, model="kia-soul-ev-2015"):
    """Return a shift, its surroundings, the car and its states."""
    sky = make_sky(start.timestamp(), 1, seed)
    car = make_car(model, np.random.default_rng(seed))
    rng = np.random.default_rng([seed, 1])
    ambient = float(sky.temperature[24])
    shift = make_shift("r", start.timestamp(), draw_orders(hours, rng), car, ambient, NO_FAULTS, rng)
    trace = make_trace(shift, sky, hills=phenomena.hills)
    return shift, trace, car, physics.integrate_states(trace, car, shift.soc, phenomena)
