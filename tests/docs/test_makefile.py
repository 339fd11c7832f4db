"""What `make` does in a stranger's terminal."""

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
    for name in ("Makefile", "README.md", "pyproject.toml", "requirements.lock"):
        shutil.copy(ROOT / name, tmp_path)
    for name in ("core", "stream", "tools"):
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


def test_installing_says_nothing_where_all_is_well(install, tmp_path):
    done = install()
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert (tmp_path / ".venv" / "bin" / "socast").exists()


def test_installing_still_tells_of_an_error(install, tmp_path):
    (tmp_path / "pyproject.toml").write_text("[project]\nname = 7\n")
    done = install()
    assert done.returncode != 0
    assert "invalid pyproject.toml config" in done.stdout + done.stderr
