"""`socast info`: show what recordings contain."""

from collections import Counter
from collections.abc import Callable, Mapping
from datetime import UTC, datetime, tzinfo
from operator import itemgetter
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape

from socast.core.formatting import format_count
from socast.core.wire.messages import BATCH, OF_VEHICLES, address
from socast.stream.mcap_reader import McapSource
from socast.tools.terminal.output import JsonFile, check_outputs, make_console, print_plain, write_json
from socast.tools.terminal.recordings import Recordings, open_recordings, refuse_unusable, show_progress, warn_of_losses
from socast.tools.terminal.rich_table import Column, make_table
from socast.tools.terminal.time_zone import TimeZone, find_zone, format_local, name_zone

MOST_TOPICS = 30
"""Largest number of topics shown on a terminal; the JSON report has all."""
OTHER = "other"
"""Kind of the messages that do not follow the wire contract."""


def info(recordings: Recordings, json_file: JsonFile = None, time_zone: TimeZone = None) -> None:
    """Show what recordings contain and what is lost: time span, vehicles, topics and schemas.

    Every chunk is read and checked, but no payload is decoded: `socast tables` reports what is wrong inside payloads.

    Examples
    --------
    socast info recordings/shift.mcap
    socast info kept/*.mcap --json - | jq '.recordings[].vehicles'
    """
    sources = open_recordings(recordings)
    check_outputs(recordings, json_file)
    with show_progress(sources) as step:
        contents = [describe_recording(source, step) for source in sources]
    write_json(json_file, "info", {"recordings": contents})
    console = make_console(json_file)
    zone = find_zone(time_zone, console)
    for source, content in zip(sources, contents, strict=True):
        _show(console, content, zone)
        warn_of_losses([source], console)
    for source, content in zip(sources, contents, strict=True):
        refuse_unusable([source], content["messages"] - content["kinds"].get(OTHER, 0))


def describe_recording(source: McapSource, step: Callable[[], None] = lambda: None) -> dict[str, Any]:
    """Read a recording to its end and return what it contains.

    Returns
    -------
    dict
        `path`, `bytes`, `joined` (recordings in the file, more than one where files were joined), `chunks`, `messages`,
        `begin`, `end` (ISO 8601, None for an empty recording), `duration_s`, `vehicles` (that have keys of their own),
        `stations`, `gateways` (that send batches), `kinds`, `topics` (`messages` and `schema` each), `viewer_topics`
        (likewise; their messages are for viewers, and no command reads them), `metadata` (what wrote the recording;
        empty if the file does not say) and `losses`.
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
    named: dict[str, set[str]] = {"vehicle": set(), "weather": set(), "errors": set(), "finding": set()}
    named[BATCH] = set()
    for topic, count in counts.items():
        where = addresses[topic]
        kinds[where.kind if where else OTHER] += count
        if where:
            named["vehicle" if where.kind in OF_VEHICLES else where.kind].add(where.identity)
    return {
        "path": str(source.path),
        "bytes": source.path.stat().st_size,
        "joined": source.joined,
        "chunks": source.blocks,
        "messages": counts.total(),
        "begin": _format_time(first),
        "end": _format_time(last),
        "duration_s": (last - first) * 1e-9 if first is not None and last is not None else 0.0,
        "vehicles": sorted(named["vehicle"]),
        "stations": sorted(named["weather"]),
        "gateways": sorted(named[BATCH]),
        "kinds": dict(kinds),
        "topics": _describe_topics(source, counts),
        "viewer_topics": _describe_topics(source, source.viewer_messages),
        "metadata": source.metadata,
        "losses": source.losses.lines(),
    }


def _describe_topics(source: McapSource, counts: Mapping[str, int]) -> dict[str, dict[str, Any]]:
    """Return the number of messages and the schema of each topic."""
    return {topic: {"messages": counts[topic], "schema": source.schemas.get(topic, "")} for topic in sorted(counts)}


def _describe_metadata(metadata: Mapping[str, str]) -> str:
    """Return a line that says what wrote a recording, without control characters."""
    others = "; ".join(f"{name} {text}" for name, text in metadata.items() if name not in {"version", "command"})
    wrote = f"written by socast {metadata.get('version', '')} {metadata.get('command', '')}".strip()
    line = f"{wrote}; {others}" if others else wrote
    return "".join(each if each.isprintable() else "?" for each in line)


def _format_time(time_ns: int | None) -> str | None:
    """Return a time as ISO 8601 in UTC, to the second."""
    return None if time_ns is None else datetime.fromtimestamp(time_ns // 10**9, UTC).isoformat()


def _describe_span(content: Mapping[str, Any], zone: tzinfo | None) -> str:
    """Return from when to when a recording is, in a time zone."""
    if not content["begin"]:
        return "empty"
    ends = [datetime.fromisoformat(content[name]).timestamp() for name in ("begin", "end")]
    first, last = (format_local(each, "%Y-%m-%d %H:%M:%S", zone) for each in ends)
    return f"{first} to {last} {name_zone(ends, zone)}, {content['duration_s'] / 3600:.2f} h"


def _show(console: Console, content: dict[str, Any], zone: tzinfo | None) -> None:
    """Print what a recording contains."""
    name = escape(Path(content["path"]).name)
    console.print(f"[bold]{name}[/bold]  {_describe_span(content, zone)}", highlight=False, soft_wrap=True)
    console.print(
        f"{format_count(content['messages'], 'message')}, {format_count(len(content['vehicles']), 'vehicle')}, "
        f"{len(content['stations']):,} stations, {content['chunks']:,} chunks, {content['bytes']:,} bytes",
        highlight=False,
        soft_wrap=True,
    )
    if content["joined"] > 1:
        console.print(f"{content['joined']:,} recordings joined to one file; all are read", highlight=False)
    if content["metadata"]:
        print_plain(console, _describe_metadata(content["metadata"]))
    if for_viewers := content["viewer_topics"].values():
        count = sum(about["messages"] for about in for_viewers)
        schemas = ", ".join(sorted({about["schema"] for about in for_viewers}))
        topics = format_count(len(for_viewers), "topic")
        print_plain(
            console,
            f"for viewers, read by no command: {format_count(count, 'message')} on {topics} ({schemas})",
        )
    rows = [
        (escape(topic), f"{about['messages']:,}", escape(about["schema"]) or "none")
        for topic, about in list(content["topics"].items())[:MOST_TOPICS]
    ]
    if len(content["topics"]) > MOST_TOPICS:
        rows.append((f"and {len(content['topics']) - MOST_TOPICS:,} more", "", ""))
    if rows:
        console.print(make_table([Column("topic"), Column("messages", number=True), Column("schema")], rows=rows))
