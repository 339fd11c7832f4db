"""Test how reports describe episodes: first of all, with the dates, the size, the cars and what to do."""

from io import StringIO
from pathlib import Path

import pytest
from msgspec.structs import replace
from rich.console import Console

from socast.tools.commands.diagnose import insert_commands
from socast.tools.report.diagnosis import page as report
from socast.tools.report.diagnosis import sentences
from socast.tools.report.diagnosis.finding_words import advise_looking, describe_episodes, tabulate_episodes
from socast.tools.report.page import write_report
from socast.tools.terminal.ride_source import RideSource
from tests.support.diagnosis_result import make_diagnosis, make_empty_diagnosis, make_episode
from tests.support.html_pages import read_page

HEADLINE = (
    "41 % of the squared error is concentrated on 17 January 2018 and 2 March 2018, 16 to 19 h UTC: +6.0 kW (95 % "
    "interval 5.7 to 6.4). Look at these dates before you add an effect."
)


def printed(result):
    console = Console(width=120, file=StringIO(), color_system=None)
    report.show(result, console)
    return " ".join(console.file.getvalue().split())


@pytest.mark.parametrize("make", [make_diagnosis, make_empty_diagnosis])
def test_report_begins_with_the_episode(make):
    result = make(episodes=[make_episode()])
    assert sentences.describe_verdict(result)[0] == HEADLINE
    output = printed(result)
    assert output.index(HEADLINE) < output.index("Episodes ") < output.index("The mean absolute error")
    assert "17 January 2018 and 2 March 2018, 16 to 19 h UTC: +6.0 kW" in output
    assert "in 3 of 4 cars that drove then, 3 rides" in output
    assert "several cars show it" in output
    assert "with a constant power in each episode, it would be" in output


def test_episode_of_data_with_invented_dates_names_its_rides_and_no_date():
    result = make_diagnosis(episodes=[make_episode()], data={"dated": False})
    rides = ", ".join(result.episodes[0].rides)
    said = [sentences.describe_verdict(result)[0], *describe_episodes(result), *advise_looking(result)]
    assert said[0].startswith(f"41 % of the squared error is concentrated on 3 rides, {rides}: +6.0 kW")
    assert "Look at these rides before you add an effect." in said[0]
    (row,) = tabulate_episodes(result).rows
    assert (row.name, row.cells[0].text) == ("–", "–")
    assert not any("2018" in line or "h UTC" in line for line in (*said, row.name))


def test_report_without_episodes_does_not_mention_them():
    assert "pisode" not in printed(make_diagnosis())


def test_next_step_is_to_look_at_the_worst_ride():
    result = make_diagnosis(episodes=[make_episode()])
    result = insert_commands(result, "base.json", RideSource([Path("autumn")]))
    first, command, *rest = sentences.describe_next_step(result)
    assert first.startswith("First look at the recordings of 17 January 2018 and 2 March 2018, 16 to 19 h UTC")
    assert command == "socast compare autumn --model base.json --ride 'taxi-003#7'"
    assert rest == sentences.describe_next_step(replace(result, episodes=[]))


@pytest.mark.parametrize(
    ("changes", "vehicles", "words"),
    [
        ({"car": "taxi-001", "cars": ["taxi-001"]}, 5, "this is a matter of taxi-001"),
        ({"car": "taxi-001", "cars": ["taxi-001"], "cars_driving": 1}, 5, "no other car shows the same"),
        ({"car": "taxi-001", "cars": ["taxi-001"], "cars_driving": 1}, 1, "these data are of one car"),
        ({"dates": [f"2018-01-{day:02}" for day in range(10, 17)]}, 5, "7 dates from 10 January 2018 to 16 January"),
        ({"hours_utc": [22, 2]}, 5, "22 to 2 h UTC"),
        ({"whole_dates": True}, 5, "all hours"),
        ({"power_kw": -1.2, "power_ci95_kw": [-1.5, -0.9]}, 5, "−1.2 kW (95 % interval −1.5 to −0.9)"),
    ],
)
def test_episode_in_words(changes, vehicles, words):
    result = make_diagnosis(episodes=[make_episode(**changes)], data={"vehicles": vehicles})
    assert words in " ".join(describe_episodes(result))


def test_further_episodes_are_mentioned_in_the_headline():
    result = make_diagnosis(episodes=[make_episode(), make_episode(power_kw=-2.0)])
    assert sentences.describe_verdict(result)[0].endswith("1 further: see Episodes.")


def test_page_has_a_table_of_episodes(tmp_path):
    write_report(report.build_report(make_diagnosis(episodes=[make_episode()])), tmp_path / "page.html")
    text = (tmp_path / "page.html").read_text()
    assert read_page(text)
    assert text.index("concentrated on 17 January 2018 and 2 March") < text.index("634 rides of 5 vehicles")
    assert "taxi-001, taxi-003, taxi-005" in text


@pytest.mark.parametrize("key", ["hours_utc", "power_kw", "power_ci95_kw", "share", "chance"])
def test_unknown_values_are_tolerated(key, tmp_path):
    result = make_diagnosis(episodes=[make_episode(**{key: None})])
    assert printed(result)
    write_report(report.build_report(result), tmp_path / "page.html")
