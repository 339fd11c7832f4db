"""Suggest a free-form term for structure that no effect of the library explains.

Every carrier is multiplied by every modulator (`socast.core.diagnose.free_form.terms`), and the best of these terms by
a second modulator. All terms are projected off what the model can refit. They are compared by the fall of the weighted
squared residual on held-out clusters, with model and term refitted without them. A simpler form of the best term is
preferred if it is within one standard error [1]_.

The search is repeated within each fold of an outer cross-validation. The reported gain is therefore that of the search
as a whole, on clusters that did not influence it [2]_. If its interval includes zero, nothing is suggested. The search
uses sums over ten pieces of the data, so a fold needs no pass over the windows.

References
----------
.. [1] Hastie, Tibshirani, Friedman, The Elements of Statistical Learning, 2nd ed., Springer 2009, section 7.10.
.. [2] Varma, Simon 2006, BMC Bioinformatics 7:91, DOI 10.1186/1471-2105-7-91: nested cross-validation.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
import pandas as pd

from socast.core.batch import Floats, Ints
from socast.core.diagnose.free_form import suggestion
from socast.core.diagnose.free_form.building_blocks import CARRIERS, VARIABLES, Carrier
from socast.core.diagnose.free_form.terms import FreeTerm, Modulator, list_modulators
from socast.core.stats.clustered import compute_clustered_ratio
from socast.core.stats.evidence import ClusterSums, compute_evidence
from socast.core.stats.scores import Estimate
from socast.core.stats.splits import deal_folds

PIECES: Final = 10
"""Number of pieces to which the clusters are assigned."""
FOLDS: Final = 5
"""Number of folds of the outer cross-validation; each consists of whole pieces."""
LEAST_CLUSTERS: Final = 8
"""Number of clusters below which nothing can be held out."""
LEAST_PIECES: Final = 0.4
"""Share of the pieces in which a term must be active."""
WIDEST: Final = 6
"""Number of terms that are tried with a second modulator."""
MORE: Final = 2.0
"""Standard errors by which a further variable must win, because it is the best of hundreds. A shape must win by one."""
SLIGHT: Final = 0.05
"""Share of the fall that is given up for a simpler term, even if the difference is certain."""
KEPT: Final = 0.5
"""Share of the fall that a simpler term must keep, even if the difference is uncertain."""
HOLD: Final = 0.03
"""Share of all windows for which the fitted model counts when it is refitted to some of them."""
LUCK: Final = 0.5
"""Standard errors that are subtracted from a fall; this matters most for terms that act on few days."""
OWN: Final = 1e-6
"""Share of the squares of a column that must remain off the model for the column to be a term."""


@dataclass(frozen=True, eq=False)
class Suggestion:
    """Hold a term outside the library that explains the residual.

    Parameters
    ----------
    coefficient : float
        Coefficient c. [`unit`]
    ci95 : (float, float)
        Interval of the coefficient for this term. [`unit`]
    unit : str
        Unit of the coefficient with which the power is in watt, as pint spells it.
    gain, gain_ci95 : float, (float, float)
        Fall of the weighted squared residual by the search on held-out clusters, as a share, and its interval. [1]
    column : (n,) float
        Energy of the term in each window, per unit of the coefficient. [kWh/`unit`]
    file : str
        Source of a Python file with the effect.
    """

    term: FreeTerm
    formula: str
    coefficient: float
    ci95: tuple[float, float]
    unit: str
    gain: float
    gain_ci95: tuple[float, float]
    column: Floats
    file: str


class _Data(NamedTuple):
    """Hold rows by piece and cluster, multiplied by the root of their weight: an orthogonal base, and the residual."""

    base: Floats
    residual: Floats
    root: Floats
    cluster: Ints
    starts: Ints
    gram: Floats
    cross: Floats


class _Sums(NamedTuple):
    """Hold products of m columns with the base, with the residual and with themselves, by piece."""

    base: Floats
    residual: Floats
    square: Floats


class _Search:
    """Provide all terms on some windows with their sums, which are computed on demand."""

    def __init__(self, data: _Data, windows: pd.DataFrame) -> None:
        self.data = data
        values = {variable.name: variable.value(windows) for variable in VARIABLES}
        self.modulators = [each for variable in VARIABLES for each in list_modulators(variable, values[variable.name])]
        self.values = np.array([each.evaluate(values[each.variable.name]) for each in self.modulators])
        self.energies = {carrier.name: carrier.energy(windows) for carrier in CARRIERS}
        self.made: dict[tuple[str, str, str, float], tuple[list[FreeTerm], _Sums]] = {}
        self.terms: list[FreeTerm] = []
        parts = []
        for carrier in CARRIERS:
            terms, sums = self._of(carrier, ())
            self.terms += terms
            parts.append(sums)
        self.sums = _joined(parts)

    def column(self, term: FreeTerm) -> Floats:
        """Return the energy of a term in each row, per unit of its coefficient. [kWh]"""
        column = self.energies[term.carrier.name]
        for each in term.modulators:
            column = column * self.values[self.modulators.index(each)]
        return column

    def longer(self, term: FreeTerm) -> tuple[list[FreeTerm], _Sums]:
        """Return the terms with one more modulator, of another variable."""
        (first,) = term.modulators
        key = term.carrier.name, first.variable.name, first.shape, first.at
        if key not in self.made:
            self.made[key] = self._of(term.carrier, (first,))
        return self.made[key]

    def _of(self, carrier: Carrier, before: tuple[Modulator, ...]) -> tuple[list[FreeTerm], _Sums]:
        """Return terms of a carrier and given modulators, each with one more; without modulators, the carrier too."""
        column = self.column(FreeTerm(carrier, before)) * self.data.root
        mine = {each.variable.name for each in before}
        kept = [i for i, each in enumerate(self.modulators) if each.variable.name not in mine]
        terms = [FreeTerm(carrier, (*before, self.modulators[i])) for i in kept]
        columns = self.values[kept] * column
        if not before:
            terms, columns = [FreeTerm(carrier), *terms], np.vstack([column, columns])
        return terms, _summed(columns, self.data)


def suggest_term(
    windows: pd.DataFrame,
    residual: Floats,
    weight: Floats,
    cluster: Ints,
    base: Floats,
    *,
    least_gain: float = 0.002,
) -> Suggestion | None:
    """Return the term that explains most of a residual, or None.

    Units: residual [kWh], weight [1/kWh^2], base [kWh per unit].

    Parameters
    ----------
    least_gain : float
        Least share of the weighted squared residual that a suggestion must explain. [1]
    """
    usable = np.isfinite(residual) & np.isfinite(weight) & (weight > 0.0) & np.isfinite(base).all(axis=1)
    if len(np.unique(cluster[usable])) < LEAST_CLUSTERS:
        return None
    order = np.flatnonzero(usable)
    order = order[np.lexsort((cluster[order], _dealt(cluster[order])))]
    table = windows.iloc[order]
    data = _prepared(residual[order], weight[order], cluster[order], base[order])
    search = _Search(data, table)
    term = _choose(search, np.arange(len(data.starts)))
    if term is None:
        return None
    gain = _gain(search)
    if gain.value < least_gain or not gain.interval[0] > 0.0:
        return None
    coefficient = _coefficient(search, term)
    column = np.full(len(windows), np.nan)
    column[order] = search.column(term)
    return Suggestion(
        term=term,
        formula=suggestion.format_formula(term),
        coefficient=coefficient.value,
        ci95=coefficient.interval,
        unit=suggestion.derive_unit(term),
        gain=gain.value,
        gain_ci95=gain.interval,
        column=column,
        file=suggestion.format_source_file(term, coefficient.value, len(order)),
    )


def _dealt(cluster: Ints) -> Ints:
    """Return the piece of each row; clusters are assigned at random with a fixed seed."""
    clusters, code = np.unique(cluster, return_inverse=True)
    return deal_folds(len(clusters), PIECES, 0)[code]


def _prepared(residual: Floats, weight: Floats, cluster: Ints, base: Floats) -> _Data:
    """Return ordered rows with the sums that every fold needs."""
    root = np.sqrt(weight / weight.mean())
    scaled = base * root[:, None]
    scaled = scaled / np.maximum(np.sqrt(np.mean(scaled**2, axis=0)), 1e-300)
    values, directions = np.linalg.eigh(scaled.T @ scaled / len(scaled))
    kept = values > 1e-9 * max(values.max(initial=0.0), 1e-300)
    scaled = scaled @ (directions[:, kept] / np.sqrt(values[kept]))
    weighted = residual * root
    weighted = weighted - scaled @ (scaled.T @ weighted) / len(weighted)
    starts = np.flatnonzero(np.diff(_dealt(cluster), prepend=-1))
    ends = [*starts[1:].tolist(), len(weighted)]
    pieces = [slice(first, last) for first, last in zip(starts.tolist(), ends, strict=True)]
    gram = np.array([scaled[piece].T @ scaled[piece] for piece in pieces])
    cross = np.array([scaled[piece].T @ weighted[piece] for piece in pieces])
    return _Data(scaled, weighted, root, cluster, starts, gram, cross)


def _summed(columns: Floats, data: _Data) -> _Sums:
    """Return the sums by piece of weighted columns, (m, n), each projected off the base over all rows."""
    ends = [*data.starts[1:].tolist(), len(data.residual)]
    parts = []
    for first, last in zip(data.starts.tolist(), ends, strict=True):
        piece = columns[:, first:last]
        square = np.einsum("mn,mn->m", piece, piece)
        parts.append((piece @ data.base[first:last], piece @ data.residual[first:last], square))
    base, residual, square = (np.array(each) for each in zip(*parts, strict=True))
    taken = base.sum(axis=0) / len(data.residual)
    along = base - taken @ data.gram
    left = square - np.einsum("mk,pmk->pm", taken, base + along)
    left = np.where(left.sum(axis=0) > OWN * square.sum(axis=0), left.clip(0.0), 0.0)
    return _Sums(along, residual - data.cross @ taken.T, left)


def _joined(parts: Sequence[_Sums]) -> _Sums:
    """Return the sums of several groups of columns as one group."""
    return _Sums(*(np.concatenate(each, axis=1) for each in zip(*parts, strict=True)))


def _project_off_base(column: Floats, data: _Data) -> Floats:
    """Return a weighted column projected off the base over all rows, (n,)."""
    return column - data.base @ (data.base.T @ column) / len(column)


class _Fitted(NamedTuple):
    """Hold base and m terms fitted to some pieces: base without a term, base in each column, coefficients."""

    base: Floats
    taken: Floats
    coefficient: Floats


def _fit(data: _Data, sums: _Sums, train: Ints) -> _Fitted:
    """Return the least-squares fit of the residual to the base and to each column alone, on some pieces."""
    gram = data.gram[train].sum(axis=0)
    inverse = np.linalg.inv(gram + HOLD * len(data.residual) * np.eye(len(gram)))
    cross = data.cross[train].sum(axis=0)
    base, square = sums.base[train].sum(axis=0), sums.square[train].sum(axis=0)
    taken = base @ inverse
    left = square - np.einsum("mk,mk->m", taken, base)
    determined = (left > 0.0) & (np.count_nonzero(sums.square[train] > 0.0, axis=0) >= LEAST_PIECES * len(train))
    total = sums.residual[train].sum(axis=0) - taken @ cross
    return _Fitted(inverse @ cross, taken, np.divide(total, left, out=np.zeros(len(left)), where=determined))


def _fall(data: _Data, sums: _Sums, train: Ints, test: int) -> Floats:
    """Return the fall of the squared residual of a piece by each column, fitted to other pieces, (m,)."""
    fitted = _fit(data, sums, train)
    gram, cross, base = data.gram[test], data.cross[test], sums.base[test]
    along = sums.residual[test] - base @ fitted.base - fitted.taken @ (cross - gram @ fitted.base)
    size = sums.square[test] - 2.0 * np.einsum("mk,mk->m", fitted.taken, base)
    size = size + np.einsum("mk,mk->m", fitted.taken @ gram, fitted.taken)
    return 2.0 * fitted.coefficient * along - fitted.coefficient**2 * size


def _falls(data: _Data, sums: _Sums, pieces: Ints) -> Floats:
    """Return the fall in each piece by each column, fitted to the other pieces, (pieces, m)."""
    return np.array([_fall(data, sums, pieces[pieces != piece], int(piece)) for piece in pieces])


def _choose(search: _Search, pieces: Ints) -> FreeTerm | None:
    """Return the best term by cross-validation over some pieces, or an equally good simpler form of it."""
    terms, falls = list(search.terms), _falls(search.data, search.sums, pieces)
    for head in _heads(terms, _sure(falls)):
        longer, sums = search.longer(head)
        terms += longer
        falls = np.hstack([falls, _falls(search.data, sums, pieces)])
    sure, total = _sure(falls), falls.sum(axis=0)
    best = int(np.argmax(sure))
    if sure[best] <= 0.0:
        return None
    plainer = [i for i, term in enumerate(terms) if term.is_plainer_than(terms[best])]
    lost = falls[:, [best]] - falls[:, plainer]
    doubt = np.array([1.0 if terms[i].variables == terms[best].variables else MORE for i in plainer])
    enough = lost.sum(axis=0) <= np.maximum(doubt * _error(lost), SLIGHT * total[best])
    enough &= total[plainer] >= KEPT * total[best]
    as_good = [i for i, good in zip(plainer, enough.tolist(), strict=True) if good]
    return terms[min(as_good, key=lambda i: (terms[i].effort, -total[i]), default=best)]


def _heads(terms: Sequence[FreeTerm], sure: Floats) -> list[FreeTerm]:
    """Return the best terms to extend, at most one for each carrier and variable."""
    heads: dict[tuple[str, frozenset[str]], FreeTerm] = {}
    for i in np.argsort(-sure, kind="stable").tolist():
        if len(heads) == WIDEST or sure[i] <= 0.0:
            break
        if terms[i].modulators:
            heads.setdefault((terms[i].carrier.name, terms[i].variables), terms[i])
    return list(heads.values())


def _error(falls: Floats) -> Floats:
    """Return the standard errors of the sums over pieces, (m,)."""
    return np.sqrt(len(falls)) * falls.std(axis=0, ddof=1)


def _sure(falls: Floats) -> Floats:
    """Return the sums over pieces less a share of their standard errors, so that one piece by chance does not count."""
    return falls.sum(axis=0) - LUCK * _error(falls)


def _gain(search: _Search) -> Estimate:
    """Return the share of the squared residual that the search explains on held-out clusters. [1]"""
    data = search.data
    piece = np.searchsorted(data.starts, np.arange(len(data.residual)), side="right") - 1
    without, fall = np.zeros(len(data.residual)), np.zeros(len(data.residual))
    every = np.arange(len(data.starts))
    for test in np.array_split(every, min(FOLDS, len(every))):
        train = np.setdiff1d(every, test)
        term = _choose(search, train)
        rows = np.isin(piece, test)
        column = _project_off_base(search.column(search.terms[0] if term is None else term) * data.root, data)
        fitted = _fit(data, _summed(column[None, :], data), train)
        left = data.residual[rows] - data.base[rows] @ fitted.base
        without[rows] = left**2
        if term is not None:
            term_left = left - fitted.coefficient[0] * (column[rows] - data.base[rows] @ fitted.taken[0])
            fall[rows] = left**2 - term_left**2
    code = np.unique(data.cluster, return_inverse=True)[1]
    falls, squares = (np.bincount(code, each).astype(np.float64) for each in (fall, without))
    return compute_clustered_ratio(falls, squares, np.arange(len(falls)))


def _coefficient(search: _Search, term: FreeTerm) -> Estimate:
    """Return the coefficient on all windows, with clustered errors."""
    data = search.data
    projected = _project_off_base(search.column(term) * data.root, data)
    clusters = ClusterSums(data.cluster)
    either = np.zeros(1, dtype=np.int64)
    return compute_evidence(data.residual, projected[:, np.newaxis], either, clusters).get_estimate(0)
