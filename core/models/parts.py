"""What a model's prediction is made of: a part for each of its terms, which add up to it."""

from typing import Final

import numpy as np

from core.batch import Floats, Ints
from core.models.features import Columns, Table
from core.models.linear import ANY, VEHICLE, VEHICLE_MODEL, LinearModel

CORRECTION: Final = "learned correction"
"""Name of the part that the boosted trees of a model say."""


def predict_parts(model: LinearModel, table: Table) -> dict[str, Floats]:
    """Return the energy of each term of a model, and of its correction by trees where it has one.

    Parameters
    ----------
    model : LinearModel
    table : mapping of str to (n,) array
        What `model.predict` takes, and the vehicle models.

    Returns
    -------
    dict of str to (n,) float
        By term; their sum is the prediction. NaN for a car that the model has no fit for. [kWh]
    """
    cars = np.asarray(table[VEHICLE_MODEL], dtype=object)
    names = [term.name for term in model.terms] + ([CORRECTION] if model.correction else [])
    found = {name: np.full(len(cars), np.nan) for name in names}
    own = [key for key in dict.fromkeys([*model.fits, *(model.correction or {})]) if key != ANY]
    left = np.ones(len(cars), np.bool_)
    for key in own:
        left &= cars != key
        _fill(found, model, key, table, np.flatnonzero(cars == key))
    _fill(found, model, ANY, table, np.flatnonzero(left))
    if model.cars:
        factor = np.array([model.cars.get(car, 1.0) for car in np.asarray(table[VEHICLE], dtype=object)])
        found = {name: energy * factor for name, energy in found.items()}
    return found


def _fill(found: dict[str, Floats], model: LinearModel, key: str, table: Table, rows: Ints) -> None:
    """Enter the parts of rides of one vehicle model, as `LinearModel.predict` adds them."""
    fit = model.fits.get(key) or model.fits.get(ANY)
    if fit is None or not len(rows):
        return
    curve = None if fit.curve is None else fit.curve.to_curve()
    seen = Columns(table, fit.fills, curve, rows)
    for term, coefficient in zip(model.terms, fit.coefficients, strict=True):
        product = np.full(len(rows), coefficient)
        for name in term.columns:
            product *= seen[name]
        found[term.name][rows] = product
    if model.correction:
        trees = model.correction.get(key) or model.correction.get(ANY)
        found[CORRECTION][rows] = trees.predict(Columns(table, None, curve, rows)) if trees else 0.0
