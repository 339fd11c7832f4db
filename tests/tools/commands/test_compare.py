"""`socast compare` prints tables and writes pages and traces, and refuses invalid input in one line."""

import json
import re
import shlex
from io import StringIO

import msgspec
import pandas as pd
import pytest
from rich.console import Console

from socast.core.evaluate.compare.records import Comparison
from socast.core.models import BASIC_PHYSICAL, EXTENDED_PHYSICAL, Fit, LinearModel, Term, save, stamp
from socast.tools.cli import main
from socast.tools.report.comparison import tables
from socast.tools.report.comparison.figures import get_model_style
from socast.tools.report.comparison.page import MOST_COMMANDS
from socast.tools.report.document import Section, print_section
from socast.tools.terminal.ride_source import RideSource
from tests.support.browsers import WIDE, open_browser
from tests.support.commands import called, done
from tests.support.html_pages import assert_axes_are_titled, read_figures, read_page
from tests.support.paths import RECORDINGS, ROOT

pytestmark = pytest.mark.long

SHIFT = ROOT / "recordings" / "shift.mcap"
MODELS = ("--model", "extended_physical", "--model", "basic_physical")
ODD = "<b>R&D's 'best'</b>"


@pytest.fixture(scope="module")
def shift():
    return RideSource([SHIFT]).read(EXTENDED_PHYSICAL.effects, library=False)


@pytest.fixture(scope="module")
def folder(shift, tmp_path_factory):
    """Return tables of the recorded shift."""
    made = tmp_path_factory.mktemp("tables")
    for name, table in zip(("rides", "windows"), shift, strict=True):
        table.to_parquet(made / f"{name}.parquet")
    return made


@pytest.fixture(scope="module")
def written(folder, tmp_path_factory):
    """Return a folder with the JSON, the page and the printed text of a comparison of two models."""
    made = tmp_path_factory.mktemp("written")
    out, *ended = called("compare", folder, *MODELS, "--json", made / "c.json", "--html", made / "c.html")
    assert ended == ["", 0]
    (made / "c.txt").write_text(out)
    return made


@pytest.fixture(scope="module")
def result(written):
    """Return what --json has of two models."""
    return json.loads((written / "c.json").read_text())


def test_recording_is_cleaned_as_the_options_say(result):
    """A limit below usual speeds rejects samples, and so leaves less distance."""
    out, *_ = called("compare", SHIFT, *MODELS, "--speed-limit-kmh", "40", "--json", "-")
    assert json.loads(out)["models"] != result["models"]


@pytest.fixture
def halves(shift, tmp_path):
    """Return the shift's rides in two folders."""
    rides, _ = shift
    parts = []
    for i in (0, 1):
        parts.append(tmp_path / f"half {i}")
        parts[i].mkdir()
        rides[rides.index % 2 == i].to_parquet(parts[i] / "rides.parquet")
    return parts


def ran(capsys, *arguments):
    """Return what a command prints."""
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in ("compare", *arguments)])
    printed = capsys.readouterr()
    assert not ended.value.code, printed.err
    return printed.out


def refused(capsys, *arguments):
    """Return the one line of a command that is refused."""
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in ("compare", *arguments)])
    message = capsys.readouterr().err
    assert ended.value.code == 2
    assert re.fullmatch(r"socast: [^\n]+\n", message), message
    return message


def as_json(path, *arguments):
    with pytest.raises(SystemExit):
        main([str(argument) for argument in ("compare", *arguments, "--json", path / "c.json")])
    return json.loads((path / "c.json").read_text())


def changed(folder, tmp_path, change):
    """Return a folder with changed rides beside the same windows."""
    change(pd.read_parquet(folder / "rides.parquet")).to_parquet(tmp_path / "rides.parquet")
    (tmp_path / "windows.parquet").write_bytes((folder / "windows.parquet").read_bytes())
    return tmp_path


def page(path):
    """Return a page, read, that loads nothing and holds figures."""
    text = path.read_text()
    parts = read_page(text)
    assert parts.loaded == []
    assert set(parts.links) <= set(parts.ids)
    assert len(parts.ids) == len(set(parts.ids))
    assert "default-src &#x27;none&#x27;" in text
    return parts


def test_comparison_is_printed_and_written(written, result):
    out = (written / "c.txt").read_text()
    about = result["about"]
    assert about["rides"] + sum(about["left_out"].values()) == about["read"] == 61
    assert f"{about['rides']} of 61 rides" in out
    assert "Left out: 4 too short" in out
    assert out.index("Errors by temperature") < out.index("Errors of the models")
    for name, of_model in result["models"].items():
        assert f"{of_model['mae_kwh']['value']:.3f} ± " in out, name
        assert set(of_model["by"]) >= {
            "distance",
            "temperature",
            "speed",
            "season",
            "time of day",
            "vehicle",
            "driver",
        }
        assert set(of_model["within"]) == {"5", "10", "15"}
    assert result["pairs"][0]["p_holm"] < 0.05
    ids = page(written / "c.html").ids
    assert {"models", "places", "worst", "figure-scatter-0", "figure-scatter-1", "figure-by-0"} <= set(ids)


def test_first_words_tell_the_error_against_the_noise_and_where_it_is_largest(tmp_path, capsys):
    folder, model = tmp_path / "autumn", tmp_path / "base.json"
    done("tables", RECORDINGS / "autumn.mcap", "--out", folder)
    done("fit", folder, "--recipe", "road_load", "-o", model)
    capsys.readouterr()
    out = ran(capsys, folder, "--model", model, "--json", tmp_path / "c.json")
    head = " ".join(out.partition("Errors by condition")[0].split())
    assert re.match(
        r"base is off by 0\.\d{3} kWh per ride on average, \d\.\d times what measurement noise alone causes", head
    )
    assert "It fails most along headwind: " in head
    assert "Headwind [km/h]: predicted less measured power, mean of windows [W]" in head
    charts = json.loads((tmp_path / "c.json").read_text())["failures"]["charts"]
    assert charts[0]["column"]["key"] == "headwind_kmh"
    (headwind,) = (chart for chart in charts if chart["column"]["key"] == "headwind_kmh")
    assert headwind["q"] < 0.01
    assert headwind["outside"] >= 4
    assert min(headwind["bins"]["low"]) < 0.0 < max(headwind["bins"]["high"])


def test_page_with_its_folded_parts_fits_on_five_screens(written):
    with open_browser() as browser:
        shown = browser.new_page(viewport=WIDE)
        shown.goto((written / "c.html").as_uri())
        shown.wait_for_selector("#figure-scatter-0.drawn")
        assert shown.evaluate("document.documentElement.scrollHeight") <= 5 * WIDE["height"]
        assert shown.locator("section > details[open]").count() == 0


def test_failures_of_rides_without_windows_say_why_not(halves, capsys):
    out = " ".join(ran(capsys, halves[0], *MODELS).split())
    assert "Where it fails cannot be said: " in out


def test_every_worst_ride_links_to_its_trace_on_the_page(written, result):
    parts, text = page(written / "c.html"), (written / "c.html").read_text()
    worst = {
        ride["ride"] for of_model in result["models"].values() for rides in of_model["worst"].values() for ride in rides
    }
    linked = dict(re.findall(r'<th scope="row"><a href="#(figure-ride-\d+)">([^<]+)</a>', text))
    assert set(linked.values()) == worst
    for target, ride in linked.items():
        assert f'<figure id="{target}"><h3>Ride {ride}</h3>' in text
    assert {f"{target}-map-1" for target in linked} <= set(parts.ids)
    assert text.count("plotly.js v") == 1
    for each in read_figures(text).values():
        assert_axes_are_titled(each)


def test_page_of_tables_without_windows_has_no_traces(folder, tmp_path, capsys):
    (tmp_path / "rides.parquet").write_bytes((folder / "rides.parquet").read_bytes())
    ran(capsys, tmp_path, *MODELS, "--html", tmp_path / "c.html")
    assert not [each for each in page(tmp_path / "c.html").ids if each.startswith("figure-ride") or each == "traces"]


def test_every_worst_ride_has_command_that_shows_its_trace(result, tmp_path, capsys):
    for of_model in result["models"].values():
        assert len(of_model["worst"]["absolute"]) == 10
        for ride in (of_model["worst"]["absolute"][0], of_model["worst"]["relative"][-1]):
            words = shlex.split(ride["command"])
            assert words[:2] == ["socast", "compare"]
            ran(capsys, *words[2:], "--json", tmp_path / "t.json")
            trace = json.loads((tmp_path / "t.json").read_text())["trace"]
            assert trace["ride"]["ride_key"] == ride["ride"]
            (model,) = trace["models"].values()
            assert model["error_kwh"] == pytest.approx(ride["error_kwh"])


def test_printed_commands_are_complete_and_quoted(shift, tmp_path, capsys):
    rides, _ = shift
    home = (
        tmp_path
        / ("a folder with a name that is longer than a line of the terminal, and so may be broken " * 2).strip()
    )
    home.mkdir()
    rides.to_parquet(home / "rides.parquet")
    model = tmp_path / f"{ODD[3:8]}.json"
    save(BASIC_PHYSICAL, model)
    out = ran(capsys, home, "--model", model)
    lines = [line for line in out.splitlines() if line.startswith("socast compare")]
    assert len(lines) == MOST_COMMANDS
    for line in lines:
        words = shlex.split(line)
        assert words[2:5] == [str(home), "--model", str(model)]
        assert words[6] in set(rides["ride_key"])


def test_trace_shows_where_models_and_measurement_differ(folder, result, tmp_path, capsys):
    ride = result["models"]["extended_physical"]["worst"]["absolute"][0]["ride"]
    out = ran(capsys, folder, *MODELS, "--ride", ride, "--json", tmp_path / "t.json", "--html", tmp_path / "t.html")
    trace = json.loads((tmp_path / "t.json").read_text())["trace"]
    for name, of_model in trace["models"].items():
        assert f"{name} {of_model['words']}" in " ".join(out.split())
        place = of_model["place"]
        assert ("diverges from the measurement at" in of_model["words"]) == (place is not None)
        if place:
            error = [
                predicted - true
                for predicted, true in zip(of_model["energy_kwh"], trace["windows"]["measured_kwh"], strict=True)
            ]
            assert place["error_kwh"] == pytest.approx(sum(error[place["first"] : place["last"] + 1]))
            assert f"{place['minute']:.1f} min, {place['km']:.1f} km" in of_model["words"]
    minutes = [line.split()[0] for line in out.splitlines() if re.match(r" \d+\.\d ", line)]
    assert minutes == [f"{minute:.1f}" for minute in trace["windows"]["end_min"]]
    figures = {one for one in page(tmp_path / "t.html").ids if one.startswith("figure-")}
    along = {"figure-along-min", "figure-along-km", "figure-power", "figure-conditions"}
    assert figures == along | {f"figure-{kind}-{i}" for kind in ("terms", "map") for i in range(2)}
    for each in read_figures((tmp_path / "t.html").read_text()).values():
        assert_axes_are_titled(each)


def test_recording_gives_same_result_as_its_tables(result, tmp_path):
    from_recording = as_json(tmp_path, SHIFT, *MODELS)
    for name, of_model in result["models"].items():
        assert from_recording["models"][name]["mae_kwh"] == of_model["mae_kwh"]
    assert from_recording["rides"]["measured_kwh"] == result["rides"]["measured_kwh"]


def test_two_sets_of_rides_are_compared(halves, tmp_path, capsys):
    one, other = halves
    written = "--json", tmp_path / "c.json", "--html", tmp_path / "c.html"
    out = ran(capsys, one, "--against", other, "--model", "extended_physical", *written)
    assert "Differences between the two sets" in out
    assert f"First: {one}. Second: {other}" in " ".join(out.split())
    against = json.loads((tmp_path / "c.json").read_text())["against"]
    assert against["shared"] == 0
    of_model = against["models"]["extended_physical"]
    sides = [of_model["explained"], of_model["unexplained"], against["consumption"]]
    explained, left, all_of_it = (side["difference"]["value"] for side in sides)
    assert explained + left == pytest.approx(all_of_it)
    ids = page(tmp_path / "c.html").ids
    assert {"against", "contrast", "figure-account-0", "figure-contrast-0-0"} <= set(ids)


def test_identical_sets_of_rides_do_not_differ(folder, tmp_path, capsys):
    out = ran(capsys, folder, "--against", folder, "--model", "basic_physical", "--json", tmp_path / "c.json")
    result = json.loads((tmp_path / "c.json").read_text())
    assert result["against"]["shared"] == result["about"]["rides"]
    assert "57 rides are in both" in " ".join(out.split())
    assert result["against"]["consumption"]["difference"]["value"] == 0.0
    assert all(entry["difference"]["value"] == 0.0 for entry in result["against"]["properties"])


def test_rides_of_several_tables_are_distinguished(halves, folder, capsys, tmp_path):
    for half in halves:
        (half / "windows.parquet").write_bytes((folder / "windows.parquet").read_bytes())
    result = as_json(tmp_path, *halves, "--model", "basic_physical")
    worst = result["models"]["basic_physical"]["worst"]["absolute"]
    assert {ride["ride"].partition("/")[0] for ride in worst} == {"0", "1"}
    for ride in worst[:3]:
        out = ran(capsys, *shlex.split(ride["command"])[2:])
        assert f"{ride['measured_kwh']:.3f} kWh" in out


def test_names_with_markup_are_shown_unchanged(shift, tmp_path, capsys):
    first, second = shift[0]["vehicle_id"].unique()[:2]
    rides, windows = (table[table["vehicle_id"].isin([first, second])] for table in shift)
    odd = {first: f"{ODD}0", second: f"{ODD}1"}
    home = tmp_path / "odd"
    home.mkdir()
    for name, table in (("rides", rides), ("windows", windows)):
        key = table["vehicle_id"].map(odd) + "#" + table["ride_key"].str.partition("#")[2]
        table.assign(vehicle_id=table["vehicle_id"].map(odd), ride_key=key).to_parquet(home / f"{name}.parquet")
    model = tmp_path / "[red]x & y.json"
    save(BASIC_PHYSICAL, model)
    out = ran(capsys, home, "--model", model, "--html", tmp_path / "c.html")
    assert "[red]x & y" in out
    assert any("[red]x & y" in text for text in page(tmp_path / "c.html").text)
    ran(capsys, home, "--model", model, "--html", tmp_path / "t.html", "--ride", f"{ODD}0#2")
    assert any(f"Ride {ODD}0#2" in text for text in page(tmp_path / "t.html").text)


def test_files_of_same_name_are_distinguished(folder, tmp_path):
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        save(msgspec.structs.replace(BASIC_PHYSICAL, name=name), tmp_path / name / "m.json")
    names = [str(tmp_path / name / "m.json") for name in ("one", "two")]
    result = as_json(tmp_path, folder, "--model", names[0], "--model", names[1])
    assert list(result["models"]) == names


@pytest.mark.usefixtures("_checks_here")
def test_user_defined_effect_is_known_with_its_file(folder, tmp_path, capsys):
    effect_file = tmp_path / "own.py"
    effect_file.write_text(
        '"""Own."""\n\nfrom socast.core.effects import effect\n\n\n'
        '@effect(coefficient="drag of the brake pads", unit="N", low=0, high=60, source="Barton 2001, p. 3")\n'
        'def rubbing(speed):\n    """Pads that rub: P = F v."""\n    return speed\n'
    )
    model = tmp_path / "own.json"
    term = {"name": "rubbing", "columns": ["effect_rubbing"], "unit": "N"}
    made = json.loads(msgspec.json.encode(BASIC_PHYSICAL))
    made["terms"].append(term)
    made["fits"]["*"]["coefficients"].append(20.0)
    made["version"] = stamp(msgspec.convert(made, LinearModel)).version
    model.write_text(json.dumps(made))
    message = refused(capsys, folder, "--model", model)
    assert "effect 'rubbing' is unknown" in message
    message = refused(capsys, folder, "--model", model, "--effects", effect_file)
    assert "column 'effect_rubbing' is missing in the data: make the tables with this model's effects" in message
    out = ran(capsys, SHIFT, "--model", model, "--effects", effect_file)
    assert f"--effects {effect_file}" in out


def test_models_are_distinguishable_without_colours():
    styles = [get_model_style(place) for place in range(8)]
    assert len({(style.dash, style.symbol) for style in styles}) == len(styles)


# what cannot be compared


def test_table_without_rides_is_refused(folder, tmp_path, capsys):
    home = changed(folder, tmp_path, lambda rides: rides[:0])
    assert "there are no rides: give tables or recordings that hold some" in refused(capsys, home, *MODELS)
    assert "is not among 0 rides" in refused(capsys, home, *MODELS, "--ride", "x")


def test_model_of_other_vehicle_is_refused(folder, tmp_path, capsys):
    fit = Fit(coefficients=(1.0,) * 4)
    save(msgspec.structs.replace(BASIC_PHYSICAL, fits={"bmw-i3-2014": fit}), tmp_path / "i3.json")
    message = refused(capsys, folder, "--model", tmp_path / "i3.json")
    assert "model i3 is fitted to bmw-i3-2014, and the rides are of " in message


def test_rides_without_measured_energy_are_refused(folder, tmp_path, capsys):
    home = changed(folder, tmp_path, lambda rides: rides.assign(energy_kwh=float("nan")))
    assert "none of 61 rides can be compared (57 no measured energy, 4 too short)" in refused(capsys, home, *MODELS)
    assert "it has no measured energy to compare with" in refused(capsys, home, *MODELS, "--ride", "taxi-001#2")


def test_two_rides_are_compared_without_intervals(folder, tmp_path, capsys):
    two = changed(folder, tmp_path, lambda rides: rides[rides["vehicle_id"] == "taxi-001"][2:4])
    out = ran(capsys, two, *MODELS, "--html", tmp_path / "c.html")
    assert "2 rides of one car on one day: too few for intervals" in out
    page(tmp_path / "c.html")


def test_missing_ride_is_refused(folder, capsys):
    message = refused(capsys, folder, *MODELS, "--ride", "taxi-1#2")
    assert "ride 'taxi-1#2' is not among 61 rides: did you mean taxi-001#2" in message


def test_table_without_required_column_is_refused(folder, tmp_path, capsys):
    home = changed(folder, tmp_path, lambda rides: rides.drop(columns="effect_climbing"))
    assert "column 'effect_climbing' is missing in the data" in refused(capsys, home, *MODELS)
    changed(folder, tmp_path, lambda rides: rides.drop(columns="ambient_c"))
    assert "column 'ambient_c' is missing in the ride table" in refused(capsys, home, *MODELS)


def test_trace_without_windows_is_refused(folder, tmp_path, capsys):
    home = changed(folder, tmp_path, lambda rides: rides)
    (home / "windows.parquet").unlink()
    message = refused(capsys, home, *MODELS, "--ride", "taxi-001#1")
    assert "holds no windows.parquet; a trace needs the windows that `socast tables` makes" in message
    (home / "windows.parquet").write_bytes(b"PAR1")
    assert "windows.parquet: cannot read windows: " in refused(capsys, home, *MODELS, "--ride", "taxi-001#1")


def test_contradictory_options_are_refused(folder, tmp_path, capsys):
    assert "leave out --against" in refused(capsys, folder, *MODELS, "--against", folder, "--ride", "x")
    assert "is given twice" in refused(capsys, folder, "--model", "basic_physical", "--model", "basic_physical")
    assert "is given twice" in refused(capsys, SHIFT, SHIFT, *MODELS)
    assert "give recordings or tables, not both" in refused(capsys, SHIFT, folder, *MODELS)
    assert "holds no rides.parquet" in refused(capsys, tmp_path, *MODELS)
    assert "is read and would be overwritten" in refused(capsys, folder, *MODELS, "--json", folder / "rides.parquet")
    assert "cannot be written" in refused(capsys, folder, *MODELS, "--html", tmp_path / "no" / "c.html")
    assert "model 'no' is unknown" in refused(capsys, folder, "--model", "no")


def test_term_missing_from_windows_is_not_invented(folder, tmp_path, capsys):
    home = changed(folder, tmp_path, lambda rides: rides.assign(effect_brake_drag=0.01))
    term = Term(name="brakes", columns=("effect_brake_drag",), unit="N")
    extended = msgspec.structs.replace(
        BASIC_PHYSICAL, terms=(*BASIC_PHYSICAL.terms, term), fits={"*": Fit(coefficients=(1.0,) * 5)}
    )
    save(extended, tmp_path / "own.json")
    ran(capsys, home, "--model", tmp_path / "own.json")
    message = refused(capsys, home, "--model", tmp_path / "own.json", "--ride", "taxi-001#2")
    assert "column 'effect_brake_drag' is missing in the data" in message


def test_terminal_of_80_columns_keeps_names_of_worst_rides(result):
    worst = result["models"]["extended_physical"]["worst"]["absolute"]
    read = msgspec.convert(result, Comparison)
    made, *_ = tables.tabulate_worst_rides(read, "extended_physical", commands=False)
    console = Console(width=80, file=StringIO(), color_system=None)
    print_section(Section("worst", "", "", [made]), console)
    lines = console.file.getvalue().splitlines()
    assert max(map(len, lines)) <= 80
    assert all(any(line.split()[:1] == [ride["ride"]] for line in lines) for ride in worst)
