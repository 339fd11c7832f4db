"""Templates of effect files pass their check, including that of a form found in data."""

import pytest

from socast.core import effects
from socast.core.effects import Parameter, registry
from socast.core.effects.source_file import render_source
from socast.tools.commands.effects import blank


def suggestion(**changes):
    """A form outside the library, as text of a file."""
    return render_source(
        **{
            "name": "suggested",
            "arguments": ("speed", "ambient"),
            "body": "return speed * (cold - ambient) / cold",
            "documentation": "Found in the data: P = v (T0 - T)/T0.",
            "coefficient": "force",
            "unit": "N",
            "low": 0.0,
            "high": 500.0,
            "source": 'suggested by a "free" search on 40 rides',
            "parameters": {"cold": Parameter(283.15, "K")},
        }
        | changes
    )


@pytest.mark.parametrize("text", [suggestion(), blank(), blank("my_other")], ids=["suggested", "blank", "named"])
def test_template_is_file_that_passes_its_check(tmp_path, text):
    path = tmp_path / "suggested.py"
    path.write_text(text)
    (effect,) = registry._run(path)
    effects.check_effect(effect)
    assert all(len(line) <= 130 for line in text.splitlines())
