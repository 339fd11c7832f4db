"""The report of a diagnosis: a story in the terminal, and one page of tables and figures."""

from collections.abc import Callable, Mapping, Sequence
from html import escape
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

from rich.console import Console
from rich.padding import Padding
from rich.text import Text

from core.evaluate.paper.results import to_json_values
from tools.report.diagnosis import figures, sentences, tables
from tools.report.evaluation.illustrations import Illustration
from tools.report.evaluation.result import Result, get_mapping
from tools.report.evaluation.sections import Section
from tools.report.evaluation.terminal import print_section
from tools.report.page import render_document, save

DRAWN: Final[Mapping[str, Callable[[Result], list[Illustration]]]] = MappingProxyType(
    {
        "error": figures.draw_errors,
        "slices": figures.draw_slices,
        "missing": figures.draw_effects,
        "remains": figures.draw_remainder,
    }
)
"""Figures of a section, by its key."""


def show(result: Any, console: Console, *, suggested: str | None = None) -> None:
    """Print a diagnosis as a story: what was looked at, how far off, where, why, what next.

    Parameters
    ----------
    result : mapping
        As `core.diagnose.diagnosis` makes it; what it lacks is left out.
    console : Console
        At least 120 columns wide.
    suggested : str, optional
        The file that the suggestion was written to.
    """
    found = to_json_values(result)
    model = get_mapping(found, "model")
    print_heading(f"Diagnosis of {model.get('name')}, version {model.get('version')}", console)
    print_lines(sentences.describe_data(found), console)
    print_heading("How far off", console)
    print_lines(sentences.describe_error(found), console)
    where = tables.tabulate_slices(found)
    if where.rows:
        print_section(Section("slices", "Where it fails", "", [where._replace(title="")]), console)
    else:
        print_heading("Where it fails", console)
        print_lines(
            ["No kind of ride stands out: the model errs everywhere alike, or the rides are too few to tell."], console
        )
    _show_missing(found, console)
    print_heading("What remains", console)
    print_lines([*sentences.describe_remainder(found), *sentences.describe_suggestion(found, suggested)], console)
    print_heading("Next", console)
    print_lines(sentences.describe_next_step(found), console, strong=True)


def print_step(result: Any, step: int, console: Console) -> None:
    """Print in a few lines what a step of the loop found."""
    found = to_json_values(result)
    print_heading(f"Step {step}", console)
    first = next((m for m in found.get("missing") or () if m.get("effect") == found.get("verdict")), None)
    if first is None:
        print_lines(["Nothing more is to be gained."], console)
        return
    said = sentences.describe_missing_effect(first)
    print_lines(
        [sentences.describe_error(found)[0], f"Missing: {sentences.name_effect(first)}: {said[0]}", *said[1:]], console
    )
    if found.get("structure_remains"):
        print_lines(
            ["Beside it structure remains:", *sentences.describe_signs(dict(found.get("structure") or {}))], console
        )


def print_heading(title: str, console: Console) -> None:
    """Print the title of a part."""
    console.print()
    console.rule(Text(title, style="bold"), align="left")


def print_lines(lines: Sequence[str], console: Console, *, strong: bool = False) -> None:
    """Print sentences; a command stays in one line, to be copied."""
    for line in lines:
        command = line.startswith("socast ")
        console.print(Text(line, style="bold" if strong else ""), soft_wrap=command, highlight=False)


def _show_missing(found: Result, console: Console) -> None:
    """Print what is missing, effect by effect."""
    print_heading("What is missing", console)
    missing = found.get("missing") or ()
    if not missing:
        print_lines(["Nothing that the library knows, beyond chance."], console)
    for place, one in enumerate(missing, start=1):
        first, *more = sentences.describe_missing_effect(one)
        console.print(Text(f"{place}. {sentences.name_effect(one)}: ", style="bold").append(first, style="not bold"))
        for line in more:
            console.print(Padding(Text(f"- {line}"), (0, 0, 0, 3)))


def write(result: Any, path: Path, *, suggested: str | None = None) -> None:
    """Write a diagnosis as a page that needs nothing else."""
    found = to_json_values(result)
    model = get_mapping(found, "model")
    title = f"Diagnosis of {model.get('name')}, version {model.get('version')}"
    lead = "".join(
        f"<p>{escape(line)}</p>" for line in (*sentences.describe_data(found), *sentences.describe_next_step(found))
    )
    page = render_document(
        title,
        lead,
        build_sections(found, suggested),
        lambda key: _drawn(found, key),
        "<p>Made by <code>socast diagnose</code>.</p>",
    )
    save(page, path)


def _drawn(found: Result, key: str) -> list[Illustration]:
    """Return the figures of a section."""
    make = DRAWN.get(key)
    return [] if make is None else make(found)


def build_sections(found: Result, suggested: str | None = None) -> list[Section]:
    """Return the sections of the page that have something to show."""
    told = [line for one in found.get("missing") or () for line in sentences.describe_rivals(one)]
    shown = [
        Section("error", "How far off", " ".join(sentences.describe_error(found)), [tables.tabulate_errors(found)]),
        Section("slices", "Where it fails", "", [tables.tabulate_slices(found)]),
        Section("missing", "What is missing", _sentences(found), [tables.tabulate_missing_effects(found)]),
        Section("remains", "What remains", " ".join(_remains(found, suggested)), [tables.tabulate_structure(found)]),
        Section("candidates", "All that was asked", " ".join(told), [tables.tabulate_candidates(found)]),
    ]
    return [section for section in shown if section.text or any(table.rows for table in section.tables)]


def _remains(found: Result, suggested: str | None) -> list[str]:
    return [
        line if line.endswith((".", ":")) else f"{line}."
        for line in (*sentences.describe_remainder(found), *sentences.describe_suggestion(found, suggested))
    ]


def _sentences(found: Result) -> str:
    """Return what is missing, a sentence each."""
    said = [f"{sentences.describe_missing_effect(one)[0]}." for one in found.get("missing") or ()]
    return " ".join(each[:1].upper() + each[1:] for each in said) or "Nothing that the library knows, beyond chance."
