"""Define the effects that a simulation can hide from the models: one function for each effect.

A function returns the power of the effect at natural size [W]. It depends on the surroundings of the car
(`EffectInputs.trace`), on the state of the car without hidden effects (`EffectInputs.state`) and on its parameters
(`EffectInputs.car`). `calibration` scales the power to the requested share of the energy. A new effect needs one
function in this file and no change elsewhere.
"""

from collections.abc import Callable
from typing import Final, NamedTuple

import numpy as np

from socast.core.batch import Floats
from socast.core.columns import GRAVITY
from socast.tools.simulator.cars import Car
from socast.tools.simulator.physics import COMFORT, PERSON, WHEEL, State
from socast.tools.simulator.settings import STEP
from socast.tools.simulator.trace import REFERENCE_DENSITY, Trace


class EffectInputs(NamedTuple):
    """Hold everything that a hidden effect may depend on."""

    trace: Trace
    state: State
    car: Car


PowerFunction = Callable[[EffectInputs], Floats]
EFFECTS: Final[dict[str, PowerFunction]] = {}
"""Power at natural size of each effect. [W]"""


def register_effect(function: PowerFunction) -> PowerFunction:
    """Register a hidden effect under the name of its function."""
    EFFECTS[function.__name__] = function
    return function


def compute_rolling_power(view: EffectInputs) -> Floats:
    """Return the power of plain rolling resistance. [W]"""
    return view.car.mass * GRAVITY * view.car.rolling_resistance * view.trace.speed


def compute_braking_power(view: EffectInputs) -> Floats:
    """Return the power that decelerates the car, as a positive number. [W]"""
    return np.maximum(-view.car.mass * view.trace.acceleration * view.trace.speed, 0.0)


def apply_lag(values: Floats, seconds: float) -> Floats:
    """Return values delayed by a first-order lag that keeps their integral.

    Units: seconds [s].
    """
    keep = np.exp(-STEP / seconds)
    kernel = (1 - keep) * keep ** np.arange(int(6 * seconds / STEP))
    size = len(values) + len(kernel)
    length = 1 << (size - 1).bit_length()
    delayed = np.fft.irfft(np.fft.rfft(values, length) * np.fft.rfft(kernel, length), length)
    return np.maximum(delayed[: len(values)], 0.0)


@register_effect
def headwind(view: EffectInputs) -> Floats:
    """Return the power against wind along the road."""
    t = view.trace
    flow = t.speed + t.headwind
    return 0.5 * REFERENCE_DENSITY * view.car.drag_area * (flow * np.abs(flow) - t.speed**2) * t.speed


@register_effect
def air_density(view: EffectInputs) -> Floats:
    """Return the additional drag due to the deviation of the air density from 1.2 kg/m^3."""
    return 0.5 * (view.trace.density - REFERENCE_DENSITY) * view.car.drag_area * view.trace.speed**3


@register_effect
def cold_rolling(view: EffectInputs) -> Floats:
    """Return the additional rolling resistance of tyres in cold air."""
    return compute_rolling_power(view) * 0.01 * np.maximum(25.0 - view.trace.ambient, 0.0)


@register_effect
def wet_road(view: EffectInputs) -> Floats:
    """Return the power that displaces water on the road."""
    return compute_rolling_power(view) * view.trace.wetness * np.minimum(view.trace.speed / 14.0, 2.0)


@register_effect
def snow(view: EffectInputs) -> Floats:
    """Return the power that displaces snow on the road."""
    return compute_rolling_power(view) * view.trace.snow


@register_effect
def tyre_pressure(view: EffectInputs) -> Floats:
    """Return the additional rolling resistance of soft tyres; each car has its own deficit of pressure."""
    return compute_rolling_power(view) * view.car.under_inflation


@register_effect
def door_heat_loss(view: EffectInputs) -> Floats:
    """Return the heating that replaces heat lost through open doors, spread over the following minutes."""
    cold = np.maximum(COMFORT[0] - view.trace.ambient, 0.0)
    return 260.0 * apply_lag(view.trace.door * cold, 120.0) * view.trace.on


@register_effect
def cabin_heating(view: EffectInputs) -> Floats:
    """Return a heating power proportional to the difference between comfort and outside temperature."""
    return view.car.cabin_loss * np.maximum(COMFORT[0] - view.trace.ambient, 0.0) * view.trace.on


@register_effect
def cabin_cooling(view: EffectInputs) -> Floats:
    """Return a cooling power proportional to the difference between outside and comfort temperature."""
    return view.car.cabin_loss * np.maximum(view.trace.ambient - COMFORT[1] + 3.0, 0.0) * view.trace.on


@register_effect
def cabin_warmup(view: EffectInputs) -> Floats:
    """Return the power that warms a cabin after parking; it decays over five minutes of the ride."""
    cooled = 1 - np.exp(-view.trace.parked / 2400.0)
    cold = np.maximum(COMFORT[0] - view.trace.ambient, 0.0)
    return np.asarray(100.0 * cold * cooled * np.exp(-view.trace.elapsed / 300.0) * view.trace.on)


@register_effect
def cold_regen_limit(view: EffectInputs) -> Floats:
    """Return the braking power that a cold battery cannot recover."""
    return compute_braking_power(view) * np.clip((15.0 - view.state.pack) / 25.0, 0.0, 1.0)


@register_effect
def regen_full_battery(view: EffectInputs) -> Floats:
    """Return the braking power that a full battery cannot recover."""
    return compute_braking_power(view) * np.clip((view.state.soc - 0.85) / 0.12, 0.0, 1.0)


@register_effect
def battery_resistance(view: EffectInputs) -> Floats:
    """Return the heat of the current in the battery, which increases in the cold."""
    cold = np.exp((25.0 - view.state.pack) / 38.0)
    return view.car.resistance * cold * view.state.current**2 * view.trace.on


@register_effect
def cold_battery_heating(view: EffectInputs) -> Floats:
    """Return a heating power of the battery, proportional to the difference from 10 °C below that temperature."""
    return 60.0 * np.maximum(10.0 - view.state.pack, 0.0) * view.trace.on


@register_effect
def payload(view: EffectInputs) -> Floats:
    """Return the power that the mass of passengers takes on the level, uphill and while accelerating."""
    t = view.trace
    force = GRAVITY * (view.car.rolling_resistance + t.grade) + t.acceleration
    return PERSON * np.maximum(t.occupants - 1, 0.0) * force * t.speed


@register_effect
def drivetrain_loss(view: EffectInputs) -> Floats:
    """Return losses proportional to the square of the power at the wheels."""
    wheel = view.state.parts[:, : len(WHEEL)].sum(axis=1)
    return np.asarray(wheel**2 / view.car.motor_power)


@register_effect
def cornering(view: EffectInputs) -> Floats:
    """Return the power of tyres that slip sideways in bends."""
    lateral = view.trace.speed * view.trace.turn_rate
    return view.car.mass * lateral**2 / 70.0 * view.trace.speed


@register_effect
def standby(view: EffectInputs) -> Floats:
    """Return a constant power while the car is ready to drive."""
    return 100.0 * view.trace.on


@register_effect
def night_lights(view: EffectInputs) -> Floats:
    """Return the power of the lamps in the dark."""
    return 120.0 * view.trace.dark * view.trace.on


@register_effect
def solar_load(view: EffectInputs) -> Floats:
    """Return the power that cools away solar heat in warm weather."""
    return view.trace.solar * np.clip((view.trace.ambient - 12.0) / 10.0, 0.0, 1.0) * view.trace.on


@register_effect
def humidity(view: EffectInputs) -> Floats:
    """Return the power that dries damp air."""
    return 500.0 * np.maximum(view.trace.humidity - 0.4, 0.0) * view.trace.on


@register_effect
def brake_drag(view: EffectInputs) -> Floats:
    """Return the power of rubbing brake pads; each car has its own force."""
    return view.car.brake_drag * view.trace.speed


@register_effect
def roof_load(view: EffectInputs) -> Floats:
    """Return the drag of the sign that some cars carry on the roof."""
    return 0.5 * REFERENCE_DENSITY * view.car.roof_drag_area * view.trace.speed**3


@register_effect
def age(view: EffectInputs) -> Floats:
    """Return the additional driving power of worn cars, proportional to their wear."""
    driving = view.state.parts[:, : len(WHEEL)].sum(axis=1)
    return np.asarray(view.car.wear * np.maximum(driving, 0.0))
