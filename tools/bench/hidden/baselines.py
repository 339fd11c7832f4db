"""Rank the effects of the library by methods of the field, for comparison with diagnosis.

All methods receive the same windows as diagnosis. The sparse regressions also receive the projection of diagnosis: the
residual and the candidates, weighted and off the terms of the model. So the noise has variance one, and the methods do
not have to find the base model first.

References
----------
Brunton, Proctor and Kutz, PNAS 113 (2016) 3932, DOI 10.1073/pnas.1517384113, sparse regression. Fasel et al.,
Proceedings of the Royal Society A 478 (2022) 20210904, DOI 10.1098/rspa.2021.0904, ensembles of it. Donoho and
Johnstone, Biometrika 81 (1994) 425, DOI 10.1093/biomet/81.3.425, the threshold. Breiman, Machine Learning 45 (2001) 5,
DOI 10.1023/A:1010933404324, permutation importance.
"""

from collections.abc import Callable, Mapping
from importlib.util import find_spec
from math import log, sqrt
from types import MappingProxyType
from typing import Final
from warnings import catch_warnings, simplefilter

import numpy as np
from sklearn.ensemble import HistGradientBoostingRegressor
from sklearn.inspection import permutation_importance

from socast.core.batch import Floats
from socast.core.diagnose.candidates import Candidates, build_candidates
from socast.core.diagnose.dataset import Windows
from socast.core.diagnose.gains import LEAST_LEFT
from socast.core.diagnose.projection import BaseProjection
from socast.core.fit.block_sums import build_design
from socast.core.fit.ride_blocks import get_numbers
from socast.core.models import ANY, LinearModel
from socast.core.models.features import Columns

MODELS: Final = 20
"""Number of regressions of an ensemble; the default of PySINDy."""
REPEATS: Final = 3
"""Number of permutations of each condition."""
LONGEST: Final = 5
"""Number of names of a ranking that are kept."""
SEED: Final = 0

THRESHOLD: Final = 0.1
ALPHA: Final = 0.05
ROUNDS: Final = 20
"""Default values of PySINDy."""


def rank_by_baselines(base: BaseProjection, candidates: Candidates) -> dict[str, list[str]]:
    """Return the effects as each baseline ranks them, the first `LONGEST`."""
    return {
        name: rank(base, candidates)[:LONGEST]
        for name, rank in BASELINES.items()
        if name != "pysindy" or find_spec("pysindy")
    }


def rank_by_stlsq(base: BaseProjection, candidates: Candidates) -> list[str]:
    """Return effects by the size of their coefficients in one sparse regression."""
    columns = project_candidates(base, candidates)
    size = np.sqrt((columns**2).sum(axis=0))
    found = fit_stlsq(columns, base.residual, compute_threshold(columns)) * size
    return rank_by_size(candidates, np.abs(found))


def rank_by_pysindy(base: BaseProjection, candidates: Candidates) -> list[str]:
    """Return effects by how often an ensemble of sparse regressions of PySINDy includes them.

    Returns
    -------
    list of str
        Only those that a regression includes. Among those that are included equally often, the largest median
        coefficient is first.
    """
    from pysindy.optimizers import STLSQ, EnsembleOptimizer  # noqa: PLC0415 - an extra

    columns = project_candidates(base, candidates)
    size = np.sqrt((columns**2).sum(axis=0))
    scaled = columns / np.where(size > 0.0, size, 1.0)
    ensemble = EnsembleOptimizer(STLSQ(compute_threshold(columns)), bagging=True, n_models=MODELS)
    state = np.random.get_state()  # noqa: NPY002 - PySINDy draws from the global generator
    np.random.seed(SEED)  # noqa: NPY002
    try:
        with catch_warnings():  # where nothing exceeds the threshold, the ranking is empty
            simplefilter("ignore", UserWarning)
            ensemble.fit(scaled, base.residual[:, np.newaxis])
    finally:
        np.random.set_state(state)  # noqa: NPY002
    found = np.abs(np.array(ensemble.coef_list)[:, 0, :])
    often, typical = (found > 0.0).mean(axis=0), np.median(found, axis=0)
    return rank_by_size(candidates, often + typical / (1.0 + typical.max()) / MODELS)


def rank_by_trees(base: BaseProjection, candidates: Candidates) -> list[str]:
    """Return effects by how much boosted trees of the residual power lose where the power of an effect is permuted.

    Notes
    -----
    The trees receive the power of each effect at a coefficient of one, which says when and how strongly it acts. They
    are fitted to every other vehicle-day; the importance is measured on the others.
    """
    hours = np.maximum(get_numbers(base.windows.table, "duration_s"), 1.0) / 3600.0
    first = [int(np.flatnonzero(candidates.effects == e)[0]) for e in range(len(candidates.names))]
    power = candidates.columns[:, first] / hours[:, np.newaxis]
    target, weight = base.convert_to_energy(base.residual) / hours, base.weight * hours**2
    fitted = base.windows.day % 2 == 0
    trees = HistGradientBoostingRegressor(random_state=SEED)
    trees.fit(power[fitted], target[fitted], sample_weight=weight[fitted])
    importance = permutation_importance(
        trees, power[~fitted], target[~fitted], n_repeats=REPEATS, random_state=SEED, sample_weight=weight[~fitted]
    ).importances_mean
    order = np.argsort(-importance, kind="stable")
    return [candidates.names[e] for e in order.tolist() if importance[e] > 0.0]


BASELINES: Final[Mapping[str, Callable[[BaseProjection, Candidates], list[str]]]] = MappingProxyType(
    {"stlsq": rank_by_stlsq, "pysindy": rank_by_pysindy, "boosted trees": rank_by_trees}
)
"""Function that ranks the effects by each method."""
RANKED: Final = "diagnosis, ranked"
"""Name of the ranking by diagnosis itself, which goes on below the probability from which it names effects."""
DESCRIPTIONS: Final = MappingProxyType(
    {
        RANKED: "diagnosis, ranked: its names, then all other effects by their probability, also below one half",
        "stlsq": "STLSQ: sequentially thresholded least squares, effects by the size of their normalised coefficient",
        "pysindy": "PySINDy: ensemble of 20 STLSQ on resampled windows, effects by how often they are included",
        "boosted trees": "gradient-boosted trees of the residual, effects by permutation importance on other days",
    }
)
"""What each method does, for the page."""


def project_candidates(base: BaseProjection, candidates: Candidates) -> Floats:
    """Return the candidates off the terms of the model, zero where too little of one is left, (n, k)."""
    off = base.project_out(candidates.columns)
    left = (off**2).sum(axis=0) > LEAST_LEFT * (base.apply_weights(candidates.columns) ** 2).sum(axis=0)
    return np.asarray(off * left)


def compute_threshold(columns: Floats) -> float:
    """Return the universal threshold √(2 ln k) of k normalised coefficients under noise of variance one."""
    return sqrt(2.0 * log(max(int((columns != 0.0).any(axis=0).sum()), 2)))


def rank_by_size(candidates: Candidates, size: Floats) -> list[str]:
    """Return the effects by the largest value of any of their variants, those of zero left out."""
    order = np.argsort(-size, kind="stable")
    return list(dict.fromkeys(candidates.names[candidates.effects[at]] for at in order.tolist() if size[at] > 0.0))


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
