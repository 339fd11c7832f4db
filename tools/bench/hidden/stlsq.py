"""Fit sparse regressions by sequentially thresholded least squares, as a baseline for diagnosis.

The algorithm is that of `pysindy.optimizers.STLSQ` (PySINDy 2.1) with normalised columns. It fits a ridge regression,
sets coefficients below a threshold to zero, repeats with the others until nothing changes, and refits them by least
squares. This implementation gives the same result to rounding and avoids a dependency on PySINDy. It does not check its
input as PySINDy does, so the ratio of times rather favours the baseline.

References
----------
Brunton, Proctor and Kutz, PNAS 113 (2016) 3932, DOI 10.1073/pnas.1517384113.
"""

from typing import Final

import numpy as np

from socast.core.batch import Floats
from socast.core.diagnose.candidates import build_candidates
from socast.core.diagnose.dataset import Windows
from socast.core.fit.block_sums import build_design
from socast.core.models import ANY, LinearModel
from socast.core.models.features import Columns

THRESHOLD: Final = 0.1
ALPHA: Final = 0.05
ROUNDS: Final = 20
"""Default values of PySINDy."""


def build_columns(windows: Windows, model: LinearModel) -> Floats:
    """Return the columns of a model and of all candidates of diagnosis. [kWh per unit]"""
    fit = model.fits[ANY]
    columns = Columns(windows.table, fit.fills, fit.curve)
    base = build_design(model.terms, columns, len(windows.measured))
    return np.nan_to_num(np.column_stack([base, build_candidates(windows, model).columns]))


def fit_stlsq(columns: Floats, energy: Floats, threshold: float = THRESHOLD, alpha: float = ALPHA) -> Floats:
    """Return sparse coefficients.

    Units: energy [kWh].

    Examples
    --------
    >>> columns = np.random.default_rng(0).normal(size=(200, 4))
    >>> fit_stlsq(columns, columns @ np.array([20.0, 0.0, -30.0, 0.0])).round().astype(int).tolist()
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
