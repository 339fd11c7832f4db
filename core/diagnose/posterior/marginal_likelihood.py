"""Compute how much more probable a family of shapes makes a residual than no effect does.

With unit noise, the residual is r = θ (x + Z b) + noise: θ is the coefficient, x the form, Z its bends, and b their
sizes, which are normal with standard deviation β. For a given θ, the bends θ b are normal with standard deviation θ β,
so that they integrate in closed form. The integral over θ is a sum over a grid.
"""

from collections.abc import Callable
from typing import Final, NamedTuple

import numpy as np

from socast.core.batch import Floats

SMALLEST: Final = 5e-4
LARGEST: Final = 0.25
"""Range of the share of the energy over which the coefficient is integrated. [1]"""
COARSE: Final = 120
"""Number of logarithmic steps over that range."""
FINE: Final = 61
"""Number of steps within `REACH` standard errors of the best coefficient."""
REACH: Final = 6.0
SHARES: Final = np.exp(np.linspace(np.log(SMALLEST), np.log(LARGEST), COARSE))
"""Those shares of the energy. [1]"""
DEVIATIONS: Final = np.linspace(-REACH, REACH, FINE)
"""Deviations from the best coefficient. [standard errors]"""

LogDensity = Callable[[Floats], Floats]


class Products(NamedTuple):
    """Hold the inner products of a family with itself and with the residual, in units of the noise variance.

    Parameters
    ----------
    own : (1 + m, 1 + m) float
        Products of the form and its m bends.
    residual : (1 + m,) float
        Their products with the residual.
    """

    own: Floats
    residual: Floats


class LogEvidence(NamedTuple):
    """Hold the log evidence of a family.

    Parameters
    ----------
    log_evidence : float
        Logarithm of the mean likelihood over the prior, divided by that without the effect. [1]
    coefficient : float
        Most probable coefficient. [unit of the coefficient]
    """

    log_evidence: float
    coefficient: float


ABSENT: Final = LogEvidence(float("-inf"), 0.0)
"""LogEvidence of a family that cannot be identified beside the model."""


def compute_marginal_likelihood(
    products: Products, scale: float, sign: int, log_density: LogDensity, bend: float
) -> LogEvidence:
    """Return the log evidence of a family of shapes."""
    size, match = float(products.own[0, 0]), float(products.residual[0])
    if not size > 0.0:
        return ABSENT
    grid = SHARES * scale
    near = np.abs(match) / size + DEVIATIONS / np.sqrt(size)
    values = np.concatenate([grid, near[(near > grid[0]) & (near < grid[-1])]])
    values.sort()
    values = values[np.concatenate([[True], values[1:] != values[:-1]])]
    signs = np.array([sign] if sign else [1, -1])
    likelihood = _integrate_bends(products, signs[:, np.newaxis] * values, bend) + log_density(values)
    likelihood -= np.log(len(signs))
    top = float(likelihood.max())
    density, logarithm = np.exp(likelihood - top), np.log(values)
    step = logarithm[1:] - logarithm[:-1]  # of the trapezoidal rule
    integral = float((step * (density[:, 1:] + density[:, :-1]) / 2.0).sum(axis=1).sum())
    best = np.unravel_index(int(likelihood.argmax()), likelihood.shape)
    return LogEvidence(top + float(np.log(max(integral, 1e-300))), float(signs[best[0]] * values[best[1]]))


def _integrate_bends(products: Products, values: Floats, bend: float) -> Floats:
    """Return the log likelihood ratio at each coefficient, (signs, n), integrated over the sizes of the bends."""
    size, match = products.own[0, 0], products.residual[0]
    out = values * match - 0.5 * values**2 * size
    if len(products.residual) == 1 or bend == 0.0:
        return np.asarray(out)
    lengths, axes = np.linalg.eigh(products.own[1:, 1:])
    lengths = np.maximum(lengths, 0.0)[:, np.newaxis]
    gained = []
    for each in values:
        left = axes.T @ (products.residual[1:, np.newaxis] - products.own[1:, :1] * each)
        variance = (bend * each) ** 2
        gained.append((left**2 * variance / (1.0 + lengths * variance) - np.log1p(lengths * variance)).sum(axis=0))
    return np.asarray(out + 0.5 * np.stack(gained))
