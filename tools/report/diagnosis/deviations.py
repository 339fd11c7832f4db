"""Describe cars that deviate from their siblings or change, in sentences."""

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
from socast.core.diagnose.records import CarDeviation, Diagnosis, RankedCar
from socast.core.formatting import format_minus
from socast.tools.report.diagnosis.coefficient_words import describe_coefficient
from socast.tools.report.table import format_percent

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
    lines += [f"- {doubt}" for doubt in _doubt_cause(one)]
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


def _doubt_cause(one: CarDeviation) -> list[str]:
    """Return that the most probable cause would need an implausible coefficient, if it would."""
    if one.coefficient.plausible:
        return []
    cause, words = name_cause(one.effect), describe_coefficient(one.coefficient)
    return [f"{cause} alone does not explain it: {words}"]


def describe_finding(found: CarDeviation) -> list[str]:
    """Return a deviation with the probability that it is real."""
    words = _word_cause(found)
    lines = [f"Finding: {word_deviation(found)}.{f' {words[:1].upper()}{words[1:]}.' if words else ''}"]
    lines += [f"{doubt[:1].upper()}{doubt[1:]}." for doubt in _doubt_cause(found)]
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
