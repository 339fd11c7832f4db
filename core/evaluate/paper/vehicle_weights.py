"""Weigh vehicle models in the weighted rows of Tables 4 to 11 of the paper, and in its Figure 2.

The paper prints the rows and not their weights. Its cluster cells determine the rule. The weights are constant: a
vehicle model weighs by its total of Table 2, in every cluster. Where a vehicle model has no figure in a cluster, the
others take equal parts of its weight, so that the weights always add up to all rides. The rule has no fitted number. It
gives 33 of the 40 printed cells to the last digit, and the other seven as exactly as their rounded cells allow.

Other rules give fewer cells: weights by the rides in the cluster 5, equal weights 7. The same totals give 25 where the
weight of an absent vehicle model is divided in proportion, and then none of the cluster 20-25 km. With such a division
no filter of rides can give the rows either: they need 9.1 to 10.6 % of the weight on the Model X, which has at most
8.0 % of the rides that remain. Totals without the clusters above 20 or 25 km give the same 33 cells, because they
differ by 0.03 % at most; the total of Table 2 is the plainest of these.
"""

from collections.abc import Sequence

import numpy as np

from socast.core.batch import Floats


def weigh_vehicle_models(rides: Sequence[float], known: Sequence[bool]) -> Floats:
    """Return the weight of each vehicle model in the weighted row of a cluster.

    Returns
    -------
    (vehicle models,) float
        Weights, in rides; 0 where there is no figure. They add up to all rides, unless no vehicle model has a figure.

    Examples
    --------
    >>> weigh_vehicle_models([600, 300, 100], [True, True, False]).tolist()
    [650.0, 350.0, 0.0]
    """
    total, present = np.array(rides, dtype=np.float64), np.array(known, dtype=bool)
    if not present.any():
        return np.zeros(len(total))
    return np.where(present, total + total[~present].sum() / present.sum(), 0.0)
