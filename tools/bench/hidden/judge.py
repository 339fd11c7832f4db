"""Judge the rankings that any method gives for exported data sets.

Example: python -m socast.tools.bench.hidden.judge build/hidden answers.json
"""

import json
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, NamedTuple

from socast.core.diagnose.records import NONE
from socast.core.errors import SettingsError
from socast.core.stats.clustered import compute_wilson_interval
from socast.tools.bench.figures.published import make_parser, show_table, tell_errors
from socast.tools.bench.hidden.figures import LEAST

Answers = Mapping[str, Sequence[str]]
Truth = Mapping[str, Any]


class Score(NamedTuple):
    """Hold how often a method was right.

    Parameters
    ----------
    right, of : int
        Number of right answers and of data sets.
    """

    what: str
    right: int
    of: int

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval of the share of right answers. [1]"""
        return compute_wilson_interval(self.right / self.of, self.of)


def judge(answers: Answers, truths: Mapping[str, Truth]) -> list[Score]:
    """Return how often rankings are right.

    Parameters
    ----------
    answers : mapping of str to sequence of str
        Names of causes for each data set, the most probable first. A data set without an answer counts as `NONE`.

    Examples
    --------
    >>> truth = {"part": "none", "truths": [["none"]], "absorbed": False}
    >>> judge({"00000": ["snow"]}, {"00000": truth, "00001": truth})
    [Score(what='nothing hidden: no name', right=1, of=2)]
    """
    for name, ranking in answers.items():
        if name not in truths:
            raise SettingsError(f"an answer is for {name!r}, which is not one of the {len(truths)} data sets")
        if isinstance(ranking, str) or not all(isinstance(cause, str) for cause in ranking):
            raise SettingsError(f"the answer for {name!r} is {ranking!r}; give a list of names")
    scores = []
    for what, belongs in GOALS.items():
        names = [name for name, truth in truths.items() if not truth["absorbed"] and belongs(truth)]
        if names:
            right = sum(is_answer_right(answers.get(name, ()), truths[name]) for name in names)
            scores.append(Score(what, right, len(names)))
    return scores


def is_answer_right(ranking: Sequence[str], truth: Truth) -> bool:
    """Return whether as many first names as there are causes are right."""
    first = list(ranking[: len(truth["truths"])]) or [NONE]
    return all(any(name in names for name in first) for names in truth["truths"])


def _is_counted(truth: Truth, measurement: str) -> bool:
    """Return whether a data set with one effect is large enough to count."""
    if truth["part"] != "one" or truth["measurement"] != measurement:
        return False
    return bool(truth["hidden"][0][1] >= LEAST[measurement])


GOALS: Final[Mapping[str, Callable[[Truth], bool]]] = MappingProxyType(
    {
        "V·I, 1.5 % or more, visible: truth first": lambda t: _is_counted(t, "vi") and bool(t["visible"]),
        "V·I, 1.5 % or more, all: truth first": lambda t: _is_counted(t, "vi"),
        "SOC only, 3 % or more, visible: truth first": lambda t: _is_counted(t, "soc") and bool(t["visible"]),
        "SOC only, 3 % or more, all: truth first": lambda t: _is_counted(t, "soc"),
        "two effects, both visible: both among the first two": lambda t: t["part"] == "two" and bool(t["visible"]),
        "truth not in the library: no effect first": lambda t: t["part"] == "outside",
        "nothing hidden: no name": lambda t: t["part"] == "none",
    }
)
"""What counts, and which data sets belong to it."""


@tell_errors
def main(arguments: list[str] | None = None) -> None:
    """Print the scores of a file of answers."""
    parser = make_parser("hidden.judge", __doc__)
    parser.add_argument("folder", type=Path, help="folder that `socast.tools.bench.hidden --export` made")
    parser.add_argument("answers", type=Path, help="JSON file: a list of names for each data set")
    options = parser.parse_args(arguments)
    truths, answers = (_read(path) for path in (options.folder / "truth.json", options.answers))
    rows = [
        (score.what, f"{100 * score.right / score.of:.1f} %", str(score.of), f"{100 * low:.1f} to {100 * high:.1f} %")
        for score in judge(answers, truths)
        for low, high in [score.interval]
    ]
    show_table("Hidden effects", ("figure", "right", "of", "95 % interval"), rows, "-nn-")


def _read(path: Path) -> dict[str, Any]:
    """Return the object that a JSON file holds."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise SettingsError(f"{path} cannot be read: {error}") from None
    if not isinstance(content, dict):
        raise SettingsError(f"{path} is not a JSON object with one entry for each data set")
    return content


if __name__ == "__main__":
    sys.exit(main())
