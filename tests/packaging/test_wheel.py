"""The wheel installs in a fresh environment and works from there."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.support.paths import ROOT

pytestmark = pytest.mark.long
CODE = """
import socast
from importlib.resources import files
recording = files("recordings").joinpath("shift.mcap")
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
    for name in ("core", "recordings", "socast", "stream", "tools"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
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
    copy_compiled_kernels(site)
    return folder / "env"


def copy_compiled_kernels(site):
    """Give the installed files this tree's compiled kernels; numba goes by a source file's time and size."""
    for cached in ROOT.glob("[cst]*/**/__pycache__/*.nb[ci]"):
        source = cached.parents[1] / f"{cached.name.partition('.')[0]}.py"
        installed = site / source.relative_to(ROOT)
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
