"""`socast info`: what recordings hold."""

from collections import Counter
from datetime import UTC, datetime
from operator import itemgetter
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape

from core.wire.messages import OF_VEHICLES, address
from stream.mcap_writer import McapSource
from tools.terminal.output import JsonFile, printer, writable, write_json
from tools.terminal.recordings import Recordings, opened, reading, warn_of_losses
from tools.terminal.rich_table import Column, make_table

MOST_TOPICS = 30
"""Topics shown on a terminal; the JSON has all."""


def info(recordings: Recordings, json_file: JsonFile = None) -> None:
    """Tell what recordings hold: time span, vehicles, topics, schemas, and what is lost.

    Every chunk is read and checked. Nothing is decoded: for what is wrong inside payloads, see `tables`.
    """
    sources = opened(recordings)
    writable(recordings, json_file)
    console = printer()
    with reading(sources) as step:
        found = [described(source, step) for source in sources]
    for source, what in zip(sources, found, strict=True):
        _show(console, what)
        warn_of_losses([source], console)
    write_json(json_file, found)


def described(source: McapSource, step: Any = lambda: None) -> dict[str, Any]:
    """Read a recording to its end and return what it holds.

    Parameters
    ----------
    source : McapSource
    step : callable. Called after each chunk.

    Returns
    -------
    dict
        `path`, `bytes`, `chunks`, `messages`, `begin`, `end` (ISO 8601, None for an empty recording), `duration_s`,
        `vehicles`, `stations`, `kinds`, `topics` (`messages` and `schema` each) and `losses`.
    """
    counts: Counter[str] = Counter()
    first = last = None
    for block in source:
        if block:
            counts.update(map(itemgetter(0), block))
            first = block[0].receipt_ns if first is None else first
            last = block[-1].receipt_ns
        step()
    addresses = {topic: address(topic) for topic in counts}
    kinds: Counter[str] = Counter()
    named: dict[str, set[str]] = {"vehicle": set(), "weather": set(), "errors": set()}
    for topic, count in counts.items():
        where = addresses[topic]
        kinds[where.kind if where else "other"] += count
        if where:
            named["vehicle" if where.kind in OF_VEHICLES else where.kind].add(where.identity)
    return {
        "path": str(source.path),
        "bytes": source.path.stat().st_size,
        "chunks": source.blocks,
        "messages": counts.total(),
        "begin": _moment(first),
        "end": _moment(last),
        "duration_s": (last - first) * 1e-9 if first is not None and last is not None else 0.0,
        "vehicles": sorted(named["vehicle"]),
        "stations": sorted(named["weather"]),
        "kinds": dict(kinds),
        "topics": {
            topic: {"messages": counts[topic], "schema": source.schemas.get(topic, "")} for topic in sorted(counts)
        },
        "losses": source.losses.lines(),
    }


def _moment(time_ns: int | None) -> str | None:
    """Return a time as ISO 8601, to the second."""
    return None if time_ns is None else datetime.fromtimestamp(time_ns // 10**9, UTC).isoformat()


def _show(console: Console, what: dict[str, Any]) -> None:
    """Print what a recording holds."""
    span = f"{what['begin']} to {what['end']}, {what['duration_s'] / 3600:.2f} h" if what["begin"] else "empty"
    console.print(f"[bold]{escape(Path(what['path']).name)}[/bold]  {span}", highlight=False, soft_wrap=True)
    console.print(
        f"{what['messages']:,} messages, {len(what['vehicles']):,} vehicles, {len(what['stations']):,} stations, "
        f"{what['chunks']:,} chunks, {what['bytes']:,} bytes",
        highlight=False,
        soft_wrap=True,
    )
    table = make_table([Column("topic"), Column("messages", number=True), Column("schema")])
    for topic, about in list(what["topics"].items())[:MOST_TOPICS]:
        table.add_row(escape(topic), f"{about['messages']:,}", escape(about["schema"]) or "none")
    if len(what["topics"]) > MOST_TOPICS:
        table.add_row(f"and {len(what['topics']) - MOST_TOPICS:,} more", "", "")
    if what["topics"]:
        console.print(table)
