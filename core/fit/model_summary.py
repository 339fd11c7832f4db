"""Summarise a fitted model: its coefficients with 95 % intervals, and its errors on the rides fitted to."""

from collections.abc import Mapping
from math import sqrt
from types import MappingProxyType
from typing import Final

from msgspec import UNSET

from socast.core.columns import ZERO_CELSIUS
from socast.core.fit.recipes import RECIPES
from socast.core.fit.records import (
    Determination,
    FitSummary,
    FittedCoefficient,
    FittedCurve,
    VehicleModelFit,
    find_fit_step,
)
from socast.core.fit.window_recipe import WindowRecipe
from socast.core.models import LinearModel
from socast.core.models.plausibility import get_plausible_ranges, is_within
from socast.core.stats.scores import Estimate
from socast.core.vehicles import AccessoryCurve

LEAST_PRIOR_FREEDOM: Final = 4
"""Least degrees of freedom of an interval whose coefficient has a prior: the prior is known without any ride."""


def summarise_model(
    model: LinearModel, determined: Mapping[str, list[Determination]] = MappingProxyType({})
) -> FitSummary:
    """Return the fits of a model, and how far the rides determine the coefficients of each where that is given."""
    step, recipe = find_fit_step(model), RECIPES.get(model.recipe)
    errors = step.mae_in_sample_kwh or {}
    fits = {
        key: VehicleModelFit(
            rides=fitted.rides,
            mae_in_sample_kwh=errors.get(key),
            residual_sd_kwh=fitted.residual_sd_kwh,
            clusters=fitted.clusters,
            held=fitted.held,
            dropped=fitted.dropped or (),
            limit=None if fitted.limit is UNSET else fitted.limit,
            converged=fitted.converged,
            limited=fitted.limited,
            curve=None if fitted.curve is None else _convert_to_celsius(fitted.curve),
            coefficients=list_coefficients(model, key),
            determined=determined.get(key, []),
        )
        for key, fitted in model.fits.items()
    }
    return FitSummary(
        recipe=model.recipe,
        title=recipe.title if recipe else model.recipe,
        version=model.version,
        rows=step.rows or "rides",
        training=model.training,
        fits=fits,
    )


def has_priors(model: LinearModel) -> bool:
    """Return whether the coefficients were fitted with priors."""
    return isinstance(RECIPES.get(model.recipe), WindowRecipe)


def find_freedom(model: LinearModel, key: str) -> int:
    """Return the degrees of freedom of the standard errors of a fit."""
    freedom = (model.fits[key].clusters or model.fits[key].rides) - 1
    return max(freedom, LEAST_PRIOR_FREEDOM) if has_priors(model) else freedom


def list_coefficients(model: LinearModel, key: str) -> list[FittedCoefficient]:
    """Return the coefficients of a fit; the widths of their intervals come from Student's t distribution."""
    fitted, ranges, freedom = model.fits[key], get_plausible_ranges(model, key), find_freedom(model, key)
    bounded = has_priors(model)
    made = []
    for i, (term, value) in enumerate(zip(model.terms, fitted.coefficients, strict=True)):
        ends: tuple[float, float] | None = None
        half = None
        plausible = ranges.get(term.name)
        if fitted.covariance is not None:
            estimate = Estimate(value, sqrt(max(fitted.covariance[i][i], 0.0)), freedom)
            ends, half = estimate.interval, estimate.ci95
            if bounded and plausible:
                low, high = (min(max(end, plausible[0]), plausible[1]) for end in ends)
                half = half if (low, high) == ends else None
                ends = low, high
        made.append(
            FittedCoefficient(
                term=term.name,
                unit=term.unit,
                value=value,
                ci95=half,
                low=ends[0] if ends else None,
                high=ends[1] if ends else None,
                at_limit=term.name in fitted.limited,
                range=plausible,
                plausible=plausible is None or is_within(value, plausible),
            )
        )
    return made


def _convert_to_celsius(curve: AccessoryCurve) -> FittedCurve:
    """Return a curve with temperatures in °C."""
    return FittedCurve(
        heating_full_c=curve.heating_full - ZERO_CELSIUS,
        heating_off_c=curve.heating_off - ZERO_CELSIUS,
        cooling_on_c=curve.cooling_on - ZERO_CELSIUS,
        cooling_full_c=curve.cooling_full - ZERO_CELSIUS,
        heating_w=curve.heating,
        standby_w=curve.standby,
        cooling_w=curve.cooling,
    )
