"""Compute the accessory power by a curve whose corners are rounded, so that a fit of its choke points converges.

The power by the curve is a piecewise linear function of temperature. The error of a fit therefore has a corner wherever
a choke point passes the temperature of a ride, and the best choke point may be at such a corner, where derivatives tell
nothing. Outside temperature is known to about half a degree. The mean power over that range is smooth.
"""

from typing import Final, NamedTuple

import numpy as np

from socast.core.batch import Floats
from socast.core.columns import ZERO_CELSIUS
from socast.core.vehicles import AccessoryCurve

SOFTENED: Final = 0.5
"""Half the range of temperatures over which the power is averaged. [K]"""


class SoftenedPower(NamedTuple):
    """Hold the mean accessory power about n temperatures, and its derivatives by the numbers of the curve.

    Parameters
    ----------
    power : (n,) float
        Mean power over temperatures within `SOFTENED`. [W]
    first : (n, 7) float
        Derivatives by the levels [1] and by the choke points [W/K], in the order of
        `socast.core.fit.priors.flatten_curve`.
    second : (n, 7, 7) float
        Second derivatives.
    """

    power: Floats
    first: Floats
    second: Floats


class _Share(NamedTuple):
    """Hold the share of a level in the power: 0 where `far` is 0, 1 where `near` is 0, and its derivatives by both."""

    value: Floats
    far: Floats
    near: Floats
    far_far: Floats
    far_near: Floats
    near_near: Floats


def compute_softened_power(curve: AccessoryCurve, ambient_c: Floats) -> Floats:
    """Return the mean accessory power about temperatures."""
    heat, cool = _compute_shares(curve, ambient_c)
    heating, cooling = curve.heating - curve.standby, curve.cooling - curve.standby
    return np.asarray(curve.standby + heating * heat.value + cooling * cool.value)


def differentiate_softened_power(curve: AccessoryCurve, ambient_c: Floats) -> SoftenedPower:
    """Return the mean accessory power about temperatures, and its derivatives by the numbers of the curve."""
    heat, cool = _compute_shares(curve, ambient_c)
    heating, cooling = curve.heating - curve.standby, curve.cooling - curve.standby
    heat_by = np.column_stack([heat.near, heat.far])
    cool_by = -np.column_stack([cool.far, cool.near])
    levels = (1.0 - heat.value - cool.value, heat.value, cool.value)
    second = np.zeros((len(ambient_c), 7, 7))
    second[:, 3, 3], second[:, 3, 4], second[:, 4, 4] = heating * np.array(
        [heat.near_near, heat.far_near, heat.far_far]
    )
    second[:, 5, 5], second[:, 5, 6], second[:, 6, 6] = cooling * np.array(
        [cool.far_far, cool.far_near, cool.near_near]
    )
    second[:, 0, 3:] = -np.column_stack([heat_by, cool_by])
    second[:, 1, 3:5], second[:, 2, 5:] = heat_by, cool_by
    upper = np.triu(second, 1)
    return SoftenedPower(
        curve.standby + heating * heat.value + cooling * cool.value,
        np.column_stack([*levels, heating * heat_by, cooling * cool_by]),
        second + np.swapaxes(upper, 1, 2),
    )


def _compute_shares(curve: AccessoryCurve, ambient_c: Floats) -> tuple[_Share, _Share]:
    """Return the shares of heating and cooling; cooling counts temperature downwards from its choke points."""
    ambient = ambient_c + ZERO_CELSIUS
    heat = _compute_share(curve.heating_off - ambient, curve.heating_full - ambient)
    return heat, _compute_share(ambient - curve.cooling_on, ambient - curve.cooling_full)


def _compute_share(far: Floats, near: Floats) -> _Share:
    """Return a share, given the distances of temperatures from both choke points. [K]"""
    width = far - near
    ramp, slope, bend = _compute_ramp(far)
    other, other_slope, other_bend = _compute_ramp(near)
    value = (ramp - other) / width
    by_far, by_near = (slope - value) / width, (value - other_slope) / width
    return _Share(
        value, by_far, by_near,
        (bend - 2.0 * by_far) / width, (by_far - by_near) / width, (2.0 * by_near - other_bend) / width,
    )  # fmt: skip


def _compute_ramp(x: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the mean of max(x, 0) over a range of x, and its first and second derivative."""
    inside = np.clip((x + SOFTENED) / (2.0 * SOFTENED), 0.0, 1.0)
    bend = np.where(np.abs(x) < SOFTENED, 0.5 / SOFTENED, 0.0)
    return np.where(x > SOFTENED, x, SOFTENED * inside * inside), inside, bend
