"""Compare the names and the probabilities that diagnosis gives with the effects that are hidden."""

from collections.abc import Mapping
from typing import Any, Final

from socast.core.diagnose.records import NONE
from socast.tools.bench.hidden.cases import Case
from socast.tools.simulator.right_names import get_right_names

Record = dict[str, Any]

LIKELY: Final = 0.5
"""Probability from which on a name counts as a claim. [1]"""


def grade_names(case: Case, result: Mapping[str, Any]) -> Record:
    """Return whether the names and the credible set of a diagnosis are right.

    Returns
    -------
    Record
        `outcome` of the first name: `right`, `wrong`, or `none` without a name. `names`: every name in the order of the
        diagnosis, its probability that it is missing, whatever else is, and whether it is right. What a cause outside
        the library resembles is no name, as the diagnosis says that it is another cause. `cause`: the most
        probable cause of the first name. `set_size` and `set_holds`: size of the credible set of the first name, and
        whether a hidden effect is in it; None without a name. `found`: number of hidden effects among the names with a
        probability of `LIKELY` or more. `deviations`: single cars, groups and dates that the diagnosis blames.
    """
    wanted = list_truths(case)
    hidden = {name for names in wanted for name in names} - {NONE}
    names = [
        {"effect": name["effect"], "probability": name["probability"], "right": name["effect"] in hidden}
        for name in result["missing"]
    ]
    outcome = "none" if not names else "right" if names[0]["right"] else "wrong"
    likely = {name["effect"] for name in names if name["probability"] >= LIKELY}
    credible = result["credible_set"] if names else None
    return {
        "outcome": outcome,
        "names": names,
        "cause": result["causes"][0]["effect"] if result["causes"] else NONE,
        "set_size": None if credible is None else len(credible),
        "set_holds": None if credible is None else not hidden.isdisjoint(credible),
        "found": sum(not likely.isdisjoint(each) for each in wanted),
        "deviations": [
            {key: one[key] for key in ("who", "of", "kind", "effect", "since", "q")} for one in result["deviations"]
        ],
        "verdict": result["verdict"],
        "unknown": bool(result["unknown"]),
    }


def list_truths(case: Case) -> list[tuple[str, ...]]:
    """Return the right names of each hidden effect; `none` where no effect of the library is missing."""
    names = [get_right_names(effect) for effect, _ in case.hidden]
    return [(NONE,) if set(each) <= set(case.without) else each for each in names] or [(NONE,)]
