"""Select given effects of synthetic drives, for tests of what a model leaves beside them."""

import numpy as np
import pandas as pd

from socast.core.diagnose.candidates import build_candidates
from socast.core.diagnose.projection import BaseProjection
from socast.core.diagnose.selection import MissingEffect, Selection
from socast.core.stats.evidence import ClusterSums, compute_evidence
from tests.support.synthetic_windows import gather_with_model


def select_effects(tables: tuple[pd.DataFrame, pd.DataFrame], *names: str) -> Selection:
    """Return a selection of effects whose coefficients are fitted one by one."""
    windows, model = gather_with_model(tables)
    base, candidates = BaseProjection(windows, model), build_candidates(windows, model)
    clusters = [ClusterSums(windows.day), ClusterSums(windows.date)]
    columns = [candidates.columns[:, [candidates.variants.index(name)]] for name in names]
    if columns:
        base = base.reweight(np.column_stack(columns))
    missing = []
    for name, column in zip(names, columns, strict=True):
        found = compute_evidence(base.residual, base.project_out(column), np.zeros(1, dtype=np.int64), clusters[0])
        missing.append(MissingEffect(name, column, found.get_estimate(0), 1.0, {name: 1.0}))
    return Selection(base, clusters, tuple(missing))
