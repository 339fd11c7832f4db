"""Markdown building blocks of the generated pages."""  # noqa: INP001

from collections.abc import Iterable, Sequence


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = [f"| {' | '.join(map(_cell, row))} |" for row in rows]
    return "\n".join([f"| {' | '.join(head)} |", f"|{'---|' * len(head)}", *lines, ""])


def code(text: str) -> str:
    """Return a text as inline code."""
    return f"`` {text} ``" if "`" in text else f"`{text}`"


def plain(text: str) -> str:
    """Return a text in which Markdown finds nothing to format."""
    for sign in "\\*_[]<>$|":
        text = text.replace(sign, f"\\{sign}")
    return text


def paragraphs(text: str) -> str:
    """Return a docstring's text with the lines of each paragraph joined, blank lines kept."""
    return "\n\n".join(" ".join(part.split()) for part in text.split("\n\n") if part.strip())


def _cell(text: str) -> str:
    """Return what stands in one cell: one line, its bars escaped."""
    line = " ".join(text.split())
    return line.replace("\\|", "|").replace("|", "\\|")
