"""Read the offsets from UTC that a column states: as offsets, as names of time zones, or at the end of its times."""

from typing import Any, Final
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc

from socast.core.batch import Floats
from socast.tools.importers.table.text_times import Stamps, to_unix
from socast.tools.importers.table.zone_offsets import find_offset

_STATED: Final = (
    r"(?:\d[^+-]*|^)(?P<zone>(?:UTC|GMT)[+-]\d{1,2}(?::?\d\d)?|[+-]\d\d:?\d\d|\bZ|\b[A-Z]{3,5})"
    r"(?:\s+\d{4}|\s*\([^)]*\))?\s*$"
)
"""Offset at the end of a time, or before a year at its end."""


def read_offsets(cells: pa.Array, stamps: Stamps) -> Floats:
    """Return the offset from UTC that each cell states, NaN where it states none. [s]

    Parameters
    ----------
    stamps : (n,) datetime64
        Local time of each row, by which the offset of a named time zone follows.
    """
    texts = pc.utf8_trim_whitespace(pc.cast(cells, pa.string()))
    stated = pc.struct_field(pc.extract_regex(texts, _STATED), "zone")
    coded = pc.dictionary_encode(pc.coalesce(stated, texts))
    words = coded.dictionary.to_pylist()
    if len(words) > MOST_WORDS:  # times without an offset
        return np.full(len(texts), np.nan)
    places = pc.fill_null(coded.indices, len(words)).to_numpy(zero_copy_only=False)
    values = np.array([_find(word) for word in words] + [np.nan])
    offsets: Floats = values[places]
    for place in np.flatnonzero(np.isnan(values[:-1])).tolist():
        if (zone := _find_zone(words[place])) is not None:
            chosen = places == place
            offsets[chosen] = _measure(stamps[chosen], zone)
    return offsets


MOST_WORDS: Final = 100
"""Different offsets that a column may state in a block."""


def _find(word: str) -> float:
    """Return the offset of a word, NaN where it is none. [s]"""
    found = find_offset(word, is_offset=True)
    return np.nan if found is None else found


def _find_zone(word: str) -> ZoneInfo | None:
    """Return the time zone of a name such as `Europe/Berlin`."""
    try:
        return ZoneInfo(word) if "/" in word else None
    except (ZoneInfoNotFoundError, ValueError, OSError):
        return None


def _measure(stamps: Stamps, zone: ZoneInfo) -> Floats:
    """Return the offsets of local times in a zone, NaN where the clock repeats or skips them. [s]"""
    local: Any = pd.Series(stamps).dt.tz_localize(zone, ambiguous="NaT", nonexistent="NaT")
    offsets: Floats = to_unix(stamps) - to_unix(local.dt.tz_convert("UTC").dt.tz_localize(None))
    return offsets
