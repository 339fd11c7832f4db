"""Simulate the car: road load, powertrain, cabin and battery, integrated in steps of half a second.

All parts are electric powers at the terminals of the battery, so that they add up to voltage times current.
`Phenomena.foreign` follows other laws than those of the effects library:

- The cabin is two masses, its air and its interior. It loses heat through walls and through leaks that grow with speed.
- Heating saturates towards the set point. A heat pump has a share of the efficiency of Carnot and frosts about 0 °C.
- The resistance of rubber grows exponentially as it cools.
- The resistance of the battery follows Vogel, Fulcher and Tammann, and grows as the battery empties. A cold battery
  gives less of its energy.
"""

from typing import Final, NamedTuple

import numpy as np

from socast.core.batch import Floats
from socast.core.columns import GRAVITY, ZERO_CELSIUS
from socast.core.compiled_cache import njit
from socast.tools.simulator.cars import Car
from socast.tools.simulator.settings import STEP, Phenomena
from socast.tools.simulator.shift import CHARGER
from socast.tools.simulator.trace import REFERENCE_DENSITY, Trace

AIR_SHARE: Final = 0.2
"""Share of the heat capacity of the cabin that is in its air. [1]"""
CONTACT: Final = 70.0
"""Heat that the interior gives to the air per kelvin. [W/K]"""
APPROACH: Final = 2.5
"""Distance from the set point at which heating and cooling reach 63 % of their power. [K]"""
CARNOT: Final = 0.36
"""Efficiency of a heat pump or cooler over Carnot's. [1]"""
CONDENSER: Final = 48.0
"""Temperature at which a heat pump gives its heat. [°C]"""
EVAPORATOR: Final = 6.0
"""Temperature at which a cooler takes up heat. [°C]"""
GLASS: Final = 165.0, 200.0
"""Slope and ideal glass temperature of the electrolyte. [K]"""
RUBBER: Final = 60.0
"""Cooling of a tyre by which its resistance grows by a factor of e. [K]"""
WHEEL: Final = (
    "rolling",
    "speed_rolling",
    "cold_rolling",
    "wet_road",
    "snow",
    "tyre_pressure",
    "winter_tyres",
    "climbing",
    "inertia",
    "payload",
    "drag",
    "air_density",
    "headwind",
    "cornering",
    "brake_drag",
)
"""Parts of the road load at the wheels. [W]"""
PARTS: Final = (
    *WHEEL,
    "powertrain_losses",
    "friction_brakes",
    "electronics",
    "night_lights",
    "cabin_heating",
    "cabin_cooling",
    "drying",
    "battery_heating",
    "hidden",
    "charger",
)
"""Parts of the power at the terminals of the battery. Losses inside the battery are not among them. [W]"""
(ROLLING, SPEED_ROLLING, COLD_ROLLING, WET_ROAD, SNOW, TYRE_PRESSURE, WINTER_TYRES, CLIMBING, INERTIA, PAYLOAD, DRAG,
 AIR_DENSITY, HEADWIND, CORNERING, BRAKE_DRAG, LOSSES, BRAKES, ELECTRONICS, LIGHTS, HEATING, COOLING, DRYING,
 BATTERY_HEATING, HIDDEN, CHARGING) = range(len(PARTS))  # fmt: skip
ROTATING: Final = 1.04
"""Effective mass with the inertia of rotating parts, divided by the mass. [1]"""
PERSON: Final = 75.0
"""Mass of a person. [kg]"""
LOWEST_SPEED: Final = 1.5
"""Speed below which there is no regeneration. [m/s]"""
TURNING_LOSS: Final = 130.0, 18.0
"""Losses of a motor that turns without load: a power, and a force. [W], [N]"""
COMFORT: Final = (20.5, 23.0)
"""Temperatures below which the cabin is heated and above which it is cooled. [°C]"""


@njit(cache=False)
def compute_heat_pump_cop(ambient: float, best: float) -> float:
    """Return heat over electric power, between 1 and that of a warm day; 1 for a resistance heater. [1]"""
    if best <= 1.0:
        return 1.0
    cop = CARNOT * (CONDENSER + ZERO_CELSIUS) / max(CONDENSER - ambient, 15.0)
    frost = 1.0 - 0.22 * np.exp(-((ambient / 3.5) ** 2))
    return float(max(1.0, min(1.25 * best, cop * frost)))


@njit(cache=False)
def compute_cooler_cop(ambient: float) -> float:
    """Return cold over electric power. [1]"""
    return float(CARNOT * (EVAPORATOR + ZERO_CELSIUS) / max(ambient + 18.0 - EVAPORATOR, 20.0))


@njit(cache=False)
def compute_demand(power: float, distance: float) -> float:
    """Return the electric power at a distance from the set point. [W]"""
    return float(power * (1.0 - np.exp(-max(distance, 0.0) / APPROACH)))


@njit(cache=False)
def compute_cabin_loss(loss: float, speed: float, door: float) -> float:
    """Return the heat that walls, leaks and open doors lose per kelvin. [W/K]"""
    return float(loss * (0.7 + 0.3 * np.sqrt(speed / 8.0)) + 220.0 * door)


@njit(cache=False)
def compute_cold_rolling(tyre: float) -> float:
    """Return the rolling resistance of tyres over that at 25 °C, minus 1. [1]"""
    return float(np.exp((25.0 - tyre) / RUBBER) - 1.0)


@njit(cache=False)
def compute_resistance_ratio(pack: float, soc: float) -> float:
    """Return the resistance of the battery over that at 25 °C and half charge. [1]"""
    slope, glass = GLASS
    kelvin = max(pack, -50.0) + ZERO_CELSIUS
    thick = np.exp(slope / (kelvin - glass) - slope / (25.0 + ZERO_CELSIUS - glass))
    return float(thick * (1.0 + 0.8 * np.exp(-max(soc, 0.0) / 0.12)))


@njit(cache=False)
def compute_cold_yield(pack: float) -> float:
    """Return the share of its energy that a battery gives at a temperature. [1]"""
    return float(1.0 - 0.11 * (1.0 - np.tanh((pack + 22.0) / 24.0)))


class State(NamedTuple):
    """Hold the state of the car at the end of each step, and its powers.

    Parameters
    ----------
    soc : (n,) float
        State of charge. [1]
    voltage, current : (n,) float
        At the terminals of the battery; the current is positive when discharging. [V], [A]
    pack, cabin, tyre : (n,) float
        Temperatures. [°C]
    hvac : (n,) float
        Power of heating, cooling and drying. [W]
    loss : (n,) float
        Heat inside the battery. [W]
    parts : (n, len(PARTS)) float
        Powers in the order of `PARTS`. [W]
    """

    soc: Floats
    voltage: Floats
    current: Floats
    pack: Floats
    cabin: Floats
    tyre: Floats
    hvac: Floats
    loss: Floats
    parts: Floats


def integrate_states(trace: Trace, car: Car, soc: float, phenomena: Phenomena, hidden: Floats | None = None) -> State:
    """Return the states of a car over a trace.

    Units: hidden [W].
    """
    n = len(trace.time)
    extra = np.zeros(n) if hidden is None else hidden
    columns, parts = np.empty((8, n)), np.zeros((n, len(PARTS)))
    _run(trace, car, soc, phenomena, extra, columns, parts)
    return State(*[*columns, parts])


@njit(cache=True)
def _run(trace: Trace, car: Car, soc: float, on: Phenomena, hidden: Floats, columns: Floats, parts: Floats) -> None:
    """Integrate all states step by step."""
    capacity = car.capacity * (1 - car.wear * on.age)
    cabin = tyre = interior = trace.ambient[0]
    pack = trace.ambient[0] + 4.0
    for i in range(len(trace.time)):
        row = parts[i]
        tyre += STEP * (trace.ambient[i] + 0.75 * trace.speed[i] - tyre) / 1200.0
        wheel = _road_load(trace, car, on, tyre, i, row)
        _powertrain(car, on, wheel, trace.speed[i], soc, pack, row)
        if on.foreign and on.cabin_warmup:
            cabin, interior = _two_mass_cabin(trace, car, on, cabin, interior, i, row)
        else:
            cabin = _cabin(trace, car, on, cabin, i, row)
        _ancillaries(trace, car, on, pack, i, row)
        row[HIDDEN] = hidden[i]
        if trace.plugged[i] > 0:
            row[CHARGING] = -CHARGER * min(1.0, max(0.0, (0.93 - soc) / 0.12)) * min(1.0, max(0.25, (pack + 15) / 30))
        power = 0.0
        for part in range(len(row)):
            power += row[part]
        source = car.voltage * (0.90 + 0.20 * soc)
        resistance = car.resistance * on.battery_resistance * (1 + 2.0 * car.wear * on.age)
        if on.foreign:
            resistance *= compute_resistance_ratio(pack, soc)
        else:
            resistance *= np.exp((25.0 - min(pack, 45.0)) / 38.0)
        current = power / source
        if resistance > 0:
            most = 0.24 * source**2 / resistance
            current = (source - np.sqrt(source**2 - 4 * resistance * min(power, most))) / (2 * resistance)
        heat = resistance * current**2
        soc -= STEP * current * source / (capacity * (compute_cold_yield(pack) if on.foreign else 1.0))
        pack += (
            STEP * (heat + 0.8 * row[BATTERY_HEATING] - car.pack_loss * (pack - trace.ambient[i])) / car.pack_capacity
        )
        hvac = row[HEATING] + row[COOLING] + row[DRYING]
        values = (soc, source - resistance * current, current, pack, cabin, tyre, hvac, heat)
        for k in range(len(values)):
            columns[k, i] = values[k]


@njit(cache=True)
def _road_load(trace: Trace, car: Car, on: Phenomena, tyre: float, i: int, row: Floats) -> float:
    """Fill in the parts of the road load and return their sum. [W]"""
    speed, grade, acceleration = trace.speed[i], trace.grade[i], trace.acceleration[i]
    rolling = car.mass * GRAVITY * car.rolling_resistance * np.sqrt(1 - grade**2) * speed
    row[ROLLING] = rolling
    row[SPEED_ROLLING] = on.speed_rolling * rolling * 0.35 * (speed / 36.0) ** 2
    cold = compute_cold_rolling(tyre) if on.foreign else 0.0075 * (25.0 - tyre)
    row[COLD_ROLLING] = on.cold_rolling * rolling * cold
    row[WET_ROAD] = on.wet_road * rolling * 0.18 * trace.wetness[i] * min(speed / 14.0, 2.0)
    row[SNOW] = on.snow * rolling * 0.55 * trace.snow[i]
    row[TYRE_PRESSURE] = on.tyre_pressure * rolling * ((1 - car.under_inflation) ** -0.45 - 1)
    row[WINTER_TYRES] = on.winter_tyres * rolling * car.winter_rolling
    row[CLIMBING] = car.mass * GRAVITY * grade * speed
    row[INERTIA] = car.mass * ROTATING * acceleration * speed
    people = PERSON * trace.occupants[i]
    row[PAYLOAD] = on.payload * people * (GRAVITY * (car.rolling_resistance + grade) + acceleration) * speed
    half = 0.5 * car.drag_area
    row[DRAG] = half * REFERENCE_DENSITY * speed**3
    row[AIR_DENSITY] = on.air_density * half * (trace.density[i] - REFERENCE_DENSITY) * speed**3
    density = trace.density[i] if on.air_density else REFERENCE_DENSITY
    flow, across = speed + trace.headwind[i], trace.crosswind[i]
    yawed = 1 + 0.6 * across**2 / (flow**2 + across**2 + 1.0)
    row[HEADWIND] = on.headwind * half * density * (yawed * flow * np.sqrt(flow**2 + across**2) - speed**2) * speed
    sideways = (car.mass + people) * speed * trace.turn_rate[i]
    row[CORNERING] = on.cornering * sideways**2 / (70.0 * car.mass) * speed
    row[BRAKE_DRAG] = on.brake_drag * car.brake_drag * speed
    total = 0.0
    for part in range(len(WHEEL)):
        total += row[part]
    return total


@njit(cache=True)
def _powertrain(car: Car, on: Phenomena, wheel: float, speed: float, soc: float, pack: float, row: Floats) -> None:
    """Fill in the losses between the wheels and the battery, and the heat of the friction brakes."""
    recovered = 0.0
    if wheel < 0:
        limit = np.inf
        if on.regen_limit:
            limit = min(-car.regen_share * wheel, car.regen_power * min(1.0, max(0.0, (speed - LOWEST_SPEED) / 4.0)))
        if on.cold_regen_limit:
            limit = min(limit, car.regen_power * min(1.0, max(0.08, (pack + 8.0) / 22.0)))
        if on.regen_full_battery:
            limit = min(limit, car.regen_power * min(1.0, max(0.0, (0.97 - soc) / 0.06)))
        recovered = min(-wheel, limit)
        row[BRAKES] = -wheel - recovered
    through = max(wheel, 0.0) + recovered
    row[LOSSES] = through * (1 / car.efficiency - 1) if wheel >= 0 else through * (1 - car.efficiency)
    if on.motor_map and speed > 0:
        best = 0.75 * (1 - car.efficiency)
        row[LOSSES] = TURNING_LOSS[0] + TURNING_LOSS[1] * speed + best * through + 0.12 * through**2 / car.motor_power


@njit(cache=True)
def _cabin(trace: Trace, car: Car, on: Phenomena, cabin: float, i: int, row: Floats) -> float:
    """Fill in heating and cooling, and return the temperature of the cabin after the step. [°C]"""
    ambient = trace.ambient[i]
    if on.cabin_warmup:
        gain = car.cabin_loss * (ambient - cabin) + 80.0 * trace.occupants[i]
        gain += on.door_heat_loss * trace.door[i] * 260.0 * (ambient - cabin)
        gain += on.solar_load * 0.9 * trace.solar[i]
        demand = 450.0 * (COMFORT[0] + car.warmth - cabin), 450.0 * (cabin - COMFORT[1] - car.warmth)
    else:
        gain = 0.0
        demand = car.cabin_loss * (COMFORT[0] - 1.0 - ambient), car.cabin_loss * (ambient - COMFORT[1]) + 150.0
    cop = max(1.0, car.heater_cop * min(1.0, 1 + ambient / 40.0))
    ready = trace.on[i] * on.climate
    heating = ready * min(car.heater_power, max(0.0, demand[0]) / cop)
    cooling = ready * min(car.cooler_power, max(0.0, demand[1]) / car.cooler_cop)
    if ambient < COMFORT[1] and not on.cabin_warmup:
        cooling = 0.0
    row[HEATING], row[COOLING] = heating, cooling
    if not on.cabin_warmup:
        return COMFORT[0]
    return float(cabin + STEP * (gain + heating * cop - cooling * car.cooler_cop) / car.cabin_capacity)


@njit(cache=True)
def _two_mass_cabin(
    trace: Trace, car: Car, on: Phenomena, air: float, interior: float, i: int, row: Floats
) -> tuple[float, float]:
    """Fill in heating and cooling, and return the temperatures of air and interior after the step. [°C]"""
    ambient, ready = trace.ambient[i], trace.on[i] * on.climate
    heating = ready * compute_demand(car.heater_power, COMFORT[0] + car.warmth - air)
    cooling = ready * compute_demand(car.cooler_power, air - COMFORT[1] - car.warmth)
    row[HEATING], row[COOLING] = heating, cooling
    heat = heating * compute_heat_pump_cop(ambient, car.heater_cop) - cooling * compute_cooler_cop(ambient)
    door = on.door_heat_loss * trace.door[i]
    gain = compute_cabin_loss(car.cabin_loss, trace.speed[i], door) * (ambient - air) + 80.0 * trace.occupants[i]
    contact = CONTACT * (interior - air)
    air_capacity = AIR_SHARE * car.cabin_capacity
    sun = on.solar_load * 0.9 * trace.solar[i]
    warmed = air + STEP * (gain + contact + heat) / air_capacity
    return float(warmed), float(interior + STEP * (sun - contact) / (car.cabin_capacity - air_capacity))


@njit(cache=True)
def _ancillaries(trace: Trace, car: Car, on: Phenomena, pack: float, i: int, row: Floats) -> None:
    """Fill in electronics, lamps, drying of the air, and heating of the battery."""
    row[ELECTRONICS] = trace.on[i] * car.electronics
    row[LIGHTS] = on.night_lights * trace.on[i] * trace.dark[i] * 130.0
    if on.humidity and car.cooler_power > 0:
        damp = max(0.0, trace.humidity[i] - 0.6) / 0.4
        mild = min(1.0, max(0.0, (trace.ambient[i] - 1.0) / 6.0))
        row[DRYING] = trace.on[i] * 450.0 * damp * mild
    if on.cold_battery_heating:
        cold = min(1.0, max(0.0, (car.pack_heater_below - pack) / 3.0))
        row[BATTERY_HEATING] = max(trace.on[i], trace.plugged[i]) * car.pack_heater * cold
