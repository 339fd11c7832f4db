"""Describe the result of a diagnosis in sentences for vehicle engineers."""

from collections.abc import Mapping
from typing import Any

from socast.core.diagnose.candidates import NOT_IN_DATA
from socast.core.diagnose.deviation_words import find_leading_deviation
from socast.core.diagnose.posterior.probabilities import NONE, SEVERAL, UNKNOWN
from socast.tools.report.cells import format_count, format_percent
from socast.tools.report.diagnosis.deviations import advise_test, describe_finding
from socast.tools.report.diagnosis.episodes import advise_looking, describe_leading_episode
from socast.tools.report.evaluation.data_tables import MEASURED_BY
from socast.tools.report.evaluation.result import Result, get_mapping, get_number

LEAST_PROBABILITY = 0.005
"""Probability below which a cause is not written out. [1]"""
MOST_CAUSES = 5
LEAST_SURE = 0.9
"""Probability below which the report does not state without reservation that nothing is missing. [1]"""
MOST_DATES = 6
"""Number of dates above which only their number, the first and the last one are written out."""
CAUSE_NAMES = {
    NONE: "no missing effect",
    SEVERAL: "several effects together",
    UNKNOWN: "a cause that is not in the library",
}
"""Causes that are no effects, in words."""
SUPERSCRIPTS = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")
LEAST_BIAS = 5e-4
"""Bias of a ride below which the report does not mention it. [kWh]"""


def format_energy(value: Any) -> str:
    """Return an energy in kWh with three significant digits.

    Examples
    --------
    >>> format_energy(0.06234), format_energy(None)
    ('0.0623 kWh', 'unknown')
    """
    known = get_number(value)
    return "unknown" if known is None else f"{known:.3g} kWh"


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


def read_interval(value: Any) -> tuple[float, float] | None:
    """Return the lower and upper end of an interval, or None where it has none."""
    if not isinstance(value, list | tuple) or len(value) != 2:
        return None
    low, high = map(get_number, value)
    return None if low is None or high is None else (low, high)


def describe_data(result: Result) -> list[str]:
    """Return sentences about the rides that were diagnosed and how their energy was measured."""
    data = get_mapping(result, "data")
    measured = MEASURED_BY.get(str(data.get("measured")), "voltage and current or state of charge")
    resolution = str(data.get("resolution") or measured)
    rides = (
        f"{format_count(data.get('rides'))} rides of {_plural(data.get('vehicles'), 'vehicle')} on "
        f"{_plural(data.get('days'), 'vehicle-day')}, {data.get('first_date')} to {data.get('last_date')}, in "
        f"{format_count(data.get('windows'))} windows."
    )
    lines = [rides, f"Energy measured by: {resolution}."]
    if left_out := get_mapping(data, "left_out"):
        reasons = ", ".join(f"{format_count(n)} {str(reason).replace('_', ' ')}" for reason, n in left_out.items())
        lines.append(f"Excluded: {reasons}.")
    if lacking := [str(row["effect"]) for row in result.get("candidates") or () if row.get("status") == NOT_IN_DATA]:
        lines.append(f"Not tested, because the tables have no values of them: {', '.join(lacking)}.")
    if data.get("dated") is False:
        lines.append("The dates are invented: no statement is made on what began at a date, on seasons and on hours.")
    return [*lines, *_describe_held_out(get_mapping(data, "held_out"))]


def _describe_held_out(held_out: Mapping[str, Any]) -> list[str]:
    """Return a sentence about the rides that were not used."""
    dates = [str(date) for date in held_out.get("dates") or ()]
    if not dates:
        return []
    where = "in the history of the model" if held_out.get("in_history") else "on which socast add evaluates"
    why = f", the final hold-out dates {where}" if held_out.get("final") else ""
    few = len(dates) <= MOST_DATES
    listed = ", ".join(dates) if few else f"{len(dates)} dates from {min(dates)} to {max(dates)}"
    return [f"Not used: {format_count(held_out.get('rides'))} rides of {listed}{why}."]


def describe_error(result: Result) -> list[str]:
    """Return sentences about the error of the model and the share of it that is measurement noise."""
    errors = get_mapping(result, "error")
    mae, floor, refitted = (get_number(errors.get(key)) for key in ("mae_kwh", "noise_floor_kwh", "mae_refitted_kwh"))
    share = get_number(errors.get("relative"))
    relative = f", {format_percent(share)} of the mean energy of a ride" if share is not None else ""
    lines = [
        f"The mean absolute error is {format_energy(mae)} per ride{relative}{_describe_bias(errors.get('bias_kwh'))}."
    ]
    if refitted is not None:
        how = "With the same terms refitted to these rides for each car, and any smooth curve of temperature"
        episodes = " and with a constant power in each episode" if result.get("episodes") else ""
        lines.append(f"{how}{episodes}, it would be {format_energy(refitted)} (in sample).")
    if implausible := get_mapping(result, "model").get("implausible"):
        lines.append(f"NOT plausible in this model: {'; '.join(map(str, implausible))}.")
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


def is_noise_overestimated(result: Result) -> bool:
    """Return whether the estimated measurement noise exceeds the error of the model, which contains the noise."""
    errors = get_mapping(result, "error")
    mae, floor = get_number(errors.get("mae_kwh")), get_number(errors.get("noise_floor_kwh"))
    return mae is not None and floor is not None and floor > mae


def _describe_bias(value: Any) -> str:
    """Return a clause with the amount and the direction of the bias."""
    bias = get_number(value)
    if bias is None or abs(bias) < LEAST_BIAS:
        return ""
    direction = "too much" if bias > 0.0 else "too little"
    return f"; on average the model predicts {format_energy(abs(bias))} {direction}"


def describe_slice(one: Mapping[str, Any]) -> str:
    """Return how predictions for a group of rides compare with those for all other rides."""
    bias = get_number(one.get("bias_kwh")) or 0.0
    return f"{format_energy(abs(bias))} {'more' if bias > 0.0 else 'less'} than for other rides"


def describe_scope(one: Mapping[str, Any]) -> str:
    """Return the vehicles and dates for which an effect is missing."""
    scope = str(one.get("scope") or "all")
    return "in all vehicles on all dates" if scope == "all" else f"only {_add_preposition(scope)}"


def _add_preposition(scope: str) -> str:
    """Return a scope with its preposition.

    >>> _add_preposition("vehicle taxi-003, since 2018-06-01")
    'in vehicle taxi-003, since 2018-06-01'
    """
    return f"in {scope}" if scope.startswith("vehicle") else scope


def name_effect(one: Mapping[str, Any]) -> str:
    """Return the name of a missing effect, or of the variant of it that fits best."""
    return str(one.get("variant") or one.get("effect"))


def describe_gain(one: Mapping[str, Any]) -> str:
    """Return how much of the error an effect explains on held-out days."""
    limits = read_interval(one.get("gain_ci95"))
    interval = f" (95 % interval {format_percent(limits[0])} to {format_percent(limits[1])})" if limits else ""
    parts = [f"explains {format_percent(one.get('gain'))}{interval} of the squared error of rides on held-out days"]
    if get_number(one.get("energy_share")) is not None:
        parts.append(f"its absolute energy is {format_percent(one['energy_share'])} of the measured energy")
    return ", ".join(parts)


def describe_coefficient(one: Mapping[str, Any]) -> str:
    """Return the coefficient of an effect, its interval, and whether it is plausible."""
    coefficient = get_mapping(one, "coefficient")
    value, limits = get_number(coefficient.get("value")), read_interval(coefficient.get("ci95"))
    if value is None:
        return ""
    unit = f" {format_unit(str(coefficient.get('unit') or '1'))}".rstrip()
    interval = f", 95 % interval {limits[0]:.3g} to {limits[1]:.3g}" if limits else ""
    low, high = get_number(coefficient.get("low")), get_number(coefficient.get("high"))
    if low is None or high is None:
        return f"coefficient {value:.3g}{unit}{interval}"
    expected = f"range {low:g} to {high:g}{unit}"
    if coefficient.get("plausible"):
        return f"coefficient {value:.3g}{unit}{interval}; plausible ({expected})"
    return f"coefficient {value:.3g}{unit}{interval}; NOT plausible ({expected}): it may stand for another cause"


def describe_rivals(one: Mapping[str, Any]) -> list[str]:
    """Return the effects that the data do not distinguish from an effect, and the data that would."""
    lines = []
    for other in one.get("separate") or ():
        r = get_number(other.get("correlation"))
        correlation = "" if r is None else f" (r = {r:.2f})"
        remedy = f"; to distinguish them, record {other['data']}" if other.get("data") else ""
        lines.append(f"not distinguishable from {other.get('effect')} in these data{correlation}{remedy}")
    return lines


def describe_causes(causes: Any, most: int = MOST_CAUSES) -> str:
    """Return the most probable causes with their probabilities, such as `headwind 94 %, crosswind_yaw 5 %`."""
    known = [(str(one.get("effect")), get_number(one.get("probability")) or 0.0) for one in causes or ()]
    shown = [(name, value) for name, value in known if value >= LEAST_PROBABILITY][:most]
    return ", ".join(f"{CAUSE_NAMES.get(name, name)} {format_percent(value, 0)}" for name, value in shown)


def describe_verdict(result: Result) -> list[str]:
    """Return the sentences with which a report begins: what was found of cars and dates, and the probable causes.

    Notes
    -----
    An episode comes before everything else, because it may be an event that no model should explain. A car, a group or
    all cars that changed come next where no effect is missing in all cars at all times. Those whose interval of the
    size contains zero are left out.
    """
    found = find_leading_deviation(result.get("deviations"))
    finding = [] if found is None else describe_finding(found)
    causes = _describe_common_causes(result, everywhere=bool(finding))
    episode = describe_leading_episode(result)
    return [*episode, *causes, *finding] if result.get("verdict") else [*episode, *finding, *causes]


def _describe_common_causes(result: Result, *, everywhere: bool) -> list[str]:
    """Return the probable causes in all cars at all times, and among which the largest one is."""
    causes, verdict = result.get("causes") or (), result.get("verdict")
    if not causes:
        return []
    first = str(causes[0].get("effect"))
    of = "Effects in all cars at all times" if everywhere or first == NONE else "Probable cause of the error"
    lines = [f"{of}: {describe_causes(causes)}."]
    credible = [CAUSE_NAMES.get(str(name), str(name)) for name in result.get("credible_set") or ()]
    if len(credible) > 1:
        lines.append(f"The largest cause is one of these in nine cases of ten: {', '.join(credible)}.")
    if verdict and credible and verdict not in credible:
        lines.append(f"Beside {verdict}, which was found next, {credible[0]} is not needed.")
    return lines


def describe_competition(result: Result) -> list[str]:
    """Return what the probabilities of causes are, and the causes of what the missing effects leave."""
    if not result.get("causes"):
        return []
    lines = ["Each cause has a probability, given these rides and the plausible range of its coefficient."]
    if result.get("missing") and (further := describe_causes(result.get("further"), 3)):
        names = ", ".join(name_effect(one) for one in result["missing"])
        lines.append(f"Probable cause of what remains after {names}: {further}.")
    return lines


def describe_missing_effect(one: Mapping[str, Any]) -> list[str]:
    """Return all statements about a missing effect, the most important first."""
    meaning = str(one.get("words") or name_effect(one))
    lines = [
        f"{meaning}; {describe_scope(one)}",
        _describe_probability(one),
        describe_gain(one),
        describe_coefficient(one),
        *describe_rivals(one),
    ]
    if equal := [str(each) for each in one.get("equivalents") or ()]:
        lines.append(f"equal in energy, on average, to {' or '.join(equal)}")
    return [line for line in lines if line]


def _describe_probability(one: Mapping[str, Any]) -> str:
    """Return the probability that an effect is the largest missing one, alone and with others, and the other causes."""
    chances = {str(each.get("effect")): get_number(each.get("probability")) or 0.0 for each in one.get("causes") or ()}
    if not chances:
        return ""
    whole, alone, several = get_number(one.get("probability")), chances.pop(str(one.get("effect")), 0.0), 0.0
    if whole is not None:
        several = max(whole - alone, 0.0)
    led = {SEVERAL: max(chances.pop(SEVERAL, 0.0) - several, 0.0)}
    rest = sorted((chances | led).items(), key=lambda item: -item[1])
    others = describe_causes([{"effect": name, "probability": chance} for name, chance in rest], MOST_CAUSES - 1)
    words = f"the largest missing effect with a probability of {format_percent(whole, 0)}"
    parts = f"alone {format_percent(alone, 0)}, with others {format_percent(several, 0)}"
    text = f"{words} ({parts}){f'; or else {others}' if others else ''}"
    return text.replace(CAUSE_NAMES[SEVERAL], "several effects of which another is the largest")


def describe_remainder(result: Result) -> list[str]:
    """Return sentences about the error that remains once the missing effects are added."""
    steps = [step for step in result.get("steps") or () if get_number(step.get("mae_kwh")) is not None]
    lines = []
    if steps:
        last, floor = get_number(steps[-1]["mae_kwh"]) or 0.0, get_number(steps[-1].get("noise_floor_kwh"))
        errors = " -> ".join(f"{get_number(step['mae_kwh']):.3g}" for step in steps)
        added = "; each missing effect fitted without the days that it is evaluated on" if len(steps) > 1 else ""
        excessive = is_noise_overestimated(result)
        noise = "overestimated, see the error above" if excessive else format_energy(floor)
        lines.append(
            f"Mean absolute error with all terms refitted to these rides for each car (in sample{added}): {errors} kWh "
            f"per ride; measurement noise {noise}."
        )
        if floor is not None and last <= floor and not excessive and not result.get("structure_remains"):
            lines.append("The remaining error does not exceed measurement noise.")
    if result.get("structure_remains"):
        lines.append(
            "The remaining error has structure. Its cause is not in the library, or too weak to be distinguished from "
            "other causes:"
        )
        lines += describe_signs(get_mapping(result, "structure"))
    elif "structure_remains" in result:
        complete = ": the data show no further effect" if result.get("missing") else ""
        lines.append(f"The remaining error has no structure that can be predicted{complete}.")
    return lines


def describe_signs(structure: Mapping[str, Any]) -> list[str]:
    """Return the evidence that the remaining error has structure."""
    signs, taken = structure.get("signs") or (), get_number(structure.get("taken"))
    least = format_percent(structure.get("least"), 0)
    share = (
        ""
        if taken is None
        else f"; the missing effects explain {format_percent(taken, 0)} of the predictable part, less than {least}"
    )
    after, gain, days = (get_number(structure.get(key)) for key in ("after", "shape_taken", "days"))
    texts = {
        "trees": f"boosted trees predict {format_percent(after)} of its variance on held-out days{share}",
        "shape": f"the pattern {format_shape(str(structure.get('shape')))} explains {format_percent(gain)} of the "
        f"squared error on held-out days{share}",
        "better": "; ".join(
            f"{format_shape(str(shape))} explains more than {effect} does: {effect} may stand for another cause"
            for effect, shape in dict(structure.get("better") or {}).items()
        ),
        "days": f"vehicle-days differ {days or 0.0:.1f} times as much as chance allows: an influence of the day or of "
        "the driver is unknown",
    }
    return [f"- {texts[sign]}" for sign in signs if sign in texts]


def format_shape(shape: str) -> str:
    """Return a pattern, a carrier of energy times a function of a feature, with spaces and a multiplication sign."""
    return shape.replace("_", " ").replace(" * ", " × ")


def describe_suggestion(result: Result, file: str | None = None) -> list[str]:
    """Return the formula of the suggested effect, and where its source is."""
    formula = result.get("suggestion")
    if not formula:
        return []
    where = (
        f"{file} contains it as an effect to edit. Check it with: socast effects check {file}"
        if file
        else "Write it to a file to edit with --suggest FILE.py"
    )
    return [f"A term that fits the remaining error: {formula}", where]


def find_recommended(result: Result) -> str | None:
    """Return the effect to add; None where no effect is missing, or where it is in doubt."""
    chosen = result.get("verdict")
    return str(chosen) if chosen and not _list_doubts(_find_verdict(result)) else None


def describe_next_step(result: Result) -> list[str]:
    """Return what to do next, with the command where there is one."""
    return [*advise_looking(result), *_advise_on_causes(result)]


def _advise_on_causes(result: Result) -> list[str]:
    """Return what to do about causes and changes, with the command where there is one."""
    chosen, found = result.get("verdict"), find_leading_deviation(result.get("deviations"))
    testing = [] if found is None else advise_test(found, then="Then" if chosen else "")
    if not chosen:
        return testing or [_advise_without_effect(result)]
    first = _find_verdict(result)
    doubts = _list_doubts(first)
    if doubts:
        lines = [f"Do not rely on {chosen} yet: {' and '.join(doubts)}. Record more rides. To try it all the same:"]
    else:
        lines = [f"Add {chosen}, {describe_scope(first)}."]
    adding = [*lines, str(first["command"])] if first.get("command") else [line.split(" To try")[0] for line in lines]
    return [*adding, *testing]


def _advise_without_effect(result: Result) -> str:
    """Return what to do where no effect is the most probable cause."""
    unknown, structure = UNKNOWN in (result.get("credible_set") or ())[:1], result.get("structure_remains")
    if structure:
        why = "The cause is probably not in the library" if unknown else "No effect of the library is missing"
        return f"{why}. Write an effect of your own for the structure that remains: socast effects new."
    if unknown:
        return (
            "No effect of the library explains these rides, and no pattern shows what does. Record more rides before "
            "you write an effect."
        )
    first: Mapping[str, Any] = next(iter(result.get("causes") or ()), {})
    chance = get_number(first.get("probability"))
    if first.get("effect") == NONE and chance is not None and chance < LEAST_SURE:
        return f"Most probably, no effect is missing ({format_percent(chance, 0)}). More rides would decide it."
    return "These rides show no missing effect."


def _find_verdict(result: Result) -> Mapping[str, Any]:
    """Return the entry of the missing effect that the verdict names."""
    chosen = result.get("verdict")
    return next((one for one in result.get("missing") or () if one.get("effect") == chosen), {})


def _list_doubts(one: Mapping[str, Any]) -> list[str]:
    """Return why an effect should not be added yet."""
    limits = read_interval(one.get("gain_ci95"))
    doubts = []
    if get_mapping(one, "coefficient").get("plausible") is False:
        doubts.append("its coefficient is not plausible")
    if limits and limits[0] <= 0.0:
        doubts.append("its gain on held-out days is not certain")
    return doubts


def _plural(count: Any, noun: str) -> str:
    """Return a count with its noun."""
    return f"{format_count(count)} {noun}{'' if get_number(count) == 1 else 's'}"
