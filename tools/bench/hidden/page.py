"""Write the figures about hidden effects for the pages."""

from collections import Counter
from collections.abc import Sequence
from typing import Final

from socast.tools.bench.hidden.figures import compute_figures, list_stated, summarise_timing
from socast.tools.bench.hidden.grading import Record
from socast.tools.bench.hidden.parts import ABSORBED
from socast.tools.bench.hidden.reliability import tabulate_reliability
from socast.tools.bench.hidden.reliability_figure import FILE
from socast.tools.bench.hidden.tables import (
    tabulate_baselines,
    tabulate_by_effect,
    tabulate_by_part,
    tabulate_by_share,
    tabulate_wrong_names,
)
from socast.tools.bench.hidden.visibility import RATIO

_VALUES: Final = {
    "V·I, 1.5 % or more, all: truth first": "vi",
    "SOC only, 3 % or more, all: truth first": "soc",
    "all of these: wrong name first": "wrong",
    "names given with 90 % or more are right": "sure",
    "truth not in the library: wrong and sure": "outside",
}
"""Figures that are among the results."""


def make_lines(records: Sequence[Record]) -> list[str]:
    """Return the lines for the pages."""
    lines = [
        _describe_run(records),
        "",
        "| figure | goal | is | 95 % interval | of | |",
        "|---|---|---|---|---|---|",
    ]
    for figure in compute_figures(records):
        if figure.of:
            goal = figure.goal or "reported"
            lines.append(
                f"| {figure.what} | {goal} | {figure.text} | {figure.interval} | {figure.of:,} | {figure.verdict} |"
            )
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
