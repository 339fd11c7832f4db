"""Describe the result of a diagnosis in sentences for vehicle engineers."""

from collections.abc import Sequence

from socast.core.diagnose.candidates import NEVER_ACTS, NO_COLUMN, NO_SIGNAL, NOT_IDENTIFIABLE
from socast.core.diagnose.deviation_words import find_leading_deviation, name_deviating
from socast.core.diagnose.gains import LEAST_GAIN
from socast.core.diagnose.leading import find_leading
from socast.core.diagnose.records import (
    NONE,
    UNKNOWN,
    CauseProbability,
    Diagnosis,
    HeldOutRides,
    NamedEffect,
    UnknownCause,
)
from socast.core.formatting import format_count as count_things
from socast.core.formatting import format_minus
from socast.core.records import ConfidenceInterval
from socast.tools.report.comparison.tables import UNITS, format_bin
from socast.tools.report.diagnosis.finding_words import (
    MOST_DATES,
    advise_looking,
    advise_test,
    describe_coefficient,
    describe_finding,
    describe_leading_episode,
    format_unit,
)
from socast.tools.report.diagnosis.location_sentences import advise_recording
from socast.tools.report.table import format_chance, format_count, format_difference, format_digits, format_percent

LEAST_PROBABILITY = 0.005
"""Probability below which a cause is not written out. [1]"""
MOST_CAUSES = 5
ALIKE = 0.5
"""Least correlation of the energy of two effects that these data are said not to distinguish. [1]"""
LEAST_SURE = 0.9
"""Probability below which the report does not state without reservation that nothing is missing. [1]"""
LEAST_NAMED = 0.5
"""Probability from which an effect is named, if it is large enough. [1]"""
MOST_NAMED = 3
"""Number of missing effects above which the headline counts the others."""
CAUSE_NAMES = {NONE: "no missing effect", UNKNOWN: "a cause outside the library"}
"""Causes that are no effects, in words."""
UNTESTED = {
    NO_COLUMN: "Not tested, because the tables lack their columns (make them again with --effects FILE)",
    NO_SIGNAL: "Not tested, because their signal is known in less than half of the windows",
    NEVER_ACTS: "Not tested, because they are zero in these drives, without their signal or out of its range",
    NOT_IDENTIFIABLE: "Not testable in all cars at all times, because the terms of the model can imitate them",
}
"""Why effects were not tested, by their status."""
REFIT_IS_NO_LOWER = (
    "That is no less than the model as given: refitting lowers the squared error of windows, of which outliers count "
    "less, and not that of whole rides. Other values of the same terms do not mend this model."
)
"""Why the error of rides may rise although a model is refitted to them."""
FEW_DATES = 3.5
"""Number of dates up to which an effect that acts on them only may be another event of these dates."""
MOST_BINS = 4
"""Number of biased bins above which the others are counted."""
LEAST_BIAS = 5e-4
"""Bias of a ride below which the report does not mention it. [kWh]"""


def format_energy(value: float | None) -> str:
    """Return an energy in kWh with three significant digits.

    Examples
    --------
    >>> format_energy(0.06234), format_energy(None)
    ('0.0623 kWh', 'unknown')
    """
    return "unknown" if value is None else f"{value:.3g} kWh"


def describe_data(result: Diagnosis) -> list[str]:
    """Return sentences about the rides that were diagnosed and how their energy was measured."""
    data = result.data
    rides = (
        f"{format_count(data.rides)} rides of {count_things(data.vehicles, 'vehicle')} on "
        f"{count_things(data.days, 'vehicle-day')}, {data.first_date} to {data.last_date}, in "
        f"{format_count(data.windows)} windows."
    )
    lines = [rides, f"Energy measured by: {data.resolution}."]
    if data.left_out:
        reasons = ", ".join(f"{reason.replace('_', ' ')} {format_count(n)}" for reason, n in data.left_out.items())
        lines.append(f"Excluded: {reasons}.")
    for status, why in UNTESTED.items():
        if names := [row.effect for row in result.tested if row.status == status]:
            lines.append(f"{why}: {', '.join(names)}.")
    if not data.dated:
        lines.append("The dates are invented: no statement is made on what began at a date, on seasons and on hours.")
    return [*lines, *_describe_held_out(data.held_out)]


def _describe_held_out(held_out: HeldOutRides) -> list[str]:
    """Return a sentence about the rides that were not used."""
    dates = held_out.dates
    if not dates:
        return []
    where = "in the history of the model" if held_out.in_history else "on which socast add evaluates"
    why = f", the final hold-out dates {where}" if held_out.final else ""
    few = len(dates) <= MOST_DATES
    listed = ", ".join(dates) if few else f"{len(dates)} dates from {min(dates)} to {max(dates)}"
    return [f"Not used: {format_count(held_out.rides)} rides of {listed}{why}."]


def describe_error(result: Diagnosis) -> list[str]:
    """Return sentences about the error of the model and the share of it that is measurement noise."""
    errors = result.error
    mae, floor, refitted = errors.mae_kwh, errors.noise_floor_kwh, errors.mae_refitted_kwh
    share = errors.relative
    relative = f", {format_percent(share)} of the mean energy of a ride" if share is not None else ""
    lines = [f"The mean absolute error is {format_energy(mae)} per ride{relative}{_describe_bias(errors.bias_kwh)}."]
    if refitted is not None:
        how = "With the same terms refitted to these rides for each car, and any smooth curve of temperature"
        episodes = " and with a constant power in each episode" if result.episodes else ""
        lines.append(f"{how}{episodes}, it would be {format_energy(refitted)} (in sample).")
        if mae is not None and refitted > mae:
            lines.append(REFIT_IS_NO_LOWER)
    if implausible := result.model.implausible:
        lines.append(f"NOT plausible in this model: {'; '.join(implausible)}.")
    if is_noise_overestimated(result):
        lines.append(
            f"The measurement noise that follows from the uncertainty of the measured energy is {format_energy(floor)},"
            " more than the error: it is overestimated for these drives, and its share of the error is unknown."
        )
    elif mae and floor is not None:
        lines.append(
            f"Measurement noise alone causes {format_energy(floor)}, {format_percent(floor / mae, 0)} of the "
            "error: a model without any error would still show it."
        )
    return lines


def is_noise_overestimated(result: Diagnosis) -> bool:
    """Return whether the estimated measurement noise exceeds the error of the model, which contains the noise."""
    errors = result.error
    mae, floor = errors.mae_kwh, errors.noise_floor_kwh
    return mae is not None and floor is not None and floor > mae


def describe_failures(result: Diagnosis) -> list[str]:
    """Return whether groups of rides differ from the others, and which bins are off zero although they do not."""
    lines = []
    if not result.slices:
        lines.append(
            "No group of rides by weather, time, speed or vehicle differs from the others, or the rides are too few."
        )
    if bins := result.biased_bins:
        units = {condition: f" {unit}" for condition, unit in UNITS.items()}
        shown = [
            f"{one.condition} {format_bin(one.condition, one.bin)}{units.get(one.condition, '')} "
            f"({format_difference(one.bias_kwh)} kWh)"
            for one in bins[:MOST_BINS]
        ]
        more = [f"{len(bins) - MOST_BINS} more"] if len(bins) > MOST_BINS else []
        lines.append(
            f"Off zero, as socast compare marks them: {', '.join([*shown, *more])}. A bin is compared with zero, "
            "a group with all other rides in each half of the days."
        )
        bias = result.error.bias_kwh
        shared = _describe_bias(bias).removeprefix("; ")
        if shared and abs(bias or 0.0) > 0.5 * max(abs(one.bias_kwh.value or 0.0) for one in bins):
            lines.append(f"The bias that all rides share marks bins and no group: {shared}.")
    return lines


def _describe_bias(bias: float | None) -> str:
    """Return a clause with the amount and the direction of the bias."""
    if bias is None or abs(bias) < LEAST_BIAS:
        return ""
    direction = "too much" if bias > 0.0 else "too little"
    return f"; on average the model predicts {format_energy(abs(bias))} {direction}"


def describe_scope(one: NamedEffect) -> str:
    """Return the vehicles and dates for which an effect is missing."""
    return f"only for {', '.join(one.scope)}" if one.scope else "in all cars"


def describe_gain(one: NamedEffect) -> str:
    """Return how much of the error an effect explains on held-out days, or by how much it raises it."""
    what, limits = "the squared error of rides on held-out days", one.gain_ci95
    if one.gain is not None and one.gain < 0.0:
        raised = None if limits is None else (-limits[1], -limits[0])
        parts = [f"raises {what} by {format_percent(-one.gain)}{word_interval(raised)}"]
    else:
        parts = [f"explains {format_percent(one.gain)}{word_interval(limits)} of {what}"]
    if one.energy_share is not None:
        parts.append(f"its absolute energy is {format_percent(one.energy_share)} of the measured energy")
    if (dates := one.effective_dates) is not None and dates < FEW_DATES:
        parts.append(f"nearly all of it on {count_things(max(round(dates), 1), 'date')}")
    return ", ".join(parts)


def word_interval(limits: ConfidenceInterval | None) -> str:
    """Return the interval of a share in parentheses, an empty text where it is unknown."""
    return "" if limits is None else f" (95 % interval {format_percent(limits[0])} to {format_percent(limits[1])})"


def describe_rivals(one: NamedEffect) -> list[str]:
    """Return the effects that may be the cause instead of an effect, and the data that would tell."""
    lines = []
    for other in one.separate:
        r = other.correlation
        correlation = "" if r is None else f" (r = {r:.2f})"
        remedy = f"; to distinguish them, record {other.data}" if other.data else ""
        if r is None or abs(r) >= ALIKE:
            lines.append(f"not distinguishable from {other.effect} in these data{correlation}{remedy}")
        else:
            lines.append(
                f"or else {other.effect}, which acts in other windows{format_minus(correlation)}: more rides would tell"
            )
    return lines


def describe_causes(causes: Sequence[CauseProbability], most: int = MOST_CAUSES) -> str:
    """Return the most probable causes with their probabilities, such as `headwind 94 %, crosswind_yaw 5 %`."""
    known = [(one.effect, one.probability or 0.0) for one in causes]
    shown = [(name, value) for name, value in known if value >= LEAST_PROBABILITY][:most]
    return ", ".join(f"{CAUSE_NAMES.get(name, name)} {format_chance(value)}" for name, value in shown)


def describe_verdict(result: Diagnosis) -> list[str]:
    """Return the sentences with which a report begins: what is missing in all cars, and what was found of some.

    Notes
    -----
    An episode comes before everything else, because it may be an event that no model should explain. What comes next is
    what `find_leading` returns. Deviations whose interval of the size contains zero are left out.
    """
    found = find_leading_deviation(result.deviations)
    finding = [] if found is None else describe_finding(found)
    common = [_describe_named(one, result) for one in _list_named(result)[:MOST_NAMED]] or _describe_none(result)
    if (more := len(_list_named(result)) - MOST_NAMED) > 0:
        common.append(f"{more} more: see Missing effects.")
    if result.unknown:
        common.append(f"{count_things(len(result.unknown), 'cause')} outside the library: see Remaining error.")
    episode = describe_leading_episode(result)
    return [*episode, *common, *finding] if result.leading else [*episode, *finding, *common]


def title_verdict(result: Diagnosis) -> str:
    """Return the result in a few words, for a heading."""
    first = find_leading(result)
    if isinstance(first, NamedEffect):
        return name_missing(first, result)
    if first is None:
        none = result.causes[0].effect == NONE if result.causes else True
        return f"No effect is {'missing' if none else 'probable enough to be named'}{_word_cars(result)}"
    who = name_deviating(first)
    others = "the others" if first.of == "group" else "its siblings"
    return f"{who[:1].upper()}{who[1:]} changed" if first.since else f"{who} differs from {others}"


def name_missing(one: NamedEffect, result: Diagnosis) -> str:
    """Return which effect is missing with its probability, such as `headwind is missing in all cars (100 %)`."""
    where = f" for {', '.join(one.scope)}" if one.scope else _word_cars(result)
    if not one.others:
        doubt = ", with an uncertain gain" if one.has_uncertain_gain else ""
        return f"{one.effect} is missing{where} ({format_chance(one.probability)}){doubt}"
    *names, last = [one.effect, *one.others]
    chances = describe_causes([each for each in one.causes if each.effect in one.credible_set])
    return f"{', '.join(names)} or {last} is missing{where}: these data do not tell them apart ({chances})"


def _word_cars(result: Diagnosis) -> str:
    """Return that something holds in all cars, an empty text where there is one."""
    return "" if result.data.vehicles == 1 else " in all cars"


def _list_named(result: Diagnosis) -> list[NamedEffect]:
    """Return the missing effects without those that would explain what an earlier one explains."""
    named: list[NamedEffect] = []
    for one in result.missing:
        if not any(one.effect in each.credible_set for each in named):
            named.append(one)
    return named


def _describe_named(one: NamedEffect, result: Diagnosis) -> str:
    """Return that an effect is missing, and how large it is."""
    size = one.words
    if size:
        size = f" If it is {one.effect}: {size}." if one.others else f" {size[:1].upper()}{size[1:]}."
    return f"{name_missing(one, result)}.{size}"


def _describe_none(result: Diagnosis) -> list[str]:
    """Return how probable it is that no effect is missing in all cars, and which effects may be."""
    others = describe_causes([one for one in result.causes if one.effect != NONE])
    if not result.causes:
        return []
    first = result.causes[0]
    if first.effect == NONE:
        line = f"No effect of the library is missing{_word_cars(result)} ({format_chance(first.probability)})"
        return [f"{line}; the most probable: {others}." if others else f"{line}."]
    if (first.probability or 0.0) >= LEAST_NAMED:
        return [f"No effect is named{_word_cars(result)}: what may be missing is too small to count ({others})."]
    return [f"No effect is probable enough to be named{_word_cars(result)}; the most probable: {others}."]


def describe_competition(result: Diagnosis) -> list[str]:
    """Return what the probabilities of effects are, and which effects may be missing beside the named ones."""
    if not result.causes:
        return []
    meaning = (
        "Each effect is judged for itself: its probability is that it is missing, whatever else is, given these rides "
        "and the plausible range of its coefficient."
    )
    lines = [meaning]
    if result.missing:
        names = ", ".join(one.name for one in result.missing)
        others = describe_causes([one for one in result.further if one.effect != NONE], 3)
        lines.append(f"Beside {names}, {f'these may be missing: {others}' if others else 'no effect is probable'}.")
    return lines


def describe_missing_effect(one: NamedEffect) -> list[str]:
    """Return all statements about a missing effect, the most important first."""
    others = describe_causes([each for each in one.causes if each.effect != one.effect], MOST_CAUSES - 1)
    chance = f"missing with a probability of {format_chance(one.probability)}"
    lines = [
        f"{one.words or one.name}; {describe_scope(one)}",
        f"{chance}{f'; or else {others}' if others else ''}",
        describe_gain(one),
        describe_coefficient(one.coefficient),
        *describe_rivals(one),
    ]
    if one.equivalents:
        lines.append(f"equal in energy, while it acts, to {' or '.join(one.equivalents)}")
    return [line for line in lines if line]


def describe_remainder(result: Diagnosis) -> list[str]:
    """Return sentences about the error that remains once the missing effects are added."""
    steps = [step for step in result.steps if step.mae_kwh is not None]
    lines = []
    if steps:
        last, floor = steps[-1].mae_kwh or 0.0, steps[-1].noise_floor_kwh
        errors = " -> ".join(f"{step.mae_kwh:.3g}" for step in steps)
        added = "; each missing effect fitted without the days that it is evaluated on" if len(steps) > 1 else ""
        excessive = is_noise_overestimated(result)
        noise = "overestimated, see the error above" if excessive else format_energy(floor)
        lines.append(
            f"Mean absolute error with all terms refitted to these rides for each car (in sample{added}): {errors} kWh "
            f"per ride; measurement noise {noise}."
        )
        if floor is not None and last <= floor and not excessive and not result.unknown:
            lines.append("The remaining error does not exceed measurement noise.")
    for one in result.unknown:
        lines += describe_unknown(one)
    if not result.unknown and result.steps:
        lines.append("These rides show no cause outside the library.")
    return lines


def describe_unknown(one: UnknownCause) -> list[str]:
    """Return what is missing and not in the library, and which other forms fit as well."""
    unit = f" {format_unit(one.coefficient.unit)}".rstrip()
    line = (
        f"Something outside the library is missing (probability {format_chance(one.probability)}), with "
        f"{format_percent(one.energy_share)}{word_interval(one.energy_share_ci95)} of the energy, like {one.formula}; "
        f"c = {format_digits(one.coefficient.value)}{unit}"
        f"{f'. It resembles {one.resembles}, but no form of it fits as well' if one.resembles and one.file else ''}."
    )
    symbols = "; ".join(f"{symbol}: {meaning}" for symbol, meaning in one.symbols.items())
    lines = [line, *([f"With {symbols}."] if symbols else [])]
    others = [f"{formula} ({format_percent(share, 0)})" for formula, share in list(one.forms.items())[:MOST_CAUSES]]
    if len(others) > 1:
        lines.append(f"Its form is uncertain; these data prefer: {'; '.join(others)}.")
    if "sin θ" in one.formula:
        lines.append(
            "It belongs to climbs and descents, where errors of the elevation look like this: check them first."
        )
    return lines


def describe_end(result: Diagnosis) -> str:
    """Return why nothing further is added."""
    names = ", ".join(one.effect for one in result.missing)
    return f"Still suspected: {names}." if names else "No further effect is missing."


def describe_suggestion(result: Diagnosis, file: str | None = None) -> list[str]:
    """Return where the source of the form outside the library is."""
    if not any(one.file for one in result.unknown):
        return []
    where = (
        f"{file} contains it as an effect to edit. Check it with: socast effects check {file}"
        if file
        else "To edit the form, write it to a file with --suggest FILE.py"
    )
    if (first := find_leading(result)) is not None:
        effect = find_recommended(result) or first.effect
        where = f"Add {effect} first, and see whether the cause outside the library is still there. {where}"
    return [where]


def find_recommended(result: Diagnosis) -> str | None:
    """Return the effect to add in all cars first; None where nothing is missing in them."""
    return result.leading.effect if result.leading else None


def describe_next_step(result: Diagnosis) -> list[str]:
    """Return what to do next, with the command where there is one."""
    return [*advise_looking(result), *_advise_on_causes(result), *advise_recording(result)]


def _advise_on_causes(result: Diagnosis) -> list[str]:
    """Return what to do about missing effects, and then about deviations, with their commands."""
    first, found = result.leading, find_leading_deviation(result.deviations)
    if first is None and found is None:
        return [_advise_without_effect(result)]
    before, after = _advise_adding(first) if first else [], advise_test(found) if found else []
    return [*before, f"Then {after[0][:1].lower()}{after[0][1:]}", *after[1:]] if before and after else before + after


def _advise_adding(one: NamedEffect) -> list[str]:
    """Return that an effect is to be added, with what speaks against it, and the command."""
    where = describe_scope(one)
    if doubts := _list_doubts(one):
        line = f"Try {one.effect} {where}, and do not rely on it yet: {' and '.join(doubts)}."
    elif one.others:
        line = f"Try {one.effect} first, {where}: these data do not tell it from {' or '.join(one.others)}."
    else:
        line = f"Add {one.effect} {where}."
    return [line, one.command] if one.command else [line]


def _advise_without_effect(result: Diagnosis) -> str:
    """Return what to do where nothing is named, or nothing of certain size."""
    if result.deviations:
        who = name_deviating(result.deviations[0])
        return f"Record more rides: how much {who} use{'' if who == 'all cars' else 's'} more or less is not certain."
    first = result.causes[0] if result.causes else None
    if any(one.file for one in result.unknown):
        return (
            "No effect of the library is named, but something outside it is missing. Write an effect of your own from "
            "its form: socast diagnose --suggest FILE.py."
        )
    if first is not None and first.effect != NONE:
        return "More rides would decide whether an effect is missing."
    if first is not None and (first.probability or 0.0) < LEAST_SURE:
        return f"Most probably, no effect is missing ({format_chance(first.probability)}). More rides would decide it."
    return "These rides show no missing effect."


def _list_doubts(one: NamedEffect) -> list[str]:
    """Return why an effect may be refused when it is added, or stand for another cause."""
    doubts = []
    if one.gain is not None and one.gain < LEAST_GAIN:
        doubts.append(f"it explains less than {format_percent(LEAST_GAIN)} of the error, which socast add asks for")
    elif one.has_uncertain_gain:
        doubts.append("its gain on held-out days is not certain")
    if (dates := one.effective_dates) is not None and dates < FEW_DATES:
        doubts.append(f"nearly all of it lies on {count_things(max(round(dates), 1), 'date')}")
    return doubts
