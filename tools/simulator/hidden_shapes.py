"""Define the effects of `hidden` in other shapes, to test a library of textbook forms on the same phenomena.

The option `--hidden cold_rolling~other` selects the other shape of `cold_rolling`. The effects of `hidden` are mostly
linear; these bend, saturate, step, lag or depend on additional quantities. `--hidden snow~bent7` selects the seventh
bent shape of `snow`: its power raised to an exponent, multiplied by a power of the speed and by an exponential of the
outside temperature, and delayed if it does not act by motion.
"""

from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Final, NamedTuple

import numpy as np

from socast.core.batch import Floats, Ints
from socast.core.columns import GRAVITY, ZERO_CELSIUS
from socast.core.errors import SettingsError
from socast.tools.simulator.hidden import (
    EFFECTS,
    EffectInputs,
    PowerFunction,
    apply_lag,
    compute_braking_power,
    compute_rolling_power,
)
from socast.tools.simulator.physics import COMFORT, PERSON, WHEEL
from socast.tools.simulator.settings import STEP, Hidden
from socast.tools.simulator.shift import NO_RIDE
from socast.tools.simulator.trace import REFERENCE_DENSITY

BENT: Final = "~bent"
"""Text between the name of an effect and the number of its bent shape."""
DELAYED: Final = frozenset(
    {
        "cabin_cooling",
        "cabin_heating",
        "cabin_warmup",
        "cold_battery_heating",
        "door_heat_loss",
        "humidity",
        "night_lights",
        "solar_load",
    }
)
"""Effects that act by time, whose bent shape may lag."""
EXPONENT: Final = 0.45
"""Largest absolute logarithm of the exponent. [1]"""
SPEED: Final = 0.35
"""Largest absolute exponent of the speed. [1]"""
TEMPERATURE: Final = 0.35
"""Largest absolute change of the logarithm over 20 K. [1]"""
LAG: Final = (20.0, 400.0)
"""Range of time constants, whose logarithm is uniform. [s]"""
LAGGED: Final = 0.5
"""Share of the bent shapes of `DELAYED` that lag."""
POWER: Final = 500.0
"""Power that an exponent does not change. [W]"""
PACE: Final = 12.0
"""Speed that the exponent of the speed does not change; half of it is the least speed that counts. [m/s]"""
OTHER: Final = "~other"
"""Suffix of the name of an effect that selects its other shape."""
OTHER_SHAPES: Final[dict[str, PowerFunction]] = {}
"""Power at natural size of each effect in its other shape. [W]"""
GUSTS: Final = 1.2
"""Effective wind speed of gusty wind divided by the mean wind speed, with respect to drag. [1]"""
ROOM_TEMPERATURE: Final = 20.0
"""Temperature at which the drag of air equals that of the base. [°C]"""
REYNOLDS: Final = 0.1
"""Exponent by which the drag coefficient falls with Reynolds number. [1]"""
RIGHT_NAMES: Final[Mapping[str, tuple[str, ...]]] = MappingProxyType(
    {
        "drivetrain_loss": ("drivetrain_loss_power", "drivetrain_loss_torque", "drivetrain_loss_speed"),
        "humidity": ("humidity", "demisting"),
    }
)
"""Right names where the library has another name for a cause than the simulator, or several names.

`drivetrain_loss`: the loss of the simulator grows with the square of the power at the wheels. The library has one
effect that grows with the square of the power, one with the square of the force and one with that of the speed.
Together they make up the loss. `humidity`: the effect of the simulator is the drying of damp air, by relative humidity.
The library calls that `demisting`, and calls the latent load of cooling, by vapour pressure, `humidity`. Both dry air.
"""


def bend_shape(effect: str, number: int) -> PowerFunction:
    """Return the power of an effect in a bent shape."""
    power = EFFECTS[effect]
    rng = np.random.default_rng([number, *effect.encode()])
    exponent = float(np.exp(rng.uniform(-EXPONENT, EXPONENT)))
    speed, temperature = float(rng.uniform(-SPEED, SPEED)), float(rng.uniform(-TEMPERATURE, TEMPERATURE))
    lag = float(np.exp(rng.uniform(*np.log(LAG)))) if effect in DELAYED and rng.uniform() < LAGGED else 0.0

    def bent(view: EffectInputs) -> Floats:
        """Return the power of the bent effect. [W]"""
        plain = power(view)
        out = np.sign(plain) * POWER * (np.abs(plain) / POWER) ** exponent
        out = out * (np.maximum(view.trace.speed, PACE / 2.0) / PACE) ** speed
        out = out * np.exp(temperature * view.trace.ambient / 20.0)
        return np.asarray(apply_lag(out, lag) * view.trace.on if lag else out)

    return bent


def register_other_shape(function: PowerFunction) -> PowerFunction:
    """Register the other shape of the hidden effect with the name of the function."""
    OTHER_SHAPES[function.__name__] = function
    return function


def _cold(view: EffectInputs) -> Floats:
    """Return the difference between comfort and outside temperature, 0 in warm weather. [K]"""
    return np.maximum(COMFORT[0] - view.trace.ambient, 0.0)


def _wheel(view: EffectInputs) -> Floats:
    """Return the power at the wheels. [W]"""
    return np.asarray(view.state.parts[:, : len(WHEEL)].sum(axis=1))


@register_other_shape
def headwind(view: EffectInputs) -> Floats:
    """Return the power against gusty wind along and across the road, with the yaw of the flow and the air density."""
    t = view.trace
    flow, across = t.speed + GUSTS * t.headwind, GUSTS * t.crosswind
    felt = np.hypot(flow, across)
    yawed = 1 + 0.6 * (across / np.maximum(felt, 1.0)) ** 2
    return 0.5 * t.density * view.car.drag_area * (yawed * flow * felt - t.speed**2) * t.speed


@register_other_shape
def air_density(view: EffectInputs) -> Floats:
    """Return additional drag of cold air by temperature alone; the drag coefficient falls with Reynolds number."""
    warm = ROOM_TEMPERATURE + ZERO_CELSIUS
    density = REFERENCE_DENSITY * ((warm / (view.trace.ambient + ZERO_CELSIUS)) ** (1 - REYNOLDS) - 1)
    return 0.5 * density * view.car.drag_area * view.trace.speed ** (3 - REYNOLDS)


@register_other_shape
def cold_rolling(view: EffectInputs) -> Floats:
    """Return additional rolling resistance by tyre temperature, which rises on the road; at most 35 % of the base."""
    return np.asarray(
        compute_rolling_power(view) * 0.35 * (1 - np.exp(-np.maximum(25.0 - view.state.tyre, 0.0) / 15.0))
    )


@register_other_shape
def wet_road(view: EffectInputs) -> Floats:
    """Return the power that displaces deep water, by a force proportional to the speed to the power of 1.6."""
    return compute_rolling_power(view) * np.maximum(view.trace.wetness - 0.2, 0.0) * (view.trace.speed / 14.0) ** 1.6


@register_other_shape
def snow(view: EffectInputs) -> Floats:
    """Return the power that displaces snow in three steps: none, half, full."""
    return np.asarray(
        compute_rolling_power(view) * np.select([view.trace.snow > 0.4, view.trace.snow > 0.1], [1.0, 0.5], 0.0)
    )


@register_other_shape
def tyre_pressure(view: EffectInputs) -> Floats:
    """Return additional rolling resistance of soft tyres that grows with speed."""
    softer = (1 - view.car.under_inflation) ** -0.45 - 1
    return np.asarray(compute_rolling_power(view) * softer * (1 + (view.trace.speed / 25.0) ** 2))


@register_other_shape
def door_heat_loss(view: EffectInputs) -> Floats:
    """Return the heating that replaces warm air rising out of open doors, while they are open."""
    return 60.0 * view.trace.door * _cold(view) ** 1.5 * view.trace.on


@register_other_shape
def cabin_heating(view: EffectInputs) -> Floats:
    """Return a heating power that grows with the square of the cold, as a heat pump loses efficiency in it."""
    return view.car.cabin_loss * _cold(view) ** 2 / 20.0 * view.trace.on


@register_other_shape
def cabin_cooling(view: EffectInputs) -> Floats:
    """Return the cooling power of a compressor with three stages."""
    ambient = view.trace.ambient
    return 1500.0 * np.select([ambient > 28.0, ambient > 24.0, ambient > 20.0], [1.0, 0.7, 0.4], 0.0) * view.trace.on


@register_other_shape
def cabin_warmup(view: EffectInputs) -> Floats:
    """Return full heating power until a cabin that cooled while parked is warm."""
    cooled = 1 - np.exp(-view.trace.parked / 2400.0)
    return np.asarray(view.car.heater_power * (view.trace.elapsed < 20.0 * _cold(view) * cooled) * view.trace.on)


@register_other_shape
def cold_regen_limit(view: EffectInputs) -> Floats:
    """Return braking power that a cold battery cannot recover, in three steps of its temperature."""
    pack = view.state.pack
    return np.asarray(
        compute_braking_power(view) * np.select([pack < -10.0, pack < 0.0, pack < 8.0], [1.0, 0.6, 0.3], 0.0)
    )


@register_other_shape
def regen_full_battery(view: EffectInputs) -> Floats:
    """Return braking power that a battery cannot recover: half when nearly full, all when full."""
    return np.asarray(
        compute_braking_power(view) * np.select([view.state.soc > 0.94, view.state.soc > 0.88], [1.0, 0.5], 0.0)
    )


@register_other_shape
def battery_resistance(view: EffectInputs) -> Floats:
    """Return the heat of a current that polarises the cells, with a linear increase below 25 °C."""
    current = np.abs(view.state.current)
    cold = 1 + 0.06 * np.maximum(25.0 - view.state.pack, 0.0)
    return view.car.resistance * cold * current * (0.5 * current + 0.5 * apply_lag(current, 30.0)) * view.trace.on


@register_other_shape
def cold_battery_heating(view: EffectInputs) -> Floats:
    """Return a heating power of the battery that is full below 2 °C and zero above 5 °C."""
    return 600.0 * np.clip((5.0 - view.state.pack) / 3.0, 0.0, 1.0) * view.trace.on


@register_other_shape
def payload(view: EffectInputs) -> Floats:
    """Return the power that passengers with luggage take; downhill and while braking half of it is recovered."""
    t = view.trace
    power = (GRAVITY * (view.car.rolling_resistance + t.grade) + t.acceleration) * t.speed
    return PERSON * np.maximum(t.occupants - 1, 0.0) ** 1.3 * np.where(power > 0.0, power, 0.5 * power)


@register_other_shape
def drivetrain_loss(view: EffectInputs) -> Floats:
    """Return losses proportional to the power at the wheels to the power of 1.5."""
    return np.asarray(np.abs(_wheel(view)) ** 1.5 / np.sqrt(view.car.motor_power))


@register_other_shape
def cornering(view: EffectInputs) -> Floats:
    """Return the power of tyres that slip sideways in sharp bends only."""
    lateral = np.abs(view.trace.speed * view.trace.turn_rate)
    return 0.03 * view.car.mass * np.maximum(lateral - 0.6, 0.0) * view.trace.speed


@register_other_shape
def standby(view: EffectInputs) -> Floats:
    """Return a constant power that is lower while the car moves."""
    return 100.0 * np.where(view.trace.speed < 0.5, 2.0, 0.7) * view.trace.on


@register_other_shape
def night_lights(view: EffectInputs) -> Floats:
    """Return the power of lamps that dim with daylight and are on in the rain."""
    dusk = 1 - np.clip(view.trace.solar / 120.0, 0.0, 1.0)
    return 120.0 * np.maximum(dusk, view.trace.precipitation > 0.0) * view.trace.on


@register_other_shape
def solar_load(view: EffectInputs) -> Floats:
    """Return the power that cools away the strong solar heat of the last quarter of an hour in warm weather."""
    stored = np.maximum(apply_lag(view.trace.solar, 900.0) - 150.0, 0.0)
    return stored * (view.trace.ambient > 15.0) * view.trace.on


@register_other_shape
def humidity(view: EffectInputs) -> Floats:
    """Return the power that dries the breath of the occupants, growing with the square of the humidity."""
    return 1000.0 * np.maximum(view.trace.humidity - 0.5, 0.0) ** 2 * view.trace.occupants * view.trace.on


@register_other_shape
def brake_drag(view: EffectInputs) -> Floats:
    """Return the power of brake pads that rub for a minute after each braking."""
    braked = apply_lag((compute_braking_power(view) > 500.0).astype(float), 60.0)
    return view.car.brake_drag * braked * view.trace.speed


@register_other_shape
def roof_load(view: EffectInputs) -> Floats:
    """Return the drag of the sign on the roof in the true wind and air density."""
    flow = view.trace.speed + view.trace.headwind
    return 0.5 * view.trace.density * view.car.roof_drag_area * flow * np.abs(flow) * view.trace.speed


@register_other_shape
def age(view: EffectInputs) -> Floats:
    """Return losses of worn cars proportional to the square of the driving power."""
    return np.asarray(view.car.wear * np.maximum(_wheel(view), 0.0) ** 2 / view.car.motor_power)


def get_power(effect: str) -> PowerFunction:
    """Return the power at natural size of an effect in the shape that its name selects. [W]

    Parameters
    ----------
    effect : str
        Name of the effect: plain, followed by `OTHER`, or followed by `BENT` and a number.
    """
    name, bent, number = effect.partition(BENT)
    if bent and name in EFFECTS and number.isdigit():
        return bend_shape(name, int(number))
    shapes = OTHER_SHAPES if effect.endswith(OTHER) else EFFECTS
    plain = effect.removesuffix(OTHER)
    if plain not in shapes:
        raise SettingsError(
            f"no hidden effect is called {effect!r}; choose from {', '.join(sorted(EFFECTS))}, each also with {OTHER} "
            f"or with {BENT} and a number"
        )
    return shapes[plain]


def strip_shape(effect: str) -> str:
    """Return the name of an effect without its shape."""
    return effect.partition(BENT)[0].removesuffix(OTHER)


def get_right_names(effect: str) -> tuple[str, ...]:
    """Return the effects of the library that are right names for a hidden effect."""
    return RIGHT_NAMES.get(strip_shape(effect), (strip_shape(effect),))


class EffectEnergies(NamedTuple):
    """Hold the energies of rides.

    Parameters
    ----------
    battery : (rides,) float
        Energy at the terminals of the battery, without hidden effects. [J]
    effects : (rides, effects) float
        Energy of each hidden effect at natural size. [J]
    """

    battery: Floats
    effects: Floats


def sum_energies(view: EffectInputs, ride: Ints, hidden: Iterable[Hidden]) -> EffectEnergies:
    """Return the energies of the rides of a shift."""
    powers = [view.state.parts.sum(axis=1), *(get_power(effect)(view) for effect, _ in hidden)]
    inside = ride != NO_RIDE
    sums: list[Floats] = [np.bincount(ride[inside], power[inside]).astype(float) * STEP for power in powers]
    return EffectEnergies(sums[0], np.stack(sums[1:], axis=1))


def calibrate_effects(pilot: list[EffectEnergies], hidden: tuple[Hidden, ...]) -> list[float]:
    """Return the factor by which the power of each effect is multiplied.

    Notes
    -----
    The size of an effect is the sum of its absolute energy over all rides, divided by the energy of all rides with
    hidden effects. For an effect that always costs energy the size equals its share of the energy.
    """
    battery = float(np.concatenate([energies.battery for energies in pilot]).sum())
    effects = np.concatenate([energies.effects for energies in pilot])
    absolute, signed = np.abs(effects).sum(axis=0), effects.sum(axis=0)
    for (effect, size), energy in zip(hidden, absolute, strict=True):
        if energy < 1e-5 * battery:
            raise SettingsError(
                f"hidden effect {effect} uses {energy / battery:.1e} of the energy in this season, too little "
                f"to make it {size:g}; choose other dates or another effect"
            )
    sizes = np.array([size for _, size in hidden])
    total = battery / (1 - float((sizes * signed / absolute).sum()))
    return [float(factor) for factor in sizes * total / absolute]


def check_effects(hidden: tuple[Hidden, ...]) -> None:
    """Raise an error if an effect does not exist."""
    for effect, _ in hidden:
        get_power(effect)
