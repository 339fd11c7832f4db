"""Write the figures and tables about hidden effects for the pages."""

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from typing import Final

import numpy as np

from socast.tools.bench.figures.published import write_table
from socast.tools.bench.hidden.baselines import DESCRIPTIONS
from socast.tools.bench.hidden.cases import ABSORBED, SHAPES, SHARES
from socast.tools.bench.hidden.evaluation import RATIO, Record
from socast.tools.bench.hidden.figures import (
    FILE,
    LEAST,
    compute_error_reduction,
    compute_figures,
    compute_hit_rate,
    format_rate,
    get_share,
    is_absorbed,
    is_right,
    list_stated,
    select_counted,
    select_far,
    select_part,
    summarise_timing,
    tabulate_reliability,
)
from socast.tools.simulator.hidden_shapes import BENT, OTHER, get_right_names, strip_shape

_VALUES: Final = {
    "V·I, 1.5 % or more, all: truth first": "vi",
    "SOC only, 3 % or more, all: truth first": "soc",
    "all of these: wrong name first": "wrong",
    "names given with 90 % or more are right": "sure",
    "truth not in the library: wrong and sure": "outside",
}
"""Figures that are among the results."""

Lines = list[str]


def make_lines(records: Sequence[Record]) -> list[str]:
    """Return the lines for the pages."""
    lines = [
        _describe_run(records),
        "",
        *write_table(
            ["figure", "goal", "is", "95 % interval", "of", ""],
            [
                (each.what, each.goal or "reported", each.text, each.interval, f"{each.of:,}", each.verdict)
                for each in compute_figures(records)
                if each.of
            ],
        ),
    ]
    seconds, ratio, count = summarise_timing(records)
    if count:
        lines.append(
            "| time for about 1,300 rides (480,000 samples), given their tables | reported "
            f"| {seconds:.1f} s, {ratio:,.0f} times STLSQ of the same windows and candidates | | {count} | |"
        )
    absorbed = "; ".join(f"`{effect}`: {why}" for effect, why in ABSORBED.items())
    lines += [
        "",
        (
            "An effect is *visible* if its true energy in each window, as a candidate of its own, is at least "
            f"{RATIO:g} times more likely than the best form of every other effect. Below that the data do not tell "
            "the effects apart."
        ),
        "",
        f"Effects with the shape of columns of the base leave no error and are counted separately: {absorbed}.",
        "",
        (
            "The error is measured on rides of held-out vehicle-days, and its fall is over all rides together. "
            "`remaining` is the share of an effect that columns of the base cannot explain. `similarity` compares that "
            "remainder with the effect of the library (1: the same shape). Both are medians. Intervals of shares are "
            "Wilson's."
        ),
    ]
    for title, table in (
        ("How often a stated probability is right", _show_reliability(records)),
        ("Other methods on the same windows: truth first among visible effects", tabulate_baselines(records)),
        ("By share: right, wrong, none, in %", tabulate_by_share(records)),
        ("By effect: right in %, first / other / bent shape, by measurement and share in %",
         tabulate_by_effect(records)),
        ("By part, in %", tabulate_by_part(records)),
        ("Most frequent wrong names", tabulate_wrong_names(records)),
    ):  # fmt: skip
        if len(table) > 2:
            lines += ["", f"### {title}", "", *table]
    return lines


def list_values(records: Sequence[Record]) -> dict[str, str]:
    """Return the figures for the table of results."""
    known = {_VALUES[each.what]: each for each in compute_figures(records) if each.what in _VALUES and each.of}
    sets = f"of {sum('refused' not in each for each in records)} simulated data sets"
    out = {}
    if {"vi", "soc"} <= set(known):
        out["right"] = (
            f"{known['vi'].text} ({known['vi'].interval}) with voltage and current, at 1.5 % of the energy or more; "
            f"{known['soc'].text} ({known['soc'].interval}) with the state of charge only, at 3 % or more"
        )
        out["right_on"] = f"{known['vi'].of} and {known['soc'].of} {sets}"
    for name, before in (("wrong", ""), ("sure", "right in "), ("outside", "")):
        if name in known:
            out[name] = f"{before}{known[name].text} ({known[name].interval})"
            out[f"{name}_on"] = f"{known[name].of} {sets}"
    return out


def _show_reliability(records: Sequence[Record]) -> list[str]:
    """Return the table of stated probabilities and a link to its figure; no lines without names."""
    stated = list_stated(records)
    text = "Share of right names against the stated probability; the numbers count names"
    return [*tabulate_reliability(stated), "", f"![{text}]({FILE})"] if stated else []


def _describe_run(records: Sequence[Record]) -> str:
    """Return the description of the run."""
    refused = sum("refused" in r for r in records)
    parts = Counter(r["part"] for r in records if "refused" not in r)
    each = ", ".join(f"{n:,} of `{part}`" for part, n in parts.items())
    apart = f"; {refused} could not be made, as the effect had nothing to act on" if refused else ""
    return (
        f"{sum(parts.values()):,} data sets of about 1,300 rides, 8 cars of 2 models, 39 days each over ten months: "
        f"{each}{apart}. "
        "A result is right if the first name is the hidden effect."
    )


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
    heads = ["effect", "remaining", "similarity", *(f"{_SHORT[m]} {100 * size:.3g}" for m, size in columns)]
    rows = []
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
        rows.append([effect + (" (absorbed)" if effect in ABSORBED else ""), *visibility, *cells])
    return write_table(heads, rows)


def get_shape(record: Record) -> str:
    """Return the shape of the first hidden effect: `first`, `other` or `bent`."""
    effect = record["hidden"][0][0]
    return "other" if effect.endswith(OTHER) else "bent" if BENT in effect else "first"


def tabulate_by_share(records: Sequence[Record]) -> Lines:
    """Tabulate right, wrong and no names by measurement, weather, shape and share, without absorbed effects."""
    one = select_part(records, "one")
    heads = [f"{100 * share:g} %: right, wrong, none" for share in SHARES]
    rows = []
    keys = sorted({(r["measurement"], r["weather"], get_shape(r)) for r in one}, reverse=True)
    for measurement, weather, shape in keys:
        group = [r for r in one if (r["measurement"], r["weather"], get_shape(r)) == (measurement, weather, shape)]
        cells = [_three([r for r in group if get_share(r) == size]) for size in SHARES]
        labels = [_SHORT[measurement], "exact" if weather == "none" else "30 % off", shape]
        rows.append([*labels, *cells, _percentage(compute_error_reduction(select_far(group)))])
    return write_table(["measurement", "weather", "shape", *heads, "error reduction"], rows)


def tabulate_by_part(records: Sequence[Record]) -> Lines:
    """Return a table of all parts, with the effects that the base absorbs apart."""
    done = [r for r in records if "refused" not in r]
    heads = [
        "part",
        "measurement",
        "data sets",
        "right, wrong, none",
        "set of a name holds the truth",
        "names per data set",
    ]
    rows = []
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
                holds = format_rate([r["set_holds"] for r in group if r["names"]])
                rows.append([what, _SHORT[measurement], str(len(group)), _three(group), holds, f"{names:.2f}"])
    return write_table(heads, rows)


def tabulate_baselines(records: Sequence[Record]) -> Lines:
    """Return a table of how often diagnosis and each baseline name the truth first, among visible effects."""
    visible = {m: [r for r in select_counted(records, m) if r["visible"]] for m in LEAST}
    heads = [f"{_SHORT[m]}, {100 * least:g} % or more ({len(visible[m])})" for m, least in LEAST.items()]
    rows = []
    if any(visible.values()):
        rows.append(["`socast diagnose`", *(format_rate([is_right(r) for r in some]) for some in visible.values())])
    for method, what in DESCRIPTIONS.items():
        if any(method in r["baselines"] for some in visible.values() for r in some):
            rows.append([what, *(format_rate([_leads(r, method) for r in some]) for some in visible.values())])
    return write_table(["method", *heads], rows)


def _leads(record: Record, method: str) -> bool:
    """Return whether a baseline names the truth first."""
    ranked = record["baselines"].get(method, [])
    return bool(ranked) and ranked[0] in get_right_names(record["hidden"][0][0])


def tabulate_wrong_names(records: Sequence[Record]) -> Lines:
    """Return a table of the most frequent wrong names and of the effects that were hidden."""
    pairs: dict[tuple[str, str], int] = {}
    for r in records:
        if "refused" not in r and r["outcome"] == "wrong" and r["part"] in {"one", "outside", "none"}:
            hidden = " + ".join(sorted(strip_shape(effect) for effect, _ in r["hidden"])) or "nothing"
            key = hidden, r["missing"][0]["effect"]
            pairs[key] = pairs.get(key, 0) + 1
    frequent = sorted(pairs.items(), key=lambda item: -item[1])[:12]
    return write_table(["hidden", "named", "data sets"], [(hidden, named, str(n)) for (hidden, named), n in frequent])


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
