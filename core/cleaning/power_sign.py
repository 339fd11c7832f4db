"""Whether the current of a car has the right sign, by its accelerations and by its state of charge, continuously.

Two witnesses know the sign of the power P of a battery. Acceleration takes power: at equal speed v, P rises with the
kinetic power k = v a of each kilogram, with a slope of about the mass of the car (partial correlation of P and k given
v, because rolling and drag also rise with v). The state of charge falls
while the battery delivers energy. The sums of both witnesses forget exponentially, so that a sign that is put right
counts as right some minutes later. Acceleration decides where it can; a logger that samples too slowly for it leaves
the decision to the state of charge.
"""

from math import isnan, sqrt
from typing import Any, Final

from socast.core.compiled_cache import njit

FIELDS: Final = (
    "sign_steps",  # weight of the steps in the sums below
    "sign_p",  # sums of power P [W], kinetic power k [m^2/s^3] and speed v [m/s], of their squares and products
    "sign_k",
    "sign_v",
    "sign_pp",
    "sign_kk",
    "sign_vv",
    "sign_pk",
    "sign_pv",
    "sign_kv",
    "fall_total",  # sum of the sizes of the changes of the charge [1]
    "fall_square",  # sum of the squares of the changes of the charge [1]
    "fall_product",  # sum of the falls of the charge times what V·I drew meanwhile [1]
    "raw_power",  # voltage times current of the last sample, as reported [W]
    "drawn",  # energy by it since the charge last changed [J]
    "sign",  # of the current: 1 right, -1 inverted, 0 not known yet
)

MEMORY: Final = 300.0
"""Number of steps after which the weight of a step has decreased to 1/e."""
LEAST_STEPS: Final = 40.0
"""Weight of steps from which accelerations decide: two minutes of driving at the nominal period."""
LONGEST_STEP: Final = 10.0
"""Longest step that shows accelerations. [s]"""
LEAST_KINETIC: Final = 0.5
"""Least kinetic power per mass of a step that counts: 0.05 m/s^2 at 36 km/h. [m^2/s^3]"""
CLEAR: Final = 6.0
"""Deviation of the correlation from zero from which it decides. [standard errors]"""
LEAST_CORRELATION: Final = 0.3
"""Least correlation that decides: a meter that lags behind the speed by some seconds keeps so much. [1]"""
LEAST_LEFT: Final = 0.01
"""Least share of the variance of power and kinetic power that the speed leaves. [1]"""
MASSES: Final = (200.0, 7500.0)
"""Slopes that are the mass of a road vehicle, divided or multiplied by its efficiency. [kg]"""
FALL_MEMORY: Final = 30.0
"""Number of changes of the charge after which the weight of a change has decreased to 1/e."""
LEAST_FALL: Final = 0.03
"""Sum of the sizes of the changes from which the charge decides. [1]"""
LEAST_RATIO: Final = 0.3
"""Least ratio of energy to charge, of either sign, that decides: usable and nominal capacity differ. [1]"""


@njit(cache=False)
def observe_acceleration(state: Any, row: Any, dt: float) -> None:
    """Update the sums of accelerations by a row, and decide the sign."""
    kinetic = row.speed * row.acceleration
    power = row.raw_voltage * row.raw_current
    mean = 0.5 * (power + state.raw_power)
    state.raw_power = power
    if isnan(mean):
        return
    state.drawn += mean * dt
    if not (0.0 < dt <= LONGEST_STEP and abs(kinetic) > LEAST_KINETIC and row.travel == dt):
        return
    kept, speed = 1.0 - 1.0 / MEMORY, row.speed
    state.sign_steps = kept * state.sign_steps + 1.0
    state.sign_p = kept * state.sign_p + mean
    state.sign_k = kept * state.sign_k + kinetic
    state.sign_v = kept * state.sign_v + speed
    state.sign_pp = kept * state.sign_pp + mean * mean
    state.sign_kk = kept * state.sign_kk + kinetic * kinetic
    state.sign_vv = kept * state.sign_vv + speed * speed
    state.sign_pk = kept * state.sign_pk + mean * kinetic
    state.sign_pv = kept * state.sign_pv + mean * speed
    state.sign_kv = kept * state.sign_kv + kinetic * speed
    decide_sign(state)


@njit(cache=False)
def observe_charge(state: Any, fall: float, capacity: float, is_clear: bool) -> None:
    """Update the sums of the charge by a fall of it, and by the energy that V·I drew meanwhile."""
    used = state.drawn / capacity
    state.drawn = 0.0
    if isnan(used) or used == 0.0 or not is_clear:
        return
    kept = 1.0 - 1.0 / FALL_MEMORY
    state.fall_total = kept * state.fall_total + abs(fall)
    state.fall_square = kept * state.fall_square + fall * fall
    state.fall_product = kept * state.fall_product + fall * used
    decide_sign(state)


@njit(cache=False)
def judge_acceleration(state: Any) -> float:
    """Return the sign of the current by accelerations: 1 right, -1 inverted, 0 undecided."""
    n = state.sign_steps
    if n < LEAST_STEPS:
        return 0.0
    p, k, v = state.sign_p / n, state.sign_k / n, state.sign_v / n
    pp, kk, vv = state.sign_pp / n - p * p, state.sign_kk / n - k * k, state.sign_vv / n - v * v
    pk, pv, kv = state.sign_pk / n - p * k, state.sign_pv / n - p * v, state.sign_kv / n - k * v
    if vv <= 0.0:
        return 0.0
    pp_left, kk_left, pk_left = pp - pv * pv / vv, kk - kv * kv / vv, pk - pv * kv / vv
    if pp_left <= LEAST_LEFT * pp or kk_left <= LEAST_LEFT * kk:
        return 0.0
    correlation, slope = pk_left / sqrt(kk_left * pp_left), pk_left / kk_left
    is_clear = abs(correlation) > max(LEAST_CORRELATION, CLEAR / sqrt(n)) and MASSES[0] <= abs(slope) <= MASSES[1]
    return (1.0 if correlation > 0.0 else -1.0) if is_clear else 0.0


@njit(cache=False)
def decide_sign(state: Any) -> None:
    """Decide the sign of the current; without a clear witness, what was decided last remains."""
    sign = judge_acceleration(state)
    if sign == 0.0 and state.fall_total > LEAST_FALL:
        ratio = state.fall_product / state.fall_square
        sign = 1.0 if ratio > LEAST_RATIO else -1.0 if ratio < -LEAST_RATIO else 0.0
    if sign != 0.0:
        state.sign = sign
