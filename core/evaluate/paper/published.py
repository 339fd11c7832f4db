"""What the paper published, to stand beside what is measured here: typed access to `paper.toml`.

The paper's data are its company's own rides, which are not published. So its figures are for orientation: equal ones
would not mean equal data, and unequal ones no error.
"""

import tomllib
from collections.abc import Mapping
from functools import cache
from importlib import resources
from typing import Final, Literal, NamedTuple

import msgspec

WEIGHTED: Final = "weighted"
"""Row of Tables 4 to 11: mean over vehicle models, weighted by their rides."""
AVERAGE: Final = "average"
"""Column of Tables 3 to 11: mean over clusters."""

PHYSICAL: Final = "basic_physical"
"""The recipe that the paper's reductions are against."""

Quantity = Literal["rides", "consumption", "test_consumption", "mae", "new_vehicle_mae", "new_vehicle_relative"]


class PublishedFigure(NamedTuple):
    """A figure of the paper.

    Parameters
    ----------
    value : float
        In the unit of its table.
    ci95 : float or None
        Half width of its 95 % confidence interval, where the paper gives one.
    text : str
        As it was printed, with its digits.
    table : int
        Number of its table.
    """

    value: float
    ci95: float | None
    text: str
    table: int


class PaperModel(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A vehicle model of the paper: its name there, and the keys of the catalogue that it may stand for."""

    name: str
    catalogue: tuple[str, ...]


class PaperTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A table of the paper.

    Parameters
    ----------
    number : int
        In the paper.
    quantity : str
        What its figures are.
    recipe : str, optional
        Whose errors they are, in Tables 5 to 11.
    unit : str
        As pint spells it.
    rows : mapping
        Vehicle model of the paper, or `WEIGHTED` -> column -> figure as printed.
    """

    number: int
    quantity: Quantity
    recipe: str | None = None
    unit: str
    rows: dict[str, dict[str, str]]


class PaperStatement(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A figure in the text of the paper, in its unit; what it is of, in our words."""

    value: float
    unit: str
    section: str
    says: str


class PaperFinding(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A finding in the text that is no figure, in our words.

    Parameters
    ----------
    name : {"dominates", "rfecv", "rfe", "new_vehicle"}
        What it is about.
    section : str
        Where it stands.
    vehicle_model : str, optional
        Of the paper, where it is of one only.
    recipes, terms : tuple of str
        What it names.
    says : str
        The finding.
    """

    name: str
    section: str
    vehicle_model: str | None = None
    recipes: tuple[str, ...]
    terms: tuple[str, ...] = ()
    says: str


class Paper(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """All that is kept of the paper."""

    title: str
    vehicle_models: dict[str, PaperModel]
    tables: tuple[PaperTable, ...]
    statements: dict[str, PaperStatement]
    findings: tuple[PaperFinding, ...]


@cache
def load_paper() -> Paper:
    """Return all that is kept of the paper.

    Examples
    --------
    >>> [table.number for table in load_paper().tables if table.quantity == "mae"]
    [5, 6, 7, 8, 9, 10, 11]
    """
    text = resources.files("core.evaluate.paper").joinpath("paper.toml").read_text(encoding="utf-8")
    return msgspec.convert(tomllib.loads(text), Paper)


def find_paper_key(vehicle_model: str) -> str | None:
    """Return the paper's vehicle model that one of the catalogue may be set beside, None where it has none.

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
    """Return the mean consumption of a ride in kWh, Table 3; the cluster may be `AVERAGE`."""
    return _figure("consumption", vehicle_model, cluster)


def get_test_consumption(vehicle_model: str, cluster: str) -> PublishedFigure | None:
    """Return the mean consumption of a ride of the test sets in kWh, Table 4.

    Parameters
    ----------
    vehicle_model : str
        Key of the catalogue, or `WEIGHTED`.
    cluster : str
        Such as `0-5`, or `AVERAGE`.
    """
    return _figure("test_consumption", vehicle_model, cluster)


def get_mae(recipe: str, vehicle_model: str, cluster: str) -> PublishedFigure | None:
    """Return a mean absolute error in kWh, Tables 5 to 11; None where the paper has none.

    Parameters
    ----------
    recipe : str
        Of the paper's seven.
    vehicle_model : str
        Key of the catalogue, or `WEIGHTED`.
    cluster : str
        Such as `0-5`, or `AVERAGE`.

    Examples
    --------
    >>> get_mae("hybrid_interactions", "kia-soul-ev-2015", "average")
    PublishedFigure(value=0.36, ci95=0.024, text='0.36 ± 0.024', table=11)
    """
    return _figure("mae", vehicle_model, cluster, recipe)


def get_new_vehicle_mae(recipe: str, vehicle_model: str) -> PublishedFigure | None:
    """Return the error in kWh on a vehicle model left out of training, Table 12."""
    return _figure("new_vehicle_mae", vehicle_model, recipe)


def get_new_vehicle_relative_error(recipe: str, vehicle_model: str) -> PublishedFigure | None:
    """Return the error over the consumption on a vehicle model left out of training, Table 13."""
    return _figure("new_vehicle_relative", vehicle_model, recipe)


def get_table_number(recipe: str) -> int | None:
    """Return the number of the table that holds a recipe's errors."""
    return next((table.number for table in load_paper().tables if table.recipe == recipe), None)


def get_reduction(recipe: str, vehicle_model: str) -> float | None:
    """Return by what share a recipe's average error is below that of the basic physical model.

    The paper does not print it: it follows from the averages of Tables 5 to 11, which are rounded to 0.01 kWh.
    """
    return _reduction(get_mae(PHYSICAL, vehicle_model, AVERAGE), get_mae(recipe, vehicle_model, AVERAGE))


def get_new_vehicle_reduction(recipe: str, vehicle_model: str) -> float | None:
    """Return the same share on a vehicle model left out of training, as it follows from Table 12."""
    return _reduction(get_new_vehicle_mae(PHYSICAL, vehicle_model), get_new_vehicle_mae(recipe, vehicle_model))


def get_relative_error(recipe: str, cluster: str) -> float | None:
    """Return a point of the paper's Figure 2: error over consumption, all vehicle models together.

    The paper prints it as a curve only: it follows from the weighted rows of Table 4 and Tables 5 to 11.
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
    """Return the findings of a name: `dominates`, `rfecv`, `rfe`, `new_vehicle`."""
    return tuple(finding for finding in load_paper().findings if finding.name == name)


def _reduction(reference: PublishedFigure | None, error: PublishedFigure | None) -> float | None:
    """Return the share by which an error is below a reference."""
    return None if reference is None or error is None else 1.0 - error.value / reference.value


def _figure(quantity: Quantity, vehicle_model: str, column: str, recipe: str | None = None) -> PublishedFigure | None:
    """Return a figure by its quantity, row and column, None where the paper leaves it out."""
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
    """Return a figure from its text: `value` or `value ± ci95`."""
    value, _, ci95 = text.partition(" ± ")
    return PublishedFigure(float(value), float(ci95) if ci95 else None, text, table)
