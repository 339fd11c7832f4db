"""List the recipes: the models of the paper by name, each with its terms and its method of fitting.

The names are those of the paper, "Predicting Electric Vehicle Consumption: A Hybrid Physical-Empirical Model",
section 4. Ordinary least squares fits each of the paper's recipes for every vehicle model, and over all rides together
for the others. The physical recipes beyond the paper are fitted to windows, see `socast.core.fit.window_recipe`.

Some terms are collinear by construction: winter and summer, the histogram and the distance, and, for a car of unknown
load, the rolling resistance and the distance. Such terms share the explained energy, see `socast.core.fit.regression`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Final, Protocol

import pandas as pd

from socast.core.errors import ModelError
from socast.core.fit.block_sums import PassRunner
from socast.core.fit.calibration import NEEDS as INTERVAL_NEEDS
from socast.core.fit.calibration import add_interval
from socast.core.fit.fitting import fit_terms
from socast.core.fit.pooled import POOLED_RECIPES
from socast.core.fit.ride_blocks import RideFrame, RideParquet, ThinnedRides
from socast.core.fit.row_noise import DISTORTIONS_BESIDE_LOSSES
from socast.core.fit.window_recipe import WindowRecipe
from socast.core.models import BASIC_TERMS, HILLS_OF_BUILT_IN, LinearModel, Term, make_physical_term
from socast.core.models.features import ACCESSORIES_COLUMN, FEATURES, derive_coefficient_unit

INTERVAL_RIDES: Final = 20_000
"""Number of rides that suffices for the calibration of an interval."""


class Recipe(Protocol):
    """Fit a model to a ride table."""

    @property
    def name(self) -> str:
        """Return the name in code and files."""

    @property
    def title(self) -> str:
        """Return the title for people, as in the paper."""

    def fit(self, rides: pd.DataFrame, *, covariance: bool = True) -> LinearModel:
        """Return a model fitted to the rides of a table that are fit for training."""


@dataclass(frozen=True)
class LinearRecipe:
    """Fit coefficients by least squares.

    Parameters
    ----------
    name, title : str
        Name in code and files, and title for people.
    free : bool
        Whether coefficients are fitted; otherwise each has its physical value 1.
    """

    name: str
    title: str
    terms: tuple[Term, ...]
    free: bool = True
    note: str = ""

    def fit(self, rides: pd.DataFrame, *, covariance: bool = True) -> LinearModel:
        """Return a model fitted to the rides of a table that are fit for training, see `socast.core.fit.fitting`.

        Parameters
        ----------
        covariance : bool
            Whether to compute the covariance and calibrate an interval; a fit without them is faster.
        """
        model = fit_terms(self, RideFrame(rides), covariance=covariance)
        return add_interval(model, rides, fitted=self.free) if covariance else model

    def fit_parquet(self, *paths: str | Path, run: PassRunner | None = None) -> LinearModel:
        """Return a model fitted to Parquet files of rides, in memory that does not grow with the number of rides.

        Its interval is calibrated on at most `INTERVAL_RIDES` rides.
        """
        some = ThinnedRides(RideParquet(tuple(Path(path) for path in paths)), INTERVAL_RIDES, INTERVAL_NEEDS)
        model = fit_terms(self, some, run=run)
        return add_interval(model, some.table(), fitted=self.free)


def make_term(*columns: str) -> Term:
    """Return the term that is a product of columns, with a name made from their names.

    Examples
    --------
    >>> make_term("odometer_km", "effect_climbing")
    Term(name='odometer_km * climbing', columns=('odometer_km', 'effect_climbing'), unit='1/km')
    """
    name = " * ".join(column.removeprefix("effect_") for column in columns) or "constant"
    return Term(name=name, columns=columns, unit=derive_coefficient_unit(columns))


def make_product(one: str, other: Term) -> Term:
    """Return the interaction of a column with a term."""
    columns = (one, *other.columns)
    return Term(name=f"{one} * {other.name}", columns=columns, unit=derive_coefficient_unit(columns))


CONSTANT_TERM: Final = make_term()
ACCESSORY_TERM: Final = make_physical_term("accessories", (ACCESSORIES_COLUMN,))
FITTED_TERMS: Final = (
    make_physical_term("rolling", ("effect_rolling", "rolling_resistance")),
    make_physical_term("aero_drag_wind", ("effect_aero_drag_wind", "drag_area_m2")),
    make_physical_term("inertia", ("effect_inertia",)),
    make_physical_term("climbing", ("effect_climbing",)),
    ACCESSORY_TERM,
)
"""Terms of eq. (2), in its order: distance, air with wind, acceleration, height, accessories over time."""
BASIC_PART: Final = FITTED_TERMS[:-1]
"""Terms of eq. (2) that form the basic physical model."""

ROAD_LOAD_TERMS: Final = (
    make_physical_term("rolling", ("effect_rolling", "rolling_resistance")),
    make_physical_term("climbing", ("effect_climbing",)),
    make_physical_term("aero_drag", ("effect_aero_drag", "drag_area_m2")),
    make_physical_term("inertia_positive", ("effect_inertia_positive",)),
    make_physical_term("inertia_negative", ("effect_inertia_negative",)),
    make_physical_term("braking", ("effect_braking",)),
)
"""Base terms of the diagnosis without the accessories: standard air, no wind, kinetic energy and braking by sign."""

FULL_ROAD_LOAD_TERMS: Final = (
    *(
        make_physical_term("aero_drag_wind", ("effect_aero_drag_wind", "drag_area_m2"))
        if term.name == "aero_drag"
        else term
        for term in ROAD_LOAD_TERMS
    ),
    make_term("effect_cold_rolling"),
    make_term("effect_drivetrain_loss_torque"),
)
"""Terms of the road load with what every real car has: air as dense as it is, cold tyres, motors that lose by torque.

Their priors are the declared ranges of the effects. On the real cars of the tests, a loss by speed squared and one by
power squared beside them do not lower the errors of other dates.
"""

RESCALED_TERMS: Final = (make_physical_term("basic", ("basic_kwh",)),)
"""Term of the rescaled basic model: the energy of the basic physical model, times one fitted factor."""
TELEMATICS_TERMS: Final = (
    make_term("distance_km"),
    make_term("distance_km", "average_speed_kmh", "average_speed_kmh"),
    make_term("duration_s"),
    make_term("duration_s", "comfort_gap_k"),
)
"""Terms of the telematics regression: friction, drag, baseline auxiliary power, and climate control.

Geotab's model card states a linear regression on a trip's distance, duration, average speed and average outside
temperature, as a weighted sum of four energies: friction, drag, baseline auxiliary power, and heating and cooling. It
gives no formula. The patent of the same maker bases friction on the distance, and climate control on the difference
from an optimal temperature over the duration. Drag grows with the square of the average speed, here an assumption.

References
----------
Geotab, "EV Range Estimation Model" 1.0, model card, developers.geotab.com/ai/modelCardEvRangeEstimation. Girard and
Stefopulos, "Methods for range estimation in battery powered vehicles", US patent 12,270,668 B2 (2025), claim 1.
"""

HISTOGRAM_COLUMNS: Final = tuple(name for name in FEATURES if name.startswith("speed_"))
EMPIRICAL_TERMS: Final = tuple(
    make_term(name)
    for name in (
        "distance_km",
        "average_speed_kmh",
        "gained_m",
        "lost_m",
        "duration_s",
        "ambient_c",
        "wind_speed_kmh",
        "wind_from_north",
        "wind_from_east",
        "soc_start_pct",
        "time_since_charge_s",
        "odometer_km",
        "precipitation_mm_h",
        "nominal_capacity_kwh",
        "winter",
        "summer",
        *HISTOGRAM_COLUMNS,
    )
)
"""Terms of Table 1 of the paper, without names, dates, places and the ending SOC, which depends on the energy used.

The direction of the wind enters as its cosine and sine, as 359 and 1 degree are neighbours.
"""
SQUARES: Final = tuple(make_term(*t.columns, *t.columns) for t in EMPIRICAL_TERMS if t.name not in {"winter", "summer"})
"""Square of each empirical term, except winter and summer, which are 0 or 1 and equal their squares."""
SPEED_PRODUCTS: Final = tuple(
    make_term("average_speed_kmh", other) for other in ("lost_m", "odometer_km", "distance_km", "winter", "summer")
)
"""Products of the average speed with five other columns, section 4.6.1."""
REMOVED_COLUMNS: Final = frozenset({"time_since_charge_s", "precipitation_mm_h", "gained_m"})
"""Columns whose terms section 5.2 of the paper removes from the hybrid model, by RFECV and RFE."""
HYBRID_TERMS: Final = (
    *FITTED_TERMS,
    *(term for term in EMPIRICAL_TERMS if REMOVED_COLUMNS.isdisjoint(term.columns)),
)
"""Terms of the hybrid model as section 5.1 evaluates it: without those of `REMOVED_COLUMNS`."""
HYBRID_PRODUCTS: Final = (
    *(make_product("odometer_km", other) for other in FITTED_TERMS),
    *(make_product("lost_m", other) for other in BASIC_PART),
    *(make_product(season, other) for season in ("winter", "summer") for other in FITTED_TERMS),
)
"""Interactions of section 4.6.2."""

RECIPES: Final[Mapping[str, Recipe]] = MappingProxyType(
    {
        each.name: each
        for each in (
            LinearRecipe(
                "basic_physical",
                "Basic Physical Model",
                BASIC_TERMS,
                free=False,
                note=f"nothing is fitted; {HILLS_OF_BUILT_IN}",
            ),
            LinearRecipe(
                "extended_physical",
                "Extended Physical Model",
                (*BASIC_TERMS, ACCESSORY_TERM),
                free=False,
                note=f"the accessory curve is fitted; {HILLS_OF_BUILT_IN}",
            ),
            LinearRecipe("fitted_physical", "Fitted Extended Physical Model (Linear Regression)", FITTED_TERMS),
            LinearRecipe(
                "empirical",
                "Learned Empirical Model (No Interaction Terms)",
                (*EMPIRICAL_TERMS, CONSTANT_TERM),
                note="without the ending SOC, which depends on the energy used",
            ),
            LinearRecipe(
                "empirical_interactions",
                "Learned Empirical Model (Interaction Terms)",
                (*EMPIRICAL_TERMS, *SQUARES, *SPEED_PRODUCTS, CONSTANT_TERM),
                note="without the ending SOC, which depends on the energy used",
            ),
            LinearRecipe("hybrid", "Hybrid Model (No Interaction Terms)", (*HYBRID_TERMS, CONSTANT_TERM)),
            LinearRecipe(
                "hybrid_interactions",
                "Hybrid Model (Interaction Terms)",
                (*HYBRID_TERMS, *HYBRID_PRODUCTS, CONSTANT_TERM),
            ),
            LinearRecipe(
                "hybrid_full",
                "Hybrid Model (No Interaction Terms), No Term Removed",
                (*FITTED_TERMS, *EMPIRICAL_TERMS, CONSTANT_TERM),
                note="the hybrid model before section 5.2 of the paper removes three terms",
            ),
            LinearRecipe(
                "basic_rescaled", "Basic Physical Model, Rescaled", RESCALED_TERMS, note="one factor, a baseline"
            ),
            LinearRecipe(
                "basic_rescaled_power",
                "Basic Physical Model, Rescaled, with a Constant Power",
                (*RESCALED_TERMS, make_term("duration_s")),
                note="two numbers, a baseline",
            ),
            LinearRecipe(
                "telematics_regression",
                "Telematics Regression (Distance, Duration, Speed, Temperature)",
                TELEMATICS_TERMS,
                note="four numbers, a baseline after Geotab's model card",
            ),
            *POOLED_RECIPES,
            WindowRecipe(
                "road_load",
                "Road Load, Accessories by Temperature",
                (*ROAD_LOAD_TERMS, ACCESSORY_TERM),
                note="fitted to windows, with physics as the prior",
            ),
            WindowRecipe(
                "road_load_constant",
                "Road Load, Constant Auxiliaries",
                (*ROAD_LOAD_TERMS, make_term("effect_auxiliary")),
                note="fitted to windows, with physics as the prior",
            ),
            WindowRecipe(
                "road_load_full",
                "Road Load with Cold Tyres and Motor Losses, Accessories by Temperature",
                (*FULL_ROAD_LOAD_TERMS, ACCESSORY_TERM),
                note="fitted to windows, with physics as the prior",
                distortions=DISTORTIONS_BESIDE_LOSSES,
            ),
            WindowRecipe(
                "road_load_full_constant",
                "Road Load with Cold Tyres and Motor Losses, Constant Auxiliaries",
                (*FULL_ROAD_LOAD_TERMS, make_term("effect_auxiliary")),
                note="fitted to windows, with physics as the prior",
                distortions=DISTORTIONS_BESIDE_LOSSES,
            ),
        )
    }
)
"""Recipes by name: those of the paper in its order, then those beyond the paper."""
WINDOW_RECIPES: Final = tuple(name for name, recipe in RECIPES.items() if isinstance(recipe, WindowRecipe))
"""Names of the recipes that are fitted to windows."""
FIRST_RECIPE: Final = "road_load_full"
"""Recipe to begin with: it needs one ride, and errs less than `road_load` on every real car of the tests."""
BASELINES: Final = ("basic_physical", "basic_rescaled", "basic_rescaled_power", "telematics_regression")
"""Recipes to which every model is compared, with none, one, two and four fitted numbers."""


def get_recipe(name: str) -> Recipe:
    """Return a recipe by name."""
    found = RECIPES.get(name)
    if found is None:
        raise ModelError(f"recipe {name!r} is unknown: known are {', '.join(RECIPES)}")
    return found


def fit_recipe(
    name: str, rides: pd.DataFrame, windows: pd.DataFrame | None = None, *, covariance: bool = True
) -> LinearModel:
    """Return the model of a recipe, fitted to rides, or to windows where it can be and they are given."""
    recipe = get_recipe(name)
    if windows is not None and isinstance(recipe, WindowRecipe):
        recipe = recipe.bind(windows)
    return recipe.fit(rides, covariance=covariance)


def fit_to_windows(name: str, rides: pd.DataFrame, windows: pd.DataFrame, *, covariance: bool = True) -> LinearModel:
    """Return a recipe of physical terms fitted to windows."""
    if not isinstance(get_recipe(name), WindowRecipe):
        raise ModelError(f"recipe {name} cannot be fitted to windows: choose {', '.join(WINDOW_RECIPES)}")
    return fit_recipe(name, rides, windows, covariance=covariance)
