"""The wheel installs in a fresh environment and works from there."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.support.example_project import read_change, write_example
from tests.support.paths import ROOT

pytestmark = pytest.mark.long
THEIRS = ("core", "recordings", "stream", "tools")
"""Packages that the project of a user may have, too."""
CODE = """
import core, recordings, socast, stream, tools
assert all(package.OWNER == "the user" for package in (core, recordings, stream, tools))
from importlib.resources import files
recording = files("socast").joinpath("recordings", "shift.mcap")
tables = socast.make_tables(recording)
model = socast.fit_model(tables.rides, "basic_physical")
print(socast.__file__, len(tables.rides), len(model.predict(tables.rides)))
"""


@pytest.fixture(scope="module")
def environment(tmp_path_factory):
    """Return a virtual environment with nothing but the wheel in it; the dependencies are those of this environment."""
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    source.mkdir()
    for name in ("README.md", "pyproject.toml"):
        shutil.copy(ROOT / name, source)
    shutil.copytree(ROOT / "socast", source / "socast", ignore=shutil.ignore_patterns("__pycache__"))  # and its links
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    build = [*pip, "wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", folder, source]
    subprocess.run(build, check=True, capture_output=True)
    (wheel,) = folder.glob("socast-*.whl")
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", folder / "env"], check=True)
    python = folder / "env" / "bin" / "python"
    install = [*pip, "--python", python, "install", "--no-deps", "--no-compile", wheel]
    subprocess.run(install, check=True, capture_output=True)
    (site,) = (folder / "env" / "lib").glob("python*/site-packages")
    (site / "dependencies.pth").write_text(f"{Path(np.__file__).parents[1]}\n")
    assert [path.name for path in site.glob("[!_]*") if path.is_dir() and not path.match("*.dist-info")] == ["socast"]
    assert not (site / "socast" / "tools" / "bench").exists()  # measures of the project itself
    for name in THEIRS:
        (site / name).mkdir()
        (site / name / "__init__.py").write_text('OWNER = "the user"\n')
    copy_compiled_kernels(site)
    return folder / "env"


def copy_compiled_kernels(site):
    """Give the installed files this tree's compiled kernels; numba goes by a source file's time and size."""
    for cached in ROOT.glob("[cst]*/**/__pycache__/*.nb[ci]"):
        source = cached.parents[1] / f"{cached.name.partition('.')[0]}.py"
        installed = site / "socast" / source.relative_to(ROOT)
        if not installed.exists():
            continue
        (installed.parent / "__pycache__").mkdir(exist_ok=True)
        shutil.copy2(cached, installed.parent / "__pycache__")
        stamp = source.stat().st_mtime_ns
        os.utime(installed, ns=(stamp, stamp))


def run(environment, folder, *command):
    """Run a command of the environment in a folder that holds none of the sources."""
    path = f"{environment}/bin:/usr/bin:/bin"
    done = subprocess.run(
        command, cwd=folder, capture_output=True, text=True, check=False, env={"PATH": path, "HOME": str(folder)}
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_public_api_runs_from_the_wheel(environment, tmp_path):
    file, rides, predictions = run(environment, tmp_path, environment / "bin" / "python", "-c", CODE).split()
    assert Path(file).is_relative_to(environment)
    assert rides == predictions


def test_demo_runs_from_the_wheel(environment, tmp_path):
    out = run(environment, tmp_path, environment / "bin" / "socast", "demo", "--seconds", "1")
    assert "evening.mcap" in out
    assert "measured" in out


def test_example_of_the_guide_passes_and_fails_after_a_change_of_one_percent(environment, tmp_path):
    python = (environment / "bin" / "python", "-m")
    pytest_of = (*python, "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist")
    *others, update, test = write_example(tmp_path)
    for command in others:
        run(environment, tmp_path, "sh", "-c", command)
    assert "expected/rides.csv: written for the first time" in run(environment, tmp_path, *pytest_of, update.split()[1])
    assert (test, "6 passed" in run(environment, tmp_path, *pytest_of)) == ("pytest", True)
    run(environment, tmp_path, environment / "bin" / "python", "-c", read_change())
    apart = {name: value for name, value in os.environ.items() if name != "CI"}  # CI makes pytest repeat messages
    failed = subprocess.run(pytest_of, cwd=tmp_path, capture_output=True, text=True, check=False, env=apart)
    assert failed.returncode == 1
    assert "4 failed, 2 passed" in failed.stdout
    summary = r"\d+ values of 1 field differ \(ride_energy_predicted_kwh\); \d+ forecasts compared"
    assert len(re.findall(summary, failed.stdout)) == 3
    in_all = r"predicted_kwh \[kWh\]: differs in \d+ of \d+ \w+, 2 cars, by up to 0.\d+ \(0.\d+ %\) of taxi-00\d at"
    assert len(re.findall(in_all, failed.stdout)) == 4
    first = r"taxi-00\d  \d\d:\d\d:\d\d UTC +0.\d+ +0.\d+ +\+0.001\d* +0.001"
    assert re.search(first, failed.stdout)
    assert "write tests/expected/rides.csv with pytest --socast-update" in failed.stdout.replace(f"{tmp_path}/", "")
