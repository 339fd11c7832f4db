"""Give typed access to the figures that the paper published, kept in `paper.toml`.

The paper's data are rides of its own company and are not published. Its figures are therefore for orientation:
agreement does not mean equal data, and disagreement is no error.
"""

import tomllib
from collections.abc import Callable, Mapping
from functools import cache
from importlib import resources
from typing import Final, Literal, NamedTuple

import msgspec

WEIGHTED: Final = "weighted"
"""Row of Tables 4 to 11: mean over vehicle models, with the weights of `socast.core.evaluate.paper.results`."""
AVERAGE: Final = "average"
"""Column of Tables 3 to 11: mean over clusters."""

PHYSICAL: Final = "basic_physical"
"""Recipe to which the paper's reductions refer."""

Quantity = Literal["rides", "consumption", "test_consumption", "mae", "new_vehicle_mae", "new_vehicle_relative"]


class PublishedFigure(NamedTuple):
    """Hold a figure of the paper.

    Parameters
    ----------
    value : float
        Value, in the unit of its table.
    ci95 : float or None
        Half width of its 95 % confidence interval, where the paper gives one.
    """

    value: float
    ci95: float | None
    text: str
    table: int


class PaperModel(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Describe a vehicle model of the paper: its name there, and the catalogue keys of comparable vehicles."""

    name: str
    catalogue: tuple[str, ...]


class PaperTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Hold a table of the paper.

    Parameters
    ----------
    recipe : str, optional
        Recipe whose errors it holds, in Tables 5 to 11.
    rows : mapping
        Vehicle model of the paper, or `WEIGHTED` -> column -> figure as printed.
    """

    number: int
    quantity: Quantity
    recipe: str | None = None
    unit: str
    rows: dict[str, dict[str, str]]


class PaperStatement(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Hold a figure in the text of the paper: value, unit, section, and what it refers to, in our words."""

    value: float
    unit: str
    section: str
    says: str


class PaperFinding(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Hold a qualitative finding in the text of the paper, in our words.

    Parameters
    ----------
    vehicle_model : str, optional
        Vehicle model of the paper, where the finding refers to one only.
    """

    name: str
    section: str
    vehicle_model: str | None = None
    recipes: tuple[str, ...]
    terms: tuple[str, ...] = ()
    says: str


class Paper(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Hold all published figures and findings of the paper."""

    title: str
    vehicle_models: dict[str, PaperModel]
    tables: tuple[PaperTable, ...]
    statements: dict[str, PaperStatement]
    findings: tuple[PaperFinding, ...]


@cache
def load_paper() -> Paper:
    """Return all published figures and findings of the paper.

    Examples
    --------
    >>> [table.number for table in load_paper().tables if table.quantity == "mae"]
    [5, 6, 7, 8, 9, 10, 11]
    """
    text = resources.files("socast.core.evaluate.paper").joinpath("paper.toml").read_text(encoding="utf-8")
    return msgspec.convert(tomllib.loads(text), Paper)


def find_paper_key(vehicle_model: str) -> str | None:
    """Return the paper's vehicle model that is comparable to one of the catalogue; None where there is none.

    Examples
    --------
    >>> find_paper_key("nissan-leaf-2016"), find_paper_key("bmw-i3-2014")
    ('nissan-leaf', None)
    """
    if vehicle_model == WEIGHTED:
        return WEIGHTED
    return next((key for key, model in load_paper().vehicle_models.items() if vehicle_model in model.catalogue), None)


def get_ride_count(vehicle_model: str, cluster: str) -> PublishedFigure | None:
    """Return the number of rides, Table 2; the cluster may be `total`."""
    return _figure("rides", vehicle_model, cluster)


def get_consumption(vehicle_model: str, cluster: str) -> PublishedFigure | None:
    """Return the mean consumption of a ride, Table 3; the cluster may be `AVERAGE`. [kWh]"""
    return _figure("consumption", vehicle_model, cluster)


def get_test_consumption(vehicle_model: str, cluster: str) -> PublishedFigure | None:
    """Return the mean consumption of a ride of the test sets, Table 4. [kWh]"""
    return _figure("test_consumption", vehicle_model, cluster)


def get_mae(recipe: str, vehicle_model: str, cluster: str) -> PublishedFigure | None:
    """Return a mean absolute error, Tables 5 to 11; None where the paper has none. [kWh]

    Examples
    --------
    >>> get_mae("hybrid_interactions", "kia-soul-ev-2015", "average")
    PublishedFigure(value=0.36, ci95=0.024, text='0.36 ± 0.024', table=11)
    """
    return _figure("mae", vehicle_model, cluster, recipe)


def get_new_vehicle_mae(recipe: str, vehicle_model: str) -> PublishedFigure | None:
    """Return the error on a vehicle model left out of training, Table 12. [kWh]"""
    return _figure("new_vehicle_mae", vehicle_model, recipe)


def get_new_vehicle_relative_error(recipe: str, vehicle_model: str) -> PublishedFigure | None:
    """Return the error over the consumption on a vehicle model left out of training, Table 13."""
    return _figure("new_vehicle_relative", vehicle_model, recipe)


def get_table_number(recipe: str) -> int | None:
    """Return the number of the table that holds a recipe's errors."""
    return next((table.number for table in load_paper().tables if table.recipe == recipe), None)


def get_reduction(recipe: str, vehicle_model: str) -> float | None:
    """Return by which share a recipe's average error is below that of the basic physical model.

    The paper does not print it: it follows from the averages of Tables 5 to 11, which are rounded to 0.01 kWh.

    Examples
    --------
    >>> round(get_reduction("hybrid_interactions", AVERAGE), 4)
    0.5204
    """
    return _reduction(lambda of, key: get_mae(of, key, AVERAGE), recipe, vehicle_model)


def get_new_vehicle_reduction(recipe: str, vehicle_model: str) -> float | None:
    """Return the same share on a vehicle model left out of training, which follows from Table 12."""
    return _reduction(get_new_vehicle_mae, recipe, vehicle_model)


def get_relative_error(recipe: str, cluster: str) -> float | None:
    """Return a point of the paper's Figure 2: error over consumption, over all vehicle models.

    The paper prints a curve only: the point follows from the weighted rows of Table 4 and Tables 5 to 11.
    """
    error, of = get_mae(recipe, WEIGHTED, cluster), get_test_consumption(WEIGHTED, cluster)
    return None if error is None or of is None else error.value / of.value


def get_statement(name: str) -> PaperStatement:
    """Return a figure of the text by its name in `paper.toml`.

    Examples
    --------
    >>> get_statement("buffer").value
    1.0
    """
    return load_paper().statements[name]


def get_findings(name: str) -> tuple[PaperFinding, ...]:
    """Return the findings of a name: `dominates`, `rfecv`, `rfe` or `new_vehicle`."""
    return tuple(finding for finding in load_paper().findings if finding.name == name)


def _reduction(figure: Callable[[str, str], PublishedFigure | None], recipe: str, vehicle_model: str) -> float | None:
    """Return the share by which an error is below that of the basic physical model; `AVERAGE` is the mean of shares."""
    if vehicle_model == AVERAGE:
        keys = [model.catalogue[0] for model in load_paper().vehicle_models.values()]
        known = [share for key in keys if (share := _reduction(figure, recipe, key)) is not None]
        return sum(known) / len(known) if known else None
    reference, error = figure(PHYSICAL, vehicle_model), figure(recipe, vehicle_model)
    return None if reference is None or error is None else 1.0 - error.value / reference.value


def _figure(quantity: Quantity, vehicle_model: str, column: str, recipe: str | None = None) -> PublishedFigure | None:
    """Return a figure by quantity, row and column; None where the paper has none."""
    row = find_paper_key(vehicle_model)
    return None if row is None else _figures().get((quantity, recipe, row, column))


@cache
def _figures() -> Mapping[tuple[str, str | None, str, str], PublishedFigure]:
    """Return every figure of the tables by quantity, recipe, row and column."""
    return {
        (table.quantity, table.recipe, row, column): _published(text, table.number)
        for table in load_paper().tables
        for row, cells in table.rows.items()
        for column, text in cells.items()
    }


def _published(text: str, table: int) -> PublishedFigure:
    """Return a figure from its text, `value` or `value ± ci95`."""
    value, _, ci95 = text.partition(" ± ")
    return PublishedFigure(float(value), float(ci95) if ci95 else None, text, table)
