"""Effects that a simulation may hide from the models: one function each, and nothing else to touch.

A function returns power [W] at its natural size, from what surrounds the car (`View.trace`), its state without hidden
effects (`View.state`) and itself (`View.car`). `calibration` scales it to the share of energy that was asked for.
"""

from collections.abc import Callable
from typing import Final, NamedTuple

import numpy as np

from core.batch import Floats
from core.columns import GRAVITY
from tools.simulator.cars import Car
from tools.simulator.physics import COMFORT, PERSON, WHEEL, State
from tools.simulator.settings import STEP
from tools.simulator.trace import REFERENCE_DENSITY, Trace


class EffectInputs(NamedTuple):
    """What a hidden effect may depend on."""

    trace: Trace
    state: State
    car: Car


PowerFunction = Callable[[EffectInputs], Floats]
EFFECTS: Final[dict[str, PowerFunction]] = {}
"""Name -> power at natural size."""


def register_effect(function: PowerFunction) -> PowerFunction:
    """Register a hidden effect under its function's name."""
    EFFECTS[function.__name__] = function
    return function


def compute_rolling_power(view: EffectInputs) -> Floats:
    """Return the power of plain rolling resistance. [W]."""
    return view.car.mass * GRAVITY * view.car.rolling_resistance * view.trace.speed


def compute_braking_power(view: EffectInputs) -> Floats:
    """Return the power that slows the car, positive. [W]."""
    return np.maximum(-view.car.mass * view.trace.acceleration * view.trace.speed, 0.0)


def apply_lag(values: Floats, seconds: float) -> Floats:
    """Return values held back by a first-order lag; their integral is kept."""
    keep = np.exp(-STEP / seconds)
    kernel = (1 - keep) * keep ** np.arange(int(6 * seconds / STEP))
    size = len(values) + len(kernel)
    length = 1 << (size - 1).bit_length()
    held = np.fft.irfft(np.fft.rfft(values, length) * np.fft.rfft(kernel, length), length)
    return np.maximum(held[: len(values)], 0.0)


@register_effect
def headwind(view: EffectInputs) -> Floats:
    """Wind along the road."""
    t = view.trace
    flow = t.speed + t.headwind
    return 0.5 * REFERENCE_DENSITY * view.car.drag_area * (flow * np.abs(flow) - t.speed**2) * t.speed


@register_effect
def air_density(view: EffectInputs) -> Floats:
    """Drag by how far the air's density is from 1.2 kg/m^3."""
    return 0.5 * (view.trace.density - REFERENCE_DENSITY) * view.car.drag_area * view.trace.speed**3


@register_effect
def cold_rolling(view: EffectInputs) -> Floats:
    """Tyres roll harder in the cold."""
    return compute_rolling_power(view) * 0.01 * np.maximum(25.0 - view.trace.ambient, 0.0)


@register_effect
def wet_road(view: EffectInputs) -> Floats:
    """Water on the road is displaced."""
    return compute_rolling_power(view) * view.trace.wetness * np.minimum(view.trace.speed / 14.0, 2.0)


@register_effect
def snow(view: EffectInputs) -> Floats:
    """Snow on the road is displaced."""
    return compute_rolling_power(view) * view.trace.snow


@register_effect
def tyre_pressure(view: EffectInputs) -> Floats:
    """Each car's tyres are too soft by their own amount."""
    return compute_rolling_power(view) * view.car.under_inflation


@register_effect
def door_heat_loss(view: EffectInputs) -> Floats:
    """Heat lost through open doors is made up for over the minutes after."""
    cold = np.maximum(COMFORT[0] - view.trace.ambient, 0.0)
    return 260.0 * apply_lag(view.trace.door * cold, 120.0) * view.trace.on


@register_effect
def cabin_heating(view: EffectInputs) -> Floats:
    """Heating in proportion to the cold outside."""
    return view.car.cabin_loss * np.maximum(COMFORT[0] - view.trace.ambient, 0.0) * view.trace.on


@register_effect
def cabin_cooling(view: EffectInputs) -> Floats:
    """Cooling in proportion to the heat outside."""
    return view.car.cabin_loss * np.maximum(view.trace.ambient - COMFORT[1] + 3.0, 0.0) * view.trace.on


@register_effect
def cabin_warmup(view: EffectInputs) -> Floats:
    """Warming a cabin that cooled while parked, fading over five minutes of the ride."""
    cooled = 1 - np.exp(-view.trace.parked / 2400.0)
    cold = np.maximum(COMFORT[0] - view.trace.ambient, 0.0)
    return np.asarray(100.0 * cold * cooled * np.exp(-view.trace.elapsed / 300.0) * view.trace.on)


@register_effect
def cold_regen_limit(view: EffectInputs) -> Floats:
    """Braking energy that a cold battery does not take back."""
    return compute_braking_power(view) * np.clip((15.0 - view.state.pack) / 25.0, 0.0, 1.0)


@register_effect
def regen_full_battery(view: EffectInputs) -> Floats:
    """Braking energy that a full battery does not take back."""
    return compute_braking_power(view) * np.clip((view.state.soc - 0.85) / 0.12, 0.0, 1.0)


@register_effect
def battery_resistance(view: EffectInputs) -> Floats:
    """Heat of the current in the battery, more where it is cold."""
    cold = np.exp((25.0 - view.state.pack) / 38.0)
    return view.car.resistance * cold * view.state.current**2 * view.trace.on


@register_effect
def cold_battery_heating(view: EffectInputs) -> Floats:
    """Heating of the battery, in proportion to how far it is below 10 °C."""
    return 60.0 * np.maximum(10.0 - view.state.pack, 0.0) * view.trace.on


@register_effect
def payload(view: EffectInputs) -> Floats:
    """Passengers weigh something, on the level, uphill and when accelerating."""
    t = view.trace
    force = GRAVITY * (view.car.rolling_resistance + t.grade) + t.acceleration
    return PERSON * np.maximum(t.occupants - 1, 0.0) * force * t.speed


@register_effect
def drivetrain_loss(view: EffectInputs) -> Floats:
    """Losses that grow with the square of the power at the wheels."""
    wheel = view.state.parts[:, : len(WHEEL)].sum(axis=1)
    return np.asarray(wheel**2 / view.car.motor_power)


@register_effect
def cornering(view: EffectInputs) -> Floats:
    """Tyres that slip sideways in bends."""
    lateral = view.trace.speed * view.trace.turn_rate
    return view.car.mass * lateral**2 / 70.0 * view.trace.speed


@register_effect
def standby(view: EffectInputs) -> Floats:
    """Constant draw while the car is ready to drive."""
    return 100.0 * view.trace.on


@register_effect
def night_lights(view: EffectInputs) -> Floats:
    """Lamps in the dark."""
    return 120.0 * view.trace.dark * view.trace.on


@register_effect
def solar_load(view: EffectInputs) -> Floats:
    """Cooling away the sun where it is warm."""
    return view.trace.solar * np.clip((view.trace.ambient - 12.0) / 10.0, 0.0, 1.0) * view.trace.on


@register_effect
def humidity(view: EffectInputs) -> Floats:
    """Drying of damp air."""
    return 500.0 * np.maximum(view.trace.humidity - 0.4, 0.0) * view.trace.on


@register_effect
def brake_drag(view: EffectInputs) -> Floats:
    """Each car's brake pads rub by their own amount."""
    return view.car.brake_drag * view.trace.speed


@register_effect
def roof_load(view: EffectInputs) -> Floats:
    """Drag of the sign that some cars carry on the roof."""
    return 0.5 * REFERENCE_DENSITY * view.car.roof_drag_area * view.trace.speed**3


@register_effect
def age(view: EffectInputs) -> Floats:
    """Worn cars use more of everything, in proportion to their wear."""
    driving = view.state.parts[:, : len(WHEEL)].sum(axis=1)
    return np.asarray(view.car.wear * np.maximum(driving, 0.0))
