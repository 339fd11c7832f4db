"""`socast ask` prints the answer first, then its figures, and reports an error in one line."""

import io
import json

import pytest
from rich.console import Console

from socast.core.wire.messages import Interval, LegOutlook, NextCharge
from socast.stream.zenoh_session import find_free_port
from socast.tools.commands.ask import figures, show, verdict
from tests.support.commands import done, refused
from tests.support.live_consumers import consumers, logged
from tests.support.outlooks import NOW, OUTLOOK, outlook
from tests.support.zenoh_sessions import live

RIDE = ("--distance-km", "18", "--duration-min", "25")
NOTHING_AFTER = {"reserve_risk": None, "soc_end_of_shift_pct": None, "shift_end_s": None, "legs": []}


@pytest.fixture
def consumer(tmp_path):
    with consumers(tmp_path) as start:
        yield start


def arriving(mean: float, risk: float) -> LegOutlook:
    charge = Interval(mean, mean - 3.0, mean + 3.0)
    return LegOutlook(18.0, 1500.0, Interval(3.1, 2.7, 3.6), charge, reserve_risk=risk)


@pytest.mark.parametrize(
    ("risk", "word", "words"),
    [
        (0.0, "YES", "taxi-7 can take 18 km in 25 min and finish above its reserve of 20 %: the risk is under 1 %"),
        (0.049, "YES", "the risk is under 5 %"),
        (0.05, "UNCERTAIN", "taxi-7 may not be able to take 18 km"),
        (0.5, "UNCERTAIN", "the risk is 50 %"),
        (0.51, "NO", "taxi-7 cannot take 18 km in 25 min and finish above its reserve of 20 %: the risk is 51 %"),
        (1.0, "NO", "the risk is over 99 %"),
    ],
)
def test_answer_follows_risk(risk, word, words):
    first, sentence = verdict(outlook(reserve_risk=risk))
    assert first == word
    assert words in sentence


def test_answer_without_ride_is_about_shift():
    assert verdict(outlook(asked=None)) == (
        "YES",
        "taxi-7 can finish its shift above its reserve of 20 %: the risk is 2 %",
    )


@pytest.mark.parametrize(
    ("ride", "word"),
    [
        (arriving(61.2, 0.01), "YES"),
        (arriving(22.0, 0.15), "UNCERTAIN"),
        (arriving(18.0, 0.85), "NO"),
    ],
)
def test_answer_is_about_ride_if_rest_of_shift_is_unknown(ride, word):
    first, sentence = verdict(outlook(asked=ride, **NOTHING_AFTER))
    assert first == word
    assert "arrive above its reserve of 20 %: the risk is " in sentence
    assert sentence.endswith("; the rest of its shift is not known")
    assert dict(figures(outlook(asked=ride, **NOTHING_AFTER)))["at arrival"].split(", risk ")[1] in sentence


def test_answer_is_not_known_if_nothing_is_known():
    unknown = outlook(asked=LegOutlook(18.0, 1500.0, None, None), why_not="the car tells no SOC", **NOTHING_AFTER)
    assert verdict(unknown)[0] == "NOT KNOWN"
    assert verdict(outlook(asked=None, **NOTHING_AFTER))[0] == "NOT KNOWN"
    assert list(figures(unknown))[-1] == ("not known", "the car tells no SOC")


def test_figures_are_those_of_outlook():
    assert dict(figures(OUTLOOK)) == {
        "at arrival": "61 % (57 to 65), 41 points above the reserve",
        "end of shift": "31 % (24 to 38) at 14:00 UTC, 11 points above the reserve",
        "energy": "3.10 kWh (2.70 to 3.60)",
        "then planned": "2 legs, 30 km, 4.0 kWh",
        "now": "72.0 ± 0.8 % of 38.2 ± 1.2 kWh, by a sample of 2024-01-15 12:00 UTC",
        "this car today": "takes 4 % more than is usual for its vehicle model at this temperature",
    }


def test_planned_charges_are_told():
    charge = NextCharge(NOW + 1800.0, Interval(41.0, 38.0, 44.0), 0.01)
    legs = [*OUTLOOK.legs, LegOutlook(0.0, 2400.0, None, Interval(80.0, 70.0, 85.0), 80.0)]
    told = dict(figures(outlook(next_charge=charge, legs=legs)))
    assert told["next charge"].startswith("41 % (38 to 44) at ")
    assert told["next charge"].endswith(", 21 points above the reserve")
    assert told["then planned"] == "2 legs, 30 km, 4.0 kWh, charges to 80 %"


@pytest.mark.parametrize("without", ["soc_pct", "soc_sd_pct", "usable_capacity_kwh", "usable_capacity_sd_kwh"])
def test_unknown_figures_are_left_out(without):
    console = Console(file=io.StringIO(), width=120)
    show(outlook(**{without: None}), console)
    printed = console.file.getvalue()
    assert printed.startswith("YES: taxi-7 can take 18 km")
    assert "None" not in printed
    assert "nan" not in printed


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("taxi 7",), "'taxi 7'"),
        (("taxi-7", "--distance-km", "18"), "a ride needs --distance-km and --duration-min"),
        (("taxi-7", "--distance-km", "18", "--duration-min", "1"), "check --distance-km and --duration-min"),
        (
            ("taxi-7", "--distance-km", "18", "--duration-min", "1500"),
            "--duration-min is 1500, must be 0 to 1440; give minutes",
        ),
        (("taxi-7", "--distance-km=-3", "--duration-min", "25"), "--distance-km is -3"),
        (("taxi-7", "--distance-km", "nan", "--duration-min", "25"), "'nan'"),
        (("taxi-7", *RIDE, "--plan", "nowhere.json"), "nowhere.json cannot be read"),
        (("taxi-7", *RIDE, "--plan", "{tmp}/rubbish.json"), "no plan"),
        (("taxi-7", "--plan", "{tmp}/empty.json"), "empty.json is empty; "),
        (("taxi-7", *RIDE, "--timeout-s", "0"), "--timeout-s is 0"),
        (("taxi-7", *RIDE, "--timeout-s", "nan"), "--timeout-s is nan"),
        (("taxi-7", *RIDE, "--json", "/nowhere/x.json"), "/nowhere/x.json"),
        (("taxi-7", *RIDE, "--prefix", "a/**"), "'a/**'"),
        (("taxi-7", *RIDE), "cannot be joined"),
    ],
)
def test_invalid_question_is_refused_in_one_line(arguments, message, tmp_path, capsys):
    (tmp_path / "rubbish.json").write_text("lunch at noon")
    (tmp_path / "empty.json").touch()
    given = [argument.replace("{tmp}", str(tmp_path)) for argument in arguments]
    assert message in refused(capsys, "ask", *given, "--connect", f"tcp/127.0.0.1:{find_free_port()}")


def test_live_consumer_answers_command(tmp_path, capsys):
    plan = {"shift_end_s": NOW + 3600.0, "reserve_soc_pct": 30.0, "legs": [{"distance_km": 7.0, "duration_s": 700}]}
    (tmp_path / "plan.json").write_text(json.dumps(plan))
    (tmp_path / "old.json").write_text(json.dumps(plan | {"shift_end_s": NOW - 3600.0}))
    with live("montreal") as (_, _, client):
        at = ("--prefix", "montreal", "--connect", client.connection.connect[0])
        done("ask", "taxi-7", *RIDE, "--plan", tmp_path / "plan.json", "--json", tmp_path / "result.json", *at)
        assert "taxi-7 can take 18 km in 25 min" in capsys.readouterr().out
        assert "1.0 h before" in refused(capsys, "ask", "taxi-7", "--plan", tmp_path / "old.json", *at)
        assert "taxi-9 is not known" in refused(capsys, "ask", "taxi-9", *RIDE, *at)
        assert "no consumer answers" in refused(capsys, "ask", "taxi-7", *RIDE, *at, "--prefix", "quebec")
    written = json.loads((tmp_path / "result.json").read_text())
    assert (written["asked"]["distance_km"], [leg["distance_km"] for leg in written["legs"]]) == (18.0, [7.0])


def test_service_refuses_in_words_and_counts_queries(consumer, capsys):
    endpoint = f"tcp/127.0.0.1:{find_free_port()}"
    process, log = consumer("--listen", endpoint)
    message = refused(capsys, "ask", "taxi-9", *RIDE, "--connect", endpoint, "--timeout-s", "30")
    assert "no consumer answers" not in message
    process.terminate()
    assert process.wait(20) == 0
    (counts,) = (line for line in logged(log) if line["event"] == "queries")
    assert sum(count for name, count in counts.items() if name.startswith("refused.")) == 1
