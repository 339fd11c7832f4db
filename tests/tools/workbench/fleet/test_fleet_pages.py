"""The pages of the fleet in a real browser: replay, seek, table, map, car and questions."""

import re

import msgspec
import numpy as np
import pytest
from msgspec.structs import replace
from PIL import Image
from playwright.sync_api import expect

from socast.core.wire.messages import Finding, Forecast, Message, encode
from socast.tools.bench.workbench import BoardSource, make_fleet_messages
from socast.tools.commands.ask import BESIDES
from socast.tools.workbench.fleet.alarms import list_alarms
from socast.tools.workbench.fleet.board import Board
from socast.tools.workbench.jobs import Jobs
from socast.tools.workbench.json_routes import Workbench
from socast.tools.workbench.workspace import Workspace
from tests.support.accessibility import list_violations
from tests.support.browsers import NARROW, WIDE, Visit, open_browser
from tests.support.players import playing, stand_in_the_middle
from tests.support.workbench_pictures import DOCS, PICTURES, measure_difference, playing_the_evening, take_pictures
from tests.support.workbenches import serve
from tests.support.zenoh_sessions import eventually

pytestmark = pytest.mark.long
LARGEST_LOAD = 1_500_000
LARGEST_DIFFERENCE = 0.05
"""Mean difference of two pictures that another font makes."""
PAGES = {"#/fleet": ".fleet-table tr.car", "#/car/taxi-001?km=18&min=25": ".answer .chip"}
"""Address of a page, and an element that shows that it is complete."""

decode_forecast = msgspec.json.Decoder(Forecast).decode
LOOK = "document.querySelector('canvas.map').toDataURL()"
"""Script that gives the picture of the map."""


@pytest.fixture(scope="module")
def player():
    """Return a player that stands in the middle of the shift."""
    with playing() as player:
        stand_in_the_middle(player)
        yield player


@pytest.fixture(scope="module")
def server(player):
    with serve(Workbench(Workspace(), Jobs(), fleet=player)) as server:
        yield server


@pytest.fixture(scope="module")
def browser():
    with open_browser() as browser:
        yield browser


@pytest.fixture(scope="module")
def pictures(browser, tmp_path_factory):
    """Return the folder of fresh pictures of the pages."""
    folder = tmp_path_factory.mktemp("pictures")
    with playing_the_evening() as player, serve(Workbench(Workspace(), Jobs(), fleet=player)) as server:
        take_pictures(browser, server, folder)
    return folder


@pytest.fixture(scope="module")
def window(browser, server):
    """One window for all tests: to open one takes longer than most tests."""
    opened = Visit(browser, server)
    yield opened
    opened.close()


@pytest.fixture
def visit(window):
    """The window at the page of the fleet; nothing goes wrong in it, and it asks no other host."""
    window.go("#/fleet")
    yield window
    assert window.strangers == []
    assert window.errors == []


def test_first_load_is_small_and_from_this_host_only(browser, server):
    visit = Visit(browser, server)
    visit.page.wait_for_selector(PAGES["#/fleet"])
    sizes = visit.page.evaluate(
        "[...performance.getEntriesByType('navigation'), ...performance.getEntriesByType('resource')]"
        ".map((each) => each.transferSize)"
    )
    visit.close()
    assert len(sizes) > 8
    assert 20_000 < sum(sizes) < LARGEST_LOAD
    assert (visit.strangers, visit.errors) == ([], [])


@pytest.mark.parametrize("name", PICTURES)
def test_pictures_of_the_documentation_show_the_present_pages(name, pictures):
    assert measure_difference(pictures / name, DOCS / name) < LARGEST_DIFFERENCE, (
        "renew with: python -m tests.support.workbench_pictures"
    )


@pytest.mark.parametrize("name", PICTURES)
def test_pictures_of_the_documentation_keep_every_colour(name):
    with Image.open(DOCS / name) as picture:
        assert picture.mode == "RGB"  # a palette would lose those of small marks


@pytest.mark.parametrize("scheme", ["dark", "light"])
def test_pages_are_accessible_and_fit_every_width(visit, scheme):
    visit.page.emulate_media(color_scheme=scheme, reduced_motion="reduce")
    for address, complete in PAGES.items():
        visit.go(address)
        visit.page.wait_for_selector(complete)
        assert visit.page.evaluate(f"() => matchMedia('(prefers-color-scheme: {scheme})').matches")
        assert list_violations(visit.page) == []
        visit.page.set_viewport_size(NARROW)
        visit.page.wait_for_function(f"() => document.scrollingElement.scrollWidth <= {NARROW['width']}")
        assert list_violations(visit.page) == []
        visit.page.set_viewport_size(WIDE)


def test_player_seeks_and_plays_from_the_page(visit, player):
    page = visit.page
    page.wait_for_selector(PAGES["#/fleet"])
    page.get_by_role("button", name="Play").click()
    page.get_by_role("button", name="Pause").click()
    page.get_by_role("button", name="Play").wait_for()
    assert not player.describe()["playing"]
    slider = page.get_by_label("Time of the recording")
    slider.focus()
    page.keyboard.press("Home")
    assert eventually(lambda: player.describe()["time_s"] == pytest.approx(player.begin_ns * 1e-9, abs=1.0))
    visit.wait("document.querySelectorAll('tr.car').length < 3")
    page.get_by_label("Speed").select_option("max")
    page.get_by_role("button", name="Play").click()
    page.get_by_role("button", name="Play again").wait_for()
    visit.wait("document.querySelectorAll('tr.car').length === 7")
    player.pause()
    stand_in_the_middle(player)
    visit.wait("Math.abs(Number(document.querySelector('input[type=range]').value) - 500) < 2")


def test_table_is_sorted_filtered_and_walked_by_keys(visit):
    page = visit.page
    page.wait_for_selector(PAGES["#/fleet"])
    names = "[...document.querySelectorAll('tr.car')].map((line) => line.dataset.car)"
    assert page.query_selector("th[aria-sort]") is None  # trouble first is the order of no single column
    cells = "[...document.querySelectorAll('tr.car td:nth-child(4)')].map((cell) => cell.textContent)"
    risks = [int("".join(filter(str.isdigit, text))) for text in page.evaluate(cells)]
    trouble = [risk if risk >= 5 else 0 for risk in risks]
    assert trouble == sorted(trouble, reverse=True)
    page.get_by_role("button", name="Charge %").click()
    page.wait_for_selector("th[aria-sort=ascending][data-key=soc_pct]")
    charges = [
        float(text)
        for text in page.evaluate(
            "[...document.querySelectorAll('tr.car td:nth-child(2)')].map((cell) => cell.textContent)"
        )
    ]
    assert charges == sorted(charges)
    page.locator(".fleet-frame").focus()
    page.keyboard.press("ArrowDown")
    page.wait_for_selector("tr.chosen")
    first = page.evaluate(names)[0]
    assert f"car={first}" in page.url
    assert first in page.locator("p[aria-live]").text_content()
    page.get_by_label("Filter by name").fill("003")
    visit.wait("document.querySelectorAll('tr.car').length === 1")
    assert "filter=003" in page.url
    page.get_by_label("Filter by name").fill("horse")
    page.get_by_text("No car matches").wait_for()
    page.get_by_label("Filter by name").fill("")
    page.locator(".fleet-frame").focus()
    page.keyboard.press("Enter")
    page.get_by_role("heading", name=first).wait_for()
    page.go_back()
    page.wait_for_selector(PAGES["#/fleet"])


def test_map_answers_to_pointer_and_keys(visit):
    page = visit.page
    page.wait_for_selector(PAGES["#/fleet"])
    canvas = page.locator("canvas.map")
    visit.wait("document.querySelector('canvas.map').width > 300")
    canvas.hover()
    canvas.focus()
    for act in (
        lambda: page.keyboard.press("+"),
        lambda: page.keyboard.press("ArrowLeft"),
        lambda: page.mouse.wheel(0, -300),
        page.get_by_role("button", name="Show the whole fleet").click,
    ):
        before = page.evaluate(LOOK)
        act()
        visit.wait(f"(before) => ({LOOK}) !== before", before)
    page.locator("button[data-color=risk]").click()
    page.wait_for_selector("button[data-color=risk][aria-pressed=true]")
    assert "color=risk" in page.url


def test_question_is_asked_by_a_form_and_kept_in_the_address(visit, player):
    page = visit.page
    visit.go("#/car/taxi-001")
    page.get_by_label("Distance [km]").fill("18")
    page.get_by_label("Duration [min]").fill("25")
    page.get_by_role("button", name="Ask").click()
    page.locator(".answer .chip").wait_for()
    assert page.locator(".answer .command").count() == 0
    assert "km=18" in page.url
    answer = player.ask("taxi-001", {"distance_km": "18", "duration_s": "1500"})
    assert f"reserve of {answer.reserve_soc_pct:g} %" in page.locator(".answer-line").text_content()
    page.get_by_label("Distance [km]").fill("900")
    page.get_by_role("button", name="Ask").click()
    page.locator(".answer .bad").wait_for()
    assert re.search(r"\d", page.locator(".answer .bad").text_content())


def test_car_that_is_unknown_and_page_that_does_not_exist_say_so(visit):
    visit.go("#/car/horse")
    visit.page.get_by_text("horse has sent nothing so far").wait_for()
    visit.go("#/stable")
    visit.page.get_by_text("There is no such page").wait_for()


def test_text_of_messages_is_shown_as_text(browser):
    words = "<img src=x onerror=alert(1)> saves nothing"
    finding = Finding("all", "aero_drag", 1.7e9, "sure", 0.95, [], "2026-01-01", None, None, *[None] * 5, words, [])
    board = Board()
    board.take([*make_fleet_messages(3, 0.0, np.random.default_rng(7)), Message("findings/all/a", encode(finding), 0)])
    with serve(Workbench(Workspace(), Jobs(), fleet=BoardSource(board))) as server:
        visit = Visit(browser, server)
        visit.page.get_by_text(words).wait_for()
        assert visit.page.locator("img").count() == 0
        visit.close()
    assert (visit.strangers, visit.errors) == ([], [])


def test_plan_ends_with_the_energy_of_waiting_that_the_range_leaves_out(visit, player):
    visit.go("#/car/taxi-001")
    row = visit.page.locator(".legs-frame tbody tr").last
    row.wait_for()
    waiting = player.ask("taxi-001", {}).waiting_energy_kwh
    assert row.text_content() == f"{BESIDES[False]}{waiting:.2f}"


def test_car_whose_shift_is_over_is_named_so_and_has_no_risk(browser):
    board = Board()
    for second in (0.0, 60.0, 8000.0, 8060.0):
        cars = [
            decode_forecast(each.payload) for each in make_fleet_messages(3, second, np.random.default_rng(7))[1::2]
        ]
        ended = [replace(each, ride_id=None, ride_duration_s=0.0, reserve_risk=0.4) for each in cars]
        for one in ended if second < 100.0 else ended[:2]:
            board.take([Message(f"fleet/{one.vehicle_id}/forecast", encode(one), 0)])
    with serve(Workbench(Workspace(), Jobs(), fleet=BoardSource(board))) as server:
        visit = Visit(browser, server)
        visit.go("#/fleet?show=shift over")
        row = visit.page.locator(".fleet-table tr.car")
        expect(row).to_have_count(1)
        assert row.text_content().startswith("taxi-0002")
        assert row.text_content().endswith("shift over")
        assert row.locator("td").nth(3).text_content() == "–"
        visit.go("#/car/taxi-0002")
        visit.page.get_by_text("shift over").wait_for()
        visit.close()
    assert {alarm["car"] for alarm in list_alarms(board)["list"]} == {"taxi-0000", "taxi-0001"}


def test_address_that_changes_while_its_page_loads_is_obeyed(browser, server):
    visit, held = Visit(browser, server), []
    visit.page.route("**/car.js", lambda route: held.append(route))  # noqa: PLW0108 - Playwright marks what it is given
    visit.go("#/car/taxi-001")
    assert eventually(lambda: visit.page.evaluate("1") and held)
    visit.go("#/car/taxi-001?km=18&min=25")
    visit.page.wait_for_timeout(50)
    held[0].continue_()
    expect(visit.page.get_by_label("Distance [km]")).to_have_value("18")
    visit.close()


def test_page_says_when_it_shows_what_is_old(browser, monkeypatch):
    source, board = BoardSource(Board()), make_fleet_messages(3, 0.0, np.random.default_rng(7))
    source.board.take(board)
    state = source.describe()
    monkeypatch.setattr(source, "describe", lambda: state)
    with serve(Workbench(Workspace(), Jobs(), fleet=source)) as server:
        visit = Visit(browser, server)
        live, banner = visit.page.get_by_text("Live", exact=True), visit.page.get_by_role("alert")
        live.wait_for()
        assert banner.count() == 0
        state = state | {"problem": "no router at E", "refused": {"too_large": 2}}
        expect(banner).to_have_text("What is shown is old: no router at E")
        expect(live).to_be_hidden()
        visit.page.get_by_text("2 too large").wait_for()
        state = state | {"problem": ""}
        expect(banner).to_have_count(0)
        expect(live).to_be_visible()
        visit.close()
    assert (visit.strangers, visit.errors) == ([], [])


def test_page_of_another_origin_reaches_nothing(browser, server):
    reached = browser.new_context()
    page = reached.new_page()
    page.goto(f"http://localhost:{server.port}/")
    assert "no session" in page.text_content("body") or "another" in page.text_content("body")
    script = """async (address) => {
        const sent = fetch(address + "/api/session", {credentials: "include"});
        const asked = await sent.then(() => "read", () => "refused");
        const socket = await new Promise((done) => {
            const opened = new WebSocket(address.replace("http", "ws") + "/fleet.socket");
            opened.onopen = () => done("open");
            opened.onerror = () => done("refused");
        });
        return [asked, socket];
    }"""
    page.goto("about:blank")
    assert page.evaluate(script, server.origin) == ["refused", "refused"]
    reached.close()


def test_workbench_without_a_fleet_says_how_to_get_one(browser):
    with serve(Workbench(Workspace(), Jobs(), read_only=True)) as server:
        visit = Visit(browser, server)
        visit.page.get_by_text("No fleet to show").wait_for()
        assert visit.page.get_by_text("read-only").is_visible()
        assert list_violations(visit.page) == []
        visit.close()
    assert (visit.strangers, visit.errors) == ([], [])


def test_times_are_in_the_zone_of_the_reader_and_name_it(visit):
    page = visit.page
    page.wait_for_selector(PAGES["#/fleet"])
    told = page.evaluate(
        """async () => {
          const format = await import("/static/format.js");
          const before = format.getZone();
          const tell = () => [format.clock(1.7e9, true), format.day(1.7e9), format.zoneName(1.7e9)];
          const zones = ["America/Toronto", "Asia/Kolkata", "UTC", "no/zone"];
          const out = zones.map((zone) => { format.setZone(zone); return tell(); });
          format.setZone(before);
          return out;
        }"""
    )
    assert told[0][:2] == ["17:13:20", "2023-11-14"]
    assert told[1][:2] == ["03:43:20", "2023-11-15"]
    assert told[2] == told[3] == ["22:13:20", "2023-11-14", "UTC"]
    assert told[0][2] != "UTC"


def test_mistakes_in_a_question_have_the_names_of_the_form(visit):
    page = visit.page
    visit.go("#/car/taxi-001?km=18")
    page.get_by_text("Duration is not given; a ride needs Distance and Duration").wait_for()
