"""Compare the names and the probabilities that diagnosis gives with the effects that are hidden."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

from socast.core.diagnose.posterior.probabilities import NONE, UNKNOWN

from socast.tools.bench.hidden.cases import Case
from socast.tools.simulator.right_names import get_right_names

Record = dict[str, Any]
Effects = Sequence[tuple[str, float]]

STEPS: Final = 2
"""Number of steps in whose credible sets two hidden effects are sought."""


def grade_names(case: Case, result: Mapping[str, Any]) -> Record:
    """Return whether the names and credible sets of a diagnosis are right.

    Returns
    -------
    Record
        `outcome` of the first name: `right`, `wrong`, or `none` without a name. `names`: every name in order of
        selection, its probability, and whether it is right. `cause`: the most probable cause before any effect is
        selected. `set_size` and `set_holds`: size of the credible set of the leading cause before any effect is
        selected, and whether the truth is in it. `found`: number of hidden effects in the credible sets of the first
        two steps.
    """
    wanted = list_truths(case)
    hidden = {name for names in wanted for name in names} - {NONE, UNKNOWN}
    names = [
        {"effect": name["effect"], "probability": name["probability"], "right": name["effect"] in hidden}
        for name in result["missing"]
    ]
    outcome = "none" if not names else "right" if names[0]["right"] else "wrong"
    sets = list_credible_sets(result)
    within = set().union(*sets)
    return {
        "outcome": outcome,
        "names": names,
        "cause": result["causes"][0]["effect"] if result["causes"] else NONE,
        "set_size": len(sets[0]),
        "set_holds": any(name in sets[0] for each in wanted for name in each),
        "found": sum(any(name in within for name in each) for each in wanted),
        "verdict": result["verdict"],
        "structure_remains": result["structure_remains"],
    }


def list_truths(case: Case) -> list[tuple[str, ...]]:
    """Return the right names of each cause: of each hidden effect, of nothing, or of an effect outside the library."""
    if not case.hidden:
        return [(NONE,)]
    names = [get_right_names(effect) for effect, _ in case.hidden]
    return [(UNKNOWN,) if set(each) <= set(case.without) else each for each in names]


def list_credible_sets(result: Mapping[str, Any]) -> list[list[str]]:
    """Return the credible sets of the first steps of a diagnosis, the one in which it ended included."""
    selected = [name["credible_set"] for name in result["missing"]]
    sets = [result["credible_set"], *selected[1:]]
    if selected:
        sets.append(result["further_credible_set"])
    return [list(each) for each in sets[:STEPS]]
