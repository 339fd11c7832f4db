"""The same phenomena as in `hidden`, each in another shape: what a library of textbook forms has to cope with.

`cold_rolling~other` is chosen like any hidden effect. Where `hidden` is straight, these bend, saturate, step, lag or
depend on something else besides.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

import numpy as np

from core.batch import Floats
from core.columns import GRAVITY, ZERO_CELSIUS
from tools.simulator.hidden import (
    EFFECTS,
    EffectInputs,
    PowerFunction,
    apply_lag,
    compute_braking_power,
    compute_rolling_power,
)
from tools.simulator.physics import COMFORT, PERSON, WHEEL
from tools.simulator.trace import REFERENCE_DENSITY

OTHER: Final = "~other"
"""What follows the name of an effect where its other shape is meant."""
OTHER_SHAPES: Final[dict[str, PowerFunction]] = {}
"""Name of the effect -> power at natural size, in another shape."""
GUSTS: Final = 1.2
"""Gusts over the mean wind, by what they do to drag."""
ROOM_TEMPERATURE: Final = 20.0
"""Where the drag of air is as the base has it. [°C]"""
REYNOLDS: Final = 0.1
"""How fast the drag coefficient falls with Reynolds number, as an exponent."""


def register_other_shape(function: PowerFunction) -> PowerFunction:
    """Register another shape of the hidden effect of this name."""
    OTHER_SHAPES[function.__name__] = function
    return function


def _cold(view: EffectInputs) -> Floats:
    """Return how much colder than the cabin it is outside, 0 where it is not. [K]."""
    return np.maximum(COMFORT[0] - view.trace.ambient, 0.0)


def _wheel(view: EffectInputs) -> Floats:
    """Return the power at the wheels. [W]."""
    return np.asarray(view.state.parts[:, : len(WHEEL)].sum(axis=1))


@register_other_shape
def headwind(view: EffectInputs) -> Floats:
    """Gusty wind along and across, by the yaw of the flow, in the air's own density."""
    t = view.trace
    flow, across = t.speed + GUSTS * t.headwind, GUSTS * t.crosswind
    felt = np.hypot(flow, across)
    yawed = 1 + 0.6 * (across / np.maximum(felt, 1.0)) ** 2
    return 0.5 * t.density * view.car.drag_area * (yawed * flow * felt - t.speed**2) * t.speed


@register_other_shape
def air_density(view: EffectInputs) -> Floats:
    """Denser air by its temperature alone, with a drag coefficient that falls with Reynolds number."""
    warm = ROOM_TEMPERATURE + ZERO_CELSIUS
    density = REFERENCE_DENSITY * ((warm / (view.trace.ambient + ZERO_CELSIUS)) ** (1 - REYNOLDS) - 1)
    return 0.5 * density * view.car.drag_area * view.trace.speed ** (3 - REYNOLDS)


@register_other_shape
def cold_rolling(view: EffectInputs) -> Floats:
    """Tyres by their own temperature, which rises on the road, and never worse than by a third."""
    return np.asarray(
        compute_rolling_power(view) * 0.35 * (1 - np.exp(-np.maximum(25.0 - view.state.tyre, 0.0) / 15.0))
    )


@register_other_shape
def wet_road(view: EffectInputs) -> Floats:
    """Water that is displaced by the speed to the power of 1.6, where it stands deeper than the texture."""
    return compute_rolling_power(view) * np.maximum(view.trace.wetness - 0.2, 0.0) * (view.trace.speed / 14.0) ** 1.6


@register_other_shape
def snow(view: EffectInputs) -> Floats:
    """Snow that makes no difference, some, or much."""
    return np.asarray(
        compute_rolling_power(view) * np.select([view.trace.snow > 0.4, view.trace.snow > 0.1], [1.0, 0.5], 0.0)
    )


@register_other_shape
def tyre_pressure(view: EffectInputs) -> Floats:
    """Soft tyres that bulge the more, the faster they turn."""
    softer = (1 - view.car.under_inflation) ** -0.45 - 1
    return np.asarray(compute_rolling_power(view) * softer * (1 + (view.trace.speed / 25.0) ** 2))


@register_other_shape
def door_heat_loss(view: EffectInputs) -> Floats:
    """Warm air that rises out of open doors, made up for while they are open."""
    return 60.0 * view.trace.door * _cold(view) ** 1.5 * view.trace.on


@register_other_shape
def cabin_heating(view: EffectInputs) -> Floats:
    """Heating with the square of the cold, as a heat pump does worse in it."""
    return view.car.cabin_loss * _cold(view) ** 2 / 20.0 * view.trace.on


@register_other_shape
def cabin_cooling(view: EffectInputs) -> Floats:
    """Cooling by a compressor of three stages."""
    ambient = view.trace.ambient
    return 1500.0 * np.select([ambient > 28.0, ambient > 24.0, ambient > 20.0], [1.0, 0.7, 0.4], 0.0) * view.trace.on


@register_other_shape
def cabin_warmup(view: EffectInputs) -> Floats:
    """Heating at full power until a cabin that cooled while parked is warm."""
    cooled = 1 - np.exp(-view.trace.parked / 2400.0)
    return np.asarray(view.car.heater_power * (view.trace.elapsed < 20.0 * _cold(view) * cooled) * view.trace.on)


@register_other_shape
def cold_regen_limit(view: EffectInputs) -> Floats:
    """Braking energy that a cold battery takes none of, some of, most of."""
    pack = view.state.pack
    return np.asarray(
        compute_braking_power(view) * np.select([pack < -10.0, pack < 0.0, pack < 8.0], [1.0, 0.6, 0.3], 0.0)
    )


@register_other_shape
def regen_full_battery(view: EffectInputs) -> Floats:
    """Braking energy of which a nearly full battery takes half, a full one none."""
    return np.asarray(
        compute_braking_power(view) * np.select([view.state.soc > 0.94, view.state.soc > 0.88], [1.0, 0.5], 0.0)
    )


@register_other_shape
def battery_resistance(view: EffectInputs) -> Floats:
    """Heat of a current that polarises the cells, more by so much for each degree below 25 °C."""
    current = np.abs(view.state.current)
    cold = 1 + 0.06 * np.maximum(25.0 - view.state.pack, 0.0)
    return view.car.resistance * cold * current * (0.5 * current + 0.5 * apply_lag(current, 30.0)) * view.trace.on


@register_other_shape
def cold_battery_heating(view: EffectInputs) -> Floats:
    """Heating of the battery that is on below 2 °C and off above 5 °C."""
    return 600.0 * np.clip((5.0 - view.state.pack) / 3.0, 0.0, 1.0) * view.trace.on


@register_other_shape
def payload(view: EffectInputs) -> Floats:
    """Passengers with ever more luggage, whose momentum is paid in full and regained by half."""
    t = view.trace
    power = (GRAVITY * (view.car.rolling_resistance + t.grade) + t.acceleration) * t.speed
    return PERSON * np.maximum(t.occupants - 1, 0.0) ** 1.3 * np.where(power > 0.0, power, 0.5 * power)


@register_other_shape
def drivetrain_loss(view: EffectInputs) -> Floats:
    """Losses that grow with the power at the wheels to the power of one and a half."""
    return np.asarray(np.abs(_wheel(view)) ** 1.5 / np.sqrt(view.car.motor_power))


@register_other_shape
def cornering(view: EffectInputs) -> Floats:
    """Tyres that slip sideways once a bend is sharp."""
    lateral = np.abs(view.trace.speed * view.trace.turn_rate)
    return 0.03 * view.car.mass * np.maximum(lateral - 0.6, 0.0) * view.trace.speed


@register_other_shape
def standby(view: EffectInputs) -> Floats:
    """Constant draw, lower while air flows about the car."""
    return 100.0 * np.where(view.trace.speed < 0.5, 2.0, 0.7) * view.trace.on


@register_other_shape
def night_lights(view: EffectInputs) -> Floats:
    """Lamps that are dimmed by the daylight, and lit in the rain."""
    dusk = 1 - np.clip(view.trace.solar / 120.0, 0.0, 1.0)
    return 120.0 * np.maximum(dusk, view.trace.precipitation > 0.0) * view.trace.on


@register_other_shape
def solar_load(view: EffectInputs) -> Floats:
    """Cooling away the sun of the last quarter of an hour where it is warm, a little sun being no matter."""
    stored = np.maximum(apply_lag(view.trace.solar, 900.0) - 150.0, 0.0)
    return stored * (view.trace.ambient > 15.0) * view.trace.on


@register_other_shape
def humidity(view: EffectInputs) -> Floats:
    """Drying of what people breathe out, the more the damper the air."""
    return 1000.0 * np.maximum(view.trace.humidity - 0.5, 0.0) ** 2 * view.trace.occupants * view.trace.on


@register_other_shape
def brake_drag(view: EffectInputs) -> Floats:
    """Brake pads that rub for a minute after each braking."""
    braked = apply_lag((compute_braking_power(view) > 500.0).astype(float), 60.0)
    return view.car.brake_drag * braked * view.trace.speed


@register_other_shape
def roof_load(view: EffectInputs) -> Floats:
    """Drag of the sign on the roof, in the wind and the air that there is."""
    flow = view.trace.speed + view.trace.headwind
    return 0.5 * view.trace.density * view.car.roof_drag_area * flow * np.abs(flow) * view.trace.speed


@register_other_shape
def age(view: EffectInputs) -> Floats:
    """Worn cars that lose with the square of the driving power."""
    return np.asarray(view.car.wear * np.maximum(_wheel(view), 0.0) ** 2 / view.car.motor_power)


POWERS: Final[Mapping[str, PowerFunction]] = MappingProxyType(
    EFFECTS | {f"{name}{OTHER}": power for name, power in OTHER_SHAPES.items()}
)
"""All that can be hidden: name, with `OTHER` where it is the other shape -> power at natural size."""
