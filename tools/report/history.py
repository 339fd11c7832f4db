"""Show the trial of one effect and the history of a model, in the terminal and as an HTML page."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import msgspec
from rich.console import Console
from rich.text import Text

from socast.core.diagnose.add.error_fall import ATTEMPTS, ErrorStep, list_error_steps, read_scope, read_step
from socast.core.diagnose.add.terms import name_scoped
from socast.core.diagnose.records import EstimatedCoefficient
from socast.core.evaluate.compare.records import ResidualSurvey
from socast.core.formatting import format_minus
from socast.core.models import LinearModel
from socast.core.records import to_json_values
from socast.tools.report.cells import UNKNOWN, Cell, ReportTable, Row, format_change, format_count, format_signed
from socast.tools.report.comparison.failures import illustrate_change
from socast.tools.report.diagnosis.coefficient_words import describe_coefficient
from socast.tools.report.diagnosis.sentences import format_energy
from socast.tools.report.error_fall import CAPTION, draw_error_fall, print_error_fall
from socast.tools.report.evaluation.illustrations import Drawing, Illustration
from socast.tools.report.evaluation.result import get_half_width, get_mapping, get_number
from socast.tools.report.evaluation.sections import Section
from socast.tools.report.evaluation.terminal import print_section
from socast.tools.report.page import render_document, save

Entry = Mapping[str, Any]

HELD_OUT: Final[Mapping[str, str]] = {
    "of_effect": "held-out days, effect refitted",
    "on_days": "held-out days, all refitted",
    "on_vehicles": "held-out vehicles, all refitted",
    "final": "final hold-out days",
}
"""Key of a comparison in a trial and the row title for it."""
TRIAL_NOTE: Final = (
    "In the first row, the coefficient of the effect is fitted without the held-out days; in the other rows, "
    "everything is fitted without what is held out. ± is half of the 95 % interval of the mean difference per ride, "
    "clustered by vehicle-day. The final hold-out days decide nothing: evaluate on them once, and do not tune on them."
)
WORSE: Final = 1.05
"""Ratio of the error of a refitted model to that of the model as given from which a line says why. [1]"""
HISTORY_NOTE: Final = (
    "Error: mean absolute error of a ride on held-out days. Each step is evaluated on the rides given at that time, so "
    "a step may begin with another error than the previous step ended with."
)


def print_trial(trial: Any, console: Console) -> None:
    """Print the comparison, the coefficient and the outcome of a trial."""
    entry = to_json_values(trial)
    for section in build_trial_sections(entry):
        print_section(section, console)
    print_error_fall([read_step(entry)], console)
    console.print()
    for line in describe_coefficients(entry):
        console.print(Text(line))
    for line in entry.get("warnings") or ():
        console.print(Text(f"warning: {line}", style="yellow"))
    console.print(Text(_outcome(entry), style="bold"))


def write_trial(trial: Any, surveys: Sequence[ResidualSurvey], path: Path) -> None:
    """Write the trial of an effect as an HTML page that loads no other file."""
    entry = to_json_values(trial)
    errors, *_ = build_trial_sections(entry)
    text = " ".join(f"{line}." for line in (*describe_coefficients(entry), *(entry.get("warnings") or ())))
    changes = illustrate_change(*surveys) if surveys else []
    sections = [
        Section("fall", "Error above the noise", _outcome(entry), []),
        *([Section("change", "Where it fails, before and after", "", [])] if changes else []),
        errors._replace(title="Before and after", text=text, tables=errors.tables[:1]),
        errors._replace(key="conditions", title="By condition", tables=errors.tables[1:], closed=True),
    ]
    drawn: dict[str, Sequence[Illustration | Drawing]] = {"fall": _draw_steps([read_step(entry)]), "change": changes}
    made_by = "<p>Made by <code>socast add</code>.</p>"
    shown = [section for section in sections if section.tables or drawn.get(section.key) or section.key == "fall"]
    save(render_document("add", errors.title, "", shown, lambda key: drawn.get(key, []), made_by), path)


def describe_coefficients(trial: Entry) -> list[str]:
    """Return the coefficient in words and figures, and those of vehicle models with a coefficient of their own."""
    lines = [str(trial.get("words") or ""), _word_coefficient(trial.get("coefficient"))]
    by_vehicle_model = get_mapping(trial, "by_vehicle_model")
    words = get_mapping(trial, "words_by_vehicle_model")
    lines += [f"{key}: {words.get(key, '')} ({_word_coefficient(value)})" for key, value in by_vehicle_model.items()]
    return [line for line in lines if line]


def _word_coefficient(value: Any) -> str:
    """Return a coefficient of the history of a model in words."""
    return describe_coefficient(msgspec.convert(value or {}, EstimatedCoefficient))


def _outcome(trial: Entry) -> str:
    """Return a sentence that states whether the effect helps, and why."""
    words = {"add": "helps", "refused": "does not help", "undecided": "may or may not help"}
    outcome = str(trial.get("outcome") or ("add" if trial.get("accepted") else "refused"))
    return f"{_name(trial)} {words[outcome]}: {trial.get('reason')}."


def build_trial_sections(trial: Entry) -> list[Section]:
    """Return the tables of a trial: the errors before and after, overall and by condition."""
    comparisons = [(what, get_mapping(trial, key)) for key, what in HELD_OUT.items() if get_mapping(trial, key)]
    rows = tuple(_compared(what, one) for what, one in comparisons)
    floor = (
        f"Measurement noise alone: {format_energy(trial.get('noise_floor_kwh'))}.{_compare_given(trial)} {TRIAL_NOTE}"
    )
    heads = ("rides", "vehicle-\ndays", "before,\nkWh", "after,\nkWh", "change,\nkWh", "change")
    title = f"{_name(trial)}: before and after"
    tables = [ReportTable("Mean absolute error of a ride", "evaluated on", heads, rows, (floor,))]
    parts = get_mapping(trial, "conditions")
    for what, bins in parts.items():
        rows_of_bins = tuple(_compared(format_minus(str(one.get("where"))), one) for one in bins)
        tables.append(ReportTable(f"By {what}, held-out days", what, heads, rows_of_bins))
    return [Section("trial", title, "", [table for table in tables if table.rows])]


def _compare_given(trial: Entry) -> str:
    """Return the error of the model as given beside that of the refitted one, and why the latter is larger if it is."""
    given, refitted = (
        get_number(trial.get("mae_given_kwh")),
        get_number(get_mapping(trial, "on_days").get("mae_before_kwh")),
    )
    if given is None:
        return ""
    line = f" The model as given: {format_energy(given)} on the days that are held out in turn"
    if refitted is None or refitted <= WORSE * given:
        return f"{line}."
    return (
        f"{line}, less than with all terms refitted without them ({format_energy(refitted)}): it has "
        "seen these days, or was fitted to more rides, and these days alone do not determine all its terms."
    )


def _compared(name: str, one: Entry) -> Row:
    """Return one row with the errors before and after."""
    was, now = get_number(one.get("mae_before_kwh")), get_number(one.get("mae_after_kwh"))
    return Row(
        name,
        (
            Cell(format_count(one.get("rides"))),
            Cell(format_count(one.get("clusters"))),
            Cell(_error(was)),
            Cell(_error(now)),
            Cell(_spread(one.get("change_kwh"))),
            Cell(format_change(now, was)),
        ),
    )


def summarise(model: LinearModel) -> dict[str, Any]:
    """Return the history of a model as JSON values."""
    steps = list_attempts(model)
    taken = [step for step in steps if step["action"] == "add"]
    return {
        "model": model.name,
        "version": model.version,
        "recipe": model.recipe,
        "mae_first_kwh": steps[0].get("mae_before_kwh") if steps else None,
        "mae_last_kwh": taken[-1].get("mae_after_kwh") if taken else None,
        "noise_floor_kwh": steps[-1].get("noise_floor_kwh") if steps else None,
        "steps": list(model.history),
    }


def list_attempts(model: LinearModel) -> list[Entry]:
    """Return the entries of the effects that were tried, the oldest first."""
    return [entry for entry in model.history if entry.get("action") in ATTEMPTS]


def show(model: LinearModel, console: Console) -> None:
    """Print the history of a model."""
    print_section(Section("history", _title(model), "", [tabulate_history(model)]), console)
    print_error_fall(list_error_steps(model.history), console)
    console.print()
    for i, entry in enumerate(model.history):
        if entry in list_attempts(model):
            console.print(Text(f"{i}. {_describe_attempt(entry)}"))
    console.print(Text(describe_progress(model), style="bold"))


def write(model: LinearModel, path: Path) -> None:
    """Write the history of a model as an HTML page that loads no other file."""
    shown = [Section("history", "Step by step", describe_progress(model), [tabulate_history(model)])]
    for i, entry in enumerate(list_attempts(model), start=1):
        section = build_trial_sections(entry)[0]
        text = " ".join(f"{line}." for line in (*describe_coefficients(entry), _outcome(entry).removesuffix(".")))
        shown.append(Section(f"step-{i}", f"{i}. {section.title}", text, section.tables))
    made_by = "<p>Made by <code>socast history</code>.</p>"
    save(
        render_document(
            "history", _title(model), "", shown, lambda key: draw_errors(model) if key == "history" else [], made_by
        ),
        path,
    )


def _title(model: LinearModel) -> str:
    return f"History of {model.name}, version {model.version}"


def describe_progress(model: LinearModel) -> str:
    """Return a sentence that states how far the error fell."""
    tried = list_attempts(model)
    if not tried:
        return "No effect has been tried. Find a missing effect with socast diagnose, and add it with socast add."
    taken = [step for step in tried if step["action"] == "add"]
    first, floor = tried[0].get("mae_before_kwh"), tried[-1].get("noise_floor_kwh")
    names = ", ".join(map(_name, taken))
    added = f"Added: {names}" if taken else "No effect was added"
    numbers = {word: sum(step["action"] == word for step in tried) for word in ATTEMPTS[1:]}
    beside = "".join(f", {format_count(number)} {word}" for word, number in numbers.items() if number)
    last = taken[-1].get("mae_after_kwh") if taken else None
    fall = f"error {_error(first)} -> {format_energy(last)}" if taken else f"error {format_energy(first)}"
    return f"{added}{beside}; {fall} per ride on held-out days; measurement noise alone {format_energy(floor)}."


def tabulate_history(model: LinearModel) -> ReportTable:
    """Return a table with every step of the history."""
    rows = tuple(_step(i, entry) for i, entry in enumerate(model.history))
    heads = ("result", "before,\nkWh", "after,\nkWh", "change,\nkWh", "noise,\nkWh", "final,\nkWh")
    return ReportTable("", "step", heads, rows, (HISTORY_NOTE,) if list_attempts(model) else ())


def _step(place: int, entry: Entry) -> Row:
    """Return one row of the history."""
    action = str(entry.get("action"))
    if action not in ATTEMPTS:
        fitted = [value for value in get_mapping(entry, "mae_in_sample_kwh").values() if get_number(value) is not None]
        recipe = f"recipe {entry['recipe']}" if entry.get("recipe") else ""
        inside = f"in-sample error {_error(max(fitted))} kWh at most" if fitted else ""
        blank = tuple(Cell("") for _ in range(5))
        return Row(
            f"{place}. {', '.join(each for each in (recipe or action, inside) if each)}", (Cell(_past(action)), *blank)
        )
    done = "added by force" if entry.get("forced") else "added" if action == "add" else action
    final = get_mapping(entry, "final")
    return Row(
        f"{place}. {_name(entry)}",
        (
            Cell(done),
            Cell(_error(entry.get("mae_before_kwh"))),
            Cell(_error(entry.get("mae_after_kwh")), strong=action == "add"),
            Cell(_spread(entry.get("change_kwh"))),
            Cell(_error(entry.get("noise_floor_kwh"))),
            Cell(_final(final)),
        ),
    )


def _final(final: Entry) -> str:
    """Return the errors before and after on the final hold-out days."""
    if not final:
        return UNKNOWN
    return f"{_error(final.get('mae_before_kwh'))} → {_error(final.get('mae_after_kwh'))}"


def _past(action: str) -> str:
    """Return the past participle of an action.

    Examples
    --------
    >>> _past("fit"), _past("adapt")
    ('fitted', 'adapted')
    """
    return {"fit": "fitted"}.get(action, f"{action}ed")


def _describe_attempt(entry: Entry) -> str:
    """Return what the coefficient of an effect means, or why the effect was refused."""
    name = _name(entry)
    if entry["action"] != "add":
        return f"{name} was {entry['action']}: {entry.get('reason')}"
    plausible = get_mapping(entry, "coefficient").get("plausible", True)
    forced = f"; added by force, although {entry.get('reason')}" if entry.get("forced") else ""
    return f"{entry.get('words') or name}{'' if plausible else ' (not plausible)'}{forced}"


def draw_errors(model: LinearModel) -> list[Drawing]:
    """Return the picture of the error before and after each step, in a list that is empty without a step."""
    return _draw_steps(list_error_steps(model.history))


def _draw_steps(steps: Sequence[ErrorStep]) -> list[Drawing]:
    """Return the picture of the error before and after steps, in a list that is empty without one."""
    svg = draw_error_fall(steps)
    return [Drawing("falling", "Error before and after each step", CAPTION, svg)] if svg else []


def _name(entry: Entry) -> str:
    return name_scoped(str(entry.get("effect")), read_scope(entry))


def _error(value: Any) -> str:
    known = get_number(value)
    return UNKNOWN if known is None else f"{known:.4f}"


def _spread(value: Any) -> str:
    """Return a change with half the width of its interval."""
    known, half = get_number(value), get_half_width(value)
    if known is None:
        return UNKNOWN
    return format_signed(known, 4) + ("" if half is None else f" ± {half:.4f}")
