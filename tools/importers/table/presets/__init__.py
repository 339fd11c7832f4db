"""Maps of exports that people have, one TOML file each, and the choice of the one that fits a table."""

import tomllib
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.resources import files
from types import MappingProxyType
from typing import Any, NamedTuple

from socast.core.errors import SettingsError


class PresetField(NamedTuple):
    """Describe a place in which an export may hold a field.

    Parameters
    ----------
    column, signal : str, optional
        Column, or signal of the long form.
    unit : str, optional
        Unit; None is found from the values.
    sign : int, optional
        1 or -1; None is found from the values.
    """

    column: str | None
    signal: str | None
    unit: str | None
    sign: int | None
    true: tuple[str, ...]


class PresetTime(NamedTuple):
    """Describe a clock that an export may have; None is found from the values."""

    column: str
    unit: str | None
    form: str | None
    zone: str | None
    day_from_file_name: bool


class Preset(NamedTuple):
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
    edit: str
    columns: Sequence[Sequence[str]]
    some: Sequence[str]
    without: Sequence[str]
    extra_cells: bool
    rest: bool
    times: Sequence[PresetTime]
    vehicle: Sequence[str]
    ride: Sequence[str]
    long: Sequence[tuple[str, str]]
    fields: Mapping[str, Sequence[PresetField]]
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
    about = tables["preset"]
    vehicle, ride, long = (tables.get(key, {}) for key in ("vehicle", "ride", "long"))
    return Preset(
        name,
        about["title"],
        about["source"],
        about["how"],
        about.get("edit", ""),
        [_to_list(group) for group in about["columns"]],
        about.get("any", []),
        about.get("without", []),
        about.get("extra_cells", False),
        about.get("rest", False),
        [time for table in tables.get("time", []) for time in _read_times(table)],
        _to_list(vehicle.get("column", [])),
        _to_list(ride.get("column", [])),
        [(first, second) for first in _to_list(long.get("name", [])) for second in _to_list(long["value"])],
        {field: _read_places(places) for field, places in tables["fields"].items()},
        (tables["parked"]["column"], tuple(tables["parked"]["values"])) if "parked" in tables else None,
        about.get("on_change", False),
    )


def _read_times(table: Mapping[str, Any]) -> list[PresetTime]:
    """Return the clocks of a table of a preset."""
    return [
        PresetTime(
            column, table.get("unit"), table.get("format"), table.get("zone"), table.get("day_from_file_name", False)
        )
        for column in _to_list(table["column"])
    ]


def _read_places(places: Any) -> list[PresetField]:
    """Return the places of a field."""
    return [
        PresetField(
            column if "column" in place else None,
            column if "signal" in place else None,
            place.get("unit"),
            place.get("sign"),
            tuple(place.get("true", ())),
        )
        for place in (places if isinstance(places, list) else [places])
        for column in _to_list(place.get("column", place.get("signal")))
    ]


def _to_list(value: Any) -> list[str]:
    """Return a text or a list of texts as a list."""
    return [value] if isinstance(value, str) else list(value)
