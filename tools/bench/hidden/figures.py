"""Figures of all records: against the goals, by effect, by share."""

from collections.abc import Callable, Iterable, Sequence
from typing import Final, NamedTuple

import numpy as np

from tools.bench.hidden.cases import strip_shape
from tools.bench.hidden.evaluation import Record
from tools.bench.hidden.parts import ABSORBED, PAIR_SHARE, SHARES
from tools.simulator.hidden_shapes import OTHER

GOOD: Final = frozenset({"right", "group"})
LEAST: Final = {"vi": 0.015, "soc": 0.03}
"""Share of the energy from which on an effect should be named."""
VISIBLE: Final = 4.0
"""Standard errors from which on what is hidden can be seen."""
Lines = list[str]


class Figure(NamedTuple):
    """A figure and its goal.

    Parameters
    ----------
    what : str
    goal : str
    value : float
        NaN where nothing was run.
    text : str
        The value as it is read.
    of : int
        Data sets, or names, that it is of.
    met : bool
    """

    what: str
    goal: str
    value: float
    text: str
    of: int
    met: bool


def compute_figures(records: Sequence[Record]) -> list[Figure]:
    """Return the figures that have goals."""
    done = [r for r in records if "refused" not in r]
    one = [r for r in _part(done, "one") if not is_absorbed(r)]
    vi, soc = select_counted(records, "vi"), select_counted(records, "soc")
    two = _part(done, "two")
    none, outside = _part(done, "none"), [r for r in _part(done, "outside") if not is_absorbed(r)]
    sure = [r for r in outside if r["names"] and not r["doubt"]]
    held = [i["holds"] for r in [*one, *two] for i in r["intervals"] if i["right"]]
    named = [r for r in vi if r["names"]]
    return [
        _at_least(
            "right effect (or a group holding it) first, V·I, at 1.5 % or more", 0.97, compute_hit_rate(vi), len(vi)
        ),
        _at_least("the same, SOC only, at 3 % or more", 0.90, compute_hit_rate(soc), len(soc)),
        _at_least("two effects: both in the first two steps", 0.90, _mean(r["found"] == 2 for r in two), len(two)),
        _names(none),
        _at_most(
            "true effect not in the library: wrong name without mark of doubt", 0.03, _rate(sure, outside), len(outside)
        ),
        _between("95 % intervals of the coefficient hold the truth", 0.90, 0.98, _mean(held), len(held)),
        _at_least(
            "error after adding, of the way to the model that knows the truth",
            0.90,
            compute_error_reduction(named),
            len(named),
        ),
    ]


def select_counted(records: Sequence[Record], measurement: str) -> list[Record]:
    """Return the records of one effect that count towards the goal of a measurement."""
    one = [r for r in _part(records, "one") if "refused" not in r and not is_absorbed(r)]
    return [r for r in one if r["measurement"] == measurement and get_share(r) >= LEAST[measurement]]


def summarise_timing(records: Sequence[Record]) -> tuple[float, float, int]:
    """Return the median seconds of diagnosis, over those of sparse regression, and how many were timed."""
    timed = [r for r in records if r.get("stlsq_seconds")]
    if not timed:
        return float("nan"), float("nan"), 0
    seconds = float(np.median([r["seconds"] for r in timed]))
    return seconds, seconds / float(np.median([r["stlsq_seconds"] for r in timed])), len(timed)


def compute_hit_rate(records: Sequence[Record]) -> float:
    """Return the share whose first name is right, or a group that holds it."""
    return _mean(r["outcome"] in GOOD for r in records)


def compute_error_reduction(records: Sequence[Record]) -> float:
    """Return how far the error has gone towards that of the model that knows the truth, of all rides together."""
    gone = sum(r["errors"]["before"] - r["errors"]["after"] for r in records)
    whole = sum(r["errors"]["before"] - r["errors"]["truth"] for r in records)
    return gone / whole if whole > 0.0 else float("nan")


def is_absorbed(record: Record) -> bool:
    """Tell whether the base's own columns take up what is hidden."""
    return any(strip_shape(effect) in ABSORBED for effect, _ in record["hidden"])


def get_share(record: Record) -> float:
    """Return the share of the energy of the first hidden effect."""
    return float(record["hidden"][0][1])


def tabulate_by_effect(records: Sequence[Record]) -> Lines:
    """Return a table: each effect's hits by measurement and share, the simulator's own shape and the other.

    Before them, how much of the effect the base cannot take up, and how like that is to the library's.
    """
    one = [r for r in _part(records, "one") if "refused" not in r]
    wanted = [*(("vi", size) for size in SHARES), *(("soc", size) for size in SHARES)]
    lines = _head(["effect", "left", "alike", *(f"{_SHORT[m]} {size:.3g}" for m, size in _percent(wanted))])
    for effect in sorted({strip_shape(r["hidden"][0][0]) for r in one}, key=lambda e: (e in ABSORBED, e)):
        own = [r for r in one if strip_shape(r["hidden"][0][0]) == effect]
        cells = [
            "/".join(_cell([r for r in here if has_other_shape(r) == other]) for other in (False, True))
            for m, size in wanted
            for here in [[r for r in own if r["measurement"] == m and get_share(r) == size]]
        ]
        seen = [
            "/".join(_median(r[key] for r in own if has_other_shape(r) == o) for o in (False, True)) for key in _SEEN
        ]
        lines.append(_row([effect + (" (absorbed)" if effect in ABSORBED else ""), *seen, *cells]))
    return lines


def has_other_shape(record: Record) -> bool:
    """Tell whether what is hidden has the other shape."""
    return any(effect.endswith(OTHER) for effect, _ in record["hidden"])


def tabulate_by_share(records: Sequence[Record]) -> Lines:
    """Return a table: hits, wrong names and no names by measurement, weather, shape and share, none of the absorbed."""
    one = [r for r in _part(records, "one") if "refused" not in r and not is_absorbed(r)]
    lines = _head(
        ["measurement", "weather", "shape", *(f"{100 * s:g} %: right, wrong, none" for s in SHARES), "of the way"]
    )
    keys = sorted({(r["measurement"], r["weather"], has_other_shape(r)) for r in one}, reverse=True)
    for measurement, weather, other in keys:
        own = [r for r in one if (r["measurement"], r["weather"], has_other_shape(r)) == (measurement, weather, other)]
        cells = [_three([r for r in own if get_share(r) == size]) for size in SHARES]
        told = [_SHORT[measurement], "exact" if weather == "none" else "30 % off", "other" if other else "own"]
        lines.append(_row([*told, *cells, _percentage(compute_error_reduction([r for r in own if r["names"]]))]))
    return lines


def tabulate_by_part(records: Sequence[Record]) -> Lines:
    """Return a table of the parts that have no goals of their own, and of what is counted apart."""
    done = [r for r in records if "refused" not in r]
    lines = _head(["part", "measurement", "data sets", "right, wrong, none", "right scope too", "names each"])
    told: list[tuple[str, Callable[[Record], bool]]] = [
        (f"one vehicle only, {PAIR_SHARE:.0%} of its energy", lambda r: r["part"] == "vehicle" and not is_absorbed(r)),
        ("the same, of the base's shape", lambda r: r["part"] == "vehicle" and is_absorbed(r)),
        (f"from a date on, {PAIR_SHARE:.0%} of the energy since", lambda r: r["part"] == "date" and not is_absorbed(r)),
        ("the same, of the base's shape", lambda r: r["part"] == "date" and is_absorbed(r)),
        (
            "everywhere, of the base's shape: no error is left to explain",
            lambda r: r["part"] == "one" and is_absorbed(r),
        ),
        ("out of the library", lambda r: r["part"] == "outside" and not is_absorbed(r)),
        ("nothing hidden", lambda r: r["part"] == "none"),
    ]
    for what, belongs in told:
        for measurement in ("vi", "soc"):
            own = [r for r in done if r["measurement"] == measurement and belongs(r)]
            if own:
                scope = _mean(r["scope_right"] and r["outcome"] in GOOD for r in own)
                names = _mean(r["names"] for r in own)
                told_scope = _percentage(scope) if own[0]["part"] in {"vehicle", "date"} else ""
                lines.append(_row([what, _SHORT[measurement], str(len(own)), _three(own), told_scope, f"{names:.2f}"]))
    return lines


def tabulate_wrong_names(records: Sequence[Record], most: int = 12) -> Lines:
    """Return a table of the names that were wrong most often, beside what was hidden."""
    pairs: dict[tuple[str, str], int] = {}
    for r in records:
        if "refused" not in r and r["names"] and r["outcome"] not in GOOD and r["part"] in {"one", "outside", "none"}:
            hidden = " + ".join(sorted(strip_shape(effect) for effect, _ in r["hidden"])) or "nothing"
            key = hidden, r["missing"][0]["effect"]
            pairs[key] = pairs.get(key, 0) + 1
    lines = _head(["hidden", "named", "data sets"])
    found = sorted(pairs.items(), key=lambda item: -item[1])[:most]
    return lines + [_row([hidden, named, str(n)]) for (hidden, named), n in found]


_SEEN: Final = ("left", "alike")
_SHORT: Final = {"vi": "V·I", "soc": "SOC"}


def _part(records: Sequence[Record], part: str) -> list[Record]:
    return [r for r in records if r["part"] == part]


def _mean(values: Iterable[float]) -> float:
    found = [float(value) for value in values]
    return sum(found) / len(found) if found else float("nan")


def _median(values: Iterable[float]) -> str:
    found = list(values)
    return f"{np.median(found):.2f}" if found else "–"


def _rate(some: Sequence[Record], of: Sequence[Record]) -> float:
    return len(some) / len(of) if of else float("nan")


def _percentage(value: float) -> str:
    return "" if np.isnan(value) else f"{100 * value:.0f} %"


def _at_least(what: str, goal: float, value: float, count: int) -> Figure:
    return Figure(what, f"{goal:.0%}".replace("%", " %"), value, _percentage(value), count, value >= goal)


def _at_most(what: str, goal: float, value: float, count: int) -> Figure:
    text = "" if np.isnan(value) else f"{100 * value:.1f} %"
    return Figure(what, f"{100 * goal:g} % or fewer", value, text, count, value <= goal)


def _between(what: str, low: float, high: float, value: float, count: int) -> Figure:
    return Figure(what, f"{100 * low:g} to {100 * high:g} %", value, _percentage(value), count, low <= value <= high)


def _names(none: Sequence[Record]) -> Figure:
    value = _mean(r["names"] for r in none)
    text = "" if np.isnan(value) else f"{value:.2f}"
    return Figure("names given when nothing is hidden", "0.1 a data set or fewer", value, text, len(none), value <= 0.1)


def _three(records: Sequence[Record]) -> str:
    """Return the percentages of right, wrong and no names."""
    if not records:
        return ""
    good, no = compute_hit_rate(records), _mean(r["names"] == 0 for r in records)
    return f"{100 * good:.0f}, {100 * (1 - good - no):.0f}, {100 * no:.0f}"


def _cell(records: Sequence[Record]) -> str:
    return f"{100 * compute_hit_rate(records):.0f}" if records else "–"


def _percent(pairs: Sequence[tuple[str, float]]) -> list[tuple[str, float]]:
    return [(measurement, 100 * size) for measurement, size in pairs]


def _head(columns: Sequence[str]) -> Lines:
    return [_row(columns), "|" + "---|" * len(columns)]


def _row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"
