"""The loop in a browser: rides, missing effect, fallen error, a refusal, and an effect of one's own."""

import json
import re
from dataclasses import replace

import pytest

from socast.core import effects
from socast.tools.terminal.ride_source import RideSource
from socast.tools.workbench.jobs import Jobs
from socast.tools.workbench.json_routes import Workbench
from socast.tools.workbench.workspace import Given, Workspace
from tests.support.accessibility import list_violations
from tests.support.browsers import NARROW, Visit, open_browser
from tests.support.paths import ROOT
from tests.support.workbenches import serve

pytestmark = pytest.mark.long
EFFECT = '''from socast import effect


@effect(coefficient="force", unit="N", low=0, high=1000, source="nobody")
def {name}(speed):
    """Something that drags: P = F v."""
    return {value}
'''
SLOW_MS = 120_000


@pytest.fixture(scope="module")
def own(tmp_path_factory):
    """A file of effects that the workbench was given, checked in this process; the library forgets it at the end."""
    file = tmp_path_factory.mktemp("own") / "mine.py"
    file.write_text(EFFECT.format(name="my_drag", value="speed"), encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(effects.registry, "_check_apart", lambda path, _: effects.registry._check_here(path))
        effects.load_file(file)
        yield file
    for name in [name for name, path in effects.registry._brought_by.items() if path == file]:
        del effects.registry._library[name], effects.registry._brought_by[name]


@pytest.fixture(scope="module")
def events(tmp_path_factory):
    """A file with a known event of one car and one of all cars."""
    file = tmp_path_factory.mktemp("events") / "workshop.csv"
    file.write_text("date,vehicle_id,what\n2018-11-20,taxi-002,new tyres\n2018-11-01,,update\n", encoding="utf-8")
    return file


@pytest.fixture(scope="module")
def workbench(own, events):
    """A workbench that reads the recording while the first page opens, with a model that is quickly refitted."""
    workspace = Workspace(
        Given(
            RideSource((ROOT / "recordings/autumn.mcap",), effect_files=(own,)),
            models=("extended_physical",),
            events=events,
        )
    )
    opened = Workbench(workspace, Jobs())
    opened.jobs.start("reading the rides", workspace.open)
    yield opened
    opened.jobs.end()
    workspace.close()


@pytest.fixture(scope="module")
def server(workbench):
    with serve(workbench) as served:
        yield served


@pytest.fixture(scope="module")
def browser():
    with open_browser() as opened:
        yield opened


@pytest.fixture(scope="module")
def visit(browser, server):
    """One window for all tests."""
    opened = Visit(browser, server)
    opened.page.set_default_timeout(SLOW_MS)
    yield opened
    opened.close()


@pytest.fixture(autouse=True)
def _page_makes_no_error(visit):
    """Check after each test that nothing went wrong in the page, and that it asked no other host."""
    yield
    assert visit.errors == []
    assert visit.strangers == []


def test_pages_lead_from_the_rides_to_the_fallen_error_and_back(visit):
    page = visit.page
    visit.go("#/rides")
    page.get_by_text("537 rides of 5 cars").wait_for()
    page.get_by_role("link", name="where the model fails", exact=True).click()
    page.locator(".survey button").first.wait_for()
    assert any("Headwind" in text for text in page.locator(".survey button").all_inner_texts()[:3])
    page.get_by_role("link", name="what is missing", exact=True).click()
    page.get_by_role("heading", name="headwind is missing in all cars (100 %)").wait_for()
    page.get_by_role("button", name="Add headwind").click()
    step = page.get_by_role("region", name="Step")
    step.get_by_role("heading", name="headwind was added").wait_for()
    pair = step.locator(".big-step").inner_text().split("kWh")[0].strip()
    before, after = pair.split("→")
    assert float(after) < float(before)
    in_use = page.locator("#in-use")
    assert "extended_physical-headwind" in in_use.inner_text()
    step.get_by_role("link", name="See where it failed").click()
    page.get_by_text("before, extended_physical").first.wait_for()
    assert page.locator('.survey path[stroke-dasharray="3 3"]').count() > 3
    assert pair in page.locator(".step-line").inner_text()
    in_use.get_by_role("button", name="back to extended_physical").click()
    visit.wait("location.hash.includes('model=extended_physical') && !location.hash.includes('headwind')")
    in_use.get_by_role("button", name="back to extended_physical-headwind").click()
    page.get_by_role("link", name="Models", exact=True).click()
    page.get_by_role("region", name="Steps").get_by_text(after.strip()).wait_for()
    assert pair in page.locator(".tree").inner_text()
    page.get_by_role("combobox", name="Compare with").select_option("extended_physical")
    assert pair in page.get_by_role("region", name="Comparison").inner_text()
    page.get_by_role("region", name="Comparison").get_by_role("link", name="Close").click()
    page.get_by_role("button", name="Undo").click()
    visit.wait("document.getElementById('in-use').hidden && !location.hash.includes('headwind')")


def test_refused_effect_says_why_and_stays_in_the_history(visit):
    page = visit.page
    visit.go("#/causes?effect=snow")
    page.get_by_role("button", name="Add snow").click()
    page.get_by_role("heading", name="snow was refused").wait_for()
    page.get_by_text(re.compile("not worth a term|grows by at least")).first.wait_for()
    visit.go("#/models")
    page.get_by_role("region", name="Steps").get_by_text("refused", exact=True).wait_for()


def test_undecided_effect_says_what_would_decide_and_can_be_added_even_so(visit):
    page = visit.page
    visit.go("#/causes?effect=cornering")
    page.get_by_role("button", name="Add cornering").click()
    step = page.get_by_role("region", name="Step")
    step.get_by_role("heading", name="cornering is undecided").wait_for()
    verdict = step.get_by_role("status").inner_text()
    assert "do not show whether cornering helps" in verdict
    assert "vehicle-days would decide" in verdict
    step.get_by_role("button", name="Add even so").click()
    step.get_by_role("heading", name="cornering was added though undecided").wait_for()
    assert "--even-if-undecided" in step.get_by_text("socast add cornering").text_content()
    step.get_by_role("button", name="Undo").click()
    page.get_by_text("Undone: extended_physical-cornering is removed").wait_for()


def test_ride_opens_by_keyboard_and_shows_where_it_diverges(visit):
    page = visit.page
    visit.go("#/rides?sort=error")
    plot = page.get_by_role("group", name="Predicted against measured")
    plot.focus()
    plot.press("End")
    assert "measured" in page.locator(".chart-tip").inner_text()
    plot.press("Enter")
    page.get_by_role("heading", name="Where prediction and measurement diverge").wait_for()
    page.get_by_role("img", name="Map of the ride").wait_for()
    assert page.get_by_role("group", name="Predicted power by term").count() == 1


def test_navigation_keeps_the_chosen_model(visit):
    page = visit.page
    visit.go("#/rides?model=extended_physical")
    page.get_by_text("537 rides of 5 cars").wait_for()
    page.get_by_role("link", name="Models", exact=True).click()
    page.wait_for_url("**#/models?model=extended_physical")


def test_filter_is_in_the_address_and_counts_its_rides(visit):
    page = visit.page
    visit.go("#/rides?filter=ambient_c:..0")
    page.get_by_role("button", name="Remove the filter Outside temperature").wait_for()
    fewer = int(page.locator(".figures dd").first.inner_text())
    assert fewer < 537
    page.get_by_role("button", name="Remove the filter Outside temperature").click()
    page.wait_for_function("() => document.querySelector('.figures dd').textContent === '537'")
    assert "filter" not in page.url


def test_drag_of_a_box_selects_rides(visit):
    page = visit.page
    visit.go("#/rides?sort=distance_km")
    box = page.get_by_role("group", name="Predicted against measured").bounding_box()
    page.mouse.move(box["x"] + 120, box["y"] + 60)
    page.mouse.down()
    page.mouse.move(box["x"] + 320, box["y"] + 320)
    page.mouse.up()
    page.get_by_role("button", name="Remove the filter Measured energy").wait_for()
    assert "measured_kwh" in page.url


def test_export_is_a_model_file(visit):
    page = visit.page
    visit.go("#/models?model=extended_physical")
    with page.expect_download() as download:
        page.get_by_role("button", name="Export").click()
    assert download.value.suggested_filename == "extended_physical.json"
    assert json.loads(download.value.path().read_text(encoding="utf-8"))["recipe"] == "extended_physical"


def test_command_that_does_the_same_is_shown(visit):
    page = visit.page
    visit.go("#/failures")
    page.get_by_text("socast diagnose").wait_for(state="attached")
    visit.go("#/causes?effect=payload")
    page.get_by_text("socast effects show payload").wait_for(state="attached")


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_pages_are_accessible_and_fit_a_telephone(browser, server, scheme):
    narrow = Visit(browser, server, NARROW, scheme)
    page = narrow.page
    page.set_default_timeout(SLOW_MS)
    ready = {"rides": ".chart", "failures": ".shares", "causes": "#add", "models": ".node", "condition": ".share"}
    for name, place in ready.items():
        narrow.go(f"#/{name}")
        page.locator(place).first.wait_for()
        assert list_violations(page) == [], name
        assert page.evaluate("() => document.documentElement.scrollWidth") == NARROW["width"], name
        chosen = page.locator("#pages [aria-current]").bounding_box()
        assert chosen["x"] + chosen["width"] <= NARROW["width"], name
    assert narrow.errors == []
    narrow.close()


def test_condition_describes_each_car_and_where_the_energy_goes(visit):
    page = visit.page
    visit.go("#/condition")
    page.get_by_role("heading", name="Where the energy goes").wait_for()
    page.locator(".facets .chart").nth(4).wait_for()
    assert page.get_by_role("region", name="Table of all cars").locator("tbody tr").count() == 5
    energy = page.get_by_role("region", name="Where the energy goes").inner_text()
    assert "unexplained" in energy
    assert "±" not in energy  # the model has no standard errors
    heads = page.get_by_role("region", name="Table of all cars").locator("th.number")
    assert heads.all_inner_texts() == ["Consumption, %", "Rate, %/year", "Usable, kWh", "Battery rate, %/year"]
    marks = page.locator(".facets .chart").first.locator("text").all_text_contents()
    assert any("Dec 18" in mark for mark in marks)  # the end of the dates has a mark as their beginning has
    page.get_by_text("socast condition").wait_for(state="attached")
    page.get_by_text("socast waterfall").wait_for(state="attached")


def test_known_events_are_marked_in_the_charts_and_reached_by_keyboard(visit):
    page = visit.page
    visit.go("#/condition")
    of_car = page.get_by_role("list", name="Known events of taxi-002")
    of_car.wait_for()
    assert of_car.get_by_role("button").all_inner_texts()[0] == "update on 1 November 2018 (all cars)"
    assert page.locator(".facets .events").count() == 5
    chart = page.get_by_role("group", name="Condition of taxi-002")
    assert "Known: new tyres on 20 November 2018" in chart.get_attribute("aria-label")
    assert {"update", "new tyres"} <= set(chart.locator("text").all_text_contents())
    of_car.get_by_role("button").nth(0).focus()
    page.keyboard.press("Tab")
    assert "new tyres" in page.evaluate("() => document.activeElement.textContent")
    assert chart.locator(".chart-cursor.strong").get_attribute("visibility") == "visible"
    page.keyboard.press("Shift+Tab")
    page.keyboard.press("Shift+Tab")
    assert chart.locator(".chart-cursor.strong").count() == 0
    page.get_by_text("--events").first.wait_for(state="attached")


def test_known_event_fills_the_form_that_compares_before_and_after(visit):
    page = visit.page
    visit.go("#/condition")
    event = page.get_by_role("list", name="Known events of taxi-002").get_by_role("button", name="new tyres")
    event.focus()
    page.keyboard.press("Enter")
    form = page.get_by_role("form", name="Repair of taxi-002")
    given = [form.get_by_label(name, exact=True).input_value() for name in ("What was done", "Date [UTC]")]
    assert given == ["new tyres", "2018-11-20"]
    assert form.get_by_label("Vehicles").input_value() == "taxi-002"
    page.keyboard.press("Enter")  # the focus is on the button of the form
    answer = page.locator(".answer").filter(has_text="since 20 November 2018 (new tyres): ")
    answer.get_by_text(re.compile("placebo campaigns shows? as much")).wait_for()
    drawn = page.get_by_role("group", name=re.compile("^What chance does"))
    assert {"Estimated change [%]", "Placebo campaigns [1]"} <= set(drawn.locator("text").all_text_contents())
    assert "90 % interval" in answer.locator("dl").inner_text()
    page.get_by_text("--vehicles taxi-002 --at 2018-11-20 --what 'new tyres'").wait_for(state="attached")
    assert list_violations(page) == []


def test_event_of_all_cars_compares_all_of_them_and_errors_are_one_line(visit):
    page = visit.page
    visit.go("#/fleet")
    visit.go("#/condition")
    page.get_by_role("list", name="Known events of taxi-001").get_by_role("button", name="update").click()
    form = page.get_by_role("form", name="Repair of taxi-001")
    vehicles, submit = form.get_by_label("Vehicles"), form.get_by_role("button")
    assert vehicles.input_value().count("taxi-") == 5
    submit.click()
    page.get_by_text("No siblings of").wait_for()
    vehicles.fill("taxi-01")
    submit.click()
    page.get_by_role("alert").get_by_text("did you mean taxi-001").wait_for()
    form.get_by_label("Date [UTC]", exact=True).fill("")
    submit.click()
    page.get_by_role("alert").get_by_text("is missing (--at)").wait_for()
    page.locator(".answer dl").wait_for(state="detached")


def test_days_on_of_a_file_are_compared_with_days_off(visit, tmp_path):
    page, file = visit.page, tmp_path / "eco.csv"
    file.write_text("begin,end\n2018-10-20,2018-10-27\n2018-11-10,2018-11-17\n2018-12-05,\n", encoding="utf-8")
    visit.go("#/fleet")
    visit.go("#/condition")
    page.get_by_text("Did a repair help?", exact=True).first.click()
    form = page.get_by_role("form", name="Repair of").first
    form.get_by_label("What was done").fill("eco mode")
    form.get_by_label("Date [UTC]", exact=True).fill("2018-11-10")
    form.get_by_label("It was done").select_option("days")
    assert not form.get_by_label("Date [UTC]", exact=True).is_visible()
    form.get_by_label("or a file of them").set_input_files(file)
    visit.wait("() => document.querySelector('.repair[open] textarea').value.startsWith('begin,end')")
    form.get_by_role("button", name="Compare before and after").click()
    page.locator(".answer").get_by_text("on days on (eco mode)").wait_for()
    page.get_by_text("--toggle days-on.csv").wait_for(state="attached")
    assert list_violations(page) == []


def test_read_only_form_says_at_once_why_it_cannot_be_filled(browser, workbench):
    with serve(replace(workbench, read_only=True)) as locked:
        looking = Visit(browser, locked)
        looking.go("#/condition")
        page = looking.page
        page.get_by_role("region", name="Each car").get_by_text("read-only and compares nothing").first.wait_for()
        page.get_by_text("Did a repair help?", exact=True).first.click()
        form = page.get_by_role("form", name="Repair of").first
        assert form.get_by_label("Vehicles").is_disabled()
        assert form.get_by_role("button", name="Compare before and after").is_disabled()
        page.get_by_role("list", name="Known events of taxi-002").get_by_role("button", name="new tyres").click()
        assert page.locator(".repair[open]").count() == 1
        assert list_violations(page) == []
        assert looking.errors == []
        looking.close()


def test_own_effect_is_read_again_when_its_file_changes(visit, own):
    page = visit.page
    visit.go("#/causes?effect=my_drag")
    before = page.get_by_role("region", name="Candidates").get_by_role("button", name="my drag")
    before.wait_for()
    own.write_text(EFFECT.format(name="my_drag", value="speed +"), encoding="utf-8")
    page.get_by_text(f"{own}:7: not Python").wait_for()
    assert page.locator(".source-lines .wrong").inner_text().split()[0] == "7"
    own.write_text(EFFECT.format(name="my_other_drag", value="2.0 * speed"), encoding="utf-8")
    page.get_by_role("region", name="Your own effects").get_by_role("link", name="my other drag").wait_for()
    before.wait_for(state="detached")  # the new list of candidates begins with the likely ones
    page.get_by_role("button", name="Show all").click()
    page.get_by_role("button", name="my other drag").wait_for()
