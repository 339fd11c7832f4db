"""`socast import`: public data sets of real drives, turned into recordings that `replay` and `tables` read."""

from collections.abc import Callable, Iterable, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Annotated, TypeVar
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

import typer
from rich.console import Console
from rich.progress import track

from core.errors import ImportFileError, SettingsError
from stream.mcap_writer import McapSink
from tools.importers import bmw_i3, twizy, ved
from tools.importers.drive import Drive, in_order, messages
from tools.importers.published import files
from tools.importers.shifts import FULL, Strung, plans, strung

app = typer.Typer(no_args_is_help=True, help="Turn public data sets of real drives into recordings.")

Paths = Annotated[list[Path], typer.Argument(help="Files as published, plain or .gz, or folders of them.")]
Out = Annotated[Path, typer.Option("--out", help="The recording to write.", metavar="FILE.mcap")]
Period = Annotated[float, typer.Option(min=0.1, max=60.0, help="Seconds between two samples, about.")]
SkipBad = Annotated[bool, typer.Option("--skip-bad", help="Go on without files that cannot be read, and name them.")]
ShiftHours = Annotated[
    float | None,
    typer.Option(
        "--shift-hours", metavar="H", min=0.5, max=24.0, help="String each car's rides into shifts of about so long."
    ),
]
Zone = Annotated[str, typer.Option(help="Time zone of the files' clock.", metavar="ZONE")]

Step = TypeVar("Step")
BLOCK = 4096
"""Messages handed to the recording at a time."""


@app.command("ved")
def import_ved(
    *,
    paths: Paths,
    out: Out,
    vehicle: Annotated[
        list[int] | None, typer.Option(help="Only this VehId; may be repeated. By default all electric cars.")
    ] = None,
    period: Period = 3.0,
    shift_hours: ShiftHours = None,
    time_zone: Zone = ved.TIME_ZONE,
    skip_bad: SkipBad = False,
) -> None:
    """Import the electric cars of the Vehicle Energy Dataset (Ann Arbor): weekly originals or extracts."""
    zone, chosen = _zone(time_zone), tuple(vehicle or ())
    drives = collect(paths, lambda path: ved.read_drives(path, zone, chosen), skip_bad)
    absent = [number for number in chosen if f"ved-{number}" not in {drive.vehicle_id for drive in drives}]
    if absent or not drives:
        who = f"VehId {absent[0]} with battery data" if absent else "electric car"
        raise ImportFileError(
            f"{paths[0]}: column 'VehId' has no {who} in the files given; 10, 455 and 541 are electric"
        )
    write(drives, out, period, shift_hours)


@app.command("bmw-i3")
def import_bmw_i3(
    paths: Paths,
    out: Out,
    period: Period = 3.0,
    shift_hours: ShiftHours = None,
    time_zone: Zone = bmw_i3.TIME_ZONE,
    skip_bad: SkipBad = False,
) -> None:
    """Import the BMW i3 around Munich, summer and winter, logged at 10 Hz; needs Overview.xlsx beside the files."""
    zone = _zone(time_zone)
    overviews: dict[Path, dict[str, object]] = {}

    def read(path: Path) -> list[Drive]:
        if path.parent not in overviews:
            overviews[path.parent] = bmw_i3.read_overview(path.parent / bmw_i3.OVERVIEW)
        return bmw_i3.read_drives(path, zone, overviews[path.parent])

    write(collect(paths, read, skip_bad), out, period, shift_hours)


@app.command("twizy")
def import_twizy(
    paths: Paths,
    out: Out,
    period: Period = 3.0,
    shift_hours: ShiftHours = None,
    time_zone: Zone = twizy.TIME_ZONE,
    skip_bad: SkipBad = False,
) -> None:
    """Import the Renault Twizy around Rabat, logged at 1 Hz, without voltage and current."""
    zone = _zone(time_zone)
    write(collect(paths, lambda path: twizy.read_drives(path, zone), skip_bad), out, period, shift_hours)


def collect(paths: Sequence[Path], read: Callable[[Path], list[Drive]], skip_bad: bool = False) -> list[Drive]:
    """Read the drives of all files, and put them in order of time.

    Parameters
    ----------
    paths : sequence of Path. Files and folders.
    read : callable. The drives of one file.
    skip_bad : bool. Name and count what cannot be read instead of raising.

    Returns
    -------
    list of Drive
        As `in_order` has them.

    Raises
    ------
    ImportFileError
        For the first bad file, and where no file is left or a ride is there twice.
    """
    console = Console(stderr=True)
    source_of: dict[tuple[str, str], Path] = {}
    drives: list[Drive] = []
    bad = 0
    named = files(paths)
    for path in _progress(named, "reading"):
        try:
            found = _once(path, read(path), source_of)
        except ImportFileError as error:
            if not skip_bad:
                raise
            bad += 1
            console.print(f"skipped: {error}", style="yellow", markup=False, highlight=False, soft_wrap=True)
            continue
        drives += found
    if bad == len(named):
        raise ImportFileError(f"{paths[0]}: none of the {bad} files given can be read")
    if bad:
        console.print(f"skipped {bad} of {len(named)} files", style="yellow")
    return in_order(drives)


def write(drives: Sequence[Drive], out: Path, period: float, shift_hours: float | None = None) -> None:
    """Write drives as a recording, and say what is in it.

    Parameters
    ----------
    drives : sequence of Drive. In order.
    out : Path. The recording.
    period : float. Time between two samples. [s]
    shift_hours : float, optional. String the rides of each car into shifts, with plans. [h]
    """
    console = Console()
    for note in (note for drive in drives for note in drive.notes):
        console.print(note, markup=False, highlight=False, soft_wrap=True)
    shifts = [] if shift_hours is None else strung(drives, shift_hours)
    if shifts:
        console.print(_of_shifts(shifts), markup=False, highlight=False, soft_wrap=True)
        drives = [drive for shift in shifts for drive in shift.drives]
    planned = [plan for shift in shifts for plan in plans(shift)]
    recording = sorted([*messages(drives, period), *planned], key=attrgetter("receipt_ns"))
    with McapSink(out) as sink:
        for start in _progress(range(0, len(recording), BLOCK), "writing"):
            sink.put(recording[start : start + BLOCK])
    cars = len({drive.vehicle_id for drive in drives})
    hours = sum(float(drive.elapsed[-1]) for drive in drives) / 3600
    console.print(
        f"{out}: {len(recording)} messages, {len(drives)} rides of {cars} car{'s' * (cars > 1)}, {hours:.1f} h",
        markup=False,
        highlight=False,
        soft_wrap=True,
    )


def _of_shifts(shifts: Sequence[Strung]) -> str:
    """Return what became of the rides, for a person to read."""
    hours = [(shift.end - shift.drives[0].start) / 3600.0 for shift in shifts]
    return (
        f"strung into {len(shifts)} shifts of {min(hours):.1f} to {max(hours):.1f} h: rides moved, the state of charge "
        f"continued from {FULL:g} %, plans made up"
    )


def _once(path: Path, drives: list[Drive], source_of: dict[tuple[str, str], Path]) -> list[Drive]:
    """Return the drives of a file and remember them, if none has come from another file."""
    names = [(drive.vehicle_id, drive.ride_id) for drive in drives]
    for name in names:
        if name in source_of:
            raise ImportFileError(f"{path}: holds ride {name[1]}, as {source_of[name]} does; give each ride once")
    source_of.update(dict.fromkeys(names, path))
    return drives


def _progress(steps: Sequence[Step], what: str) -> Iterable[Step]:
    """Show a bar on a terminal, nothing elsewhere."""
    console = Console(stderr=True)
    return track(steps, what, console=console, transient=True, disable=not console.is_terminal)


def _zone(name: str) -> ZoneInfo:
    """Return a time zone by its name."""
    try:
        return ZoneInfo(name)
    except (ZoneInfoNotFoundError, ValueError, OSError) as error:
        raise SettingsError(
            f"--time-zone is '{name}', which is no time zone; give one as Europe/Berlin or UTC"
        ) from error
