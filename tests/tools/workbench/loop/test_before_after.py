"""The comparison of cars before and after a repair, as the page Condition requests it."""

import json
import shlex
import subprocess
from pathlib import Path

import msgspec
import pytest

from socast.core.condition.campaign_records import BeforeAfter
from socast.tools.terminal.ride_source import RideSource
from socast.tools.workbench.jobs import Jobs
from socast.tools.workbench.json_routes import Workbench
from socast.tools.workbench.loop.command_lines import before_after_commands
from socast.tools.workbench.workspace import Given, Workspace
from tests.support.commands import done
from tests.support.paths import RECORDINGS
from tests.support.web_requests import Client
from tests.support.workbenches import serve
from tests.support.zenoh_sessions import eventually

pytestmark = pytest.mark.long
MODEL = "extended_physical"
REPAIR = {"model": MODEL, "vehicles": "taxi-005", "at": "2018-11-10", "what": "new brake pads"}


@pytest.fixture(scope="module")
def workspace(autumn_tables):
    opened = Workspace(Given(RideSource((autumn_tables,)), (MODEL,)))
    opened.open()
    yield opened
    opened.close()


@pytest.fixture(scope="module")
def client(workspace):
    with serve(Workbench(workspace, Jobs())) as server:
        yield Client(server)


@pytest.fixture(scope="module")
def answer(client):
    """The result of a comparison that succeeds."""
    job = _compare(client, REPAIR)
    assert job["status"] == "done", job
    return job["result"]


def _compare(client, body):
    """Return the record of the job of a request after its end."""
    started = client.post("/api/before-after", body)
    assert started.code == 200, started
    path = f"/api/jobs/{started.record()['job']}"
    assert eventually(lambda: client.get(path).record()["status"] != "running", 120.0)
    return client.get(path).record()


def test_report_is_that_of_the_command_which_is_shown(answer, tmp_path):
    (command,) = answer["commands"]
    file = tmp_path / "report.json"
    done(*shlex.split(command)[1:], "--json", file)
    report = json.loads(file.read_text())
    assert report.pop("format")["report"] == "before-after"
    assert answer["report"] == report


def test_answer_has_words_and_counts_every_placebo_campaign(answer):
    report, placebos = answer["report"], answer["placebos"]
    assert "taxi-005" in answer["words"][0]
    assert "(new brake pads)" in answer["words"][0]
    assert answer["words"][1].startswith("The change is of the consumption of a day")
    assert answer["words"][2].startswith("To see ")
    assert sum(placebos["counts"]) == len(report["placebo"]["campaigns"]) > 0
    assert len(placebos["edges_pct"]) == len(placebos["counts"]) + 1
    assert placebos["edges_pct"][0] < 100.0 * report["change"]["change"] < placebos["edges_pct"][-1]


def test_date_to_come_has_no_change_and_no_placebo_distribution(client):
    result = _compare(client, REPAIR | {"at": "2019-01-10"})["result"]
    assert result["report"]["change"] is result["placebos"] is None
    assert "nothing can be compared yet" in result["words"][0]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"at": "10.11."}, "Date is '10.11.'; give a date such as"),
        ({"at": ""}, "is missing (Date): give it, such as 2018-11-20"),
        ({"vehicles": " , "}, "not named (Vehicles)"),
        ({"until": "2018-11-01"}, "Last date is 2018-11-01, and must be after Date, 2018-11-10"),
        ({"model": "none"}, "none"),
        ({"days_on": "2018-11-10,2018-11-12"}, "Date is given with Days on"),
        ({"at": "", "days_on": "2018-11-10,12.11."}, "Days on, line 2: end is '12.11.'"),
        ({"at": "", "days_on": "since,until"}, "its header must be vehicle_id,begin,end"),
    ],
)
def test_wrong_input_is_refused_before_work_begins(client, changes, words):
    answer = client.post("/api/before-after", REPAIR | changes)
    assert answer.code in {404, 422}
    assert words in answer.record()["error"]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"vehicles": "taxi-05"}, "did you mean taxi-005"),
        ({"at": "2018-12-16"}, "3 days with measurements after the date"),
        ({"at": "2018-09-01"}, "the rides are of 2018-10-01 to 2018-12-19"),
    ],
)
def test_error_of_the_command_is_that_of_the_job(client, changes, words):
    job = _compare(client, REPAIR | changes)
    assert job["status"] == "failed"
    assert words in job["error"]


def test_read_only_workbench_compares_nothing(workspace):
    with serve(Workbench(workspace, Jobs(), read_only=True)) as server:
        answer = Client(server).post("/api/before-after", REPAIR)
    assert answer.code == 403
    assert answer.record()["error"].startswith("this workbench is read-only")


def test_days_on_are_compared_with_days_off_as_by_the_command_which_is_shown(client, tmp_path):
    periods = "2018-10-20, 2018-10-27\n\n2018-11-10,2018-11-17\n2018-12-10"
    job = _compare(client, {"model": MODEL, "vehicles": "taxi-005", "what": "eco mode", "days_on": periods})
    assert job["status"] == "done", job
    assert "on days on (eco mode)" in job["result"]["words"][0]
    assert job["result"]["report"]["change"]["days_after"] > 10
    writes, compares = job["result"]["commands"]
    subprocess.run(writes, shell=True, check=True, cwd=tmp_path)
    words = shlex.split(compares)
    words[words.index("days-on.csv")] = tmp_path / "days-on.csv"
    done(*words[1:], "--json", tmp_path / "report.json")
    assert json.loads((tmp_path / "report.json").read_text()).items() >= job["result"]["report"].items()


def test_days_on_may_name_their_cars(client):
    periods = "vehicle_id,from,to\ntaxi-005,2018-11-10,\ntaxi-002,2018-10-10,2018-11-20"
    result = _compare(client, {"model": MODEL, "vehicles": "", "days_on": periods})["result"]
    assert result["report"]["vehicles"] == ["taxi-005", "taxi-002"]


def test_data_sheets_of_cars_are_given_to_the_tables(workspace, answer):
    """`--vehicles` of the comparison names cars, so a file of vehicles cannot be given there."""
    source = RideSource((RECORDINGS / "autumn.mcap",), vehicle_files=(Path("mine.toml"),))
    recorded = Workspace(Given(source))
    result = msgspec.convert(answer["report"], BeforeAfter)
    made, compared = map(shlex.split, before_after_commands(recorded, workspace.get_node(), result))
    recorded.close()
    assert made[1] == "tables"
    assert "mine.toml" in made
    assert compared[2] == made[made.index("--out") + 1]
    assert compared[compared.index("--vehicles") + 1] == "taxi-005"
