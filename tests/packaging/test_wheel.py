"""The wheel installs in a fresh environment and works from there."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import msgspec
import numpy as np
import pytest

from socast.core import models
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
    assert "shift.mcap" in out
    assert "measured" in out


def test_example_of_the_guide_passes_and_fails_after_a_change_of_one_percent(environment, tmp_path):
    guide = (ROOT / "docs" / "guide" / "test-with-recordings.md").read_text(encoding="utf-8")
    (tmp_path / "recordings").mkdir()
    (tmp_path / "expected").mkdir()
    (tmp_path / "core").mkdir()
    (tmp_path / "core" / "__init__.py").touch()
    (tmp_path / "test_forecasts.py").write_text(guide.partition("```python\n")[2].partition("```")[0])
    shutil.copy(ROOT / "recordings" / "shift.mcap", tmp_path / "recordings" / "monday.mcap")
    model = models.load(str(ROOT / "recordings" / "fitted.json"))
    models.save(model, tmp_path / "model.json")
    pytest_of = (environment / "bin" / "python", "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist")
    run(environment, tmp_path, *pytest_of, "--socast-update")
    assert "2 passed" in run(environment, tmp_path, *pytest_of)
    fits = {}
    for key, fit in model.fits.items():
        first, second, *others = fit.coefficients
        fits[key] = msgspec.structs.replace(fit, coefficients=(first, 1.01 * second, *others))
    models.save(models.stamp(msgspec.structs.replace(model, fits=fits)), tmp_path / "model.json")
    failed = subprocess.run(pytest_of, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert failed.returncode == 1
    assert "1 failed, 1 passed" in failed.stdout
    found = r"taxi-00\d  ride_energy_predicted_kwh  [\d.]+ -> [\d.]+ at 2018-01-16T\S+, in \d+ of \d+ by up to 0.00\d+"
    assert re.search(found, failed.stdout)
    assert "write expected/monday.mcap with pytest --socast-update" in failed.stdout.replace(f"{tmp_path}/", "")
