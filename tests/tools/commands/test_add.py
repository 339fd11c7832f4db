"""`socast diagnose` and `socast add` work together as a user runs them, and report each error in one line."""

import json
import re
import shlex
from pathlib import Path

import msgspec
import numpy as np
import pandas as pd
import pytest

from socast.core import models
from socast.core.diagnose import diagnosis as diagnosing
from socast.core.errors import SettingsError
from tests.support.commands import called, done, refused
from tests.support.diagnosis_result import make_diagnosis, make_empty_diagnosis, make_missing_effect
from tests.support.planted_windows import base_model, planted

pytestmark = pytest.mark.long
OWN = '''"""An effect of one's own."""

from socast.core.effects import effect


@effect(coefficient="{coefficient}", unit="{unit}", low=0, high=1, source="nobody")
def my_effect(speed):
    """Something: P = F v."""
    {body}
'''


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A folder with tables in which cold tyres are planted, and the base as a model file."""
    path = tmp_path_factory.mktemp("planted")
    rides, windows = planted({"effect_cold_rolling": 1e-4})
    (path / "tables").mkdir()
    rides.to_parquet(path / "tables" / "rides.parquet")
    windows.to_parquet(path / "tables" / "windows.parquet")
    models.save(base_model(rides), path / "base.json")
    return path


@pytest.fixture
def here(folder, tmp_path) -> Path:
    """The same, with a model file that a test may change."""
    (tmp_path / "tables").symlink_to(folder / "tables")
    (tmp_path / "base.json").write_bytes((folder / "base.json").read_bytes())
    return tmp_path


def read_parts(path: Path) -> list[str]:
    """Return the identifiers of a page."""
    return re.findall(r'id="([^"]+)"', path.read_text(encoding="utf-8"))


def adding(here: Path, effect: str, *more: object) -> tuple[object, ...]:
    return "add", effect, here / "tables", "--model", here / "base.json", "-o", here / "m2.json", *more


def test_command_of_diagnosis_adds_effect(here, capsys):
    done(
        "diagnose", here / "tables", "--model", here / "base.json", "--json", here / "d.json", "--html", here / "d.html"
    )
    printed = capsys.readouterr().out
    result = json.loads((here / "d.json").read_text())
    assert result["verdict"] == "cold_rolling"
    assert {"model", "data", "error", "slices", "missing", "candidates", "unknown", "steps"} <= set(result)
    assert "cold tyres: rolling resistance grows by" in printed
    command = result["missing"][0]["command"]
    assert command in printed
    program, *arguments = shlex.split(command)
    assert program == "socast"
    done(*arguments, "--json", here / "a.json")
    printed = capsys.readouterr().out
    alone = next(one["gain"] for one in result["candidates"] if one["effect"] == "cold_rolling")
    assert alone == pytest.approx(result["missing"][0]["gain"])
    assert json.loads((here / "a.json").read_text())["gain"]["value"] == pytest.approx(alone, abs=2e-3)
    assert "cold_rolling helps: it explains" in printed
    assert "held-out vehicles" in printed
    assert "By outside temperature" in printed
    model = models.load(arguments[-1])
    assert model.terms[-1].name == "cold_rolling"
    assert model.interval is not None
    assert "Cold tyres" in (here / "d.html").read_text()
    rides = pd.read_parquet(here / "tables" / "rides.parquet")
    error = [
        np.abs(m.predict_energy(rides) - rides["energy_kwh"]).mean() for m in (models.load(here / "base.json"), model)
    ]
    assert error[1] < 0.5 * error[0]


@pytest.fixture(scope="module")
def refusal(folder, tmp_path_factory) -> tuple[Path, str]:
    """A folder in which headwind was refused, and the message."""
    path = tmp_path_factory.mktemp("refusal")
    (path / "tables").symlink_to(folder / "tables")
    (path / "base.json").write_bytes((folder / "base.json").read_bytes())
    _, message, code = called(*adding(path, "headwind"))
    assert code == 2
    return path, message


def test_refused_effect_leaves_input_model_unchanged_and_writes_attempt_to_output(folder, refusal):
    here, message = refusal
    assert re.fullmatch(r"socast: [^\n]+\n", message)
    assert "headwind is not added, it is refused: " in message
    assert f"{here / 'm2.json'} holds model base without it, and the attempt in its history" in message
    assert "add the effect all the same with --force" in message
    assert (here / "base.json").read_bytes() == (folder / "base.json").read_bytes()
    assert sorted(path.name for path in here.iterdir()) == ["base.json", "m2.json", "tables"]
    base, kept = models.load(here / "base.json"), models.load(here / "m2.json")
    assert [entry["action"] for entry in kept.history] == ["fit", "refused"]
    assert msgspec.structs.replace(kept, history=base.history) == base


def test_refused_attempt_of_built_in_model_is_written_to_output(here, capsys):
    refused(capsys, "add", "headwind", here / "tables", "--model", "basic_physical", "-o", here / "m2.json")
    assert models.load(here / "m2.json").history[-1]["action"] == "refused"


def test_force_adds_effect_that_does_not_help_after_its_refusal_in_the_history(refusal, tmp_path, capsys):
    here, _ = refusal
    again = ("add", "headwind", here / "tables", "--model", here / "m2.json", "-o", tmp_path / "m3.json")
    done(*again, "--force", "--json", tmp_path / "trial.json")
    plausible = json.loads((tmp_path / "trial.json").read_text())["coefficient"]["plausible"]
    assert plausible or "warning" in capsys.readouterr().out
    model = models.load(tmp_path / "m3.json")
    assert [entry["action"] for entry in model.history] == ["fit", "refused", "add"]
    assert model.history[-1]["forced"]


def test_output_may_not_be_the_input_model(here, capsys):
    before = (here / "base.json").read_bytes()
    base = here / "base.json"
    message = refused(capsys, "add", "headwind", here / "tables", "--model", base, "-o", base)
    assert f"{base} is read and would be overwritten; name another file to write" in message
    assert base.read_bytes() == before


def test_scoped_effect_is_a_separate_term(here):
    done(*adding(here, "cold_rolling", "--scope", "vehicle=taxi-2", "--force"))
    assert models.load(here / "m2.json").terms[-1].columns == ("effect_cold_rolling", "vehicle=taxi-2")


@pytest.mark.parametrize(
    ("effect", "more", "words"),
    [
        ("cold_roling", (), "effect 'cold_roling' is unknown: did you mean cold_rolling"),
        ("rolling", (), "is in model base already"),
        ("payload", (), "payload is not in the tables: make them again"),
        ("wet_road", ("--scope", "since=2018-13-01"), "'2018-13-01' is not a date"),
        ("wet_road", ("--scope", "taxi-1"), "scope 'taxi-1' is not valid: write vehicle=ID or since=YYYY-MM-DD"),
        ("wet_road", ("--scope", "vehicle=taxi-7"), "rides are of taxi-0, taxi-1, taxi-2, taxi-3"),
    ],
)
def test_errors_of_add_are_one_line(effect, more, words, here, capsys):
    assert words in refused(capsys, *adding(here, effect, *more))


def changed(here: Path, name: str, change) -> Path:
    """Return a folder of tables of which one is changed."""
    path = here / "changed"
    path.mkdir()
    for each in ("rides", "windows"):
        table = pd.read_parquet(here / "tables" / f"{each}.parquet")
        (change(table) if name in {each, "both"} else table).to_parquet(path / f"{each}.parquet")
    return path


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("both", lambda t: t[t["ride_key"].isin(["taxi-0#0", "taxi-0#1"])], "2 rides "),
        ("both", lambda t: t.assign(energy_kwh=np.nan, energy_vi_kwh=np.nan), "measured energy"),
        ("both", lambda t: t.assign(vehicle_model="tesla-model-s"), "model base was fitted to kia-soul-ev-2015"),
        ("windows", lambda t: t.drop(columns="ambient_c"), "column 'ambient_c' is missing in the window table"),
        ("rides", lambda t: t.drop(columns="energy_sd_kwh"), "column 'energy_sd_kwh' is missing in the ride table"),
        ("windows", lambda t: t.assign(ride_key="x"), "no window belongs to any of the rides"),
        ("rides", lambda t: pd.concat([t, t]), "is in the ride table twice"),
    ],
)
@pytest.mark.parametrize("command", ["diagnose", "add"])
def test_errors_in_tables_are_one_line(command, name, change, words, here, capsys):
    tables = changed(here, name, change)
    if command == "diagnose":
        message = refused(capsys, "diagnose", tables, "--model", here / "base.json")
    else:
        message = refused(capsys, "add", "wet_road", tables, "--model", here / "base.json", "-o", here / "m.json")
    assert words in message


def test_errors_in_inputs_are_one_line(here, capsys):
    base = here / "base.json"
    lone = here / "lone"
    lone.mkdir()
    (lone / "rides.parquet").write_bytes((here / "tables" / "rides.parquet").read_bytes())
    assert "holds no windows.parquet" in refused(capsys, "diagnose", lone, "--model", base)
    assert "does not exist" in refused(capsys, "diagnose", here / "nothing", "--model", base)
    (here / "a.mcap").write_bytes(b"")
    assert "give recordings or tables" in refused(capsys, "diagnose", here / "a.mcap", here / "tables", "--model", base)
    assert "a.mcap" in refused(capsys, "diagnose", here / "a.mcap", "--model", base)
    assert "is given twice" in refused(capsys, "diagnose", here / "a.mcap", here / "a.mcap", "--model", base)
    assert "give --auto and -o M2 together" in refused(capsys, "diagnose", here / "tables", "--model", base, "--auto")
    assert "cannot read a model" in refused(capsys, "diagnose", here / "tables", "--model", here / "no.json")
    written = refused(capsys, "diagnose", here / "tables", "--model", base, "--json", here / "no" / "d.json")
    assert "cannot be written" in written


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("def (", "not Python"),
        (OWN.format(coefficient="c", unit="N", body="return speed * 1j"), "my_effect"),
        (OWN.format(coefficient="c", unit="kg", body="return speed"), "my_effect"),
        (OWN.format(coefficient="c", unit="N", body="return speed[:1].repeat(2)"), "my_effect"),
        (OWN.format(coefficient="c", unit="N", body="return speed * float('nan')"), "my_effect"),
        (OWN.format(coefficient="c", unit="N", body="return speed") + "\nimport socket\n", "imports socket"),
    ],
)
@pytest.mark.parametrize("command", ["diagnose", "add"])
@pytest.mark.usefixtures("_checks_here")
def test_errors_in_effect_files_are_one_line(command, text, words, here, capsys):
    file = here / "mine.py"
    file.write_text(text)
    given = {
        "diagnose": ("diagnose", here / "tables", "--model", here / "base.json"),
        "add": adding(here, "my_effect"),
    }[command]
    message = refused(capsys, *given, "--effects", file)
    assert str(file) in message
    assert words in message


# ---- the loop, with diagnoses made up


@pytest.fixture
def made_up(monkeypatch) -> list[dict[str, object]]:
    """Diagnoses that the loop is given, one after another."""
    results: list[dict[str, object]] = []
    monkeypatch.setattr(diagnosing, "diagnose", lambda *_, **__: results.pop(0))
    return results


def cold(variant: str = "cold_rolling") -> dict[str, object]:
    named = make_missing_effect(variant=variant, columns=[f"effect_{variant}"], probability=0.97)
    return make_diagnosis(missing=[named])


def test_loop_adds_effects_until_none_is_missing(made_up, here, capsys):
    made_up += [cold(), make_empty_diagnosis()]
    done(
        "diagnose",
        here / "tables",
        "--model",
        here / "base.json",
        "--auto",
        "-o",
        here / "m2.json",
        "--json",
        here / "d",
    )
    printed = capsys.readouterr().out
    assert (
        printed.index("Step 1")
        < printed.index("cold_rolling helps")
        < printed.index("Step 2")
        < printed.index("History of base")
    )
    assert "No further effect is missing." in printed
    assert [entry["action"] for entry in models.load(here / "m2.json").history] == ["fit", "add"]
    assert json.loads((here / "d").read_text())["verdict"] is None
    assert models.load(here / "base.json").history[-1]["action"] == "fit"


def test_loop_tries_each_effect_once_and_ends_without_further_ones(made_up, here, capsys):
    wind = make_missing_effect(effect="headwind", variant="headwind", columns=["effect_headwind"])
    made_up += 2 * [make_diagnosis(verdict="headwind", missing=[wind], deviations=[])]
    done("diagnose", here / "tables", "--model", here / "base.json", "--auto", "-o", here / "m2.json")
    assert "The loop ends here" in capsys.readouterr().out
    model = models.load(here / "m2.json")
    assert model.history[-1]["action"] == "refused"
    assert model.terms == models.load(here / "base.json").terms


def test_loop_keeps_model_if_effect_cannot_be_added(made_up, here, capsys):
    made_up += [
        cold(),
        make_diagnosis(
            verdict="brake_drag", missing=[make_missing_effect(effect="brake_drag", columns=["effect_brake_drag"])]
        ),
    ]
    done("diagnose", here / "tables", "--model", here / "base.json", "--auto", "-o", here / "m2.json")
    assert "The loop ends here: model base can reproduce all of brake_drag" in " ".join(capsys.readouterr().out.split())
    assert models.load(here / "m2.json").terms[-1].name == "cold_rolling"


def test_diagnosis_does_not_use_final_hold_out_days(here, capsys, monkeypatch):
    done(*adding(here, "cold_rolling"))
    apart = models.load(here / "m2.json").history[-1]["final"]["dates"]
    seen = []
    monkeypatch.setattr(
        diagnosing, "_diagnose", lambda windows, *_, **__: (seen.append(windows), make_empty_diagnosis())[1]
    )
    capsys.readouterr()
    done("diagnose", here / "tables", "--model", here / "m2.json")
    rides = pd.read_parquet(here / "tables" / "rides.parquet")
    left_out = rides["date"].isin(apart).sum()
    assert left_out > 0
    stated = f"Not used: {left_out:,} rides of {', '.join(apart)}, the final hold-out dates"
    assert f"{stated} in the history of the model." in " ".join(capsys.readouterr().out.split())
    done("diagnose", here / "tables", "--model", here / "base.json")
    assert f"{stated} on which socast add evaluates." in " ".join(capsys.readouterr().out.split())
    diagnosing.diagnose(rides, pd.read_parquet(here / "tables" / "windows.parquet"), models.load(here / "base.json"))
    assert len(seen) == 3
    for windows in seen:
        assert not set(apart) & (set(windows.rides["date"]) | set(windows.table["date"]))


def test_suggestion_is_written_to_given_file(made_up, here, capsys):
    made_up += [make_diagnosis(), make_empty_diagnosis()]
    done("diagnose", here / "tables", "--model", here / "base.json", "--suggest", here / "mine.py")
    assert (here / "mine.py").read_text() == make_diagnosis().unknown[0].file
    assert f"socasteffectscheck{here / 'mine.py'}" in "".join(capsys.readouterr().out.split())
    done("diagnose", here / "tables", "--model", here / "base.json", "--suggest", here / "none.py")
    assert not (here / "none.py").exists()


def test_findings_are_kept_and_announced_once(made_up, here, capsys):
    made_up += [cold(), cold(), make_empty_diagnosis()]
    printed = []
    for _ in range(3):
        done("diagnose", here / "tables", "--model", here / "base.json", "--findings", here / "findings.json")
        printed.append(capsys.readouterr().out)
    assert "Sure (97 %): cold_rolling is missing in all cars" in printed[0]
    assert f"socast live --model {here / 'base.json'} --model {here / 'base-cold_rolling.json'}" in printed[0]
    assert "No finding became sure, and none is gone." in printed[1]
    assert "Gone: cold_rolling is missing in all cars" in printed[2]
    kept = json.loads((here / "findings.json").read_text())["findings"]
    assert kept[0]["status"] == "gone"


@pytest.mark.usefixtures("_checks_here")
def test_commands_of_a_finding_load_the_effects_of_the_user(made_up, here):
    made_up.append(cold())
    (here / "my.py").write_text(OWN.format(coefficient="force", unit="N", body="return speed"))
    own = ("--effects", here / "my.py")
    done("diagnose", here / "tables", "--model", here / "base.json", "--findings", here / "f.json", *own)
    commands = json.loads((here / "f.json").read_text())["findings"][0]["commands"]
    assert [f"--effects {here / 'my.py'}" in command for command in commands] == [True, True]


def test_commands_of_a_finding_add_its_effect_and_run_it_as_a_shadow(here, capsys, monkeypatch):
    done("diagnose", here / "tables", "--model", here / "base.json", "--findings", here / "f.json")
    (finding,) = json.loads((here / "f.json").read_text())["findings"]
    assert finding["effect"] == "cold_rolling"
    adding, shadowing = (shlex.split(command)[1:] for command in finding["commands"])
    done(*adding)
    started = []

    def end(*given: object) -> None:
        started.extend(given)
        raise SettingsError("the models are loaded")

    monkeypatch.setattr("socast.tools.terminal.live_service.compile_kernels", end)
    assert "the models are loaded" in refused(capsys, *shadowing)
    assert [len(model.terms) for model in started] == [len(started[0].terms), len(started[0].terms) + 1]


def test_diagnosis_since_a_date_reads_later_rides_only(here, monkeypatch):
    seen = []
    monkeypatch.setattr(
        diagnosing, "diagnose", lambda rides, windows, *_, **__: (seen.append((rides, windows)), cold())[1]
    )
    dates = sorted(set(pd.read_parquet(here / "tables" / "rides.parquet")["date"]))
    first = dates[len(dates) // 2]
    done("diagnose", here / "tables", "--model", here / "base.json", "--since", first)
    rides, windows = seen[0]
    assert sorted(set(rides["date"])) == dates[len(dates) // 2 :]
    assert set(windows["ride_key"]) <= set(rides["ride_key"])


@pytest.mark.parametrize(
    ("more", "part"),
    [
        (["--since", "yesterday"], "--since is 'yesterday'"),
        (["--since", "2999-01-01"], "the last ride is on "),
        (["--auto", "-o", "m2.json", "--findings", "f.json"], "--findings has no effect with --auto"),
    ],
)
def test_wrong_date_and_findings_of_the_loop_are_refused(here, capsys, more, part):
    assert part in refused(capsys, "diagnose", here / "tables", "--model", here / "base.json", *more)


def test_page_of_an_added_effect_shows_error_and_failures_before_and_after(here, capsys):
    done(*adding(here, "cold_rolling", "--html", here / "a.html"))
    assert f"report in {here / 'a.html'}" in capsys.readouterr().out
    assert {"fall", "figure-falling", "change", "figure-change-0", "trial", "conditions"} <= set(
        read_parts(here / "a.html")
    )
    text = (here / "a.html").read_text(encoding="utf-8")
    assert "cold_rolling helps: it explains" in text
    assert "Made by <code>socast add</code>" in text


def test_page_of_a_refused_effect_is_written_too(here, capsys):
    refused(capsys, *adding(here, "headwind", "--html", here / "a.html"))
    assert "headwind does not help" in (here / "a.html").read_text(encoding="utf-8")


def test_page_of_an_effect_that_would_overwrite_the_model_is_refused(here, capsys):
    message = refused(capsys, *adding(here, "cold_rolling", "--html", here / "base.json"))
    assert "is read and would be overwritten" in message
