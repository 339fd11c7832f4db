"""Read cars of one's own from their data sheets, with priors for the figures that are not known."""

from collections.abc import Mapping
from statistics import median
from typing import Any, Final

from socast.core.errors import CatalogueError
from socast.core.files import UNREADABLE_TOML, parse_toml
from socast.core.vehicles.catalogue import BOUNDS, VehicleModel, load_catalogue, read_entry

REQUIRED: Final = ("mass_kg", "nominal_capacity_kwh")
"""Figures that every data sheet gives."""
DRAG_AREA: Final = "drag_area_m2"
"""Drag coefficient times frontal area, which may stand in place of both. [m^2]"""
OF_SHEET: Final = "data sheet"
"""Source of a figure that the file gives without one."""


def read_data_sheets(text: str, origin: str) -> Mapping[str, VehicleModel]:
    r"""Read the vehicle models of a file of data sheets.

    Parameters
    ----------
    text : str
        TOML with one table per vehicle model, as in the catalogue. Only `REQUIRED` must be there. `drag_area_m2` may
        stand in place of `drag_coefficient` and `frontal_area_m2`, and sources are optional.

    Examples
    --------
    >>> sheets = read_data_sheets("[my-car]\nmass_kg = 1800\nnominal_capacity_kwh = 60", "cars.toml")
    >>> sheets["my-car"].sources["rolling_resistance"]
    'estimated: median of the vehicle catalogue'
    """
    try:
        tables = parse_toml(text)
    except UNREADABLE_TOML as error:
        raise CatalogueError(f"{origin} is not TOML: {error}; write [my-car] and its figures below") from error
    if not tables:
        raise CatalogueError(f"{origin} holds no vehicle; write [my-car] and its figures below")
    try:
        return {key: read_entry(key, _complete(key, table), {DRAG_AREA}) for key, table in tables.items()}
    except CatalogueError as error:
        raise CatalogueError(f"{origin}: {error}") from error


def list_assumed(vehicle: VehicleModel) -> list[str]:
    """Return the figures of a vehicle model that are assumed and not known."""
    return [name for name, source in vehicle.sources.items() if source.startswith("estimated")]


def is_drag_area_assumed(vehicle: VehicleModel) -> bool:
    """Return whether the drag coefficient times the frontal area of a vehicle model is assumed and not known."""
    assumed = list_assumed(vehicle)
    is_given = DRAG_AREA in vehicle.sources.get("drag_coefficient", "")
    return "drag_coefficient" in assumed or ("frontal_area_m2" in assumed and not is_given)


def _complete(key: str, table: Any) -> Any:
    """Return a table with priors in place of what it does not give."""
    if not isinstance(table, dict):
        return table
    if key in load_catalogue() and load_catalogue()[key].sources.get("origin") != OF_SHEET:
        raise CatalogueError(f"vehicle {key}: is in the catalogue already; choose another name for yours")
    given = dict(table)
    sources = {name: OF_SHEET for name in given if name in BOUNDS} | dict(given.get("sources", {}))
    if (area := given.pop(DRAG_AREA, None)) is not None:
        _split_drag_area(key, area, given, sources)
    for name in BOUNDS:
        if name not in given and name not in REQUIRED:
            given[name], sources[name] = _find_prior(name)
    given.setdefault("name", key)
    return given | {"sources": sources | {"origin": OF_SHEET}}


def _split_drag_area(key: str, area: Any, given: dict[str, Any], sources: dict[str, str]) -> None:
    """Replace a drag area by a drag coefficient, with the frontal area that is given or usual."""
    if "drag_coefficient" in given:
        raise CatalogueError(f"vehicle {key}: has {DRAG_AREA} and drag_coefficient; leave one of them out")
    if not isinstance(area, int | float) or isinstance(area, bool) or not 0.1 <= area <= 5.0:
        raise CatalogueError(f"vehicle {key}: {DRAG_AREA} is {area!r}; give one from 0.1 to 5")
    if "frontal_area_m2" not in given:
        given["frontal_area_m2"], sources["frontal_area_m2"] = _find_prior("frontal_area_m2")
    given["drag_coefficient"] = area / given["frontal_area_m2"]
    sources["drag_coefficient"] = f"{OF_SHEET}: {DRAG_AREA} {area:g} over the frontal area"


def _find_prior(name: str) -> tuple[float, str]:
    """Return the usual value of a figure and its source."""
    shipped = [each for each in load_catalogue().values() if each.sources.get("origin") != OF_SHEET]
    return median(getattr(each, name) for each in shipped), "estimated: median of the vehicle catalogue"
