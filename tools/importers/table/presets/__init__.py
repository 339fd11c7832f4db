"""Maps of exports that people have, one TOML file each, and the choice of the one that fits a table."""

import tomllib
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.resources import files
from types import MappingProxyType
from typing import Any

import msgspec

from socast.core.errors import SettingsError


class PresetField(msgspec.Struct, frozen=True):
    """Describe a place in which an export may hold a field: a column, or a signal of the long form.

    Parameters
    ----------
    unit, sign : optional
        None is found from the values.
    """

    column: str | None = None
    signal: str | None = None
    unit: str | None = None
    sign: int | None = None
    true: tuple[str, ...] = ()


class PresetTime(msgspec.Struct, frozen=True, rename={"form": "format"}):
    """Describe a clock that an export may have; None is found from the values."""

    column: str
    unit: str | None = None
    form: str | None = None
    zone: str | None = None
    day_from_file_name: bool = False


class Preset(msgspec.Struct, frozen=True, kw_only=True, rename={"some": "any"}):
    """Describe an export that people have.

    Parameters
    ----------
    name, title, source : str
        Name for `--preset`, the product, and where its form was looked up.
    edit : str
        What a person must correct in the map; empty where nothing.
    columns : sequence of sequences of str
        Columns that such a table has; of each sequence one is there.
    some : sequence of str
        Columns of which one is there, where there are any.
    without : sequence of str
        Columns that such a table does not have.
    extra_cells : bool
        Whether rows may have more cells than the header.
    rest : bool
        Whether fields that the preset does not name are guessed by the names of columns.
    times : sequence of PresetTime
        Clocks, the best one first; none where it is guessed.
    vehicle, ride : sequence of str
        Names that the columns of car and ride may have.
    long : sequence of (str, str)
        Names that the columns of the long form may have.
    fields : mapping of str to sequence of PresetField
        Places of each field, the best one first.
    parked : (str, tuple of str), optional
        Column and words of rows in which the car is parked.
    """

    name: str
    title: str
    source: str
    how: str
    edit: str = ""
    columns: list[list[str]]
    some: list[str] = []
    without: list[str] = []
    extra_cells: bool = False
    rest: bool = False
    times: list[PresetTime]
    vehicle: list[str]
    ride: list[str]
    long: list[tuple[str, str]]
    fields: dict[str, list[PresetField]]
    parked: tuple[str, tuple[str, ...]] | None = None
    on_change: bool = False

    def fits(self, names: Sequence[str]) -> bool:
        """Return whether a table with these columns is such an export."""
        has_all = all(any(name in names for name in group) for group in self.columns)
        has_any = not self.some or any(name in names for name in self.some)
        return has_all and has_any and not any(name in names for name in self.without)

    def list_missing(self, names: Sequence[str]) -> list[str]:
        """Return columns that a table lacks to be such an export."""
        missing = [group[0] for group in self.columns if not any(name in names for name in group)]
        lacks_any = self.some and not any(name in names for name in self.some)
        return missing or ([" or ".join(self.some)] if lacks_any else [])


@cache
def load_presets() -> Mapping[str, Preset]:
    """Return the presets by their names."""
    folder = files(__name__)
    texts = {
        each.name.removesuffix(".toml"): each.read_text(encoding="utf-8")
        for each in folder.iterdir()
        if each.name.endswith(".toml")
    }
    return MappingProxyType({name: _read(name, tomllib.loads(texts[name])) for name in sorted(texts)})


def get_preset(name: str) -> Preset:
    """Return the preset of a name."""
    presets = load_presets()
    if name not in presets:
        raise SettingsError(f"--preset is '{name}', must be one of {', '.join(presets)}")
    return presets[name]


def find_preset(names: Sequence[str]) -> Preset | None:
    """Return the preset that fits the columns of a table, the one that asks for most of them; None where none fits.

    Examples
    --------
    >>> find_preset(["utc", "soc", "power", "speed"]).title
    'ABRP telemetry (Iternio)'
    """
    fitting = [preset for preset in load_presets().values() if preset.fits(names)]
    return max(fitting, key=lambda preset: len(preset.columns), default=None)


def _read(name: str, tables: Mapping[str, Any]) -> Preset:
    """Return the preset of a file."""
    vehicle, ride, long = (tables.get(key, {}) for key in ("vehicle", "ride", "long"))
    lists = {
        "columns": [_to_list(group) for group in tables["preset"]["columns"]],
        "times": _divide(tables.get("time", []), "column"),
        "vehicle": _to_list(vehicle.get("column", [])),
        "ride": _to_list(ride.get("column", [])),
        "long": [(first, second) for first in _to_list(long.get("name", [])) for second in _to_list(long["value"])],
        "fields": {field: _divide(places, "column", "signal") for field, places in tables["fields"].items()},
    }
    parked = {"parked": [tables["parked"][key] for key in ("column", "values")]} if "parked" in tables else {}
    return msgspec.convert({"name": name, **tables["preset"], **lists, **parked}, Preset)


def _divide(tables: Any, *keys: str) -> list[dict[str, Any]]:
    """Return a table for each of the names that a table, or each of several, holds under a key."""
    found = tables if isinstance(tables, list) else [tables]
    return [{**each, key: name} for each in found for key in keys if key in each for name in _to_list(each[key])]


def _to_list(value: Any) -> list[str]:
    """Return a text or a list of texts as a list."""
    return [value] if isinstance(value, str) else list(value)
