"""`socast ask`: ask a live consumer whether a car can take a ride and still finish above its reserve."""

from collections.abc import Iterator, Sequence
from datetime import UTC, tzinfo
from pathlib import Path
from typing import Annotated, Final

import msgspec
import typer
from rich.console import Console
from rich.text import Text

from socast.core.errors import SettingsError, read_input
from socast.core.files import UNREADABLE
from socast.core.formatting import format_count, format_half_width
from socast.core.wire.messages import Interval, LegOutlook, Outlook
from socast.core.wire.plan_checks import ShownParameter, ShownParameters, parse_leg, parse_plan, parse_vehicle
from socast.stream.zenoh_queryable import query_outlook
from socast.stream.zenoh_session import LOOPBACK, Connection, Node
from socast.tools.terminal.output import JsonFile, check_outputs, make_console, print_plain, write_json
from socast.tools.terminal.time_zone import TimeZone, find_zone, format_local

LOW_RISK: Final = 0.05
"""Probability of falling below the reserve under which the answer is YES. [1]"""
HIGH_RISK: Final = 0.5
"""Probability of falling below the reserve above which the answer is NO. [1]"""
BESIDES: Final = (
    "waiting, heating, empty ways and the way home",
    "waiting, heating and empty ways to the next charge",
)
"""What takes energy beside the legs, without and with a planned charge."""
LEAST_KWH: Final = 0.05
"""Energy of waiting from which it is shown. [kWh]"""
SURE_CAPACITY: Final = 0.1
"""Relative standard deviation of the usable capacity below which the consumption of a car is shown. [1]"""
OPTIONS: Final[ShownParameters] = {
    "distance_km": ShownParameter("--distance-km", "kilometres"),
    "duration_s": ShownParameter("--duration-min", "minutes", 60.0),
    "gained_m": ShownParameter("--gained-m", "metres"),
    "lost_m": ShownParameter("--lost-m", "metres"),
}
"""The options of a ride."""
LONGEST_S: Final = 3600.0
"""Longest permitted wait for an answer. [s]"""
INTERVALS: Final = {"(": "in brackets: 90 % interval", "±": "±: half of the 95 % interval"}
"""Mark of an interval in a figure -> which interval it is."""
_CLOCK: Final = "%H:%M %Z"
_SAYS: Final = {
    "YES": "{} can",
    "NO": "{} cannot",
    "UNCERTAIN": "{} may not be able to",
    "NOT KNOWN": "whether {} can",
}
_STYLES: Final = {"YES": "bold green", "NO": "bold red", "UNCERTAIN": "bold yellow", "NOT KNOWN": "bold yellow"}


def ask_outlook(
    vehicle: Annotated[str, typer.Argument(metavar="VEHICLE", help="The car, such as taxi-012.")],
    distance_km: Annotated[float | None, typer.Option(metavar="KM", help="Length of the ride.")] = None,
    duration_min: Annotated[float | None, typer.Option(metavar="MIN", help="Duration of the ride.")] = None,
    gained_m: Annotated[float | None, typer.Option(metavar="M", help="Altitude gained on the ride.")] = None,
    lost_m: Annotated[float | None, typer.Option(metavar="M", help="Altitude lost on the ride.")] = None,
    plan: Annotated[
        Path | None,
        typer.Option(metavar="F.json", help="Answer for this plan instead of the known one; JSON as on the wire."),
    ] = None,
    connect: Annotated[
        str | None, typer.Option(metavar="E", help=f"Router to join. [default: that of --config, else {LOOPBACK}]")
    ] = None,
    config: Annotated[
        Path | None, typer.Option(metavar="F.json5", help="Zenoh's own configuration, such as dispatch.json5.")
    ] = None,
    prefix: Annotated[str, typer.Option(metavar="P", help="Key chunks before `fleet`, such as montreal.")] = "",
    timeout_s: Annotated[float, typer.Option(metavar="S", help="Longest wait for the answer.")] = 5.0,
    time_zone: TimeZone = None,
    json_file: JsonFile = None,
) -> None:
    """Ask a live consumer whether a car can take a ride and still finish above its reserve.

    Without a ride the question is about the shift as planned. The answer is YES for a risk below 5 %, NO above 50 %,
    and UNCERTAIN between. The figures in brackets are 90 % intervals, and ± is half of a 95 % interval. Every answer
    exits with code 0.

    Examples
    --------
    socast ask taxi-012 --distance-km 18 --duration-min 25 --gained-m 40
    socast ask taxi-012 --plan plan.json --connect tcp/router.example:7447 --prefix montreal
    socast ask taxi-012 --config dispatch.json5 --prefix montreal
    """
    console = make_console(json_file)
    zone = find_zone(time_zone, console)
    duration_s = None if duration_min is None else 60.0 * duration_min
    ride = {"distance_km": distance_km, "duration_s": duration_s, "gained_m": gained_m, "lost_m": lost_m}
    given = {name: f"{value:.12g}" for name, value in ride.items() if value is not None}
    check_outputs([plan] if plan else [], json_file)
    payload = _read(plan) if plan else None
    parse_plan(payload, parse_vehicle(vehicle))  # report mistakes before a query is sent
    parse_leg(given, OPTIONS)
    if not 0.0 < timeout_s <= LONGEST_S:
        raise SettingsError(f"--timeout-s is {timeout_s:g}, must be above 0 and at most {LONGEST_S:g} s")
    joined = Connection((connect,) if connect else (), mode="client", prefix=prefix, config=config)
    with Node(joined) as node:
        answer = query_outlook(node, vehicle, given, payload, timeout_s)
    try:
        outlook = msgspec.json.decode(answer, type=Outlook)
    except UNREADABLE as error:
        raise SettingsError(
            f"the answer for {vehicle} cannot be read: {error}; use the same version of `socast` as the consumer"
        ) from error
    write_json(json_file, "ask", outlook)
    show(outlook, console, zone)


def show(outlook: Outlook, console: Console, zone: tzinfo | None = UTC) -> None:
    """Print the answer: first one word, then a sentence, then the figures."""
    word, sentence = verdict(outlook)
    console.print(Text.assemble((f"{word}:", _STYLES[word]), f" {sentence}"), highlight=False, soft_wrap=True)
    shown = list(figures(outlook, zone))
    for name, figure in shown:
        print_plain(console, f"  {name:<14} {figure}")
    meanings = [words for mark, words in INTERVALS.items() if any(mark in figure for _, figure in shown)]
    if meanings:
        print_plain(console, f"  {'; '.join(meanings)}", style="dim")


def verdict(outlook: Outlook) -> tuple[str, str]:
    """Return the answer as one word and as a sentence.

    Returns
    -------
    word : str
        `YES`, `NO`, `UNCERTAIN` or `NOT KNOWN`. If the rest of the shift is unknown, the word is about the ride only.
    """
    ride, risk, ends, rest = outlook.asked, outlook.reserve_risk, "finish", ""
    if risk is None and ride and isinstance(ride.reserve_risk, float):
        risk, ends, rest = ride.reserve_risk, "arrive", "; the rest of its shift is not known"
    word, because = "NOT KNOWN", ""
    if risk is not None:
        word = "YES" if risk < LOW_RISK else "NO" if risk > HIGH_RISK else "UNCERTAIN"
        because = f": the risk is {_share(risk)}{rest}"
    doing = (
        f"take {ride.distance_km:.4g} km in {ride.duration_s / 60:.0f} min and {ends}" if ride else "finish its shift"
    )
    says = _SAYS[word].format(outlook.vehicle_id)
    return word, f"{says} {doing} above its reserve of {outlook.reserve_soc_pct:g} %{because}"


def figures(outlook: Outlook, zone: tzinfo | None = UTC) -> Iterator[tuple[str, str]]:
    """Yield the figures behind the answer, without unknown ones; the reason for a missing answer comes last."""
    reserve = outlook.reserve_soc_pct
    ride, end = outlook.asked, outlook.soc_end_of_shift_pct
    if ride and ride.soc_pct:
        risk = f", risk {_share(ride.reserve_risk)}" if isinstance(ride.reserve_risk, float) else ""
        yield "at arrival", f"{_format_interval(ride.soc_pct, '%')}, {_apart(ride.soc_pct.mean, reserve)}{risk}"
    if charge := outlook.next_charge:
        level = f"{_format_interval(charge.soc_pct, '%')} at {format_local(charge.time_s, _CLOCK, zone)}"
        yield "next charge", f"{level}, {_apart(charge.soc_pct.mean, reserve)}"
    if end:
        when = f" at {format_local(outlook.shift_end_s, _CLOCK, zone)}" if outlook.shift_end_s is not None else ""
        yield "end of shift", f"{_format_interval(end, '%')}{when}, {_apart(end.mean, reserve)}"
    if ride and ride.energy_kwh:
        yield "energy", _format_interval(ride.energy_kwh, "kWh", 2)
    if outlook.legs:
        yield "then planned", _planned(outlook.legs)
    if outlook.waiting_energy_kwh is not None and outlook.waiting_energy_kwh >= LEAST_KWH:
        yield "besides", f"{outlook.waiting_energy_kwh:.1f} kWh for {BESIDES[bool(outlook.next_charge)]}"
    if outlook.soc_pct is not None:
        yield "now", _now(outlook, zone)
    capacity, sd = outlook.usable_capacity_kwh, outlook.usable_capacity_sd_kwh
    knows_capacity = capacity is not None and sd is not None and sd < SURE_CAPACITY * capacity
    if outlook.consumption_scale is not None and knows_capacity:  # else the two cannot be told apart
        yield (
            "this car today",
            f"{_compare(outlook.consumption_scale)} is usual for its vehicle model at this temperature",
        )
    if outlook.why_not:
        yield "not known", outlook.why_not


def _read(path: Path) -> bytes:
    """Return the content of a file; refuse an empty one, which the consumer would treat as no plan."""
    try:
        held = read_input(path)
    except OSError as error:
        raise SettingsError(f"{path} cannot be read: {error.strerror}; name a file with a plan as JSON") from error
    if not held:
        raise SettingsError(f"{path} is empty; name a file with a plan as JSON, or leave --plan out")
    return held


def _format_interval(value: Interval, unit: str, digits: int = 0) -> str:
    """Return the text of a quantity with its interval."""
    return f"{value.mean:.{digits}f} {unit} ({value.p05:.{digits}f} to {value.p95:.{digits}f})"


def _apart(soc: float, reserve: float) -> str:
    """Return the text of the difference between a state of charge and the reserve."""
    return f"{abs(soc - reserve):.0f} points {'above' if soc >= reserve else 'below'} the reserve"


def _share(risk: float) -> str:
    """Return the text of a probability in percent, never as certainty.

    >>> _share(0.0), _share(0.034), _share(1.0)
    ('under 1 %', '3 %', 'over 99 %')
    """
    if risk < 0.01:
        return "under 1 %"
    if LOW_RISK - 0.005 <= risk < LOW_RISK:
        return f"under {LOW_RISK * 100:.0f} %"
    return "over 99 %" if risk > 0.99 else f"{risk * 100:.0f} %"


def _compare(ratio: float) -> str:
    """Return the text of a consumption over another one.

    >>> _compare(1.213), _compare(0.9), _compare(1.001)
    ('takes 21 % more than', 'takes 10 % less than', 'takes as much as')
    """
    percent = round(100.0 * abs(ratio - 1.0))
    return f"takes {percent} % {'more' if ratio > 1.0 else 'less'} than" if percent else "takes as much as"


def _planned(legs: Sequence[LegOutlook]) -> str:
    """Return the text of the remaining legs of a plan: number, distance and energy of rides, and charges."""
    rides = [leg for leg in legs if not leg.is_charge()]
    known = [leg.energy_kwh.mean for leg in rides if leg.energy_kwh]
    takes = f", {sum(known):.1f} kWh" if len(known) == len(rides) else ""
    text = f"{format_count(len(rides), 'leg')}, {sum(leg.distance_km for leg in rides):.0f} km{takes}"
    charges = [f"{leg.charge_to_soc_pct:g} %" for leg in legs if leg.is_charge()]
    return f"{text}, charges to {' and '.join(charges)}" if charges else text


def _now(outlook: Outlook, zone: tzinfo | None) -> str:
    """Return the text of the state of charge, the usable capacity and the time of the sample."""
    soc = f"{outlook.soc_pct:.1f}{format_half_width(outlook.soc_sd_pct, 1)}"
    of = ""
    if outlook.usable_capacity_kwh is not None:
        half = format_half_width(outlook.usable_capacity_sd_kwh, 1)
        of = f" of {outlook.usable_capacity_kwh:.1f}{half} kWh"
    return f"{soc} %{of}, by a sample of {format_local(outlook.time_s, '%Y-%m-%d %H:%M %Z', zone)}"
