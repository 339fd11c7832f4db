"""Test the fixtures of pytest in projects of their own."""

import shutil
import subprocess
import sys

import pytest

from socast.tools.testing.golden_files import check_table
from socast.tools.testing.live_consumer import LiveConsumer
from socast.tools.testing.made_recording import make_car
from tests.support.paths import RECORDINGS

pytest_plugins = ["pytester"]
QUIET = ("-q", "-p", "no:cacheprovider", "-p", "no:xdist", "-p", "no:hypothesispytest", "-p", "no:anyio")
MODULES = """
import sys

def pytest_unconfigure():
    heavy = {"numba", "numpy", "pandas", "zenoh", "msgspec", "rich", "typer", "scipy", "pyarrow"} & {*sys.modules}
    print("HEAVY", sorted(heavy), sorted(name for name in sys.modules if name.startswith("socast.")))
"""


@pytest.fixture(scope="module", autouse=True)
def _everything_is_imported(tmp_path_factory):
    """Import what the fixtures do: pytester forgets what its run imports, and numpy cannot be imported twice."""
    folder = tmp_path_factory.mktemp("imported")
    with LiveConsumer("extended_physical", folder / "x.mcap") as live:
        live.publish(make_car())
        check_table(folder / "x.parquet", live.finish().forecasts, key=(), tolerances=None, update=True)


@pytest.fixture
def project(pytester):
    """Return a project with recordings, empty ones, of two days."""
    pytester.mkdir("recordings")
    for name in ("tuesday", "monday"):
        (pytester.path / "recordings" / f"{name}.mcap").touch()
    return pytester


def run(pytester, *arguments):
    return pytester.runpytest_inprocess(*QUIET, *arguments)


def test_unrelated_tests_load_nothing_of_the_product(pytester):
    pytester.makeconftest(MODULES)
    pytester.makepyfile("def test_nothing(): pass")
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *QUIET, "-s"], cwd=pytester.path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0
    assert "HEAVY [] ['socast.tools', 'socast.tools.testing', 'socast.tools.testing.plugin']" in done.stdout


def test_unrelated_tests_may_use_the_same_words(pytester):
    pytester.makeini("[pytest]\nmarkers = recordings(*files): another marker\naddopts = --strict-markers")
    pytester.makepyfile(
        """
        import pytest

        @pytest.fixture
        def replay():
            return 1

        @pytest.mark.recordings("none/*.mcap")
        def test_marker(replay):
            assert replay == 1
        """
    )
    run(pytester).assert_outcomes(passed=1)


def test_one_test_runs_per_recording_with_its_name(project):
    project.makepyfile("def test_each(socast_recording): assert socast_recording.is_absolute()")
    found = run(project, "--collect-only").stdout
    found.fnmatch_lines(["*test_each?monday?", "*test_each?tuesday?"])


def test_marker_and_setting_name_the_recordings(project):
    for folder in ("days", "nights"):
        project.mkdir(folder)
        (project.path / folder / "one.mcap").touch()
    project.makeini("[pytest]\nsocast_recordings = days/*.mcap nights/*.mcap\naddopts = --strict-markers")
    project.makepyfile(
        """
        import pytest

        def test_all(socast_recording): pass

        @pytest.mark.socast_recordings("nights/*.mcap")
        def test_nights(socast_recording): pass
        """
    )
    found = run(project, "--collect-only").stdout
    found.fnmatch_lines(["*test_all?days/one.mcap?", "*test_all?nights/one.mcap?", "*test_nights?one?"])


def test_pattern_without_recordings_is_an_error_with_a_remedy(pytester):
    pytester.makepyfile("def test_each(socast_recording): pass")
    done = run(pytester)
    assert done.ret != 0
    done.stdout.fnmatch_lines(["*test_each: no recording matches recordings/?.mcap in *; put recordings there, or *"])
    assert "Traceback" not in done.stdout.str()


def test_golden_tables_are_written_compared_and_renewed(project):
    project.makepyfile(
        test_golden="""
        import json
        from pathlib import Path

        def test_all(socast_replay, socast_car, socast_make_recording, socast_golden):
            speed_kmh = json.loads(Path("speed.json").read_text())
            replayed = socast_replay(socast_make_recording(socast_car(speed_kmh=speed_kmh)))
            socast_golden(replayed.rides[["vehicle_id", "start_s", "distance_km"]], "rides.csv")
            socast_golden(replayed.forecasts, "forecasts.parquet")
            socast_golden(replayed.quality, "quality.csv", tolerances={"count": 5})
        """
    )
    (project.path / "speed.json").write_text("36")
    done = run(project)
    done.assert_outcomes(failed=1)
    done.stdout.fnmatch_lines(["rides.csv: does not exist; write it with pytest --socast-update*"])
    done = run(project, "--socast-update")
    done.assert_outcomes(passed=1)
    done.stdout.fnmatch_lines(["*golden files of socast*", "rides.csv: written for the first time", "quality.csv: *"])
    run(project).assert_outcomes(passed=1)
    (project.path / "speed.json").write_text("37")
    done = run(project)
    done.assert_outcomes(failed=1)
    done.stdout.fnmatch_lines(
        ["distance_km ?km?: differs in 1 of 1 ride, taxi-1, by up to 0.167 (2.8 %) of taxi-1 at 2024-01-15T12:00:00Z"]
    )
    done = run(project, "--socast-update")
    done.stdout.fnmatch_lines(["rides.csv: written anew; *", "quality.csv: * as before"])


def test_expected_forecasts_are_written_and_compared(project):
    shutil.copy(RECORDINGS / "shift.mcap", project.path / "recordings" / "monday.mcap")
    project.makepyfile(
        """
        import pytest

        @pytest.mark.socast_recordings("recordings/monday.mcap")
        def test_each(socast_recording, socast_expect):
            found = socast_expect(socast_recording, f"expected/{socast_recording.name}", tolerances={"range_km": "1 %"})
            assert len(found.forecasts) and len(found.rides)
        """
    )
    run(project, "--socast-update").assert_outcomes(passed=1)
    run(project).assert_outcomes(passed=1)


def test_live_consumer_ends_with_a_test_that_fails(project):
    project.makepyfile(
        """
        import threading

        def test_fails(socast_live, socast_car):
            live = socast_live()
            live.publish(socast_car())
            assert live.finish().forecasts.empty

        def test_nothing_runs():
            assert not any(thread.name == "socast-live" for thread in threading.enumerate())
        """
    )
    run(project).assert_outcomes(passed=1, failed=1)


def test_mistakes_are_one_line(project):
    project.makepyfile(
        """
        def test_folder(socast_replay, tmp_path): socast_replay(tmp_path)
        def test_model(socast_replay): socast_replay("x.mcap", model="absent.json")
        def test_fault(socast_car): socast_car(faults={"loss": (1, 2)})
        def test_profile(socast_car): socast_car(speed_kmh=[(0, 0), (60, "x")])
        def test_setting(socast_replay): socast_replay("x.mcap", settings={"windw": 3})
        def test_tolerance(socast_expect, socast_recording):
            socast_expect(socast_recording, "new.mcap", tolerances={"rangekm": 1})
        """
    )
    for option in ((), ("--socast-update",)):
        done = run(project, *option)
        done.assert_outcomes(failed=7)
        done.stdout.fnmatch_lines(
            [
                "*: no ?.mcap in this folder; give a recording, or a folder of *",
                "*absent.json*",
                "*there is no fault 'loss'*",
                "*speed_kmh: 'x' is no number*",
                "*there is no setting 'windw'; did you mean *",
                "*tolerance of 'rangekm': there is no such field; did you mean range_km*",
            ]
        )
        assert "Traceback" not in done.stdout.str()
        assert "socast/tools" not in done.stdout.str()
        assert len(done.outlines) < 40


def test_an_update_never_replaces_a_recording_of_telemetry(project):
    recording = project.path / "recordings" / "monday.mcap"
    shutil.copy(RECORDINGS / "shift.mcap", recording)
    shutil.copy(RECORDINGS / "shift.mcap", project.path / "other.mcap")
    project.makepyfile(
        """
        def test_itself(socast_expect): socast_expect("recordings/monday.mcap", "recordings/monday.mcap")
        def test_other(socast_expect): socast_expect("recordings/monday.mcap", "other.mcap")
        """
    )
    before = recording.read_bytes()
    done = run(project, "--socast-update")
    done.assert_outcomes(failed=2)
    done.stdout.fnmatch_lines(
        ["*other.mcap: is a recording of telemetry, which the update would replace; name another*"]
    )
    run(project).stdout.fnmatch_lines(
        ["*other.mcap: holds no forecasts to compare with; it is a recording of telemetry*"]
    )
    assert recording.read_bytes() == (project.path / "other.mcap").read_bytes() == before


def test_what_a_damaged_recording_lost_is_told(project):
    whole = (RECORDINGS / "shift.mcap").read_bytes()
    (project.path / "recordings" / "monday.mcap").write_bytes(whole[: len(whole) // 2])
    project.makepyfile(
        """
        def test_damaged(socast_expect): assert socast_expect("recordings/monday.mcap", "x.mcap").losses
        """
    )
    run(project, "--socast-update").stdout.fnmatch_lines(
        ["*the recording is damaged: *monday.mcap: *after its last whole*"]
    )
    shutil.copy(RECORDINGS / "shift.mcap", project.path / "recordings" / "monday.mcap")
    project.makepyfile("def test_whole(socast_expect): socast_expect('recordings/monday.mcap', 'x.mcap')")
    run(project).stdout.fnmatch_lines(["*forecasts not expected*"])


def test_options_of_a_replay_apply(project):
    project.makepyfile(
        """
        def test_options(socast_replay, socast_car, socast_make_recording):
            earlier = socast_make_recording(socast_car(duration_s=600, speed_kmh=40))
            later = socast_make_recording(socast_car(duration_s=600, speed_kmh=40, start_s=1.8e9))
            plain = socast_replay(later)
            warm = socast_replay(later, warm_up=[earlier], settings={"window": 8})
            plain, warm = (each.forecasts["ride_energy_predicted_kwh"].tolist() for each in (plain, warm))
            assert plain != warm
        """
    )
    run(project).assert_outcomes(passed=1)


def test_fixtures_are_listed_with_the_recording_of_a_test(project):
    run(project, "--fixtures").stdout.fnmatch_lines(["socast_recording -- *"])
