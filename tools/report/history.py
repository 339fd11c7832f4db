"""Show the trial of one effect and the history of a model, in the terminal and as an HTML page."""

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, Final

from rich.console import Console
from rich.text import Text

from socast.core.diagnose.add.records import (
    ADDED,
    ATTEMPTS,
    REFUSED,
    UNDECIDED,
    EffectAttempt,
    EffectTrial,
    ErrorFall,
    list_attempts,
    summarise_history,
)
from socast.core.evaluate.compare.records import ResidualSurvey
from socast.core.fit.records import read_fit_step
from socast.core.formatting import format_minus
from socast.core.models import LinearModel
from socast.tools.report.comparison.failures import illustrate_change
from socast.tools.report.diagnosis.finding_words import describe_coefficient
from socast.tools.report.diagnosis.sentences import format_energy
from socast.tools.report.document import Drawing, Illustration, Report, Section, print_section
from socast.tools.report.error_fall import CAPTION, draw_error_fall, print_error_fall
from socast.tools.report.table import (
    FORMATS,
    UNKNOWN,
    Cell,
    ReportTable,
    Row,
    format_estimate,
    keep_filled,
    tabulate_records,
)

HELD_OUT: Final[Mapping[str, str]] = MappingProxyType(
    {
        "of_effect": "held-out days, effect refitted",
        "on_days": "held-out days, all refitted",
        "on_vehicles": "held-out vehicles, all refitted",
        "final": "final hold-out days",
    }
)
"""Field of a comparison in a trial and the row title for it."""
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
STEP_FIELDS: Final = ("result", "mae_before_kwh", "mae_after_kwh", "change_kwh", "noise_floor_kwh", "final")
OUTCOMES: Final = MappingProxyType({ADDED: "helps", REFUSED: "does not help", UNDECIDED: "may or may not help"})
"""Outcome of a trial -> what it says of the effect."""


def print_trial(trial: EffectTrial, console: Console) -> None:
    """Print the comparison, the coefficient and the outcome of a trial."""
    tables = [tabulate_errors(trial), *_tabulate_conditions(trial)]
    print_section(Section("trial", _title_trial(trial), "", tables), console)
    print_error_fall([trial], console)
    console.print()
    for line in _describe_coefficients(trial, trial.words_by_vehicle_model):
        console.print(Text(line))
    for line in trial.warnings:
        console.print(Text(f"warning: {line}", style="yellow"))
    console.print(Text(_describe_outcome(trial), style="bold"))


def build_trial_report(trial: EffectTrial, surveys: Sequence[ResidualSurvey]) -> Report:
    """Return the report of the trial of an effect, and of where the models before and after it fail."""
    lines = (*_describe_coefficients(trial, trial.words_by_vehicle_model), *trial.warnings)
    changes, conditions = illustrate_change(*surveys) if surveys else [], _tabulate_conditions(trial)
    text = " ".join(f"{line}." for line in lines)
    sections = [Section("fall", "Error above the noise", _describe_outcome(trial), [])]
    if changes:
        sections.append(Section("change", "Where it fails, before and after", "", []))
    sections.append(Section("trial", "Before and after", text, [tabulate_errors(trial)]))
    if conditions:
        sections.append(Section("conditions", "By condition", "", conditions, closed=True))
    drawn: dict[str, Callable[[Any], Sequence[Illustration | Drawing]]]
    drawn = {"fall": lambda of: _draw_steps([of]), "change": lambda _: changes}
    return Report("add", "add", _title_trial(trial), sections, result=trial, figures=drawn)


def _title_trial(trial: EffectAttempt) -> str:
    return f"{trial.name}: before and after"


def _describe_coefficients(trial: EffectAttempt, words: Mapping[str, str] = MappingProxyType({})) -> list[str]:
    """Return the coefficient in words and figures, and those of vehicle models with a coefficient of their own."""
    lines = [trial.words, describe_coefficient(trial.coefficient)]
    for key, coefficient in trial.by_vehicle_model.items():
        lines.append(f"{key}: {words.get(key, '')} ({describe_coefficient(coefficient)})")
    return [line for line in lines if line]


def _describe_outcome(trial: EffectAttempt) -> str:
    """Return a sentence that states whether the effect helps, and why."""
    outcome = trial.outcome or (ADDED if trial.accepted else REFUSED)
    return f"{trial.name} {OUTCOMES[outcome]}: {trial.reason}."


def tabulate_errors(trial: EffectAttempt) -> ReportTable:
    """Return the errors before and after, on what is held out."""
    falls = {what: getattr(trial, field) for field, what in HELD_OUT.items()}
    note = f"Measurement noise alone: {format_energy(trial.noise_floor_kwh)}.{_compare_given(trial)} {TRIAL_NOTE}"
    known = {what: fall for what, fall in falls.items() if fall is not None and fall.rides}
    return tabulate_records("Mean absolute error of a ride", known, ErrorFall, corner="evaluated on", notes=(note,))


def _tabulate_conditions(trial: EffectTrial) -> list[ReportTable]:
    """Return the errors before and after by condition, on held-out days."""
    return keep_filled(
        *(
            tabulate_records(
                f"By {what}, held-out days",
                {each.where: each for each in bins},
                ErrorFall,
                corner=what,
                label=format_minus,
            )
            for what, bins in trial.conditions.items()
        )
    )


def _compare_given(trial: EffectAttempt) -> str:
    """Return the error of the model as given beside that of the refitted one, and why the latter is larger if it is."""
    given, refitted = trial.mae_given_kwh, trial.on_days.mae_before_kwh
    if given is None:
        return ""
    line = f" The model as given: {format_energy(given)} on the days that are held out in turn"
    if refitted is None or refitted <= WORSE * given:
        return f"{line}."
    return (
        f"{line}, less than with all terms refitted without them ({format_energy(refitted)}): it has "
        "seen these days, or was fitted to more rides, and these days alone do not determine all its terms."
    )


def show(model: LinearModel, console: Console) -> None:
    """Print the history of a model."""
    print_section(Section("history", _title(model), "", [tabulate_history(model)]), console)
    print_error_fall(list_attempts(model.history), console)
    console.print()
    for place, attempt in _number_attempts(model).items():
        console.print(Text(f"{place}. {_describe_attempt(attempt)}"))
    console.print(Text(describe_progress(model), style="bold"))


def build_report(model: LinearModel) -> Report:
    """Return the report of the history of a model."""
    shown = [Section("history", "Step by step", describe_progress(model), [tabulate_history(model)])]
    for i, attempt in enumerate(list_attempts(model.history), start=1):
        text = " ".join(f"{line}." for line in (*_describe_coefficients(attempt), _describe_outcome(attempt)[:-1]))
        shown.append(Section(f"step-{i}", f"{i}. {_title_trial(attempt)}", text, [tabulate_errors(attempt)]))
    return Report("history", "history", _title(model), shown, result=model, figures={"history": draw_errors})


def _title(model: LinearModel) -> str:
    return f"History of {model.name}, version {model.version}"


def describe_progress(model: LinearModel) -> str:
    """Return a sentence that states how far the error fell."""
    tried, whole = list_attempts(model.history), summarise_history(model)
    if not tried:
        return "No effect has been tried. Find a missing effect with socast diagnose, and add it with socast add."
    names = ", ".join(attempt.name for attempt in tried if attempt.action == ADDED)
    numbers = {word: sum(attempt.action == word for attempt in tried) for word in ATTEMPTS[1:]}
    beside = "".join(f", {number:,} {word}" for word, number in numbers.items() if number)
    first, last, floor = (
        format_energy(error) for error in (whole.mae_first_kwh, whole.mae_last_kwh, whole.noise_floor_kwh)
    )
    fall = f"error {format_estimate(whole.mae_first_kwh, 4)} -> {last}" if names else f"error {first}"
    added = f"Added: {names}" if names else "No effect was added"
    return f"{added}{beside}; {fall} per ride on held-out days; measurement noise alone {floor}."


def _number_attempts(model: LinearModel) -> dict[int, EffectAttempt]:
    """Return the effects that were tried by their place in the history."""
    places = [place for place, entry in enumerate(model.history) if entry.get("action") in ATTEMPTS]
    return dict(zip(places, list_attempts(model.history), strict=True))


def tabulate_history(model: LinearModel) -> ReportTable:
    """Return a table with every step of the history."""
    attempts = _number_attempts(model)
    table = tabulate_records(
        "",
        {f"{place}. {attempt.name}": attempt for place, attempt in attempts.items()},
        EffectAttempt,
        corner="step",
        fields=STEP_FIELDS,
        notes=(HISTORY_NOTE,) if attempts else (),
        strong=lambda field, place, _: field == "mae_after_kwh" and [*attempts.values()][place - 1].action == ADDED,
        formats={**FORMATS, "before and after": _format_fall},
    )
    rows = iter(table.rows)
    every = [
        next(rows) if place in attempts else _describe_fit(place, entry) for place, entry in enumerate(model.history)
    ]
    return table._replace(rows=tuple(every))


def _describe_fit(place: int, entry: Mapping[str, Any]) -> Row:
    """Return the row of a step that tried no effect."""
    step = read_fit_step(entry)
    recipe = f"recipe {step.recipe}" if step.recipe else step.action or "unknown step"
    errors = step.mae_in_sample_kwh
    inside = [f"in-sample error {format_estimate(max(errors.values()), 4)} kWh at most"] if errors else []
    done = {"fit": "fitted", "adapt": "adapted"}.get(step.action, UNKNOWN)
    return Row(f"{place}. {', '.join([recipe, *inside])}", (Cell(done), *(Cell("") for _ in STEP_FIELDS[1:])))


def _format_fall(fall: ErrorFall | None) -> str:
    """Return the errors before and after."""
    if fall is None:
        return UNKNOWN
    return f"{format_estimate(fall.mae_before_kwh, 4)} → {format_estimate(fall.mae_after_kwh, 4)}"


def _describe_attempt(attempt: EffectAttempt) -> str:
    """Return what the coefficient of an effect means, or why the effect was refused."""
    if attempt.action != ADDED:
        return f"{attempt.name} was {attempt.action}: {attempt.reason}"
    doubt = "" if attempt.coefficient.plausible else " (not plausible)"
    forced = f"; added although {attempt.reason}" if attempt.forced else ""
    return f"{attempt.words or attempt.name}{doubt}{forced}"


def draw_errors(model: LinearModel) -> list[Drawing]:
    """Return the picture of the error before and after each step, in a list that is empty without a step."""
    return _draw_steps(list_attempts(model.history))


def _draw_steps(steps: Sequence[EffectAttempt]) -> list[Drawing]:
    """Return the picture of the error before and after steps, in a list that is empty without one."""
    svg = draw_error_fall(steps)
    return [Drawing("falling", "Error before and after each step", CAPTION, svg)] if svg else []
