"""Sparse regression by sequentially thresholded least squares, to compare with: what others would do.

The algorithm of `pysindy.optimizers.STLSQ` (PySINDy 2.1) with normalised columns: ridge regression, coefficients below
a threshold set to zero, again with what is left until nothing changes, and least squares of what remains. Written out
here, and the same to rounding, as PySINDy would be installed for this alone; it has none of its checks of input, so
that the ratio is rather against us.

References
----------
Brunton, Proctor and Kutz, PNAS 113 (2016) 3932, DOI 10.1073/pnas.1517384113.
"""

from typing import Final

import numpy as np

from core.batch import Floats
from core.diagnose.candidates import build_candidates
from core.diagnose.dataset import Windows
from core.fit.fitting import build_design
from core.models import ANY, LinearModel
from core.models.features import Columns

THRESHOLD: Final = 0.1
ALPHA: Final = 0.05
ROUNDS: Final = 20
"""Defaults of PySINDy."""


def build_columns(windows: Windows, model: LinearModel) -> Floats:
    """Return a model's own columns, then all that diagnosis asks of, (n, k). [kWh per unit]"""
    fit = model.fits[ANY]
    columns = Columns(windows.table, fit.fills, fit.curve)
    own = build_design(model.terms, columns, len(windows.measured))
    return np.nan_to_num(np.column_stack([own, build_candidates(windows, model).columns]))


def fit_stlsq(columns: Floats, energy: Floats, threshold: float = THRESHOLD, alpha: float = ALPHA) -> Floats:
    """Return sparse coefficients, (k,).

    Examples
    --------
    >>> columns = np.random.default_rng(0).normal(size=(200, 4))
    >>> stlsq(columns, columns @ np.array([20.0, 0.0, -30.0, 0.0])).round().astype(int).tolist()
    [20, 0, -30, 0]
    """
    size = np.sqrt((columns**2).sum(axis=0))
    size = np.where(size > 0.0, size, 1.0)
    table = columns / size
    gram, right = table.T @ table, table.T @ energy
    kept = np.ones(len(size), np.bool_)
    for _ in range(ROUNDS):
        some = np.flatnonzero(kept)
        if not len(some):
            return np.zeros(len(size))
        values = np.linalg.solve(gram[np.ix_(some, some)] + alpha * np.eye(len(some)), right[some])
        large = np.abs(values) >= threshold
        if large.all():
            break
        kept[some[~large]] = False
    out = np.zeros(len(size))
    out[kept] = np.linalg.lstsq(table[:, kept], energy, rcond=None)[0] / size[kept]
    return out
