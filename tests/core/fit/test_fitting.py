"""Test that the fit of one vehicle model does not depend on the rides of the others in the same table."""

import numpy as np
import pytest

from socast.core.fit.fitting import fit_terms
from socast.core.fit.recipes import RECIPES
from socast.core.fit.ride_blocks import RideFrame
from socast.core.models import ANY
from tests.support.planted_rides import MODELS, noisy, physical_energy, rides

RECIPE = RECIPES["hybrid_interactions"]


@pytest.mark.parametrize("unknown", [(), ("odometer_km",), ("odometer_km", "wind_from_deg", "soc_start_pct")])
def test_each_vehicle_model_is_fitted_as_if_alone_whatever_is_unknown(unknown):
    table = rides(2000, seed=7, models=MODELS[:2])
    table = noisy(table, physical_energy(table, {}))
    rng = np.random.default_rng(3)
    for name in unknown:
        table[name] = table[name].where(rng.random(len(table)) > 0.3)
    together = fit_terms(RECIPE, RideFrame(table))
    assert set(together.fits) == {*MODELS[:2], ANY}
    for model in MODELS[:2]:
        alone = fit_terms(RECIPE, RideFrame(table[table["vehicle_model"] == model]))
        assert together.fits[model] == alone.fits[ANY]
    either = fit_terms(RECIPE, RideFrame(table.drop(columns="vehicle_model")))
    assert together.fits[ANY] == either.fits[ANY]
