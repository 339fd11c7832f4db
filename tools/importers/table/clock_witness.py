"""Judge a clock of a table by other clocks of its rows, the names of the files, and when they were written."""

import re
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, date, datetime
from functools import partial
from itertools import islice
from typing import Final, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from socast.core.batch import Floats
from socast.tools.importers.table.guess_time import Blocks, GuessedTime, collect_cells
from socast.tools.importers.table.row_reader import SECONDS_PER_WEEK, TimeReader
from socast.tools.importers.table.text_stream import RowFaults
from socast.tools.importers.table.text_times import parse_times, read_offsets
from socast.tools.importers.table.time_words import LARGEST, TimeSource, find_name_day, spell_offset

DAY: Final = 86400.0
ROLLOVER_WEEKS: Final = 1024
"""Weeks after which the count of weeks of old GPS receivers starts again."""
LEAST_ROWS: Final = 5
"""Rows in which two clocks must be known to be compared."""
QUARTER: Final = 900.0
"""Time zones differ by whole quarters of an hour. [s]"""
STEADY: Final = 150.0
"""Deviation of two clocks from each other, beside their zones, up to which they are the same time. [s]"""
SLACK: Final = 1.5 * DAY
"""Deviation between a clock and a day in a name, with the time zones of both. [s]"""
MOST_BLOCKS: Final = 16
"""Blocks of each file in which days above 12 are looked for."""
EARLIEST: Final = datetime(2010, 1, 1, tzinfo=UTC).timestamp()
"""Time before which no logger of an electric car is expected. [Unix s]"""
EPOCHS: Final = (
    (315964782.0, "1980-01-05T23:59:42+00:00", "seconds of GPS since 1980"),
    (978307200.0, "2001-01-01T00:00:00+00:00", "seconds since 2001"),
    (946684800.0, "2000-01-01T00:00:00+00:00", "seconds since 2000"),
)
"""Zero of other counts of seconds: its Unix time [s], as a text, and their name."""
_UTC_NAME: Final = re.compile(r"utc|gmt|unix|epoch|zulu", re.IGNORECASE)
_OFFSET_NAME: Final = re.compile(r"(utc|gmt|tz|time ?zone)[ _-]*(offset|diff\w*)?$|^offset$", re.IGNORECASE)


class Difference(NamedTuple):
    """Hold by how much one clock is ahead of another: the usual time [s], and whether it is always about this."""

    usual: float
    is_steady: bool


def judge_clock(
    first: GuessedTime, others: Sequence[GuessedTime], names: Sequence[str], blocks: Blocks, *, is_fixed: bool = False
) -> GuessedTime:
    """Return a clock with what other witnesses show of its days, its weeks and its zone."""
    others = [each for each in others if each.is_absolute and each.columns != first.columns]
    if first.others:
        sure = [each for each in others if not each.others]
        first = _order_day_and_month(first, sure, names, blocks)
    others = [each._replace(form=form, others=()) for each in others for form in (each.form, *each.others)]
    first = _check_weeks(first, others, blocks)
    if first.has_zone:
        return first
    others = [_align(each, first, blocks) for each in others]
    if (stated := _find_offset_column(first, names, blocks)) is not None:
        return stated
    zoned = [each for each in others if each.has_zone or any(map(_UTC_NAME.search, each.columns))]
    if not any(map(_UTC_NAME.search, first.columns)):
        for other in zoned:
            if (found := _take_zone(first, other, blocks, is_fixed=is_fixed)) is not None:
                return found
    return first


def read_clock(source: TimeSource, blocks: Blocks) -> Floats:
    """Return the times of the first rows of all files, NaN where unknown. [Unix s]"""
    reader, parts = TimeReader(source), []
    for table, block in blocks:
        count = len(next(iter(block.values())))
        known = all(name in block for name in source.columns)
        zeros = np.zeros(count, "i4")
        parts.append(reader.read(table, block, zeros).times if known else np.full(count, np.nan))
    return np.concatenate(parts)


def _compare(first: GuessedTime, other: GuessedTime, blocks: Blocks) -> Difference | None:
    """Return by how much a clock is ahead of another one, None where too few rows have both."""
    ahead = read_clock(first.to_source(), blocks) - read_clock(other.to_source(), blocks)
    ahead = ahead[np.isfinite(ahead)]
    if len(ahead) < LEAST_ROWS:
        return None
    usual = float(np.median(ahead))
    return Difference(usual, bool(np.mean(np.abs(ahead - usual) < STEADY) > 0.9))


def _check_weeks(first: GuessedTime, others: Sequence[GuessedTime], blocks: Blocks) -> GuessedTime:
    """Return a clock with the weeks or the origin by which it differs from another clock or the names of files."""
    for other in others:
        found = _compare(first, other, blocks)
        if found is not None and (changed := _shift(first, found.usual, f"column '{other.columns[0]}'")) is not None:
            return changed
    ahead = [
        float(np.nanmedian(times)) - datetime(day.year, day.month, day.day, 12, tzinfo=UTC).timestamp()
        for table, block in blocks
        if (day := find_name_day(table.path)) is not None
        and np.isfinite(times := read_clock(first.to_source(), [(table, block)])).any()
    ]
    if ahead and max(ahead) - min(ahead) < SLACK:
        return _shift(first, float(np.median(ahead)), "the name of the file") or first
    return first


def _shift(first: GuessedTime, ahead: float, witness: str) -> GuessedTime | None:
    """Return a clock that is moved by whole rollovers, or counts from another zero, where it is early by that."""
    rolls = round(-ahead / (ROLLOVER_WEEKS * SECONDS_PER_WEEK))
    if rolls >= 1 and abs(ahead + rolls * ROLLOVER_WEEKS * SECONDS_PER_WEEK) < SLACK:
        weeks = rolls * ROLLOVER_WEEKS
        words = f"{weeks} weeks added, as {witness} is later by that: the count of GPS weeks started again"
        return first._replace(add_weeks=weeks, reason=f"{first.reason}; {words}", doubts=(*first.doubts, words))
    if first.unit is not None and first.origin is None and first.has_zone:
        for zero, text, name in EPOCHS:
            if abs(ahead + zero) < SLACK:
                return first._replace(origin=text, reason=f"{name}, as {witness} shows")
    return None


def _align(other: GuessedTime, first: GuessedTime, blocks: Blocks) -> GuessedTime:
    """Return another clock, moved by whole rollovers or to another zero where it is early by that."""
    found = _compare(other, first, blocks)
    moved = _shift(other, found.usual, f"column '{first.columns[0]}'") if found is not None else None
    return moved or other


def _find_offset_column(first: GuessedTime, names: Sequence[str], blocks: Blocks) -> GuessedTime | None:
    """Return a local clock with a column of offsets, None where there is none."""
    for name in names:
        if not _OFFSET_NAME.search(name.strip()) or name in first.columns:
            continue
        cells = collect_cells((name,), blocks)
        if cells is None or not len(cells):
            continue
        noon = np.full(len(cells), np.datetime64("2024-06-01T12:00", "us"))
        if np.isfinite(read_offsets(cells, noon)).mean() > 0.9:
            return first._replace(
                offset_column=name, has_zone=True, reason=f"{first.reason}; offset from UTC in column '{name}'"
            )
    return None


def _take_zone(first: GuessedTime, other: GuessedTime, blocks: Blocks, *, is_fixed: bool) -> GuessedTime | None:
    """Return a local clock with the zone of another one, or that one where it is as good; None for neither."""
    found = _compare(first, other, blocks)
    if found is None or abs(found.usual) > LARGEST + STEADY:
        return None
    name = other.columns[0]
    if not is_fixed and _is_as_good(other, first, blocks):
        words = f"it is in UTC, beside the local time in column '{first.columns[0]}'"
        return other._replace(has_zone=True, reason=f"{other.reason}; {words}")
    if (other.form is not None and "%Z" in other.form) or (
        other.form is None and other.unit is None and other.has_zone
    ):
        stated = first._replace(offset_column=name)
        again = _compare(stated, other, blocks)
        if again is not None and abs(again.usual) < 4 * STEADY:
            return stated._replace(
                has_zone=True, reason=f"{first.reason}; offset from UTC as stated in column '{name}'"
            )
    rounded = round(found.usual / QUARTER) * QUARTER
    if found.is_steady and abs(found.usual - rounded) < STEADY:
        words = f"zone by the difference to column '{name}', which is in UTC"
        return first._replace(zone=spell_offset(rounded), reason=f"{first.reason}; {words}")
    return None


def _is_as_good(other: GuessedTime, first: GuessedTime, blocks: Blocks) -> bool:
    """Return whether a clock is known in as many rows as another one, and as fine."""
    mine, yours = (read_clock(each.to_source(), blocks) for each in (other, first))
    known, wanted = np.isfinite(mine), np.isfinite(yours)
    return bool(
        known.sum() >= 0.95 * wanted.sum() and len(np.unique(mine[known])) >= 0.9 * len(np.unique(yours[wanted]))
    )


def _order_day_and_month(
    first: GuessedTime, others: Sequence[GuessedTime], names: Sequence[str], blocks: Blocks
) -> GuessedTime:
    """Return a clock with the format that the witnesses prefer, or with a doubt where none of them decides."""
    forms = [first.form or "", *first.others]
    times = {form: read_clock(first._replace(form=form).to_source(), blocks) for form in forms}
    for find in (partial(_prefer_by_clock, others=others), _prefer_by_name, _prefer_by_file):
        kept, reason = find(forms, times, blocks)
        if reason and len(kept) == 1:
            return first._replace(
                form=kept[0], others=(), reason=f"{first.reason}, not {_spell(forms, kept)}, {reason}"
            )
        forms = kept
    kept = _read_on(first, forms, blocks)
    if len(kept) == 1:
        return first._replace(
            form=kept[0], others=(), reason=f"{first.reason}, not {_spell(forms, kept)}, by days above 12"
        )
    spans = {form: float(np.nanmax(times[form]) - np.nanmin(times[form])) for form in forms}
    ranked = sorted(forms, key=spans.__getitem__)
    if spans[ranked[1]] > spans[ranked[0]] + DAY:
        reason = f"by the shorter span of time ({spans[ranked[0]] / DAY:.3g} days, not {spans[ranked[1]] / DAY:.3g})"
        return first._replace(form=ranked[0], others=(), reason=f"{first.reason}, not {ranked[1]}, {reason}")
    return _assume_order(first, forms, times, names)


def _assume_order(
    first: GuessedTime, forms: Sequence[str], times: Mapping[str, Floats], names: Sequence[str]
) -> GuessedTime:
    """Return a clock whose order of day and month is assumed, with the doubt."""
    forms = _keep_latest(forms, times)
    of_america = "%p" in forms[0] or any(re.search(r"mph|°F|degF|\(mi\)|miles|\(ft\)", name) for name in names)
    shown = [form for form in forms if form.index("%m") < form.index("%d")]
    if of_america and shown:
        form, why = shown[0], "month first is assumed, as with miles and a clock of twelve hours"
    else:
        form, why = forms[0], "day first is assumed"
    other = next((each for each in (*forms, *times) if each != form), form)
    if re.search(r"%d\.%m\.|%d\. ?%m", form):
        return first._replace(
            form=form, others=(), reason=f"{first.reason}, day first, as dates with points are written"
        )
    known = np.flatnonzero(np.isfinite(times[form]))
    at = int(known[0]) if len(known) else 0
    days = [f"{datetime.fromtimestamp(float(times[each][at]), UTC):%Y-%m-%d}" for each in (form, other)]
    doubt = (
        f"ambiguous: the dates in column '{first.columns[0]}' may be {days[0]} or {days[1]}, and no row decides; "
        f'{why}: where this is wrong, set format = "{other}" in [time]'
    )
    reason = f"{first.reason}; ambiguous: {why}, else format = '{other}'"
    return first._replace(form=form, others=(), reason=reason, doubts=(*first.doubts, doubt))


def _keep_latest(forms: Sequence[str], times: Mapping[str, Floats]) -> list[str]:
    """Return the formats with the latest year, where two digits may be the year or the day."""
    years = {form: datetime.fromtimestamp(float(np.nanmedian(times[form])), UTC).year for form in forms}
    return [form for form in forms if years[form] == max(years.values())]


Kept = tuple[list[str], str]


def _prefer_by_clock(
    forms: list[str], times: Mapping[str, Floats], blocks: Blocks, *, others: Sequence[GuessedTime]
) -> Kept:
    """Return the formats that agree with another clock."""
    for other in others:
        theirs = read_clock(other.to_source(), blocks)
        near = [form for form in forms if _is_near(times[form] - theirs)]
        if near and len(near) < len(forms):
            return near, f"as column '{other.columns[0]}' shows"
    return forms, ""


def _is_near(ahead: Floats) -> bool:
    """Return whether two clocks show the same days, perhaps in other zones."""
    known = ahead[np.isfinite(ahead)]
    if len(known) < LEAST_ROWS:
        return False
    rollover = ROLLOVER_WEEKS * SECONDS_PER_WEEK
    known = known - round(float(np.median(known)) / rollover) * rollover
    return bool(np.mean(np.abs(known) < LARGEST + DAY / 2) > 0.9)


def _prefer_by_name(forms: list[str], times: Mapping[str, Floats], blocks: Blocks) -> Kept:
    """Return the formats that agree with the days in the names of the files."""
    days = [find_name_day(table.path) for table, _ in blocks]
    if None in days:
        return forms, ""
    near = [form for form in forms if _fits_days(times[form], days, blocks)]
    return (near, "as the name of the file shows") if near and len(near) < len(forms) else (forms, "")


def _fits_days(times: Floats, days: Sequence[date | None], blocks: Blocks) -> bool:
    """Return whether the times of each file begin on the day of its name."""
    at = 0
    for day, (_, block) in zip(days, blocks, strict=True):
        count = len(next(iter(block.values())))
        known = times[at : at + count]
        known = known[np.isfinite(known)]
        at += count
        if day is None or not len(known):
            continue
        noon = datetime(day.year, day.month, day.day, 12, tzinfo=UTC).timestamp()
        if abs(known[0] - noon) > SLACK:
            return False
    return True


def _prefer_by_file(forms: list[str], times: Mapping[str, Floats], blocks: Blocks) -> Kept:
    """Return the formats with which no row is later than the files, or so early that no logger was there."""
    written = max(table.path.stat().st_mtime for table, _ in blocks) + DAY
    tests: list[tuple[Callable[[Floats], bool], str]] = [
        (lambda each: bool(np.nanmax(each) <= written), "by the time at which the file was written"),
        (lambda each: bool(np.nanmin(each) >= EARLIEST), "because no row is that old"),
    ]
    why = ""
    for test, reason in tests:
        kept = [form for form in forms if test(times[form])]
        if kept and len(kept) < len(forms):
            forms, why = kept, reason
    return forms, why


def _read_on(first: GuessedTime, forms: list[str], blocks: Blocks) -> list[str]:
    """Return the formats that also read further rows of the files, all where none fails."""
    if len(first.columns) > 1:
        return forms
    (name,) = first.columns
    for table in dict.fromkeys(table for table, _ in blocks):
        for block in islice(table.iterate_blocks([name], RowFaults()), 1, MOST_BLOCKS):
            texts = pc.unique(pc.utf8_trim_whitespace(pc.cast(block[name], pa.string()))).drop_null()
            reads = {form: int(np.sum(~np.isnat(parse_times(texts, form).stamps))) for form in forms}
            best = [form for form in forms if reads[form] == max(reads.values())]
            if len(best) < len(forms):
                return best
    return forms


def _spell(forms: Sequence[str], kept: Sequence[str]) -> str:
    """Return the formats that were given up."""
    return " or ".join(form for form in forms if form not in kept)
