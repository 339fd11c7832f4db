"""Describe episodes, hours of a few dates in which the power is off, in sentences and in a table."""

from typing import Final

from socast.core.diagnose.records import Diagnosis, FoundEpisode
from socast.core.formatting import format_minus, word_date
from socast.tools.report.table import UNKNOWN, Cell, ReportTable, Row, format_count, format_percent

MOST_DATES: Final = 6
"""Number of dates above which only their number, the first and the last one are written out."""
LEAST_CHANCE: Final = 0.001
"""Probability below which a report gives only this bound. [1]"""
NOTE: Final = (
    "Power: mean power of the windows beyond what the model and every effect of the library explain, with a 95 % "
    "interval. Share: of the squared error of rides after refitting. Chance: probability that a diagnosis without any "
    "episode reports one as clear. Dates and hours are UTC."
)


def describe_leading_episode(result: Diagnosis) -> list[str]:
    """Return the sentence with which a report begins where hours of a few dates hold much of the error."""
    found = result.episodes
    if not found:
        return []
    more = f" {len(found) - 1} further: see Episodes." if len(found) > 1 else ""
    share, when = format_percent(found[0].share, 0), _word_when(found[0], result)
    what = f"{share} of the squared error is concentrated on {when}: {_word_power(found[0])}{_word_car(found[0])}"
    return [f"{what}. Look at {_these(found[0], result)} before you add an effect.{more}"]


def describe_episodes(result: Diagnosis) -> list[str]:
    """Return each episode with its dates, size and cars, what it may be, and the command that shows its worst ride."""
    lines = []
    for one in result.episodes:
        rides = one.rides
        cars = f"{format_count(len(one.cars))} of {format_count(one.cars_driving)}"
        lines.append(
            f"{_word_when(one, result)}: {_word_power(one)} in {cars} cars that drove then, "
            f"{format_count(len(rides))} rides; {format_percent(one.share)} of the squared error of rides. "
            f"Chance shows an episode as clear in {_word_chance(one)} of diagnoses."
        )
        lines.append(f"- {_suggest_cause(one, result)}")
        lines += [f"- the ride with the largest part of it is {rides[0]}"] if rides else []
        lines += [one.command] if one.command else []
    if lines:
        lines.append("What follows leaves the power of these hours out, so that no effect is named for it.")
    return lines


def advise_looking(result: Diagnosis) -> list[str]:
    """Return what to do about the first episode, with the command where there is one."""
    found = result.episodes
    if not found:
        return []
    line = (
        f"First look at the recordings of {_word_when(found[0], result)}, and leave these rides out if a logger is "
        "wrong."
    )
    return [line, found[0].command] if found[0].command else [line]


def tabulate_episodes(result: Diagnosis) -> ReportTable:
    """Return the episodes, the clearest first."""
    rows = tuple(
        Row(
            _list_dates(one) if result.data.dated else UNKNOWN,
            (
                Cell(_word_hours(one) if result.data.dated else UNKNOWN),
                Cell(_word_power(one)),
                Cell(format_percent(one.share)),
                Cell(", ".join(one.cars) or UNKNOWN),
                Cell(format_count(len(one.rides))),
                Cell(_word_chance(one)),
            ),
        )
        for one in result.episodes
    )
    return ReportTable("Episodes", "dates", ("hours", "power", "share", "cars", "rides", "chance"), rows, (NOTE,))


def _word_when(one: FoundEpisode, result: Diagnosis) -> str:
    """Return the dates and hours of an episode, or its rides where the dates are invented."""
    if result.data.dated:
        return f"{_list_dates(one)}, {_word_hours(one)}"
    further = len(one.rides) - MOST_DATES
    listed = ", ".join(one.rides[:MOST_DATES]) + (f" and {further} more" if further > 0 else "")
    return f"{format_count(len(one.rides))} rides, {listed}"


def _word_power(one: FoundEpisode) -> str:
    """Return the power with its interval.

    >>> _word_power(FoundEpisode(power_kw=6.02, power_ci95_kw=(5.66, 6.38)))
    '+6.0 kW (95 % interval 5.7 to 6.4)'
    """
    if one.power_kw is None:
        return UNKNOWN
    limits = one.power_ci95_kw
    interval = f" (95 % interval {limits[0]:.1f} to {limits[1]:.1f})" if limits else ""
    return format_minus(f"{one.power_kw:+.1f} kW{interval}")


def _word_hours(one: FoundEpisode) -> str:
    """Return the hours of an episode.

    >>> _word_hours(FoundEpisode(hours_utc=(22, 2))), _word_hours(FoundEpisode(hours_utc=(6, 21), whole_dates=True))
    ('22 to 2 h UTC', 'all hours')
    """
    first, last = one.hours_utc or (UNKNOWN, UNKNOWN)
    return "all hours" if one.whole_dates else f"{first} to {last} h UTC"


def _word_car(one: FoundEpisode) -> str:
    return f", in {one.car} alone" if one.car else ""


def _word_chance(one: FoundEpisode) -> str:
    """Return the probability of so clear an episode by chance, or its bound."""
    chance = one.chance
    if chance is None:
        return UNKNOWN
    return f"less than {format_percent(LEAST_CHANCE)}" if chance < LEAST_CHANCE else f"{format_percent(chance)}"


def _these(one: FoundEpisode, result: Diagnosis) -> str:
    if not result.data.dated:
        return "these rides"
    return "this date" if len(one.dates) == 1 else "these dates"


def _list_dates(one: FoundEpisode) -> str:
    """Return the dates in words.

    >>> _list_dates(FoundEpisode(dates=["2018-11-01", "2018-11-22"]))
    '1 November 2018 and 22 November 2018'
    """
    dates = [word_date(each) for each in one.dates]
    if len(dates) > MOST_DATES:
        return f"{len(dates)} dates from {dates[0]} to {dates[-1]}"
    return " and ".join(part for part in (", ".join(dates[:-1]), *dates[-1:]) if part)


def _suggest_cause(one: FoundEpisode, result: Diagnosis) -> str:
    """Return what an episode may be, by the cars that it concerns."""
    car, vehicles = one.car, result.data.vehicles
    if car and vehicles == 1:
        return "these data are of one car, so that weather, a load or its logger are not distinguishable"
    if car and one.cars_driving == 1:
        return f"no other car shows the same: look at {car} first, its logger or a load of its own"
    if car:
        return f"others drove then without it: this is a matter of {car}, such as its logger or a load of its own"
    return "several cars show it: weather that no column describes, their roads, or what their loggers have in common"
