"""The section of BENCHMARKS.md that tells of hidden effects."""

import os
import platform
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from tools.bench.hidden.evaluation import Record
from tools.bench.hidden.figures import (
    VISIBLE,
    compute_figures,
    compute_hit_rate,
    select_counted,
    summarise_timing,
    tabulate_by_effect,
    tabulate_by_part,
    tabulate_by_share,
    tabulate_wrong_names,
)
from tools.bench.hidden.parts import ABSORBED

BEGIN: Final = "<!-- bench-hidden begins -->"
END: Final = "<!-- bench-hidden ends -->"


def make_section(records: Sequence[Record], told: str) -> str:
    """Return the section, with its marks; `told` says what was run."""
    lines = [
        BEGIN,
        "## Hidden effects",
        "",
        _told(records, told),
        "",
        "| figure | goal | is | of | |",
        "|---|---|---|---|---|",
    ]
    for figure in compute_figures(records):
        if figure.of:
            met = "met" if figure.met else "missed"
            lines.append(f"| {figure.what} | {figure.goal} | {figure.text} | {figure.of:,} | {met} |")
    seconds, ratio, count = summarise_timing(records)
    if count:
        lines.append(
            f"| time for some 1,300 rides (480,000 samples), tables given | told | {seconds:.1f} s, {ratio:,.0f} times "
            f"STLSQ of the same windows and candidates | {count} | |"
        )
    lines += ["", *_apart(records)]
    absorbed = "; ".join(f"`{effect}`: {why}" for effect, why in ABSORBED.items())
    lines += [
        "",
        f"Counted apart are effects of the shape of the base's own columns, which leave no error: {absorbed}.",
        (
            "The error is that of rides of vehicle-days that nothing was fitted to; its way is that of all rides "
            "together, where a name was given. `left` is the share of an effect that the base's own columns cannot "
            "take up, `alike` how like that is to the library's own (1: the very shape), each a median."
        ),
    ]
    for title, table in (
        ("By share: right, wrong, none, in %", tabulate_by_share(records)),
        ("By effect: right in %, own shape / other shape, by measurement and share in %",
         tabulate_by_effect(records)),
        ("Other parts, in %", tabulate_by_part(records)),
        ("Wrong names most often given", tabulate_wrong_names(records)),
    ):  # fmt: skip
        if len(table) > 2:
            lines += ["", f"### {title}", "", *table]
    return "\n".join([*lines, "", END])


def _apart(records: Sequence[Record]) -> list[str]:
    """Return the hits among data sets in which what is hidden can be seen at all."""
    found = []
    for what, some in (
        ("V·I at 1.5 % or more", select_counted(records, "vi")),
        ("SOC at 3 % or more", select_counted(records, "soc")),
    ):
        plain = [r for r in some if r["z"] >= VISIBLE]
        if plain:
            found.append(f"{what}: {100 * compute_hit_rate(plain):.0f} % right of {len(plain):,} of {len(some):,}")
    if not found:
        return []
    return [
        f"Where the true energy itself would stand out by {VISIBLE:g} standard errors or more, were it asked of: "
        + "; ".join(found)
        + "."
    ]


def _told(records: Sequence[Record], told: str) -> str:
    """Return what was run."""
    refused = sum("refused" in r for r in records)
    parts = Counter(r["part"] for r in records if "refused" not in r)
    each = ", ".join(f"{n:,} of `{part}`" for part, n in parts.items())
    apart = f"; {refused} could not be made, as the effect had nothing to act on" if refused else ""
    return (
        f"Written by `make bench-hidden` ({told}), on {os.cpu_count()} cores, Python {platform.python_version()}. "
        f"{sum(parts.values()):,} data sets of some 1,300 rides, 8 cars of 2 models, 39 days each over ten months: "
        f"{each}{apart}. "
        "Right means that the first name is the effect, or that its group holds it."
    )


def read_section(path: Path) -> str:
    """Return the section as it stands in a file, nothing where there is none."""
    text = path.read_text(encoding="utf-8") if path.exists() else ""
    return BEGIN + text.partition(BEGIN)[2].partition(END)[0] + END if BEGIN in text and END in text else ""


def replace_section(text: str, new: str) -> str:
    """Return a page with a section in place of the one that it has, or at its end."""
    if BEGIN in text and END in text:
        before, _, rest = text.partition(BEGIN)
        return before + new + rest.partition(END)[2]
    return text.rstrip("\n") + "\n\n" + new + "\n"
