"""Measure whether the data show a hidden effect at all, and show it better than any other effect.

No diagnosis can name an effect that leaves no trace, or one whose trace another effect of the library fits as well. The
oracle knows the true energy of the hidden effect in each window. An effect is visible where the likelihood of the
oracle exceeds that of every form of every other effect by the factor `RATIO`.
"""

from math import log
from typing import Any, Final

import numpy as np

from socast.core import effects
from socast.core.batch import Floats, Ints
from socast.core.diagnose.candidates import Candidates
from socast.core.diagnose.gains import LEAST_LEFT
from socast.core.diagnose.projection import BaseProjection
from socast.core.fit.block_sums import build_design
from socast.core.models import Term
from socast.core.models.features import Columns
from socast.tools.bench.hidden.cases import Case
from socast.tools.simulator.right_names import get_right_names

RATIO: Final = 20.0
"""Likelihood ratio from which on the true energy of an effect is distinct from every other effect."""
LARGEST_SHARE: Final = 0.999
"""Largest share of a vehicle-day in a sum from which it is left out. [1]"""


def measure_visibility(case: Case, base: BaseProjection, candidates: Candidates, hidden: Floats) -> dict[str, Any]:
    """Return how much of the hidden energy is visible to diagnosis.

    Units: hidden [kWh].

    Returns
    -------
    dict
        `left`: share of the size of the hidden energy that the terms of the model cannot explain. `alike`: correlation
        of that remainder with the best variant of the right effect of the library; 1 means the same shape. `z`: number
        of standard errors by which the hidden energy itself would differ from zero as a candidate, from sums over
        vehicle-days, each with that day left out. `ratios`: logarithm of the likelihood ratio of each effect, see
        `compare_with_rivals`. `visible`: whether all of them reach `RATIO`.
    """
    energy = hidden.sum(axis=1)[:, np.newaxis]
    off = base.project_out(energy)[:, 0]
    size, whole = float(np.sqrt(off @ off)), float(np.sqrt((base.apply_weights(energy) ** 2).sum()))
    scope = [f"vehicle={case.where.vehicle}"] if case.where.vehicle else []
    scope += [f"since={case.where.since}"] if case.where.since else []
    library = [effects.get(name) for effect, _ in case.hidden for name in get_right_names(effect)]
    columns = [[each.energy_name, *scope] for effect in library for each in (effect, *effect.variants)]
    orthogonal = project_products(base, columns)
    sizes = np.sqrt((orthogonal**2).sum(axis=0))
    alike = np.divide(off @ orthogonal, size * sizes, out=np.zeros(len(sizes)), where=size * sizes > 0.0)
    ratios = [compare_with_rivals(case, base, candidates, hidden, number) for number in range(len(case.hidden))]
    return {
        "left": size / whole if whole > 0.0 else 0.0,
        "alike": float(alike.max()),
        "z": compute_z(off, base.residual, base.windows.day),
        "ratios": ratios,
        "visible": min(ratios) >= log(RATIO),
    }


def compare_with_rivals(case: Case, base: BaseProjection, candidates: Candidates, hidden: Floats, number: int) -> float:
    """Return by how much the true energy of a hidden effect is more likely than the best form of any other effect.

    Units: hidden [kWh].

    Parameters
    ----------
    number : int
        Number of the effect. The true energies of the others are known to both sides.

    Returns
    -------
    float
        Logarithm of the likelihood ratio: half the difference of the falls of the weighted squared error, divided by
        the variance that the true energies leave. [1]
    """
    off = base.project_out(np.column_stack([hidden, candidates.columns]))
    others = [i for i in range(hidden.shape[1]) if i != number]
    known, own = off[:, others], off[:, number]
    if others:
        off = off - known @ np.linalg.lstsq(known, off, rcond=None)[0]
        own = off[:, number]
    residual = base.residual - known.sum(axis=1)
    forms = off[:, hidden.shape[1] :]
    sizes, match = (forms**2).sum(axis=0), forms.T @ residual
    right = get_right_names(case.hidden[number].effect)
    names = np.array(candidates.names, dtype=object)[candidates.effects]
    seen = sizes > LEAST_LEFT * (base.apply_weights(candidates.columns) ** 2).sum(axis=0)
    rival = seen & ~np.isin(names, right) & (candidates.sign * match >= 0.0)
    falls = np.divide(match**2, sizes, out=np.zeros(len(sizes)), where=rival)
    size, along = float(own @ own), float(own @ residual)
    fall = max(along, 0.0) ** 2 / size if size > 0.0 else 0.0
    noise = (float(residual @ residual) - fall) / max(len(residual) - base.rank, 1)
    return (fall - float(falls.max(initial=0.0))) / (2.0 * noise)


def compute_z(orthogonal: Floats, residual: Floats, cluster: Ints) -> float:
    """Return the coefficient of a column divided by its standard error."""
    total = float(orthogonal @ orthogonal)
    if total <= 0.0:
        return 0.0
    value = float(orthogonal @ residual) / total
    share = np.bincount(cluster, orthogonal**2) / total
    scores = np.bincount(cluster, orthogonal * (residual - orthogonal * value)) / (
        1.0 - np.minimum(share, LARGEST_SHARE)
    )
    return value * total / float(np.sqrt((scores**2).sum()))


def project_products(base: BaseProjection, columns: list[list[str]]) -> Floats:
    """Return weighted products of columns, orthogonal to the terms of the model, (n, products)."""
    terms = tuple(Term(name=str(i), columns=tuple(each), unit="1") for i, each in enumerate(columns))
    table = base.windows.table
    return base.project_out(np.nan_to_num(build_design(terms, Columns(table), len(table))))
