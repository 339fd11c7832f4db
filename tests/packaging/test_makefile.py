"""`make` installs without output and reports errors."""

import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from tests.support.paths import ROOT

VERSION = f"python{sys.version_info.major}.{sys.version_info.minor}"


@pytest.fixture
def install(tmp_path):
    """Return a function that installs a copy of the tree as the Makefile does, in an environment of its own."""
    for name in (
        "Makefile",
        "README.md",
        "pyproject.toml",
        "requirements.lock",
        "requirements-dev.lock",
        "requirements-uv.lock",
    ):
        shutil.copy(ROOT / name, tmp_path)
    for name in ("core", "recordings", "socast", "stream", "tools"):
        shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__"))
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", tmp_path / ".venv"], check=True, timeout=60)
    ours = Path(find_spec("setuptools").origin).parent.parent
    for name in ("pip", "pip-[0-9]*", "setuptools", "setuptools-[0-9]*", "_distutils_hack"):
        (there,) = ours.glob(name)
        (tmp_path / ".venv" / "lib" / VERSION / "site-packages" / there.name).symlink_to(there)
    recipe = subprocess.run(
        ["make", "--dry-run", ".venv/installed"], cwd=tmp_path, capture_output=True, text=True, timeout=60, check=True
    ).stdout.replace("\\\n", "")
    (command,) = (line for line in recipe.splitlines() if line.endswith(" -e ."))

    def run() -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            command, shell=True, cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False,
            env={"PATH": "/usr/bin:/bin", "HOME": str(tmp_path)},
        )  # fmt: skip

    return run


def test_install_prints_nothing_on_success_and_reports_an_error(install, tmp_path):
    done = install()
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert (tmp_path / ".venv" / "bin" / "socast").exists()
    (tmp_path / "pyproject.toml").write_text("[project]\nname = 7\n")
    done = install()
    assert done.returncode != 0
    assert "invalid pyproject.toml config" in done.stdout + done.stderr


def make(tmp_path, path, *arguments):
    """Run make with a PATH of our own and return what it printed."""
    shutil.copy(ROOT / "Makefile", tmp_path)
    (tmp_path / "pyproject.toml").touch()
    for name in ("requirements.lock", "requirements-dev.lock", "requirements-uv.lock"):
        (tmp_path / name).touch()
    command = [shutil.which("make"), "--dry-run", ".venv/installed", *arguments]
    return subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, check=False, env={"PATH": f"{path}:/usr/bin:/bin"}
    )


def fake_python(folder, version, code):
    """Put a `python3.X` on the path that ends with an exit code, as one without the venv module does."""
    file = folder / f"python{version}"
    file.write_text(f"#!/bin/sh\nexit {code}\n")
    file.chmod(0o755)


def test_newest_usable_python_is_taken(tmp_path):
    for version, code in (("3.14", 1), ("3.13", 0), ("3.12", 0)):
        fake_python(tmp_path, version, code)
    assert "python3.13 -m venv" in make(tmp_path, tmp_path).stdout


def test_python_of_the_user_is_taken(tmp_path):
    fake_python(tmp_path, "3.13", 0)
    assert "python3.12 -m venv" in make(tmp_path, tmp_path, "PYTHON=python3.12").stdout
