"""Show a diagnosis as text in the terminal and as one HTML page of tables and figures."""

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from textwrap import wrap
from types import MappingProxyType
from typing import Final

from rich.console import Console
from rich.style import Style
from rich.text import Text

from socast.core.diagnose.records import CarDeviation, Diagnosis, NamedEffect
from socast.tools.report.diagnosis import figures, finding_words, sentences, tables
from socast.tools.report.diagnosis.location_sentences import describe_location
from socast.tools.report.diagnosis.residual_figures import is_drawn, name_figure
from socast.tools.report.document import Illustration, Report, Section, print_heading, print_section
from socast.tools.report.page import COMMAND, NO_BREAK, keep_units

LIST_MARK: Final = re.compile(r"- |\d+\. ")
NONE_MISSING: Final = "No effect of the library is probable enough to be named."
"""Text of a diagnosis that finds nothing."""
DRAWN: Final[Mapping[str, Callable[[Diagnosis], list[Illustration]]]] = MappingProxyType(
    {
        "error": figures.draw_errors,
        "slices": figures.draw_slices,
        "location": figures.draw_location,
        "cars": figures.draw_deviations,
        "causes": lambda result: figures.draw_causes(
            result.causes,
            title=f"Effects that would explain the same as {result.verdict}"
            if result.verdict
            else "What may be missing",
        ),
        "missing": figures.draw_effects,
        "remains": figures.draw_remainder,
    }
)
"""Functions that draw the figures of a section, by the key of the section."""


def show(result: Diagnosis, console: Console, *, suggested: str | None = None) -> None:
    """Print a diagnosis: the data, the error, where the model fails, the missing effects and the next step."""
    print_heading(f"Diagnosis of {result.model.name}, version {result.model.version}", console)
    print_lines(sentences.describe_verdict(result), console, strong=True)
    print_lines(sentences.describe_data(result), console)
    _print_part("Episodes", finding_words.describe_episodes(result), console)
    _print_part("Error", sentences.describe_error(result), console)
    failures, slices = sentences.describe_failures(result), tables.tabulate_slices(result)
    if slices.rows:
        section = Section("slices", "Where the model fails", " ".join(failures), [slices._replace(title="")])
        print_section(section, console)
    else:
        print_heading("Where the model fails", console)
        print_lines(failures, console)
    _print_part("Location of the error", describe_location(result), console)
    _print_missing_effects(result, console)
    _print_part("Cars and changes", finding_words.describe_deviations(result), console)
    print_heading("Remaining error", console)
    print_lines([*sentences.describe_remainder(result), *sentences.describe_suggestion(result, suggested)], console)
    print_heading("Next step", console)
    print_lines(sentences.describe_next_step(result), console, strong=True)


def _print_part(title: str, lines: Sequence[str], console: Console) -> None:
    """Print sentences below a title, nothing without any."""
    if lines:
        print_heading(title, console)
        print_lines(lines, console)


def print_step(result: Diagnosis, step: int, first: NamedEffect | CarDeviation | None, console: Console) -> None:
    """Print the result of one step of the automatic loop, and what it adds, in a few lines."""
    print_heading(f"Step {step}", console)
    print_lines(finding_words.describe_leading_episode(result), console)
    if first is None or isinstance(first, CarDeviation):
        lines = [sentences.describe_end(result)] if first is None else finding_words.describe_finding(first)
        print_lines(lines, console)
        return
    meaning, *more = sentences.describe_missing_effect(first)
    print_lines([sentences.describe_error(result)[0], f"Missing: {first.name}: {meaning}", *more], console)
    for one in result.unknown:
        print_lines(sentences.describe_unknown(one), console)


def print_links(result: Diagnosis, path: Path, console: Console) -> None:
    """Print a link to the picture of each missing effect in the page of a diagnosis."""
    for place, one in enumerate(result.missing):
        if is_drawn(one.partial_residual):
            anchor = f"#figure-{name_figure(place)}"
            link = Style(link=f"{path.resolve().as_uri()}{anchor}")
            line = Text(f"picture of {one.name}: ").append(f"{path}{anchor}", style=link)
            console.print(line, soft_wrap=True, highlight=False)


def print_lines(lines: Sequence[str], console: Console, *, strong: bool = False) -> None:
    """Print sentences, and commands on one line each, so that they can be copied."""
    for line in lines:
        shown = line if line.startswith(COMMAND) else wrap_line(line, console.width)
        console.print(Text(shown, style="bold" if strong else ""), soft_wrap=True, highlight=False)


def wrap_line(line: str, width: int, indent: str = "") -> str:
    """Return a sentence or a list item in lines that keep a number and its unit together.

    Examples
    --------
    >>> print(wrap_line("- explains 44.1 % of the squared error", 16, "   "))
       - explains
         44.1 % of
         the squared
         error
    """
    mark = LIST_MARK.match(line)
    hanging = indent + " " * (len(mark[0]) if mark else 0)
    kept = keep_units(line)
    lines = wrap(kept, width, initial_indent=indent, subsequent_indent=hanging, break_on_hyphens=False)
    return "\n".join(lines).replace(NO_BREAK, " ")


def _print_missing_effects(result: Diagnosis, console: Console) -> None:
    """Print the missing effects one by one."""
    print_heading("Missing effects", console)
    if not result.missing:
        print_lines([NONE_MISSING], console)
    for place, one in enumerate(result.missing, start=1):
        first, *more = sentences.describe_missing_effect(one)
        name = f"{place}. {one.name}:"
        shown = Text(wrap_line(f"{name} {first}", console.width))
        shown.stylize("bold", 0, len(name))
        console.print(shown, soft_wrap=True, highlight=False)
        for line in more:
            console.print(Text(wrap_line(f"- {line}", console.width, "   ")), soft_wrap=True, highlight=False)


def build_report(result: Diagnosis, *, suggested: str | None = None) -> Report:
    """Return the report of a diagnosis."""
    title = f"Diagnosis of {result.model.name}, version {result.model.version}"
    lead = [
        *sentences.describe_verdict(result),
        *sentences.describe_next_step(result),
        *sentences.describe_data(result),
    ]
    return Report("diagnose", "diagnose", title, build_sections(result, suggested), lead, (), result, DRAWN)


def build_sections(result: Diagnosis, suggested: str | None = None) -> list[Section]:
    """Return the sections of the page that have a text or a table with rows."""
    missing = [f"{sentences.describe_missing_effect(one)[0]}." for one in result.missing]
    remainder = (*sentences.describe_remainder(result), *sentences.describe_suggestion(result, suggested))
    rivals = [f"{one.name}: {line}." for one in result.missing for line in sentences.describe_rivals(one)]
    sections = [
        Section(
            "episodes",
            "Episodes",
            _end_sentences([line for line in finding_words.describe_episodes(result) if not line.startswith(COMMAND)]),
            [finding_words.tabulate_episodes(result)],
        ),
        Section("causes", "Probable causes", " ".join(sentences.describe_competition(result)), []),
        Section("error", "Error", " ".join(sentences.describe_error(result)), [tables.tabulate_errors(result)]),
        Section(
            "slices",
            "Where the model fails",
            " ".join(sentences.describe_failures(result)),
            [tables.tabulate_slices(result)],
        ),
        Section("location", "Location of the error", " ".join(describe_location(result)), []),
        Section(
            "missing",
            "Missing effects",
            " ".join(line[:1].upper() + line[1:] for line in missing) or NONE_MISSING,
            [tables.tabulate_missing_effects(result)],
        ),
        Section("cars", "Cars and changes", _end_sentences(finding_words.describe_deviations(result)), []),
        Section("remains", "Remaining error", _end_sentences(remainder), [tables.tabulate_unknown(result)]),
        Section("candidates", "All candidate effects", " ".join(rivals), [tables.tabulate_candidates(result)]),
    ]
    return [section for section in sections if section.text or any(table.rows for table in section.tables)]


def _end_sentences(lines: Sequence[str]) -> str:
    """Return lines as one text in which each ends with a stop, items of a list as sentences."""
    plain = (f"{line[2:3].upper()}{line[3:]}" if line.startswith("- ") else line for line in lines)
    return " ".join(line if line.endswith((".", ":")) else f"{line}." for line in plain)
