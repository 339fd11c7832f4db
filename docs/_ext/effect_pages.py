"""The reference of physical effects, read from the library."""  # noqa: INP001

from collections.abc import Iterator
from typing import Final

from markdown_text import code, paragraphs, plain, table

from socast.core import effects as library
from socast.core.effects import Effect, Parameter
from socast.core.effects.declaration import Expectation

SIGNS: Final = {1: "not negative", -1: "not positive", 0: "either"}


def effects() -> str:
    """Return the reference of every effect, by topic."""
    parts = []
    for topic, of_topic in library.group_by_topic().items():
        parts.append(f"## {topic[0].upper()}{topic[1:]}\n")
        parts += [_section(effect) for effect in of_topic]
    return "\n".join(parts)


def _section(effect: Effect) -> str:
    """Return the section of one effect."""
    summary = effect.summary.partition(": P = ")[0].rstrip(".")
    more = effect.documentation.split("\n\n")[1:]
    rows = list(_rows(effect))
    text = paragraphs(plain("\n\n".join(part for part in more if not part.startswith("Parameters"))))
    return "\n\n".join(
        part for part in (f"### {effect.name}", f"{plain(summary)}.", text, table(["property", "value"], rows)) if part
    )


def _rows(effect: Effect) -> Iterator[tuple[str, str]]:
    """Yield what is declared of an effect, row by row."""
    unit = "" if effect.unit == "1" else f" {code(effect.unit)}"
    yield "formula", code(effect.formula)
    yield "coefficient", f"{plain(effect.coefficient)}{unit}"
    yield "plausible range", f"{effect.low:g} to {effect.high:g}{unit}; sign {SIGNS[effect.sign]}"
    if effect.expected is not None:
        yield "expected before any data", _expectation(effect.expected, unit)
    yield "acts", "by motion, over the time that the distance took" if effect.per == "distance" else "all the time"
    if effect.arguments:
        yield "columns", ", ".join(map(code, effect.arguments))
    for name, parameter in effect.parameters.items():
        yield f"parameter {code(name)}", _parameter(parameter, effect.constants[name])
    yield "source", plain(effect.source)
    if effect.confused_with:
        yield "confused with", ", ".join(map(code, effect.confused_with))
    if effect.shown_by:
        yield "shown best by", plain(effect.shown_by)


def _expectation(expected: Expectation, unit: str) -> str:
    """Return the mean and the spread of a coefficient, and their source."""
    what = f" times {code(expected.of)} of the car" if expected.of else unit
    return f"{expected.mean:g} ± {expected.sd:g}{what}; {plain(expected.source)}"


def _parameter(parameter: Parameter, value: float) -> str:
    """Return the value of a parameter, its bounds and the grid of the tables."""
    unit = "" if parameter.unit == "1" else f" {code(parameter.unit)}"
    low, high = parameter.bounds
    bounds = f", {low:g} to {high:g}" if low < high else ", fixed"
    grid = f"; tabulated at {', '.join(f'{each:g}' for each in parameter.grid)}" if parameter.grid else ""
    return f"{value:g}{unit}{bounds}{grid}"
