"""Write the section about hidden effects of BENCHMARKS.md."""

import os
import platform
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
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

SECTION: Final = "bench-hidden"
"""Name of the section."""


def make_section(records: Sequence[Record], description: str) -> str:
    """Return the section with its marks.

    Parameters
    ----------
    records : sequence of Record
        Records of all data sets.
    description : str
        Description of the selection that was run.
    """
    begin, end = get_marks(SECTION)
    lines = [
        begin,
        "## Hidden effects",
        "",
        _describe_run(records, description),
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
    return "\n".join([*lines, "", end])


def _show_reliability(records: Sequence[Record]) -> list[str]:
    """Return the table of stated probabilities and a link to its figure; no lines without names."""
    stated = list_stated(records)
    text = "Share of right names against the stated probability; the numbers count names"
    return [*tabulate_reliability(stated), "", f"![{text}]({FILE})"] if stated else []


def _describe_run(records: Sequence[Record], description: str) -> str:
    """Return the description of the run."""
    refused = sum("refused" in r for r in records)
    parts = Counter(r["part"] for r in records if "refused" not in r)
    each = ", ".join(f"{n:,} of `{part}`" for part, n in parts.items())
    apart = f"; {refused} could not be made, as the effect had nothing to act on" if refused else ""
    return (
        f"Written by `make bench-hidden` ({description}), on {os.cpu_count()} cores, "
        f"Python {platform.python_version()}. "
        f"{sum(parts.values()):,} data sets of about 1,300 rides, 8 cars of 2 models, 39 days each over ten months: "
        f"{each}{apart}. "
        "A result is right if the first name is the hidden effect."
    )


def read_section(path: Path, name: str = SECTION) -> str:
    """Return a section of a file with its marks, or an empty text if there is none.

    Parameters
    ----------
    path : Path
        The file.
    name : str
        Name in the marks of the section.
    """
    begin, end = get_marks(name)
    text = path.read_text(encoding="utf-8") if path.exists() else ""
    return begin + text.partition(begin)[2].partition(end)[0] + end if begin in text and end in text else ""


def replace_section(text: str, new: str, name: str = SECTION) -> str:
    """Return a page with a new section in place of the existing one, or at its end.

    Parameters
    ----------
    text : str
        The page.
    new : str
        The section with its marks.
    name : str
        Name in the marks of the section.
    """
    begin, end = get_marks(name)
    if begin in text and end in text:
        before, _, rest = text.partition(begin)
        return before + new + rest.partition(end)[2]
    return text.rstrip("\n") + "\n\n" + new + "\n"


def get_marks(name: str) -> tuple[str, str]:
    """Return the lines that begin and end a section of a page.

    Parameters
    ----------
    name : str
        Name of the section.
    """
    return f"<!-- {name} begins -->", f"<!-- {name} ends -->"
