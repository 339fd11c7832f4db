"""Compare the coefficients of a model with the ranges that physics finds plausible.

A range belongs to an effect (`socast.core.effects`). The coefficient of a term that multiplies the effect by a figure
of the car is relative to that figure: 1.2 times the catalogue's rolling resistance of 0.008 is a coefficient of 0.0096.
"""

from collections.abc import Mapping

import numpy as np

from socast.core import effects
from socast.core.models.features import ACCESSORIES_COLUMN, EFFECT_PREFIX, is_scope
from socast.core.models.interval import ANY
from socast.core.models.linear import LinearModel, Term
from socast.core.vehicles import load_catalogue
from socast.core.vehicles.fleet import CarParameters


def compute_plausible_range(term: Term, figures: Mapping[str, float]) -> tuple[float, float] | None:
    """Return the plausible range of the coefficient of a term.

    Parameters
    ----------
    term : Term
        Term of a model.
    figures : mapping of str to float
        Figures of the car, by column of the ride table (`socast.core.vehicles.fleet.CarParameters`).

    Returns
    -------
    tuple of (float, float) or None
        Lowest and highest plausible coefficient; None where the term is not one effect, if need be times figures of
        the car that are known.

    Examples
    --------
    >>> rolling = Term(name="rolling", columns=("effect_rolling", "rolling_resistance"), unit="1")
    >>> compute_plausible_range(rolling, {"rolling_resistance": 0.008})
    (0.5, 3.125)
    """
    named = [name for name in term.columns if name.startswith(EFFECT_PREFIX) or name == ACCESSORIES_COLUMN]
    others = [name for name in term.columns if name not in named and not is_scope(name)]
    if len(named) != 1 or any(name not in CarParameters._fields for name in others):
        return None
    by = float(np.prod([figures.get(name, np.nan) for name in others]))
    if not by > 0.0:
        return None
    name = "accessories" if named[0] == ACCESSORIES_COLUMN else named[0].removeprefix(EFFECT_PREFIX)
    effect = effects.get(name)
    return effect.low / by, effect.high / by


def get_plausible_ranges(model: LinearModel, key: str) -> dict[str, tuple[float, float]]:
    """Return the plausible range of each coefficient of a fit, by the figures of the catalogue.

    Parameters
    ----------
    model : LinearModel
        Model.
    key : str
        Vehicle model of the fit, or `*`, for which the mean figures of the vehicle models of the training count.

    Returns
    -------
    dict of str to (float, float)
        Range by term, without the terms that have none.
    """
    catalogue = load_catalogue()
    trained = model.training.vehicle_models if model.training else {}
    known = [catalogue[name] for name in ([*trained] if key == ANY else [key]) if name in catalogue]
    names = [name for name in CarParameters._fields if known]
    figures = {name: float(np.mean([getattr(vehicle, name) for vehicle in known])) for name in names}
    ranges = {term.name: compute_plausible_range(term, figures) for term in model.terms}
    return {name: limits for name, limits in ranges.items() if limits is not None}


def list_implausible(model: LinearModel) -> dict[str, tuple[str, ...]]:
    """Return the terms of each fit whose coefficients are outside their plausible ranges.

    Parameters
    ----------
    model : LinearModel
        Model.

    Returns
    -------
    dict of str to tuple of str
        Names of terms by vehicle model; vehicle models without any are left out.
    """
    found = {}
    for key, fit in model.fits.items():
        ranges, values = get_plausible_ranges(model, key), dict(zip(model.terms, fit.coefficients, strict=True))
        outside = [
            term.name
            for term, value in values.items()
            if term.name in ranges and not is_within(value, ranges[term.name])
        ]
        if outside:
            found[key] = tuple(outside)
    return found


def describe_implausible(model: LinearModel) -> list[str]:
    """Return a sentence on each coefficient that is outside its plausible range.

    Parameters
    ----------
    model : LinearModel
        Model.

    Returns
    -------
    list of str
        Sentences for people, by vehicle model and term.
    """
    lines = []
    for key, names in list_implausible(model).items():
        ranges = get_plausible_ranges(model, key)
        values = dict(zip([term.name for term in model.terms], model.fits[key].coefficients, strict=True))
        lines += [
            f"{key}: coefficient of {name} {values[name]:.3g} is outside its plausible range, "
            f"{ranges[name][0]:.3g} to {ranges[name][1]:.3g}"
            for name in names
        ]
    return lines


def describe_limited(model: LinearModel) -> list[str]:
    """Return a sentence on the coefficients of each fit that stopped at an end of their plausible ranges.

    Parameters
    ----------
    model : LinearModel
        Model.

    Returns
    -------
    list of str
        Sentences for people, by vehicle model.
    """
    names = {key: [term.name for term in model.terms if term.name in fit.limited] for key, fit in model.fits.items()}
    return [f"{key}: {', '.join(own)} stopped at the limit of the plausible range" for key, own in names.items() if own]


def is_within(value: float, limits: tuple[float, float]) -> bool:
    """Return whether a coefficient lies within a range, except for rounding.

    Examples
    --------
    >>> is_within(1.0 + 1e-12, (0.0, 1.0)), is_within(1.01, (0.0, 1.0))
    (True, False)
    """
    low, high = limits
    slack = 1e-9 * (high - low)
    return low - slack <= value <= high + slack
