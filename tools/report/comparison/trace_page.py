"""Show the trace of a ride: in the terminal, and as one page of tables and figures."""

from pathlib import Path
from typing import Final

from rich.console import Console

from socast.core.evaluate.compare.records import RideTrace
from socast.tools.report.comparison.trace import (
    build_illustrations,
    describe_ride,
    tabulate_models,
    tabulate_terms,
    tabulate_windows,
)
from socast.tools.report.evaluation.sections import Section
from socast.tools.report.evaluation.terminal import print_section
from socast.tools.report.page import render_document, save

MADE_BY: Final = "<p>Made by <code>socast compare</code>.</p>"


def show(trace: RideTrace, console: Console) -> None:
    """Print the trace of a ride, from its windows to the predictions of the ride."""
    for section in reversed(build_trace_sections(trace)):
        print_section(section, console)


def write(trace: RideTrace, path: Path) -> None:
    """Write the trace of a ride as a self-contained page."""
    drawn, sections = build_illustrations(trace), build_trace_sections(trace)
    title = f"Ride {trace.ride.ride_key}"
    save(render_document("compare", title, "", sections, lambda key: drawn if key == "trace" else [], MADE_BY), path)


def build_trace_sections(trace: RideTrace) -> list[Section]:
    """Return the sections of a trace."""
    title = "Prediction and measurement along the ride"
    return [
        Section("trace", title, describe_ride(trace), [tabulate_models(trace)]),
        Section("terms", "Terms of the predictions", "", tabulate_terms(trace)),
        Section("windows", "Window by window", "", [tabulate_windows(trace)]),
    ]
