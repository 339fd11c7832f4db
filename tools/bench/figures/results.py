"""The table of results in the README: single figures of several measurements."""

from collections.abc import Mapping
from typing import Final

import msgspec

RESULTS: Final = "results"
"""Name of the block."""
ROWS: Final = (
    ("error of the energy of rides (wMAPE)", "evaluation", "wmape", "wmape_on"),
    ("the same on real drives", "real-drives", "wmape", "wmape_on"),
    ("error below baselines", "evaluation", "below", "below_on"),
    ("90 % prediction intervals of rides", "evaluation", "inside", "inside_on"),
    ("state of charge at the end of the shift, 2 h ahead", "soc-forecasts", "error", "error_on"),
    ("hidden effect named first", "hidden-effects", "right", "right_on"),
    ("another effect named first", "hidden-effects", "wrong", "wrong_on"),
    ("names given with 90 % or more", "hidden-effects", "sure", "sure_on"),
    (
        "hidden effect that the library lacks: another named with 90 % or more",
        "hidden-effects",
        "outside",
        "outside_on",
    ),
    ("one car that began to use 6 % more", "siblings", "found", "found_on"),
    ("drives of faulty loggers that are fit for training and wrong", "league", "wrong", "wrong_on"),
)
"""Result, measurement, and the names of its figure and of what it was measured on."""


class Published(msgspec.Struct, frozen=True):
    """Hold what a measurement found.

    Parameters
    ----------
    commit : str
        Commit of the source tree, with a plus sign where the sources differed from it.
    machine : str
        Number of cores and version of Python.
    values : dict of str to str
        Single figures for the table of results.
    """

    command: str
    date: str
    commit: str
    machine: str
    lines: list[str]
    values: dict[str, str]


def list_results(published: Mapping[str, Published]) -> list[str]:
    """Return the lines of the table, without measurements that have not been published."""
    lines = ["| result | figure | on what | measured |", "|---|---|---|---|"]
    for result, name, figure, on in ROWS:
        one = published.get(name)
        if one is not None and figure in one.values:
            lines.append(f"| {result} | {one.values[figure]} | {one.values.get(on, '')} | {one.date} |")
    return lines
