"""The notebook of the guide runs, and its result is the one that it announces."""

import re

import pytest

from tests.support.pages import read
from tests.support.paths import ROOT

pytestmark = pytest.mark.long

PAGE = ROOT / "docs" / "guide" / "notebook.md"


def test_notebook_runs_and_the_error_falls(monkeypatch):
    monkeypatch.chdir(ROOT)
    cells = re.findall(r"^```{code-cell} python\n(?::tags:[^\n]*\n)?(.*?)^```$", read(PAGE), re.MULTILINE | re.DOTALL)
    names: dict[str, object] = {}
    for cell in cells:
        exec(compile(cell, str(PAGE), "exec"), names)
    rides, added, base = names["rides"], names["added"], names["base"]
    assert added.accepted
    before, after = ((model.predict(rides) - rides["energy_kwh"]).abs().mean() for model in (base, added.model))
    assert after < 0.8 * before
