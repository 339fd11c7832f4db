"""Summarise all records: figures with goals, and tables by effect, share and part."""

from collections.abc import Callable, Iterable, Sequence
from typing import Final, NamedTuple

import numpy as np

from tools.bench.hidden.cases import strip_shape
from tools.bench.hidden.evaluation import Record
from tools.bench.hidden.parts import ABSORBED, PAIR_SHARE, SHARES
from tools.simulator.hidden_shapes import OTHER

GOOD: Final = frozenset({"right", "group"})
LEAST: Final = {"vi": 0.015, "soc": 0.03}
"""Share of the energy from which on diagnosis should name an effect. [1]"""
VISIBLE: Final = 4.0
"""Number of standard errors from which on a hidden effect counts as visible."""
Lines = list[str]


class Figure(NamedTuple):
    """Hold a figure and its goal.

    Parameters
    ----------
    what, goal : str
        Description and goal.
    value : float
        Value, NaN if nothing was run.
    text : str
        The value as text.
    of : int
        Number of data sets or names behind the value.
    met : bool
        Whether the value meets the goal.
    """

    what: str
    goal: str
    value: float
    text: str
    of: int
    met: bool


def compute_figures(records: Sequence[Record]) -> list[Figure]:
    """Return the figures that have goals.

    Parameters
    ----------
    records : sequence of Record
        Records of all data sets.
    """
    done = [r for r in records if "refused" not in r]
    one = [r for r in _part(done, "one") if not is_absorbed(r)]
    vi, soc = select_counted(records, "vi"), select_counted(records, "soc")
    two = _part(done, "two")
    none, outside = _part(done, "none"), [r for r in _part(done, "outside") if not is_absorbed(r)]
    sure = [r for r in outside if r["names"] and not r["doubt"]]
    contained = [i["holds"] for r in [*one, *two] for i in r["intervals"] if i["right"]]
    named = [r for r in vi if r["names"]]
    return [
        _at_least(
            "right effect (or a group that holds it) first, V·I, at 1.5 % or more", 0.97, compute_hit_rate(vi), len(vi)
        ),
        _at_least("the same, SOC only, at 3 % or more", 0.90, compute_hit_rate(soc), len(soc)),
        _at_least("two effects: both in the first two steps", 0.90, _mean(r["found"] == 2 for r in two), len(two)),
        _names(none),
        _at_most(
            "true effect not in the library: wrong name without a sign of doubt",
            0.03,
            _rate(sure, outside),
            len(outside),
        ),
        _between("95 % intervals of the coefficient contain the truth", 0.90, 0.98, _mean(contained), len(contained)),
        _at_least(
            "error reduction by adding, relative to that of the model that knows the truth",
            0.90,
            compute_error_reduction(named),
            len(named),
        ),
    ]


def select_counted(records: Sequence[Record], measurement: str) -> list[Record]:
    """Return the records of one hidden effect that count towards the goal of a measurement.

    Parameters
    ----------
    records : sequence of Record
        Records of all data sets.
    measurement : {"vi", "soc"}
        The measurement.
    """
    one = [r for r in _part(records, "one") if "refused" not in r and not is_absorbed(r)]
    return [r for r in one if r["measurement"] == measurement and get_share(r) >= LEAST[measurement]]


def summarise_timing(records: Sequence[Record]) -> tuple[float, float, int]:
    """Return the median time of diagnosis [s], its ratio to that of sparse regression, and the number of timings.

    Parameters
    ----------
    records : sequence of Record
        Records of all data sets.
    """
    timed = [r for r in records if r.get("stlsq_seconds")]
    if not timed:
        return float("nan"), float("nan"), 0
    seconds = float(np.median([r["seconds"] for r in timed]))
    return seconds, seconds / float(np.median([r["stlsq_seconds"] for r in timed])), len(timed)


def compute_hit_rate(records: Sequence[Record]) -> float:
    """Return the share of records whose first name is right or stands for a group that holds the right one.

    Parameters
    ----------
    records : sequence of Record
        The records.
    """
    return _mean(r["outcome"] in GOOD for r in records)


def compute_error_reduction(records: Sequence[Record]) -> float:
    """Return the reduction of the error divided by that of the model that knows the truth, over all rides together.

    Parameters
    ----------
    records : sequence of Record
        The records.
    """
    reduction = sum(r["errors"]["before"] - r["errors"]["after"] for r in records)
    best = sum(r["errors"]["before"] - r["errors"]["truth"] for r in records)
    return reduction / best if best > 0.0 else float("nan")


def is_absorbed(record: Record) -> bool:
    """Return whether columns of the base explain the hidden effect.

    Parameters
    ----------
    record : Record
        The record.
    """
    return any(strip_shape(effect) in ABSORBED for effect, _ in record["hidden"])


def get_share(record: Record) -> float:
    """Return the share of the energy of the first hidden effect.

    Parameters
    ----------
    record : Record
        The record.
    """
    return float(record["hidden"][0][1])


def tabulate_by_effect(records: Sequence[Record]) -> Lines:
    """Return a table of the hit rate of each effect by measurement and share, in the first and the other shape.

    Parameters
    ----------
    records : sequence of Record
        Records of all data sets.

    Returns
    -------
    list of str
        Lines of the table. The first columns give the part of the effect that the base cannot explain, and the
        similarity of that part to the effect of the library.
    """
    one = [r for r in _part(records, "one") if "refused" not in r]
    columns = [*(("vi", size) for size in SHARES), *(("soc", size) for size in SHARES)]
    lines = _head(["effect", "remaining", "similarity", *(f"{_SHORT[m]} {size:.3g}" for m, size in _percent(columns))])
    for effect in sorted({strip_shape(r["hidden"][0][0]) for r in one}, key=lambda e: (e in ABSORBED, e)):
        group = [r for r in one if strip_shape(r["hidden"][0][0]) == effect]
        cells = [
            "/".join(_cell([r for r in here if has_other_shape(r) == other]) for other in (False, True))
            for m, size in columns
            for here in [[r for r in group if r["measurement"] == m and get_share(r) == size]]
        ]
        visibility = [
            "/".join(_median(r[key] for r in group if has_other_shape(r) == o) for o in (False, True)) for key in _SEEN
        ]
        lines.append(_row([effect + (" (absorbed)" if effect in ABSORBED else ""), *visibility, *cells]))
    return lines


def has_other_shape(record: Record) -> bool:
    """Return whether the hidden effect has the other shape.

    Parameters
    ----------
    record : Record
        The record.
    """
    return any(effect.endswith(OTHER) for effect, _ in record["hidden"])


def tabulate_by_share(records: Sequence[Record]) -> Lines:
    """Return a table of right, wrong and no names by measurement, weather, shape and share, without absorbed effects.

    Parameters
    ----------
    records : sequence of Record
        Records of all data sets.
    """
    one = [r for r in _part(records, "one") if "refused" not in r and not is_absorbed(r)]
    lines = _head(
        ["measurement", "weather", "shape", *(f"{100 * s:g} %: right, wrong, none" for s in SHARES), "error reduction"]
    )
    keys = sorted({(r["measurement"], r["weather"], has_other_shape(r)) for r in one}, reverse=True)
    for measurement, weather, other in keys:
        group = [
            r for r in one if (r["measurement"], r["weather"], has_other_shape(r)) == (measurement, weather, other)
        ]
        cells = [_three([r for r in group if get_share(r) == size]) for size in SHARES]
        labels = [_SHORT[measurement], "exact" if weather == "none" else "30 % off", "other" if other else "first"]
        lines.append(_row([*labels, *cells, _percentage(compute_error_reduction([r for r in group if r["names"]]))]))
    return lines


def tabulate_by_part(records: Sequence[Record]) -> Lines:
    """Return a table of the parts without goals, and of the effects that are counted separately.

    Parameters
    ----------
    records : sequence of Record
        Records of all data sets.
    """
    done = [r for r in records if "refused" not in r]
    lines = _head(["part", "measurement", "data sets", "right, wrong, none", "right scope also", "names per data set"])
    labels: list[tuple[str, Callable[[Record], bool]]] = [
        (f"one vehicle only, {PAIR_SHARE:.0%} of its energy", lambda r: r["part"] == "vehicle" and not is_absorbed(r)),
        ("the same, with the shape of the base", lambda r: r["part"] == "vehicle" and is_absorbed(r)),
        (f"from a date on, {PAIR_SHARE:.0%} of the energy since", lambda r: r["part"] == "date" and not is_absorbed(r)),
        ("the same, with the shape of the base", lambda r: r["part"] == "date" and is_absorbed(r)),
        (
            "everywhere, with the shape of the base: no error remains to explain",
            lambda r: r["part"] == "one" and is_absorbed(r),
        ),
        ("not in the library", lambda r: r["part"] == "outside" and not is_absorbed(r)),
        ("nothing hidden", lambda r: r["part"] == "none"),
    ]
    for what, belongs in labels:
        for measurement in ("vi", "soc"):
            group = [r for r in done if r["measurement"] == measurement and belongs(r)]
            if group:
                scope = _mean(r["scope_right"] and r["outcome"] in GOOD for r in group)
                names = _mean(r["names"] for r in group)
                scope_text = _percentage(scope) if group[0]["part"] in {"vehicle", "date"} else ""
                lines.append(
                    _row([what, _SHORT[measurement], str(len(group)), _three(group), scope_text, f"{names:.2f}"])
                )
    return lines


def tabulate_wrong_names(records: Sequence[Record], most: int = 12) -> Lines:
    """Return a table of the most frequent wrong names and of the effects that were hidden.

    Parameters
    ----------
    records : sequence of Record
        Records of all data sets.
    most : int
        Largest number of lines.
    """
    pairs: dict[tuple[str, str], int] = {}
    for r in records:
        if "refused" not in r and r["names"] and r["outcome"] not in GOOD and r["part"] in {"one", "outside", "none"}:
            hidden = " + ".join(sorted(strip_shape(effect) for effect, _ in r["hidden"])) or "nothing"
            key = hidden, r["missing"][0]["effect"]
            pairs[key] = pairs.get(key, 0) + 1
    lines = _head(["hidden", "named", "data sets"])
    frequent = sorted(pairs.items(), key=lambda item: -item[1])[:most]
    return lines + [_row([hidden, named, str(n)]) for (hidden, named), n in frequent]


_SEEN: Final = ("left", "alike")
_SHORT: Final = {"vi": "V·I", "soc": "SOC"}


def _part(records: Sequence[Record], part: str) -> list[Record]:
    """Return the records of a part."""
    return [r for r in records if r["part"] == part]


def _mean(values: Iterable[float]) -> float:
    """Return the mean of values, NaN if there are none."""
    present = [float(value) for value in values]
    return sum(present) / len(present) if present else float("nan")


def _median(values: Iterable[float]) -> str:
    """Return the median of values as text."""
    present = list(values)
    return f"{np.median(present):.2f}" if present else "–"


def _rate(some: Sequence[Record], of: Sequence[Record]) -> float:
    """Return the share of some records among others, NaN if there are none."""
    return len(some) / len(of) if of else float("nan")


def _percentage(value: float) -> str:
    """Return a share as text."""
    return "" if np.isnan(value) else f"{100 * value:.0f} %"


def _at_least(what: str, goal: float, value: float, count: int) -> Figure:
    """Return a figure whose goal is a lower bound."""
    return Figure(what, f"{goal:.0%}".replace("%", " %"), value, _percentage(value), count, value >= goal)


def _at_most(what: str, goal: float, value: float, count: int) -> Figure:
    """Return a figure whose goal is an upper bound."""
    text = "" if np.isnan(value) else f"{100 * value:.1f} %"
    return Figure(what, f"{100 * goal:g} % or fewer", value, text, count, value <= goal)


def _between(what: str, low: float, high: float, value: float, count: int) -> Figure:
    """Return a figure whose goal is a range."""
    return Figure(what, f"{100 * low:g} to {100 * high:g} %", value, _percentage(value), count, low <= value <= high)


def _names(none: Sequence[Record]) -> Figure:
    """Return the figure of names given although nothing is hidden."""
    value = _mean(r["names"] for r in none)
    text = "" if np.isnan(value) else f"{value:.2f}"
    return Figure(
        "names given when nothing is hidden", "0.1 per data set or fewer", value, text, len(none), value <= 0.1
    )


def _three(records: Sequence[Record]) -> str:
    """Return the percentages of right, wrong and no names."""
    if not records:
        return ""
    good, no = compute_hit_rate(records), _mean(r["names"] == 0 for r in records)
    return f"{100 * good:.0f}, {100 * (1 - good - no):.0f}, {100 * no:.0f}"


def _cell(records: Sequence[Record]) -> str:
    """Return the hit rate as text, a dash if there are no records."""
    return f"{100 * compute_hit_rate(records):.0f}" if records else "–"


def _percent(pairs: Sequence[tuple[str, float]]) -> list[tuple[str, float]]:
    """Return pairs with the share in per cent."""
    return [(measurement, 100 * size) for measurement, size in pairs]


def _head(columns: Sequence[str]) -> Lines:
    """Return the head of a table."""
    return [_row(columns), "|" + "---|" * len(columns)]


def _row(cells: Sequence[str]) -> str:
    """Return a row of a table."""
    return f"| {' | '.join(cells)} |"
