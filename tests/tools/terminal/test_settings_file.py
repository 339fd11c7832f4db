"""A settings file holds the options of `socast live`, and a mistake in it is one line with its place and remedy."""

import re
import tomllib
from pathlib import Path

import pytest
import typer

from socast.tools.cli import application
from socast.tools.terminal.settings_file import list_settings, read_settings
from tests.support.commands import refused
from tests.support.paths import ROOT

EXAMPLE = ROOT / "deploy" / "socast.toml"
LIVE = typer.main.get_command(application("live")).commands["live"]


def parse(*arguments: object) -> dict:
    """Return the parameters of a call of `socast live`."""
    return LIVE.make_context("live", [str(argument) for argument in arguments]).params


def write(folder: Path, text: str) -> Path:
    file = folder / "s.toml"
    file.write_text(text)
    return file


def test_values_of_the_file_are_those_of_the_options(tmp_path):
    file = write(
        tmp_path,
        """
        connect = ["tcp/a:1", "tcp/b:1"]
        mode = "peer"
        config = "z.json5"
        recovery = false
        smoothing = 3
        record = "kept"
        record-mb = 8
        flush = 0.5
        json-log = true
        model = ["basic_physical"]
        """,
    )
    options = ("--connect", "tcp/a:1", "--connect", "tcp/b:1", "--mode", "peer", "--config", "z.json5", "--no-recovery")
    options += ("--smoothing", 3, "--record", "kept", "--record-mb", 8, "--flush", 0.5, "--json-log")
    of_file, of_line = parse("--settings", file), parse(*options, "--model", "basic_physical")
    assert of_file | {"settings_file": None} == of_line
    assert of_file["record"] == Path("kept")


def test_command_line_takes_precedence_over_the_file(tmp_path):
    file = write(tmp_path, 'smoothing = 3\nrecovery = true\nconnect = ["tcp/a:1"]\nprefix = "montreal"')
    found = parse("--smoothing", 5, "--settings", file, "--no-recovery", "--connect", "tcp/b:1")
    assert (found["smoothing"], found["recovery"], found["connect"]) == (5, False, ["tcp/b:1"])
    assert found["prefix"] == "montreal"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('recrod = "a"', "no setting 'recrod': did you mean 'record'? `socast live --help` lists the options"),
        ("xyz = 1", "no setting 'xyz': leave it out; `socast live --help` lists the options"),
        ("help = true", "no setting 'help'"),
        ('settings = "b.toml"', "a settings file cannot name another one; join them"),
        ("[zenoh]\nmode = 'peer'", "'zenoh' is a table; write each option as NAME = VALUE, without tables"),
        ("zenoh.mode = 'peer'", "'zenoh' is a table"),
        ('smoothing = "3"', "--smoothing is '3', must be a whole number"),
        ("smoothing = 2.5", "--smoothing is 2.5, must be a whole number"),
        ("smoothing = true", "--smoothing is true, must be a whole number"),
        ('flush = "soon"', "--flush is 'soon', must be a number"),
        ("json-log = 1", "--json-log is 1, must be true or false"),
        ("record = 5", "--record is 5, must be text in quotes"),
        ("record = 2026-01-01", "--record is 2026-01-01, must be text in quotes"),
        ('connect = "tcp/a:1"', "--connect is 'tcp/a:1', must be a list of text in quotes, such as ['a', 'b']"),
        ("connect = ['tcp/a:1', 7]", "--connect is ['tcp/a:1', 7], must be a list of text in quotes"),
        ("prefix = ['a']", "--prefix is ['a'], must be text in quotes"),
        ("smoothing = 9", "--smoothing is '9', must be less than or equal to 8; `socast live --help`"),
        ("period = nan", "--period is 'nan', must be"),
        ("flush = 0", "--flush is '0', must be greater than or equal to 0.001"),
        ("record-mb = -1.0", "--record-mb is '-1.0', must be greater than or equal to 0.001"),
        ("record-minutes = inf", "--record-minutes is 'inf', must be less than or equal to 1000000"),
        ('mode = "queen"', "--mode is wrong: 'queen' is not one of 'client', 'peer', 'router'"),
        ('prefix = "a/**"', "--prefix is 'a/**'; give plain chunks"),
        ('metrics = "nine"', "--metrics is 'nine'; give a port from 0 to 65535"),
        ("smoothing 3", "'smoothing 3' is not TOML: Expected '=' after a key"),
        ('prefix = "a', "'prefix = \"a' is not TOML: Unterminated string; write NAME = VALUE"),
    ],
)
def test_mistake_is_one_line_with_file_line_and_remedy(text, message, tmp_path, capsys):
    file = write(tmp_path, f"# settings\njson-log = false\n\n{text}" if "json-log" not in text else f"\n\n\n{text}")
    line = refused(capsys, "live", "--settings", file)
    assert re.match(rf"socast: {re.escape(str(file))}, line 4(, column \d+|, at the end)?: {re.escape(message)}", line)


def test_file_that_cannot_be_read_is_one_line(tmp_path, capsys):
    assert "nowhere.toml cannot be read: No such file" in refused(capsys, "live", "--settings", "nowhere.toml")
    assert "cannot be read: Is a directory" in refused(capsys, "live", "--settings", tmp_path)
    (tmp_path / "s.toml").write_bytes(b"prefix = '\xff'")
    assert "is not UTF-8 from byte 10 on" in refused(capsys, "live", "--settings", tmp_path / "s.toml")


def test_mistake_on_the_command_line_is_not_blamed_on_the_file(tmp_path, capsys):
    file = write(tmp_path, "smoothing = 3")
    assert refused(capsys, "live", "--settings", file, "--smoothing", "9").startswith("socast: --smoothing is '9'")
    file = write(tmp_path, "metrics = '9464'")
    assert refused(capsys, "live", "--settings", file, "--metrics", "x").startswith("socast: --metrics is 'x'")


def test_example_holds_every_option_and_is_valid(tmp_path):
    """A line that begins with `#` and a name is a setting; what follows `# ` is a comment."""
    whole = re.sub(r"^#(?! |$)", "", EXAMPLE.read_text(), flags=re.MULTILINE)
    settings = tomllib.loads(whole)
    missing = set(list_settings(LIVE)) - set(settings)
    assert missing == set(), "add these options of `socast live` to deploy/socast.toml"
    assert set(settings) <= set(list_settings(LIVE))
    assert len(read_settings(write(tmp_path, whole), LIVE)[0]) == len(settings)


def test_defaults_that_the_example_shows_are_those_of_the_options(tmp_path):
    whole = re.sub(r"^#(?! |$)", "", EXAMPLE.read_text(), flags=re.MULTILINE)
    shown, _ = read_settings(write(tmp_path, whole), LIVE)
    defaults = {name: value for name, value in parse().items() if value not in (None, "", ())}
    assert {name: shown[name] for name in defaults} == defaults


def test_example_is_accepted_as_it_stands():
    found = parse("--settings", EXAMPLE)
    assert found["metrics"] == "127.0.0.1:9464"
