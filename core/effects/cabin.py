"""Effects of cabin climate: heat loss to the air outside, open doors, stored heat, sun and moisture.

Coefficients are of electric power: heat over the coefficient of performance, which is 1 for a resistance heater and 2
to 4 for a heat pump or an air conditioner.
"""

from typing import Final

import numpy as np

from socast.core.batch import Floats
from socast.core.effects.declaration import Parameter, effect

_BALANCE: Final = "Fayazbakhsh and Bahrami 2013, SAE 2013-01-1507, DOI 10.4271/2013-01-1507, heat balance of a cabin"
_MEASURED: Final = "heater and air-conditioning power of the Vehicle Energy Dataset, arXiv:1905.02081"


@effect(
    coefficient="heat lost per opening and kelvin, over the coefficient of performance",
    unit="J/K",
    low=300.0,
    high=60_000.0,
    source=f"{_BALANCE}, ventilation load; range: from a tenth of 3 m³ of air, 3.6 kJ/K, to a minute at 0.3 m³/s "
    "(estimate)",
    per="time",
    parameters={
        "inside": Parameter(294.15, "K", 285.15, 299.15, grid=(288.15, 294.15, 298.15)),
        "share": Parameter(0.0, "1", 0.0, 1.0, grid=(0.0, 0.2, 1.0)),
        "recovery": Parameter(180.0, "s", 30.0, 900.0, grid=(90.0, 180.0, 360.0)),
    },
    confused_with=("cabin_heating", "cabin_warmup"),
    shown_by="many short rides beside few long ones, as cold, after short and after long pauses",
    words="open doors: an opening costs {value} kJ for each degree that it is colder outside than {inside}",
    scale=1e-3,
)
def door_heat_loss(
    elapsed: Floats, stop_rate: Floats, ambient: Floats, *, inside: float, share: float, recovery: float
) -> Floats:
    """Warm air that leaves through the doors: P = (exp(-t/τ)/τ + q n) max(T_in - T, 0), times the heat lost per kelvin.

    Doors open when a ride begins, t ago, and the heater replaces the heat with time constant τ. Doors also open at a
    share q of the stops, of which there are n per second.
    """
    return (np.exp(-elapsed / recovery) / recovery + share * stop_rate) * np.maximum(inside - ambient, 0.0)


@effect(
    coefficient="heat loss of the cabin, over the coefficient of performance",
    unit="W/K",
    low=20.0,
    high=350.0,
    source=f"{_BALANCE}; range: {_MEASURED}, some 120 W/K of a resistance heater; less with a heat pump, more with "
    "fresh air",
    per="time",
    parameters={"balance": Parameter(288.15, "K", 275.15, 297.15, grid=(278.15, 283.15, 288.15, 293.15))},
    confused_with=("accessories", "cabin_warmup", "cold_battery_heating", "cold_rolling", "door_heat_loss"),
    shown_by="slow drives and standing cars in the cold, where time passes and few kilometres do",
    words="heating: {value} W for each degree below {balance}",
)
def cabin_heating(ambient: Floats, balance: float) -> Floats:
    """Heating against the cold: P = max(T0 - T, 0), times the heat loss per kelvin.

    T0 is the outside temperature at which sun, people and machines balance the loss. It is below the temperature
    inside.
    """
    return np.maximum(balance - ambient, 0.0)


@effect(
    coefficient="cooling load of the cabin, over the coefficient of performance",
    unit="W/K",
    low=15.0,
    high=300.0,
    source=f"{_BALANCE}; range: {_MEASURED}, some 100 W/K",
    per="time",
    parameters={"balance": Parameter(295.15, "K", 286.15, 303.15, grid=(289.15, 292.15, 295.15, 298.15))},
    confused_with=("accessories", "humidity", "solar_load"),
    shown_by="slow drives and standing cars in the heat, by day and by night",
    words="cooling: {value} W for each degree above {balance}",
)
def cabin_cooling(ambient: Floats, balance: float) -> Floats:
    """Cooling against the heat: P = max(T - T0, 0), times the load per kelvin."""
    return np.maximum(ambient - balance, 0.0)


@effect(
    coefficient="heat stored in the cabin per kelvin, over the coefficient of performance",
    unit="J/K",
    low=1e4,
    high=3e5,
    source=f"{_BALANCE}, thermal inertia; range: 10 to 150 kg of air, seats and trim at 1 to 2 kJ/(kg K) (estimate)",
    per="time",
    parameters={
        "inside": Parameter(294.15, "K", 285.15, 299.15),
        "decay": Parameter(600.0, "s", 120.0, 2400.0, grid=(300.0, 600.0, 1200.0)),
        "soak": Parameter(3600.0, "s", 900.0, 14_400.0, grid=(1800.0, 3600.0, 7200.0)),
    },
    confused_with=("cabin_heating", "cold_battery_heating", "door_heat_loss"),
    shown_by="the first quarter of an hour of rides after a night, beside rides after a short stop, in the cold",
    words="a cold cabin takes {value} kJ per degree to warm up, all but a third of it within {decay}",
    scale=1e-3,
)
def cabin_warmup(
    ambient: Floats, parked: Floats, elapsed: Floats, *, inside: float, decay: float, soak: float
) -> Floats:
    """Seats and trim that have cooled: P = max(T_in - T, 0) (1 - exp(-p/τ_s)) exp(-t/τ)/τ, times the heat per kelvin.

    p is the time parked, in which the cabin cools with time constant τ_s, and t the time since the ride began.
    """
    cooled = np.maximum(inside - ambient, 0.0) * (1.0 - np.exp(-parked / soak))
    return cooled * np.exp(-elapsed / decay) / decay


@effect(
    coefficient="glazing that the sun shines through, over the coefficient of performance",
    unit="m^2",
    low=0.1,
    high=2.0,
    source=f"{_BALANCE}, direct and diffuse radiation; range: 1 to 3 m² of glass in the plane, letting half through, "
    "coefficient of performance 1 to 4 (estimate)",
    per="time",
    parameters={
        "cooling_on": Parameter(293.15, "K", 283.15, 303.15, grid=(288.15, 293.15, 298.15)),
        "width": Parameter(5.0, "K"),
    },
    confused_with=("cabin_cooling",),
    shown_by="clear and cloudy days as warm, with a station that measures the sun",
    words="sun: it heats as if through {value} m² of glass where it is warmer than {cooling_on}",
)
def solar_load(solar: Floats, ambient: Floats, cooling_on: float, width: float) -> Floats:
    """Sun that must be cooled away: P = G min(max((T - T0)/ΔT, 0), 1), times the area.

    Below T0 the sun costs nothing, and at most saves heating.
    """
    return solar * np.clip((ambient - cooling_on) / width, 0.0, 1.0)


@effect(
    coefficient="power per vapour pressure to be removed",
    unit="W/Pa",
    low=0.02,
    high=1.5,
    source="ASHRAE Handbook, Fundamentals, ch. Psychrometrics: 0.622 e/p of latent heat 2.45 MJ/kg; range: 0.005 to "
    "0.1 kg/s of fresh air, coefficient of performance 1 to 4 (estimate)",
    per="time",
    parameters={
        "dry": Parameter(1200.0, "Pa", 600.0, 2000.0),
        "cooling_on": Parameter(293.15, "K", 283.15, 303.15),
        "width": Parameter(5.0, "K"),
    },
    confused_with=("cabin_cooling", "demisting", "wet_road"),
    shown_by="muggy and dry days as warm, with a station that measures humidity",
    words="humidity: {value} W for each hectopascal of vapour above that of the cabin",
    scale=100.0,
)
def humidity(vapour_pressure: Floats, ambient: Floats, dry: float, cooling_on: float, width: float) -> Floats:
    """Water that the air conditioner removes: P = max(e - e_in, 0) min(max((T - T0)/ΔT, 0), 1), times W/Pa.

    e is the vapour pressure outside, and e_in that of the air that leaves the evaporator, at a dew point of 10 °C.
    """
    return np.maximum(vapour_pressure - dry, 0.0) * np.clip((ambient - cooling_on) / width, 0.0, 1.0)


@effect(
    coefficient="power to dry damp air",
    unit="W",
    low=50.0,
    high=2500.0,
    source=f"{_BALANCE}, latent load, and windows kept from fogging: ISO 3469; range: a compressor at a tenth of its "
    "power to half of it (estimate)",
    per="time",
    parameters={
        "damp": Parameter(0.6, "1", 0.3, 0.9, grid=(0.4, 0.6, 0.8)),
        "frost": Parameter(273.15, "K"),
        "magnus": Parameter(611.2, "Pa"),
        "slope": Parameter(17.62, "1"),
        "span": Parameter(243.12, "K"),
    },
    confused_with=("humidity", "wet_road"),
    shown_by="damp and dry days as warm, without rain, with a station that measures humidity",
    words="drying: {value} W for each unit of relative humidity above {damp}",
)
def demisting(
    vapour_pressure: Floats, ambient: Floats, *, damp: float, frost: float, magnus: float, slope: float, span: float
) -> Floats:
    """Damp air that is dried, so that windows stay clear: P = max(e/e_s(T) - φ0, 0), times the power.

    The saturation pressure is e_s = e_0 exp(a (T - T0)/(T - T0 + b)), Magnus' formula with the constants of WMO-No. 8.
    """
    above = ambient - frost
    saturation = magnus * np.exp(slope * above / (above + span))
    return np.maximum(vapour_pressure / saturation - damp, 0.0)
