"""Fit, load and save consumption models."""

from pathlib import Path

import pandas as pd

from socast.core import models as _models
from socast.core.fit import recipes as _recipes
from socast.core.models import LinearModel

__all__ = [
    "LinearModel",
    "fit_model",
    "list_recipes",
    "load_model",
    "save_model",
    "stamp_model",
]


def list_recipes() -> dict[str, str]:
    """Return the name and the title of every recipe that `fit_model` fits.

    Examples
    --------
    >>> "fitted_physical" in list_recipes()
    True
    """
    return {name: recipe.title for name, recipe in _recipes.RECIPES.items()}


def fit_model(
    rides: pd.DataFrame, recipe: str = _recipes.FIRST_RECIPE, windows: pd.DataFrame | None = None
) -> LinearModel:
    """Fit a model to measured rides.

    Parameters
    ----------
    rides : (n, columns) DataFrame
        A ride table. Rides that are unfit for training are left out.
    recipe : str
        A name that `list_recipes` returns. The default is physics with priors, which one ride suffices to fit.
    windows : (m, columns) DataFrame, optional
        The window table of the same rides. The recipes `road_load*` are fitted to it; without it they are fitted to
        rides, with wider intervals. The other recipes do not read it.

    Returns
    -------
    LinearModel
        One fit for each vehicle model with enough rides, and one for every other vehicle model.

    Raises
    ------
    ModelError
        Where the recipe is unknown, a column is missing, or there are too few rides.

    Examples
    --------
    >>> import socast
    >>> tables = socast.make_tables("recordings/shift.mcap")
    >>> socast.fit_model(tables.rides, windows=tables.windows).recipe
    'road_load_full'
    """
    return _recipes.fit_recipe(recipe, rides, windows)


def load_model(name_or_path: str | Path, *, verify: bool = True) -> LinearModel:
    """Return a model by name, or from its file.

    Parameters
    ----------
    name_or_path : str or Path
        `basic_physical`, `extended_physical` or the path of a model file.
    verify : bool
        Refuse a file whose content does not match its version. False loads a file that was edited on purpose;
        `save_model` then writes it with its new version.

    Raises
    ------
    ModelError
        Where there is no such model, or the file is damaged, of another format version, or edited after it was
        written.

    Examples
    --------
    >>> load_model("basic_physical").effects
    ('rolling', 'climbing', 'aero_drag', 'inertia')
    """
    return _models.load(name_or_path, verify=verify)


def save_model(model: LinearModel, path: str | Path) -> None:
    """Write a model to a JSON file, from which `load_model` reads exactly the same model.

    Parameters
    ----------
    model : LinearModel
    path : str or Path
        The file to write; an existing file is replaced.

    Raises
    ------
    ModelError
        Where a coefficient is not finite, or the file cannot be written.
    """
    _models.save(model, path)


def stamp_model(model: LinearModel) -> LinearModel:
    """Return the model with the version that follows from its content.

    Parameters
    ----------
    model : LinearModel
        A model that was changed in Python, for example with `msgspec.structs.replace`.

    Examples
    --------
    >>> stamp_model(load_model("basic_physical")).version == load_model("basic_physical").version
    False
    """
    return _models.stamp(model)
