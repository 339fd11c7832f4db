"""Energy by voltage times current, and the reported state of charge with its quantum, causally."""

from math import isnan
from typing import Any, Final

from numba import njit

from core.cleaning.quality import Quality

FIELDS: Final = (
    "power",  # at the last sample, NaN where not measured [W]
    "has_power",  # 1 once the car has sent voltage and current
    "soc",  # last reported [1]
    "has_soc",  # 1 once the car has sent a state of charge
    "soc_age",  # time since it was last reported [s]
    "soc_step",  # smallest change seen: the quantum [1]
)

SOC_MISSING: Final = int(Quality.SOC_MISSING)
POWER_MISSING: Final = int(Quality.POWER_MISSING)
LONGEST_TRAPEZOID: Final = 10.5
"""Longest step over which power is interpolated. [periods]"""


@njit(cache=False)
def integrate_power(state: Any, row: Any, dt: float, settings: Any) -> None:
    """Integrate the measured power over the step, and estimate the variance of the integral.

    The energy is the trapezoid of voltage times current. Let the power change by dP between two samples. The integral
    has the variance (dP dt)^2 / 12 if the power wanders like a Brownian bridge, and (dP dt)^2 / 2 if it is noise.
    The factor 1/8 holds for driving: it was chosen on simulated rides and covers those of other seeds.
    """
    power = row.raw_voltage * row.raw_current
    if isnan(power):
        row.quality += POWER_MISSING if state.has_power == 1.0 else 0
    else:
        state.has_power = 1.0
        if dt <= LONGEST_TRAPEZOID * settings.period:
            before = power if isnan(state.power) else state.power
            row.energy = 0.5 * (power + before) * dt
            row.energy_variance = ((power - before) * dt) ** 2 / 8.0
            row.metered = dt
    state.power = power


@njit(cache=False)
def update_soc(state: Any, row: Any, dt: float) -> bool:
    """Update the lane by the reported state of charge; return whether it changed."""
    state.soc_age += dt
    if isnan(row.raw_soc):
        row.quality += SOC_MISSING if state.has_soc == 1.0 else 0
        return False
    state.has_soc = 1.0
    state.soc_age = 0.0
    change = abs(row.raw_soc - state.soc)
    state.soc = row.raw_soc
    changed = change > 1e-6
    if changed and not change >= state.soc_step:
        state.soc_step = change
    return changed
