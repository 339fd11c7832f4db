"""Test the report of a diagnosis in the terminal and as a page, also for odd or missing values."""

from functools import partial
from io import StringIO
from pathlib import Path

import msgspec
import pytest
from msgspec.structs import replace
from rich.console import Console

from socast.core.diagnose.records import Diagnosis, TestedEffect
from socast.tools.commands.diagnose import insert_commands, parse_term
from socast.tools.report.diagnosis import page as report
from socast.tools.report.diagnosis import sentences
from socast.tools.report.diagnosis.figures import (
    draw_coefficients,
    draw_effects,
    draw_errors,
    draw_remainder,
    draw_slices,
)
from socast.tools.report.page import write_report
from socast.tools.terminal.ride_source import RideSource
from tests.support.diagnosis_result import (
    make_deviation,
    make_diagnosis,
    make_empty_diagnosis,
    make_missing_effect,
    make_unknown_cause,
)
from tests.support.html_pages import assert_axes_are_titled, read_page
from tests.support.read_parts import find_read_fields

pytestmark = pytest.mark.long

ODD = '<b>R&D\'s "best"</b> [red]model[/red] </script><script>alert(1)</script>'


def printed(result, width=120, **more):
    """Return the terminal output in one line."""
    console = Console(width=width, file=StringIO(), color_system=None)
    report.show(result, console, **more)
    return " ".join(console.file.getvalue().split())


def page(result, tmp_path, **more):
    """Return the parsed page."""
    write_report(report.build_report(result, **more), tmp_path / "page.html")
    return read_page((tmp_path / "page.html").read_text())


def test_terminal_shows_all_parts_in_order():
    output = printed(make_diagnosis(), width=160)
    parts = [
        "634 rides of 5 vehicles on 10 vehicle-days, 2018-01-15 to 2018-09-13, in 7,428 windows.",
        "Excluded: too short 12.",
        "Not used: 140 rides of 2018-01-17, 2018-01-22, the final hold-out dates on which socast add evaluates.",
        (
            "The mean absolute error is 0.062 kWh per ride, 9.0 % of the mean energy of a ride; "
            "on average the model predicts"
        ),
        "Measurement noise alone causes 0.037 kWh, 60 % of the error",
        "below 0 °C and longer than 10 km",
        "0.11 kWh less than for other rides",
        "1. cold_rolling@reference=283.15: cold tyres: rolling resistance grows by 1.1 ± 0.2 %",
        "explains 3.1 % (95 % interval 2.0 % to 4.2 %)",
        "coefficient 0.00011 1/K, 95 % interval 9e-05 to 0.00013; plausible",
        "not distinguishable from air_density in these data (r = 0.83); to distinguish them, record slow drives over a",
        "equal in energy, while it acts, to +1.2 m/s of headwind or +180 kg",
        "2. brake_drag: brakes rub with 75 ± 25 N; only for vehicle=taxi-003",
        "- coefficient 75 N, 95 % interval 50 to 100; NOT plausible (range 0 to 60 N): it may stand for another cause",
        (
            "Mean absolute error with all terms refitted to these rides for each car (in sample; each missing effect "
            "fitted without the days that it is evaluated on): 0.055 -> 0.048 -> 0.046 kWh per ride; measurement noise "
            "0.037 kWh"
        ),
        (
            "Something outside the library is missing (probability 97 %), with 2.4 % (95 % interval 1.0 % to 3.8 %) of "
            "the energy, like P = c · d · r; c = 3.1e+08 W/(m/s)."
        ),
        "Its form is uncertain; these data prefer: P = c · d · r (70 %); P = c · d² · r (25 %).",
        "Try cold_rolling first, in all cars: these data do not tell it from air_density.",
    ]
    places = [output.find(part) for part in parts]
    assert -1 not in places, parts[places.index(-1)]
    assert places == sorted(places)


def test_diagnosis_without_missing_effect_states_it():
    none = [{"effect": "none", "probability": 0.97}]
    output = printed(make_empty_diagnosis(causes=none))
    assert "No effect of the library is probable enough to be named." in output
    assert "No group of rides by weather, time, speed or vehicle differs from the others" in output
    assert "These rides show no missing effect." in output
    assert "Write an effect of your own" in printed(make_empty_diagnosis(unknown=[make_unknown_cause()]))


@pytest.mark.parametrize(("mae", "unknown", "stated"), [(0.037, 0, True), (0.038, 0, False), (0.03, 1, False)])
def test_remaining_error_is_compared_with_noise_floor(mae, unknown, stated):
    steps = [{"effect": None, "mae_kwh": mae, "noise_floor_kwh": 0.037}]
    lines = sentences.describe_remainder(make_diagnosis(unknown=unknown * [make_unknown_cause()], steps=steps))
    assert ("The remaining error does not exceed measurement noise." in lines) == stated


@pytest.mark.parametrize(
    ("first", "chance", "unknown", "advice"),
    [
        ("none", 0.58, 0, "Most probably, no effect is missing (58 %). More rides would decide it."),
        ("none", 0.97, 0, "These rides show no missing effect."),
        ("payload", 0.45, 0, "More rides would decide whether an effect is missing."),
        ("none", 0.97, 1, "No effect of the library is named, but something outside it is missing. Write an effect"),
    ],
)
def test_advice_agrees_with_the_probabilities(first, chance, unknown, advice):
    causes = [{"effect": first, "probability": chance}, {"effect": "snow", "probability": 0.03}]
    empty = make_empty_diagnosis(causes=causes, credible_set=["none"], unknown=unknown * [make_unknown_cause()])
    assert advice in printed(empty)


@pytest.mark.parametrize(
    ("causes", "stated"),
    [
        ({"none": 0.97}, "No effect of the library is missing in all cars (97 %)."),
        (
            {"none": 0.9, "payload": 0.1},
            "No effect of the library is missing in all cars (90 %); the most probable: payload 10 %.",
        ),
        (
            {"payload": 0.45, "none": 0.36, "snow": 0.35},
            "No effect is probable enough to be named in all cars; the most probable: payload 45 %, snow 35 %.",
        ),
        (
            {"payload": 0.95, "none": 0.05},
            "No effect is named in all cars: what may be missing is too small to count (payload 95 %).",
        ),
    ],
)
def test_headline_says_how_probable_it_is_that_nothing_is_missing(causes, stated):
    rows = [{"effect": name, "probability": chance} for name, chance in causes.items()]
    assert sentences.describe_verdict(make_empty_diagnosis(causes=rows)) == [stated]


def test_doubtful_effect_is_to_be_tried_and_not_relied_on():
    result = make_diagnosis(missing=[make_missing_effect(gain_ci95=[-0.1, 0.3], effective_dates=2.0)], deviations=[])
    advice = sentences.describe_next_step(result)[0]
    assert advice == (
        "Try cold_rolling in all cars, and do not rely on it yet: its gain on held-out days is not certain and nearly "
        "all of it lies on 2 dates."
    )
    assert sentences.find_recommended(result) == "cold_rolling"


def test_effect_that_raises_the_error_is_said_to_do_so():
    one = make_diagnosis(missing=[make_missing_effect(gain=-0.19, gain_ci95=[-0.5, 0.12])]).missing[0]
    assert sentences.describe_gain(one).startswith(
        "raises the squared error of rides on held-out days by 19.0 % (95 % interval −12.0 % to 50.0 %)"
    )


def test_effect_that_explains_too_little_to_be_added_is_said_to_be_so():
    result = make_diagnosis(missing=[make_missing_effect(gain=0.001, gain_ci95=[0.0005, 0.0015])])
    assert (
        "it explains less than 0.2 % of the error, which socast add asks for" in sentences.describe_next_step(result)[0]
    )


def test_own_effect_is_not_advised_beside_a_named_one():
    """A term that fits what remains is offered for later."""
    for result in (
        make_diagnosis(),
        make_empty_diagnosis(deviations=[make_deviation()], unknown=[make_unknown_cause()]),
    ):
        assert "effect of your own" not in printed(result)
    assert "and see whether the cause outside the library is still there." in printed(make_diagnosis())


def test_effects_without_a_signal_are_listed():
    result = make_diagnosis()
    statuses = {
        "demisting": "not in the data",
        "my_effect": "not in the tables",
        "cold_regen_limit": "zero in these drives",
        "my_constant": "not identifiable beside the model",
    }
    untested = [TestedEffect(effect=name, status=status) for name, status in statuses.items()]
    text = printed(replace(result, tested=[*result.tested, *untested]))
    for sentence in (
        "their signal is known in less than half of the windows: snow, demisting.",
        "(make them again with --effects FILE): my_effect.",
        "without their signal or out of its range: cold_regen_limit.",
        "because the terms of the model can imitate them: my_constant.",
    ):
        assert sentence in text, sentence


CERTAIN = {
    "causes": [{"effect": "cold_rolling", "probability": 1.0}],
    "credible_set": ["cold_rolling"],
    "probability": 1,
}
RIVALS = [
    {"effect": name, "probability": p} for name, p in (("cold_rolling", 0.6), ("air_density", 0.35), ("none", 0.05))
]


def test_probability_of_a_missing_effect_is_told_with_those_of_its_rivals():
    _, line, *_ = sentences.describe_missing_effect(make_missing_effect(causes=RIVALS, probability=0.6))
    assert line == "missing with a probability of 60 %; or else air_density 35 %, no missing effect 5 %"


def test_headline_names_a_missing_effect_with_its_size():
    one = make_diagnosis(missing=[make_missing_effect(**CERTAIN)], deviations=[], unknown=[])
    (line,) = sentences.describe_verdict(one)
    assert line.startswith("cold_rolling is missing in all cars (100 %). Cold tyres: rolling resistance grows by 1.1 ±")
    assert "plausible" not in line


def test_headline_of_one_car_does_not_speak_of_all_cars():
    one = make_diagnosis(missing=[make_missing_effect(**CERTAIN)], deviations=[], data={"vehicles": 1})
    assert sentences.describe_verdict(one)[0].startswith("cold_rolling is missing (100 %).")


def test_headline_names_all_that_would_explain_the_same_once():
    rival = make_missing_effect(effect="air_density", variant="", causes=RIVALS, probability=0.35)
    result = make_diagnosis(missing=[make_missing_effect(causes=RIVALS), rival], deviations=[], unknown=[])
    (line,) = sentences.describe_verdict(result)
    assert line.startswith(
        "cold_rolling or air_density is missing in all cars: these data do not tell them apart (cold_rolling 60 %, "
        "air_density 35 %). If it is cold_rolling: cold tyres: rolling resistance grows by 1.1 ± 0.2 %"
    )


def test_headline_counts_effects_beyond_the_third():
    effects = ("cold_rolling", "headwind", "snow", "payload", "wet_road")
    missing = [make_missing_effect(**CERTAIN | {"effect": name, "credible_set": [name]}) for name in effects]
    lines = sentences.describe_verdict(make_diagnosis(missing=missing, deviations=[]))
    assert [line.split()[0] for line in lines] == ["cold_rolling", "headwind", "snow", "2", "1"]
    assert lines[-1] == "1 cause outside the library: see Remaining error."


def test_deviation_leads_only_where_nothing_is_missing_in_all_cars():
    both = make_diagnosis(missing=[make_missing_effect(**CERTAIN)])
    assert sentences.describe_verdict(both)[0].startswith("cold_rolling is missing in all cars")
    add, *_, then = [line for line in sentences.describe_next_step(both) if "socast" not in line][:2]
    assert (add, then[:21]) == ("Add cold_rolling in all cars.", "Then test the finding")
    one = make_empty_diagnosis(deviations=both.deviations)
    assert sentences.describe_verdict(one)[0].startswith("Finding: taxi-005")
    assert sentences.describe_next_step(one)[0].startswith("Test the finding")
    assert sentences.find_recommended(one) is None
    assert sentences.title_verdict(one) == "Taxi-005 changed"


def test_uncorrelated_rival_is_not_called_indistinguishable():
    rival = {"effect": "air_density", "correlation": -0.1, "data": "slow drives over a year"}
    (line,) = sentences.describe_rivals(make_missing_effect(separate=[rival]))
    assert line == "or else air_density, which acts in other windows (r = −0.10): more rides would tell"
    (close,) = sentences.describe_rivals(make_missing_effect())
    assert close.startswith("not distinguishable from air_density in these data (r = 0.83)")


def test_refit_that_does_not_lower_the_error_is_explained(tmp_path):
    error = {"mae_kwh": 0.247, "mae_refitted_kwh": 0.296}
    worse = make_diagnosis(error=error)
    assert "it would be 0.296 kWh (in sample). That is no less than the model as given: refitting lowers" in printed(
        worse
    )
    assert "Refitted: That is no less than the model as given" in " ".join(page(worse, tmp_path).text)
    assert "no less than the model as given" not in printed(make_diagnosis())


def test_bins_that_compare_marks_are_named_where_no_group_differs():
    bins = [
        {"condition": "temperature", "bin": "20 to 25", "rides": 21, "bias_kwh": {"value": 0.227, "ci95": 0.068}},
        {"condition": "speed", "bin": "30 to 40", "rides": 8, "bias_kwh": {"value": 0.239, "ci95": 0.087}},
    ]
    text = printed(make_empty_diagnosis(biased_bins=bins, error={"mae_kwh": 0.162, "bias_kwh": 0.134}))
    named = "temperature 20 to 25 °C (+0.227 ± 0.068 kWh), speed 30 to 40 km/h (+0.239 ± 0.087 kWh)"
    assert f"Off zero, as socast compare marks them: {named}. A bin is compared with zero" in text
    assert "marks bins and no group: on average the model predicts 0.134 kWh too much." in text
    small = printed(make_empty_diagnosis(biased_bins=bins, error={"mae_kwh": 0.162, "bias_kwh": 0.013}))
    assert "marks bins and no group" not in small
    assert "Off zero" not in printed(make_empty_diagnosis())


def test_noise_above_the_error_is_called_overestimated():
    result = make_diagnosis(unknown=[], error={"mae_kwh": 0.0596, "noise_floor_kwh": 0.113})
    assert "is 0.113 kWh, more than the error: it is overestimated" in sentences.describe_error(result)[-1]
    assert "100 %" not in printed(result)
    assert "does not exceed measurement noise" not in printed(result)


def test_many_held_out_dates_are_counted():
    held_out = {"rides": 269, "dates": [f"2018-03-{day:02d}" for day in range(3, 12)], "final": True}
    result = make_diagnosis(data={"held_out": held_out})
    sentence = "Not used: 269 rides of 9 dates from 2018-03-03 to 2018-03-11, the final hold-out dates on which"
    assert sentence in printed(result)


def test_error_without_missing_effect_is_not_called_held_out():
    steps = [{"effect": None, "mae_kwh": 0.0206, "noise_floor_kwh": 0.0233}]
    line, *_ = sentences.describe_remainder(make_empty_diagnosis(steps=steps))
    assert "refitted to these rides for each car (in sample): 0.0206 kWh per ride" in line
    assert "held-out" not in line


def test_next_command_can_be_copied(tmp_path):
    result = insert_commands(
        make_diagnosis(), "models/base.json", RideSource([Path("tables one"), Path("b")], effect_files=[Path("my.py")])
    )
    command = result.missing[0].command
    assert command == (
        "socast add cold_rolling@reference=283.15 'tables one' b --model models/base.json "
        "--effects my.py -o models/base-cold_rolling.json"
    )
    assert "--scope vehicle=taxi-003" in result.missing[1].command
    console = Console(width=40, file=StringIO(), color_system=None)
    report.show(result, console)
    assert command in console.file.getvalue().splitlines()
    assert {"class": "command"} in [attrs for tag, attrs in page(result, tmp_path).tags if tag == "p"]
    assert command in " ".join(page(result, tmp_path).text)
    assert parse_term(result.missing[1]) == ("brake_drag", ["vehicle=taxi-003"])


@pytest.mark.parametrize("result", [make_diagnosis(), make_empty_diagnosis()], ids=["some", "none"])
def test_page_is_self_contained(result, tmp_path):
    reader = page(result, tmp_path)
    assert not reader.loaded
    assert len(reader.ids) == len(set(reader.ids))
    assert set(reader.links) - {"main"} <= set(reader.ids)


def test_page_has_every_figure_and_table(tmp_path):
    reader = page(make_diagnosis(), tmp_path, suggested="mine.py")
    figures = {name.removeprefix("figure-") for name in reader.ids if name.startswith("figure-")}
    assert figures == {
        *("causes", "errors", "slices", "location", "effects", "coefficient-0", "coefficient-1", "unknown"),
        *("partial-0", "partial-cars-0", "partial-slopes-0", "partial-1", "partial-cars-1", "partial-slopes-1"),
        *("profile-average_speed_kmh", "profile-vehicle_id"),
        *("cars", "change-0"),
    }
    text = " ".join(reader.text)
    for part in ("snow", "not in the data", "1.1 ± 0.2 %", "mine.py contains it as an effect to edit", "P = c · d · r"):
        assert part in text, part


def test_page_states_what_is_missing_once(tmp_path):
    further = [{"effect": "none", "probability": 0.8}, {"effect": "snow", "probability": 0.2}]
    text = " ".join(page(make_diagnosis(further=further), tmp_path).text)
    assert text.count("cold_rolling or air_density is missing in all cars: these data do not tell them apart") == 1
    assert "Beside cold_rolling@reference=283.15, brake_drag, these may be missing: snow 20 %." in text


def test_numbers_stay_with_their_units_on_the_page_and_in_the_terminal(tmp_path):
    write_report(report.build_report(make_diagnosis()), tmp_path / "page.html")
    text = (tmp_path / "page.html").read_text()
    assert "60\u00a0% of the error" in text
    assert "0.037\u00a0kWh" in text
    console = Console(width=30, file=StringIO(), color_system=None)
    report.show(make_diagnosis(), console)
    assert not [line for line in console.file.getvalue().splitlines() if line.lstrip().startswith(("%", "kWh", "±"))]


def test_title_and_caption_that_repeat_stand_once(tmp_path):
    write_report(report.build_report(make_diagnosis()), tmp_path / "page.html")
    text = (tmp_path / "page.html").read_text()
    assert "<h3>Location of the error</h3>" not in text
    assert "<h3>1. cold_rolling@reference=283.15: coefficient and plausible range</h3>" in text
    assert text.count(">Line: 95\u00a0% interval. Shaded: the plausible range.") == 1


@pytest.mark.parametrize("make", [draw_errors, draw_slices, draw_effects, draw_remainder])
def test_figures_have_units_and_work_in_black_and_white(make):
    for one in make(make_diagnosis()):
        assert_axes_are_titled(one.figure)
        assert one.caption
        for trace in one.figure.data:
            if trace.type == "scatter":
                assert trace.marker.symbol or trace.line.dash or trace.fill
            else:
                assert trace.marker.pattern.shape is not None


def test_intervals_of_figures_are_those_of_the_diagnosis():
    trace = draw_effects(make_diagnosis())[0].figure.data[0]
    assert trace.x[0] == pytest.approx(3.1)
    assert (trace.error_x.array[0], trace.error_x.arrayminus[0]) == pytest.approx((1.1, 1.1))
    [drawn] = draw_coefficients([make_missing_effect()])
    assert drawn.figure.data[0].x[0] == pytest.approx(1.1e-4)
    assert drawn.figure.layout.xaxis.title.text == "Growth of the rolling resistance [1/K]"
    assert (drawn.figure.layout.shapes[0].x0, drawn.figure.layout.shapes[0].x1) == (2e-5, 3e-4)
    [outside] = draw_coefficients([make_diagnosis().missing[1]])
    low, high = outside.figure.layout.xaxis.range
    assert low < outside.figure.layout.shapes[0].x1 < outside.figure.data[0].x[0] < high
    bias = draw_slices(make_diagnosis(slices=[{"where": "x", "bias_kwh": 0.1, "ci95": [0.05, 0.2]}]))[0].figure.data[0]
    assert (bias.error_x.array[0], bias.error_x.arrayminus[0]) == pytest.approx((0.1, 0.05))


def make_result():
    """Return a diagnosis with one missing effect."""
    return make_diagnosis(missing=[make_missing_effect()])


def list_paths(value, path=()):
    """Yield the path of every value in JSON values."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield (*path, key)
            yield from list_paths(item, (*path, key))
    elif isinstance(value, list) and value and isinstance(value[0], dict):
        yield from list_paths(value[0], (*path, 0))


def forget(values, path):
    """Return the diagnosis of JSON values without the value at a path; None where the value is always known."""
    part = values
    for key in path[:-1]:
        part = part[key]
    known, part[path[-1]] = part[path[-1]], None
    try:
        return msgspec.convert(values, Diagnosis)
    except msgspec.ValidationError:
        return None
    finally:
        part[path[-1]] = known


KNOWN_VALUES = make_result().to_json()
UNKNOWN_VALUES = {path: made for path in list_paths(KNOWN_VALUES) if (made := forget(KNOWN_VALUES, path)) is not None}


PRINTERS = ("print_heading", "print_lines", "print_section")


@pytest.fixture(scope="module")
def known():
    """Return what the terminal shows of the whole diagnosis, with the function that prints it."""
    parts = []
    with pytest.MonkeyPatch.context() as patch:
        for name in PRINTERS:
            patch.setattr(report, name, lambda part, *_, name=name, **__: parts.append((name, part)))
        printed(make_result())
    return parts


def print_changes(result, known):
    """Print what the terminal shows of a diagnosis, without the known parts."""
    printers = {name: getattr(report, name) for name in PRINTERS}

    def print_unknown(name, part, *rest, **more):
        if (name, part) not in known:
            printers[name](part, *rest, **more)

    with pytest.MonkeyPatch.context() as patch:
        for name in PRINTERS:
            patch.setattr(report, name, partial(print_unknown, name))
        printed(result)


@pytest.fixture(scope="module")
def readers():
    """Return the functions that draw each field of a result; no other figure can depend on the field."""
    found = {}
    for draw in report.DRAWN.values():
        for name in find_read_fields(draw, make_result()):
            found.setdefault(name, []).append(draw)
    return found


def test_every_part_with_a_figure_has_a_reader(readers):
    assert {"causes", "error", "steps", "slices", "error_location", "missing", "unknown", "profiles"} <= set(readers)
    assert {"deviations", "cars"} <= set(readers)


@pytest.mark.parametrize("path", UNKNOWN_VALUES, ids=lambda path: ".".join(map(str, path)))
def test_unknown_values_are_tolerated(path, readers, known, tmp_path):
    result = UNKNOWN_VALUES[path]
    print_changes(result, known)
    for draw in readers.get(path[0], ()):
        draw(result)
    report.build_sections(result)
    if path[0] == "model":
        write_report(report.build_report(result), tmp_path / "page.html")


def test_odd_names_are_escaped(tmp_path):
    result = make_diagnosis(
        missing=[make_missing_effect(effect=ODD, variant=ODD, words=ODD, scope=[f"vehicle={ODD}"], group=[ODD, ODD])]
    )
    first, *others = result.slices
    result = replace(result, model=replace(result.model, name=ODD), slices=[replace(first, where=ODD), *others])
    assert "[red]model[/red]" in printed(result)
    reader = page(result, tmp_path)
    assert "alert(1)" in "".join(reader.text)
    assert not [tag for tag, _ in reader.tags if tag == "b" and ODD in tag]
