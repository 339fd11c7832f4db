"""Show the report of a result: its tables in the terminal, and its page with figures as a file."""

from importlib import import_module
from pathlib import Path
from typing import Any

from socast.tools.terminal.output import make_console, print_plain


def show_report(name: str, result: Any, html_file: Path | None, json_file: Path | None = None, **options: Any) -> None:
    """Write the HTML page of a result if a file is named, then print its tables.

    Parameters
    ----------
    name : str
        Module of `socast.tools.report` that shows the result. It is imported here, because figures take seconds to
        import.
    """
    shown, console = import_module(f"socast.tools.report.{name}"), make_console(json_file)
    if html_file:
        import_module("socast.tools.report.page").write_report(shown.build_report(result, **options), html_file)
    shown.show(result, console, **options)
    if html_file:
        print_plain(console, f"report in {html_file}")
