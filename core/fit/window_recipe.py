"""Recipes of physical terms that are fitted to windows, with physics as the prior."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import pandas as pd
from msgspec import structs

from socast.core.fit.determination import determine_terms
from socast.core.fit.measured_rows import join_tables
from socast.core.fit.records import Determination, find_fit_step
from socast.core.fit.ride_blocks import ENERGY, find_measured, select_trainable
from socast.core.fit.row_noise import DISTORTED_COLUMNS, DISTORTIONS
from socast.core.fit.window_fit import READ, add_window_interval, fit_rows, gather_rows
from socast.core.fit.window_solver import GroupFit
from socast.core.models import ANY, VEHICLE, VEHICLE_MODEL, LinearModel, Term, stamp
from socast.core.models.features import list_raw_columns
from socast.core.vehicles.fleet import CarParameters

IDENTITY: tuple[str, ...] = ("ride_key", "start_s", VEHICLE, VEHICLE_MODEL, ENERGY, "energy_sd_kwh")
"""Columns of windows that every fit reads."""


@dataclass(frozen=True)
class WindowRecipe:
    """Fit coefficients of physical terms to windows, see `socast.core.fit.window_fit`.

    Parameters
    ----------
    name, title : str
        Name in code and files, and title for people.
    terms : tuple of Term
        Terms of the model; each adds up over the windows of a ride.
    distortions : mapping of str to float
        Standard deviations of the distortions of sampling, see `socast.core.fit.row_noise`.
    windows : DataFrame, optional
        Window table that `fit` reads where it is given none, see `bind`.
    """

    name: str
    title: str
    terms: tuple[Term, ...]
    note: str = ""
    distortions: Mapping[str, float] = field(default_factory=lambda: DISTORTIONS, hash=False)
    windows: pd.DataFrame | None = field(default=None, compare=False, repr=False)

    @property
    def columns(self) -> tuple[str, ...]:
        """Return the columns of the window table that the fit reads."""
        raw = [name for term in self.terms for column in term.columns for name in list_raw_columns(column)]
        return tuple(dict.fromkeys((*IDENTITY, *READ, *DISTORTED_COLUMNS, *raw)))

    def bind(self, windows: pd.DataFrame) -> "WindowRecipe":
        """Return the recipe with windows, of which each fit uses those of its rides.

        Cross-validation passes training rides alone; the key of each ride selects its windows, so no window of another
        ride takes part. Only the columns that the fit reads are kept, because each process gets a copy.
        """
        return replace(self, windows=windows[[name for name in self.columns if name in windows]])

    def fit(self, rides: pd.DataFrame, windows: pd.DataFrame | None = None, *, covariance: bool = True) -> LinearModel:
        """Return a model fitted to the windows of the rides of a table that are fit for training.

        Parameters
        ----------
        windows : DataFrame, optional
            Window table of the same recordings; windows of other rides do not count. Without it, each ride is one
            row, which tells less of each coefficient; the priors are the same.
        covariance : bool
            Whether to calibrate an interval; a fit without it is faster. The model has a covariance in any case.
        """
        return self._fit(rides, self.windows if windows is None else windows, covariance=covariance)[0]

    def determine(
        self, rides: pd.DataFrame, windows: pd.DataFrame | None = None
    ) -> tuple[LinearModel, dict[str, list[Determination]]]:
        """Return a fitted model as `fit` does, and how far the rides determine its coefficients, by vehicle model."""
        model, groups, rows = self._fit(rides, windows, covariance=True)
        rows, _ = select_trainable(rows, [name for name in self.columns if name in rows])
        found = {}
        for key, fitted in groups.items():
            own = rows if key == ANY else rows[rows[VEHICLE_MODEL] == key]
            figures = {name: float(own[name].mean()) for name in (*CarParameters._fields, "ambient_c")}
            gathered = gather_rows(self.terms, own, model.fits[key].fills, self.distortions)
            found[key] = determine_terms(self.terms, gathered, fitted, figures)
        return model, found

    def _fit(
        self, rides: pd.DataFrame, windows: pd.DataFrame | None, *, covariance: bool
    ) -> tuple[LinearModel, dict[str, GroupFit], pd.DataFrame]:
        """Return the model, the fit of each vehicle model, and the rows of rides fit for training."""
        rows = rides.loc[find_measured(rides)] if windows is None else join_tables(rides, windows)
        model, groups = fit_rows(self.name, self.terms, rows, rides, self.distortions)
        if covariance:
            model = add_window_interval(model, groups, rides)
        step = structs.replace(
            find_fit_step(model), action="fit", recipe=self.name, rows="rides" if windows is None else "windows"
        )
        return stamp(structs.replace(model, history=(step.to_json(),))), groups, rows
