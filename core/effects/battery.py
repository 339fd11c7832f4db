"""Effects of the battery: its resistance, its own heating, and limits of regeneration.

Driving power is what the car's own road load demands, never the measured current, which is the answer.
"""

from typing import Final

import numpy as np

from socast.core.batch import Floats
from socast.core.effects.declaration import Parameter, effect

_COLD: Final = "Steinstraeter, Heinrich and Lienkamp 2021, World Electric Vehicle J. 12:115, DOI 10.3390/wevj12030115"
_REVIEW: Final = "Alipour et al. 2020, Batteries 6:35, DOI 10.3390/batteries6030035"


@effect(
    coefficient="resistance at 25 °C",
    unit="ohm",
    low=0.02,
    high=0.6,
    source=f"{_REVIEW}: resistance by Arrhenius' law; range: some 0.1 ohm of a 360 V battery when new (estimate)",
    parameters={
        "voltage": Parameter(360.0, "V"),
        "activation": Parameter(2500.0, "K", 0.0, 6000.0, grid=(1000.0, 2500.0, 4000.0)),
        "warm": Parameter(298.15, "K"),
    },
    confused_with=(
        "air_density",
        "cold_regen_limit",
        "cold_rolling",
        "drivetrain_loss_power",
        "drivetrain_loss_torque",
    ),
    shown_by="hard and gentle driving with a cold and with a warm battery, energy measured by the state of charge",
    words="the battery's resistance is {value} ohm at 25 °C",
)
def battery_resistance(
    wheel_power: Floats, pack_temperature: Floats, *, voltage: float, activation: float, warm: float
) -> Floats:
    """Loss of the battery current, larger in the cold: P = (F v/U)^2 exp(E (1/T - 1/T0)), times R.

    E is an activation energy over the gas constant; 2500 K makes the loss at -20 °C 4.4 times that at 25 °C. Voltage
    times current at the terminals excludes the battery's own loss; the state of charge includes it.
    """
    current = wheel_power / voltage
    return current * current * np.exp(activation * (1.0 / pack_temperature - 1.0 / warm))


@effect(
    coefficient="heating of the battery per kelvin",
    unit="W/K",
    low=10.0,
    high=300.0,
    source="Lindgren and Lund, Effect of extreme temperatures on battery charging and performance of electric "
    "vehicles, J. Power Sources (October 2016) 37-45; range: heaters of 0.2 to 6 kW over 20 K (estimate)",
    per="time",
    parameters={"threshold": Parameter(273.15, "K", 253.15, 288.15, grid=(263.15, 268.15, 273.15, 278.15))},
    confused_with=("cabin_heating", "cabin_warmup"),
    shown_by="cars with a cold and with a warm battery on equally cold days, where cars report its temperature",
    words="the battery is heated with {value} W for each degree that it is below {threshold}",
)
def cold_battery_heating(pack_temperature: Floats, threshold: float) -> Floats:
    """Heating that keeps the battery from frost: P = max(T0 - T, 0), times W/K.

    T is the battery's temperature, and T0 the threshold of its heater.
    """
    return np.maximum(threshold - pack_temperature, 0.0)


@effect(
    coefficient="share of braking power not regained in the cold",
    unit="1",
    low=0.02,
    high=1.0,
    source=f"{_COLD}: range lost to limited regeneration in the cold; range: up to all that the wheels give",
    parameters={
        "threshold": Parameter(283.15, "K", 268.15, 298.15, grid=(273.15, 278.15, 283.15, 288.15)),
        "width": Parameter(20.0, "K"),
    },
    confused_with=("battery_resistance", "cold_rolling", "regen_full_battery"),
    shown_by="town drives and descents with a cold and with a warm battery",
    words="{value} % of braking power is lost where the battery is 20 degrees below {threshold}",
    scale=100.0,
)
def cold_regen_limit(
    braking_force: Floats, speed: Floats, pack_temperature: Floats, threshold: float, width: float
) -> Floats:
    """Regeneration lost in a cold battery: P = max(-F v, 0) min(max((T0 - T)/ΔT, 0), 1), times a share.

    The loss is relative to what the base regains by `inertia_negative` and `climbing_down`.
    """
    return braking_force * speed * np.clip((threshold - pack_temperature) / width, 0.0, 1.0)


@effect(
    coefficient="share of braking power not regained when full",
    unit="1",
    low=0.02,
    high=1.0,
    source="estimate: a cell at its upper voltage takes no current, so that the last 5 to 20 % of charge are guarded; "
    "range: of all that the wheels give",
    parameters={"threshold": Parameter(0.9, "1", 0.7, 0.98, grid=(0.8, 0.85, 0.9, 0.95))},
    confused_with=("cold_regen_limit",),
    shown_by="the first rides after a full charge, beside those at half charge",
    words="{value} % of braking power is lost with a full battery, less below, nothing at a charge of {threshold}",
    scale=100.0,
)
def regen_full_battery(braking_force: Floats, speed: Floats, charge: Floats, threshold: float) -> Floats:
    """Regeneration lost in a full battery: P = max(-F v, 0) max((s - s0)/(1 - s0), 0), times a share.

    s is the state of charge. The loss is relative to what the base regains by `inertia_negative` and `climbing_down`.
    """
    return braking_force * speed * np.maximum((charge - threshold) / (1.0 - threshold), 0.0)
