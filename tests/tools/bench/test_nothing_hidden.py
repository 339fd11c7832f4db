"""The measurement with nothing hidden reads diagnoses of several source trees and counts false names."""

import json
from pathlib import Path

import pytest

from socast.core.errors import SettingsError, SocastError
from socast.tools.bench import nothing_hidden
from socast.tools.bench.nothing_hidden import (
    ROOT,
    main,
    make_lines,
    parse_seeds,
    parse_trees,
    read_fleet,
    run_command,
    summarise_effects,
)


def make_diagnosis(z, missing=(), deviations=()):
    """Return the part of a diagnosis that the measurement reads."""
    rows = [{"effect": name, "z": value} for name, value in z.items()]
    named = [{"effect": name, "columns": [f"effect_{name}", *scope]} for name, *scope in missing]
    data = {"rides": 30, "windows": 200}
    return {"data": data, "missing": named, "candidates": rows, "deviations": list(deviations)}


def test_seeds_are_numbers_and_ranges():
    assert parse_seeds("4001-4003,7") == [4001, 4002, 4003, 7]
    with pytest.raises(SettingsError, match="give numbers and ranges"):
        parse_seeds("4001-")


def test_trees_must_hold_the_product(tmp_path):
    assert parse_trees([f"here={ROOT}"]) == {"here": ROOT}
    with pytest.raises(SettingsError, match="holds tools/cli"):
        parse_trees([f"old={tmp_path}"])


def test_names_count_with_and_without_scope():
    one = read_fleet(1, make_diagnosis({"snow": 4.0, "payload": None}, [("snow", "vehicle=taxi-001")]))
    other = read_fleet(2, make_diagnosis({"snow": -1.0, "payload": 0.5}))
    assert one.named == ["snow (vehicle=taxi-001)"]
    changed = {"effect": "brake_drag", "who": "taxi-002", "since": "2018-06-01"}
    assert read_fleet(3, make_diagnosis({}, deviations=[changed])).named == ["brake_drag (taxi-002, since=2018-06-01)"]
    snow, payload = summarise_effects([one, other])
    assert (snow.effect, snow.fleets, snow.least, snow.median, snow.most, snow.named) == ("snow", 2, -1.0, 1.5, 4.0, 1)
    assert (payload.fleets, payload.named) == (1, 0)


def test_each_tree_diagnoses_the_same_recording_and_kept_files_are_used_again(tmp_path, monkeypatch, capsys):
    calls = []

    def run(tree, words):
        calls.append((tree, *words))
        if words[0] == "simulate":
            Path(words[2]).touch()
        if words[0] == "diagnose":
            missing = [("snow", "all")] if tree == tmp_path / "new" else []
            Path(words[-1]).write_text(json.dumps(make_diagnosis({"snow": 1.0}, missing)), encoding="utf-8")

    monkeypatch.setattr(nothing_hidden, "run_command", run)
    for name in ("old", "new"):
        (tmp_path / name / "tools").mkdir(parents=True)
        (tmp_path / name / "tools" / "cli.py").touch()
    trees = [word for name in ("old", "new") for word in ("--tree", f"{name}={tmp_path / name}")]
    words = ["--seeds", "5", "--keep", str(tmp_path / "keep"), "--json", str(tmp_path / "out.json"), *trees]
    assert main(words) == 0
    read = [call[2] for call in calls if call[1] == "tables"]
    assert read == [str(tmp_path / "keep" / "5.mcap")] * 2
    count = len(calls)
    assert main(words) == 0
    assert len(calls) == count
    fleets = json.loads((tmp_path / "out.json").read_text(encoding="utf-8"))["trees"]
    assert [fleets[name][0]["named"] for name in ("old", "new")] == [[], ["snow"]]
    assert "new: 1 false names in 1 fleets" in capsys.readouterr().out


def test_lines_for_the_pages_compare_trees():
    old = [read_fleet(1, make_diagnosis({"snow": 4.0, "payload": 1.0}, [("snow", "all")]))]
    new = [read_fleet(1, make_diagnosis({"snow": 0.5}))]
    section = make_lines({"before": old, "after": new}, "seed 1")
    assert "1 by `before`, 0 by `after`" in section[0]
    assert "| snow | 4.0 (4.0 to 4.0), named in 1 | 0.5 (0.5 to 0.5) |" in section
    assert "| payload | 1.0 (1.0 to 1.0) | – |" in section


def test_a_failed_command_ends_with_its_message():
    with pytest.raises(SocastError, match="ended with code"):
        run_command(ROOT, ["no-such-command"])
