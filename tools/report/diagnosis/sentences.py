"""What a diagnosis found, in sentences: what a person would tell another."""

from collections.abc import Mapping
from typing import Any

from tools.report.cells import format_count, format_percent
from tools.report.evaluation.data_tables import MEASURED_BY
from tools.report.evaluation.result import Result, get_mapping, get_number

LEAST_BIAS = 5e-4
"""Bias of a ride below which none is told. [kWh]"""
NOISE_ONLY = 1.1
"""Error over the noise floor up to which what remains is the measurement's noise."""


def format_energy(value: Any) -> str:
    """Return an energy in kWh to three digits.

    Examples
    --------
    >>> energy(0.06234), energy(None)
    ('0.0623 kWh', 'unknown')
    """
    known = get_number(value)
    return "unknown" if known is None else f"{known:.3g} kWh"


def read_interval(value: Any) -> tuple[float, float] | None:
    """Return lower and upper end of an interval, None where it has none."""
    if not isinstance(value, list | tuple) or len(value) != 2:
        return None
    low, high = map(get_number, value)
    return None if low is None or high is None else (low, high)


def describe_data(result: Result) -> list[str]:
    """Say what was looked at."""
    found = get_mapping(result, "data")
    measured = MEASURED_BY.get(str(found.get("measured")), "voltage and current or state of charge")
    said = str(found.get("resolution") or measured)
    seen = (
        f"{format_count(found.get('rides'))} rides of {_plural(found.get('vehicles'), 'vehicle')}, "
        f"{_plural(found.get('days'), 'vehicle-day')}, {found.get('first_date')} to {found.get('last_date')}, in "
        f"{format_count(found.get('windows'))} windows."
    )
    lines = [seen, f"How the energy was measured: {said}."]
    if left := get_mapping(found, "left_out"):
        told = ", ".join(f"{format_count(n)} {str(why).replace('_', ' ')}" for why, n in left.items())
        lines.append(f"Left out: {told}.")
    return lines


def describe_error(result: Result) -> list[str]:
    """Say how far off the model is, and how much of that is the measurement's own noise."""
    found = get_mapping(result, "error")
    mae, floor, refitted = (get_number(found.get(key)) for key in ("mae_kwh", "noise_floor_kwh", "mae_refitted_kwh"))
    share = get_number(found.get("relative"))
    of = f", {format_percent(share)} of what rides take" if share is not None else ""
    lines = [f"The model is {format_energy(mae)} off a ride on average{of}{_bias(found.get('bias_kwh'))}."]
    if refitted is not None:
        lines.append(f"The same terms, fitted to these rides, would be {format_energy(refitted)} off.")
    if mae and floor is not None:
        lines.append(
            f"Measurement noise: a model without any error would still seem {format_energy(floor)} off, "
            f"{format_percent(min(floor / mae, 1.0), 0)} of that."
        )
    return lines


def _bias(value: Any) -> str:
    """Say to which side a model errs."""
    bias = get_number(value)
    if bias is None or abs(bias) < LEAST_BIAS:
        return ""
    side = "too much" if bias > 0.0 else "too little"
    return f"; on balance it predicts {format_energy(abs(bias))} {side}"


def describe_slice(found: Mapping[str, Any]) -> str:
    """Say what is special about a slice."""
    bias = get_number(found.get("bias_kwh")) or 0.0
    return f"{format_energy(abs(bias))} {'more' if bias > 0.0 else 'less'} than elsewhere"


def describe_scope(found: Mapping[str, Any]) -> str:
    """Say for whom and since when an effect is missing."""
    said = str(found.get("scope") or "all")
    return "in all vehicles, all the time" if said == "all" else f"only {_with_preposition(said)}"


def _with_preposition(said: str) -> str:
    """Return a scope as it stands in a sentence.

    >>> _with_preposition("vehicle taxi-003, since 2018-06-01")
    'in vehicle taxi-003, since 2018-06-01'
    """
    return f"in {said}" if said.startswith("vehicle") else said


def name_effect(found: Mapping[str, Any]) -> str:
    """Return the name of what is missing: of the variant that fits best."""
    return str(found.get("variant") or found.get("effect"))


def describe_gain(found: Mapping[str, Any]) -> str:
    """Say what an effect explains."""
    limits = read_interval(found.get("gain_ci95"))
    between = f" ({format_percent(limits[0])} to {format_percent(limits[1])})" if limits else ""
    of = f" of {found['gain_of']}" if found.get("gain_of") else ""
    said = [
        f"it explains {format_percent(found.get('gain'))}{between} of the squared error{of} on days it was not fitted to"
    ]
    if get_number(found.get("energy_share")) is not None:
        said.append(f"it moves {format_percent(found['energy_share'])} of all energy")
    if (q := get_number(found.get("q"))) is not None:
        said.append(f"q = {q:.2g}")
    return ", ".join(said)


def describe_coefficient(found: Mapping[str, Any]) -> str:
    """Say what an effect's coefficient is, and whether that is plausible."""
    own = get_mapping(found, "coefficient")
    value, limits = get_number(own.get("value")), read_interval(own.get("ci95"))
    if value is None:
        return ""
    unit = "" if own.get("unit") in {None, "1"} else f" {own['unit']}"
    between = f", 95 % interval {limits[0]:.3g} to {limits[1]:.3g}" if limits else ""
    low, high = get_number(own.get("low")), get_number(own.get("high"))
    if low is None or high is None:
        return f"coefficient {value:.3g}{unit}{between}"
    wide = f"{low:g} to {high:g}{unit}"
    judged = f"plausible (from {wide})" if own.get("plausible") else f"NOT plausible (from {wide}): a finding by itself"
    return f"coefficient {value:.3g}{unit}{between}; {judged}"


def describe_rivals(found: Mapping[str, Any]) -> list[str]:
    """Say what an effect cannot be told from, and what would tell."""
    lines = []
    for other in found.get("separate") or ():
        r = get_number(other.get("correlation"))
        alike = "" if r is None else f" (r = {r:.2f})"
        shown = f": {other['data']} would tell" if other.get("data") else ""
        lines.append(f"cannot be told from {other.get('effect')}{alike}{shown}")
    alone = [str(each) for each in found.get("group") or () if each != found.get("effect")]
    if alone and not lines:
        lines.append(f"cannot be told from {', '.join(alone)}")
    return lines


def describe_missing_effect(found: Mapping[str, Any]) -> list[str]:
    """Say all about an effect that is missing, most important first."""
    said = str(found.get("words") or name_effect(found))
    lines = [
        f"{said}; {describe_scope(found)}",
        describe_gain(found),
        describe_coefficient(found),
        *describe_rivals(found),
    ]
    if equal := [str(each) for each in found.get("equivalents") or ()]:
        lines.append(f"as large, on average, as {', or '.join(equal)}")
    return [line for line in lines if line]


def describe_remainder(result: Result) -> list[str]:
    """Say what is left once the named effects are in."""
    steps = [step for step in result.get("steps") or () if get_number(step.get("mae_kwh")) is not None]
    lines = []
    if steps:
        last, floor = get_number(steps[-1]["mae_kwh"]) or 0.0, get_number(steps[-1].get("noise_floor_kwh"))
        said = " -> ".join(f"{get_number(step['mae_kwh']):.3g}" for step in steps)
        lines.append(
            f"Error with the named effects, held-out days: {said} kWh a ride; measurement noise {format_energy(floor)}."
        )
        if floor is not None and last <= NOISE_ONLY * floor and not result.get("structure_remains"):
            lines.append("What remains is measurement noise.")
    if result.get("structure_remains"):
        lines.append("Structure remains whose cause is not in the library, or too weak to be told from others:")
        lines += describe_signs(get_mapping(result, "structure"))
    elif "structure_remains" in result:
        all_of_it = ": the named effects are all that these data show" if result.get("missing") else ""
        lines.append(f"No structure remains that could be predicted{all_of_it}.")
    return lines


def describe_signs(structure: Mapping[str, Any]) -> list[str]:
    """Say what speaks for there being more than was named."""
    spoken, taken = structure.get("signs") or (), get_number(structure.get("taken"))
    least = format_percent(structure.get("least"), 0)
    share = (
        "" if taken is None else f"; the named effects take {format_percent(taken, 0)} of it, and should take {least}"
    )
    said = {
        "trees": f"boosted trees predict {format_percent(get_number(structure.get('after')))} of what is left{share}",
        "shape": f"a plain shape is left, {format_shape(str(structure.get('shape')))}, that explains "
        f"{format_percent(get_number(structure.get('gain')))} of the squared error on held-out days{share}",
        "better": "; ".join(
            f"{format_shape(str(shape))} explains more than {effect} in its place: the name may be that of a stand-in"
            for effect, shape in dict(structure.get("better") or {}).items()
        ),
        "days": f"days differ {get_number(structure.get('days')) or 0.0:.1f} times as much as by chance: something of the "
        "day, or of its driver, is not known",
    }
    return [f"- {said[sign]}" for sign in spoken if sign in said]


def format_shape(shape: str) -> str:
    """Return a carrier times a function as people read it."""
    return shape.replace("_", " ").replace(" * ", " × ")


def describe_suggestion(result: Result, file: str | None = None) -> list[str]:
    """Say what term of one's own would fit."""
    formula = result.get("suggestion")
    if not formula:
        return []
    where = (
        f"{file} holds it, ready to edit: socast effects check {file}"
        if file
        else "--suggest FILE writes it, ready to edit"
    )
    return [f"A term that would fit: {formula}", where]


def describe_next_step(result: Result) -> list[str]:
    """Say what to do next."""
    chosen = result.get("verdict")
    if not chosen:
        if result.get("structure_remains"):
            return ["No effect of the library is missing; what remains asks for one of your own: socast effects new."]
        return ["Nothing is missing that these rides could show."]
    first: Mapping[str, Any] = next((m for m in result.get("missing") or () if m.get("effect") == chosen), {})
    lines = [f"Add {chosen}, {describe_scope(first)}."]
    return [*lines, str(first["command"])] if first.get("command") else lines


def _plural(number_: Any, what: str) -> str:
    """Return a number of things."""
    return f"{format_count(number_)} {what}{'' if get_number(number_) == 1 else 's'}"
