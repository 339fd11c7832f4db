"""Describe coefficients, cars that deviate or change, and episodes, in sentences."""

from typing import Final

from socast.core.diagnose.deviation_words import (
    MONTH,
    SEVERAL,
    has_certain_size,
    is_rate_known,
    name_cause,
    name_deviating,
    word_deviation,
)
from socast.core.diagnose.records import CarDeviation, Diagnosis, EstimatedCoefficient, FoundEpisode, RankedCar
from socast.core.formatting import format_minus, word_date
from socast.tools.report.table import UNKNOWN, Cell, ReportTable, Row, format_count, format_percent

SUPERSCRIPTS: Final = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")


def format_unit(unit: str) -> str:
    """Return a unit as it is printed: `m^2` is m², and `1` is empty.

    Examples
    --------
    >>> format_unit("m^2"), format_unit("W/K"), format_unit("1"), format_unit("s^-1 / m**2")
    ('m²', 'W/K', '', 's⁻¹ / m²')
    """
    head, *rest = unit.replace("**", "^").split("^")
    words = head
    for part in rest:
        digits = len(part) - len(part.lstrip("-0123456789"))
        words += part[:digits].translate(SUPERSCRIPTS) + part[digits:]
    return "" if words == "1" else words


def describe_coefficient(coefficient: EstimatedCoefficient) -> str:
    """Return a coefficient, its interval, and whether it is plausible."""
    value, limits = coefficient.value, coefficient.ci95
    if value is None:
        return ""
    unit = f" {format_unit(coefficient.unit)}".rstrip()
    interval = f", 95 % interval {limits[0]:.3g} to {limits[1]:.3g}" if limits else ""
    low, high = coefficient.low, coefficient.high
    words = f"coefficient {value:.3g}{unit}{interval}"
    if low is not None and high is not None:
        expected = f"range {low:g} to {high:g}{unit}"
        if not coefficient.plausible:
            words += f"; NOT plausible ({expected}): it may stand for another cause"
        else:
            words += f"; {'plausible' if low <= value <= high else 'plausible within its interval'} ({expected})"
    return format_minus(words)


WH: Final = 1000.0
"""Watt-hours in a kilowatt-hour. [Wh/kWh]"""
NOTABLE: Final = 1.0
"""Deviation from which a car that was not named is described. [spreads]"""
MOST_CARS: Final = 3
"""Number of cars that the terminal describes in spreads."""
MOST_SURE: Final = 0.999
"""Probability above which a report gives only this bound. [1]"""
DIRECTIONS: Final = {
    "rolling": ("rolls harder", "rolls more easily"),
    "drag": ("has more drag", "has less drag"),
    "constant": ("uses more standby power", "uses less standby power"),
    "inertia": ("uses more for acceleration", "uses less for acceleration"),
    "heating": ("uses more for heating", "uses less for heating"),
    "cooling": ("uses more for cooling", "uses less for cooling"),
    "climbing": ("uses more uphill", "uses less uphill"),
    "braking": ("recovers less when braking", "recovers more when braking"),
}
"""What a positive and a negative deviation in each direction mean."""


def describe_deviations(result: Diagnosis) -> list[str]:
    """Return one sentence for each deviation with what would distinguish its causes, then cars in spreads."""
    lines: list[str] = []
    for one in result.deviations:
        lines += describe_deviation(one)
    if not lines and result.cars:
        lines.append("No car deviates from its siblings beyond the spread between cars, and nothing changed.")
    named = {one.who for one in result.deviations}
    return lines + [line for car in result.cars[:MOST_CARS] if car.car not in named and (line := describe_spread(car))]


def describe_deviation(one: CarDeviation) -> list[str]:
    """Return a deviation as a sentence, its size, what would distinguish its causes, and the command that adds it.

    Examples
    --------
    >>> from socast.core.diagnose.records import CauseProbability
    >>> low_tyre = CauseProbability(effect="tyre_pressure", probability=0.94)
    >>> size = {"share": 0.041, "share_ci95": (0.032, 0.05)}
    >>> since = {"since": "2018-11-14", "since_ci90": ("2018-11-12", "2018-11-16")}
    >>> describe_deviation(CarDeviation(who="taxi-005", kind="step", causes=[low_tyre], **size, **since))
    ['taxi-005 uses 4.1 ± 0.9 % more since 14 November 2018 (12 to 16 November): low tyre pressure 94 %']
    """
    causes = one.causes
    lines = [word_deviation(one)]
    if sure := _word_probability(one):
        lines.append(f"- {sure}")
    if not has_certain_size(one):
        lines.append("- the interval of its size contains zero: record more rides before you rely on it")
    amounts = []
    if (per_km := one.kwh_per_km) is not None:
        amounts.append(f"{WH * per_km:+.3g} Wh/km")
    if (per_month := one.kwh_per_month) is not None:
        amounts.append(
            f"{per_month:+.3g} kWh per month" if is_rate_known(one) else f"{per_month / MONTH:+.3g} kWh a day"
        )
    if amounts:
        lines.append(format_minus(f"- {', '.join(amounts)} of the rides that were diagnosed"))
    if len(causes) > 1:
        remedies = dict.fromkeys(cause.shown_by for cause in causes[:SEVERAL] if cause.shown_by)
        lines += [f"- to distinguish the causes, record {remedy}" for remedy in remedies]
    if words := _word_cause(one):
        lines.append(f"- {words}")
    return [*lines, one.command] if one.command else lines


def _word_cause(one: CarDeviation) -> str:
    """Return what the size of the most probable cause means, an empty text where that is unknown."""
    if not one.words or len(one.causes) < 2:
        return one.words
    return f"if it is {name_cause(one.effect)}: {one.words}"


def describe_finding(found: CarDeviation) -> list[str]:
    """Return a deviation with the probability that it is real."""
    words = _word_cause(found)
    lines = [f"Finding: {word_deviation(found)}.{f' {words[:1].upper()}{words[1:]}.' if words else ''}"]
    if sure := _word_probability(found):
        lines.append(f"This finding is {sure}; the probabilities of its causes hold if it is.")
    return lines


def _word_probability(one: CarDeviation) -> str:
    """Return the probability that a deviation is real, or its bound; an empty text where it is unknown."""
    if one.q is None:
        return ""
    real = 1.0 - one.q
    bound = f"more than {format_percent(MOST_SURE)}" if real > MOST_SURE else format_percent(real, 0)
    return f"real with a probability of {bound}"


def advise_test(found: CarDeviation) -> list[str]:
    """Return how to test a deviation, with the command where a term can hold it."""
    who, since, effect = name_deviating(found), found.since, found.effect
    when = f" since {since}" if since else ""
    if found.columns:
        line = f"Test the finding on days to which it was not fitted: add {effect} in {who}{when}."
        return [line, found.command] if found.command else [line]
    what = "a growth" if found.kind == "ramp" else "a group"
    return [f"Check {who} for {name_cause(effect)}{when}: no term of a model holds {what}, so no command tests it."]


def describe_spread(car: RankedCar) -> str:
    """Return the largest deviation of a car in spreads, or an empty text where it is small or uncertain.

    Examples
    --------
    >>> from socast.core.diagnose.records import DirectionSpread
    >>> rolling = DirectionSpread(direction="rolling", value=1.34, error=0.5)
    >>> describe_spread(RankedCar(car="taxi-005", spreads=[rolling]))
    'taxi-005 rolls harder than its siblings by 1.3 ± 0.5 spreads between cars, which is not unusual'
    """
    most = max(car.spreads, key=lambda each: abs(each.value), default=None)
    if most is None or abs(most.value) < max(NOTABLE, most.error) or most.direction not in DIRECTIONS:
        return ""
    words = DIRECTIONS[most.direction][0 if most.value > 0.0 else 1]
    size = f"{abs(most.value):.1f} ± {most.error:.1f} spreads between cars"
    usual = ", which is not unusual" if abs(most.value) < 2.0 * NOTABLE else ""
    return f"{car.car} {words} than its siblings by {size}{usual}"


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
    these = "these rides" if not result.data.dated else "this date" if len(found[0].dates) == 1 else "these dates"
    alone = f", in {found[0].car} alone" if found[0].car else ""
    what = f"{share} of the squared error is concentrated on {when}: {_word_power(found[0])}{alone}"
    return [f"{what}. Look at {these} before you add an effect.{more}"]


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


def _word_chance(one: FoundEpisode) -> str:
    """Return the probability of so clear an episode by chance, or its bound."""
    chance = one.chance
    if chance is None:
        return UNKNOWN
    return f"less than {format_percent(LEAST_CHANCE)}" if chance < LEAST_CHANCE else f"{format_percent(chance)}"


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
