"""Test the source text of effects: quotes, imports and names."""

import pytest

from socast.core.effects import Parameter, registry
from socast.core.effects.source_file import render_source
from socast.core.errors import EffectError


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


def test_quotes_and_letters_of_source_are_preserved(tmp_path):
    path = tmp_path / "suggested.py"
    path.write_text(suggestion(source='θ of "Größe" \\ é'))
    (effect,) = registry._run(path)
    assert effect.source == 'θ of "Größe" \\ é'
    assert effect.parameters["cold"].bounds == (283.15, 283.15)


def test_numpy_is_imported_only_if_used():
    assert "import numpy" not in suggestion()
    assert "import numpy as np" in suggestion(body="return np.maximum(speed, 0.0) * (cold - ambient) / cold")


@pytest.mark.parametrize("name", ["my effect", "2nd", "a-b", "", "x()"])
def test_invalid_function_name_is_refused(name):
    with pytest.raises(EffectError, match="not the name of a function"):
        suggestion(name=name)
