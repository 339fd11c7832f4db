"""The documentation is true: its commands run, every command is told of, and links lead somewhere."""

import re
import shlex
import subprocess
import sys

import pytest

from core.forecast.plan_checks import FASTEST_KMH, LEG_LIMITS, MOST_LEGS, PAST_S
from core.forecast.plan_tracker import LONGEST_SHIFT
from core.wire.messages import LegOutlook, Outlook
from tests.support.paths import ROOT
from tools.cli import COMMANDS

README = (ROOT / "README.md").read_text(encoding="utf-8")
TOLD = [line for block in re.findall(r"```console\n(.*?)```", README, re.DOTALL) for line in block.splitlines()]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder in which the commands of the README can be run one after another."""
    folder = tmp_path_factory.mktemp("readme")
    (folder / "recordings").symlink_to(ROOT / "recordings")
    return folder


@pytest.mark.parametrize("command", TOLD)
def test_the_commands_of_the_readme_run(command, folder):
    program, *arguments = shlex.split(command)
    assert program == "socast"
    done = subprocess.run(
        [sys.executable, "-m", "tools.cli", *arguments],
        cwd=folder, capture_output=True, text=True, timeout=120, check=False,
        env={"PYTHONPATH": str(ROOT), "PATH": "", "COLUMNS": "120", "HOME": str(folder)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    assert done.stdout.strip()


def test_every_command_is_in_the_readme():
    for name in COMMANDS:
        assert re.search(rf"^\*\*`socast {name}`\*\*", README, re.MULTILINE), f"{name} is not told of"


@pytest.mark.parametrize(
    "page", ["README.md", "ARCHITECTURE.md", "CHANGELOG.md", "recordings/README.md", "docs/outlook.md"]
)
def test_links_lead_somewhere(page):
    text = (ROOT / page).read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)#]+)\)", text):
        assert target.startswith("http") or (ROOT / page).parent.joinpath(target).exists(), target


def test_the_page_on_questions_has_every_field_of_the_reply_and_each_limit_of_the_query():
    page = (ROOT / "docs" / "outlook.md").read_text(encoding="utf-8")
    query, reply, errors = (part for part in page.split("\n## ")[1:])
    told = re.findall(r"^\| (`.*?) \|", reply, re.MULTILINE)
    assert [*Outlook.__struct_fields__, *LegOutlook.__struct_fields__] == re.findall(r"`(\w+)`", " ".join(told))
    for name, limit in LEG_LIMITS.items():
        row = re.search(rf"^\| [^|]*`{name}`.*", query, re.MULTILINE)[0]
        assert f"to {limit.most:g} |" in row
    assert f"at most {FASTEST_KMH:g} km/h " in query
    assert f"more than {MOST_LEGS:g} " in errors
    assert f"more than {PAST_S:g} s before" in errors
    assert f"more than {LONGEST_SHIFT / 3600:g} h after" in errors


def test_the_lock_file_and_the_docs_name_no_address():
    assert "://" not in (ROOT / "requirements.lock").read_text(encoding="utf-8")
