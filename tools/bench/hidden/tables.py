"""Tabulate records by effect, share and part, and beside the baselines."""

from collections.abc import Callable, Iterable, Sequence
from typing import Final

import numpy as np

from socast.tools.bench.hidden.baselines import DESCRIPTIONS
from socast.tools.bench.hidden.cases import get_right_names
from socast.tools.bench.hidden.figures import (
    LEAST,
    compute_error_reduction,
    compute_hit_rate,
    format_rate,
    get_share,
    is_absorbed,
    is_right,
    select_counted,
    select_far,
    select_part,
)
from socast.tools.bench.hidden.grading import Record
from socast.tools.bench.hidden.parts import ABSORBED, SHAPES, SHARES
from socast.tools.simulator.bent_shapes import BENT
from socast.tools.simulator.hidden_shapes import OTHER, strip_shape

Lines = list[str]


def tabulate_by_effect(records: Sequence[Record]) -> Lines:
    """Return a table of the hit rate of each effect by measurement and share, in each shape.

    Returns
    -------
    list of str
        Lines of the table. The first columns give the part of the effect that the base cannot explain, and the
        similarity of that part to the effect of the library.
    """
    one = [r for r in records if r["part"] == "one" and "refused" not in r]
    columns = [*(("vi", size) for size in SHARES), *(("soc", size) for size in SHARES)]
    lines = _head(["effect", "remaining", "similarity", *(f"{_SHORT[m]} {size:.3g}" for m, size in _percent(columns))])
    for effect in sorted({strip_shape(r["hidden"][0][0]) for r in one}, key=lambda e: (e in ABSORBED, e)):
        group = [r for r in one if strip_shape(r["hidden"][0][0]) == effect]
        cells = [
            "/".join(_cell([r for r in here if get_shape(r) == shape]) for shape in SHAPES)
            for m, size in columns
            for here in [[r for r in group if r["measurement"] == m and get_share(r) == size]]
        ]
        visibility = [
            "/".join(_median(r[key] for r in group if get_shape(r) == shape) for shape in SHAPES) for key in _SEEN
        ]
        lines.append(_row([effect + (" (absorbed)" if effect in ABSORBED else ""), *visibility, *cells]))
    return lines


def get_shape(record: Record) -> str:
    """Return the shape of the first hidden effect: `first`, `other` or `bent`."""
    effect = record["hidden"][0][0]
    return "other" if effect.endswith(OTHER) else "bent" if BENT in effect else "first"


def tabulate_by_share(records: Sequence[Record]) -> Lines:
    """Tabulate right, wrong and no names by measurement, weather, shape and share, without absorbed effects."""
    one = select_part(records, "one")
    lines = _head(
        ["measurement", "weather", "shape", *(f"{100 * s:g} %: right, wrong, none" for s in SHARES), "error reduction"]
    )
    keys = sorted({(r["measurement"], r["weather"], get_shape(r)) for r in one}, reverse=True)
    for measurement, weather, shape in keys:
        group = [r for r in one if (r["measurement"], r["weather"], get_shape(r)) == (measurement, weather, shape)]
        cells = [_three([r for r in group if get_share(r) == size]) for size in SHARES]
        labels = [_SHORT[measurement], "exact" if weather == "none" else "30 % off", shape]
        lines.append(_row([*labels, *cells, _percentage(compute_error_reduction(select_far(group)))]))
    return lines


def tabulate_by_part(records: Sequence[Record]) -> Lines:
    """Return a table of all parts, with the effects that the base absorbs apart."""
    done = [r for r in records if "refused" not in r]
    lines = _head(
        ["part", "measurement", "data sets", "right, wrong, none", "set holds the truth", "names per data set"]
    )
    labels: list[tuple[str, Callable[[Record], bool]]] = [
        ("one effect", lambda r: r["part"] == "one" and not is_absorbed(r)),
        ("one effect with the shape of the base: no error remains", lambda r: r["part"] == "one" and is_absorbed(r)),
        ("two effects: one of them first", lambda r: r["part"] == "two"),
        ("not in the library", lambda r: r["part"] == "outside" and not is_absorbed(r)),
        ("nothing hidden", lambda r: r["part"] == "none"),
    ]
    for what, belongs in labels:
        for measurement in LEAST:
            group = [r for r in done if r["measurement"] == measurement and belongs(r)]
            if group:
                names = sum(len(r["names"]) for r in group) / len(group)
                holds = format_rate([r["set_holds"] for r in group])
                lines.append(_row([what, _SHORT[measurement], str(len(group)), _three(group), holds, f"{names:.2f}"]))
    return lines


def tabulate_baselines(records: Sequence[Record]) -> Lines:
    """Return a table of how often diagnosis and each baseline name the truth first, among visible effects."""
    visible = {m: [r for r in select_counted(records, m) if r["visible"]] for m in LEAST}
    heads = [f"{_SHORT[m]}, {100 * least:g} % or more ({len(visible[m])})" for m, least in LEAST.items()]
    lines = _head(["method", *heads])
    if not any(visible.values()):
        return lines
    lines.append(_row(["`socast diagnose`", *(format_rate([is_right(r) for r in some]) for some in visible.values())]))
    for method, what in DESCRIPTIONS.items():
        if any(method in r["baselines"] for some in visible.values() for r in some):
            cells = [format_rate([_leads(r, method) for r in some]) for some in visible.values()]
            lines.append(_row([what, *cells]))
    return lines


def _leads(record: Record, method: str) -> bool:
    """Return whether a baseline names the truth first."""
    ranked = record["baselines"].get(method, [])
    return bool(ranked) and ranked[0] in get_right_names(record["hidden"][0][0])


def tabulate_wrong_names(records: Sequence[Record], most: int = 12) -> Lines:
    """Return a table of the most frequent wrong names and of the effects that were hidden."""
    pairs: dict[tuple[str, str], int] = {}
    for r in records:
        if "refused" not in r and r["outcome"] == "wrong" and r["part"] in {"one", "outside", "none"}:
            hidden = " + ".join(sorted(strip_shape(effect) for effect, _ in r["hidden"])) or "nothing"
            key = hidden, r["missing"][0]["effect"]
            pairs[key] = pairs.get(key, 0) + 1
    lines = _head(["hidden", "named", "data sets"])
    frequent = sorted(pairs.items(), key=lambda item: -item[1])[:most]
    return lines + [_row([hidden, named, str(n)]) for (hidden, named), n in frequent]


_SEEN: Final = ("left", "alike")
_SHORT: Final = {"vi": "V·I", "soc": "SOC"}


def _median(values: Iterable[float]) -> str:
    """Return the median of values as text."""
    present = list(values)
    return f"{np.median(present):.2f}" if present else "–"


def _percentage(value: float) -> str:
    """Return a share as text."""
    return "" if np.isnan(value) else f"{100 * value:.0f} %"


def _three(records: Sequence[Record]) -> str:
    """Return the percentages of right, wrong and no names."""
    if not records:
        return ""
    shares = [sum(r["outcome"] == outcome for r in records) / len(records) for outcome in ("right", "wrong", "none")]
    return ", ".join(f"{100 * share:.0f}" for share in shares)


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
