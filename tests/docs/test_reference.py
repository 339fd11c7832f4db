"""Written reference pages agree with the code."""

import re
import runpy

from socast.core.effects import Effect, check_effect
from socast.core.forecast.plan_tracker import LONGEST_SHIFT
from socast.core.wire.messages import KINDS, OF_VEHICLES, LegOutlook, Outlook, Wire
from socast.core.wire.plan_checks import FASTEST_KMH, LEG_LIMITS, MOST_LEGS, PAST_S
from tests.support.pages import blocks
from tests.support.paths import ROOT

DOCS = ROOT / "docs"


def sections(page):
    """Return the parts of a page under its second-level headings: heading -> text."""
    parts = page.read_text(encoding="utf-8").split("\n## ")[1:]
    return dict(part.split("\n", 1) for part in parts)


def test_outlook_page_has_every_field_of_the_reply_and_every_limit_of_the_query():
    page = sections(DOCS / "outlook.md")
    query, reply, errors = page["The query"], page["The reply"], page["The error reply"]
    assert all(f"<!-- generated: wire/{struct.__name__} -->" in reply for struct in (Outlook, LegOutlook))
    for name, limit in LEG_LIMITS.items():
        row = re.search(rf"^\| [^|]*`{name}`.*", query, re.MULTILINE)[0]
        assert f"to {limit.most:g}" in row
    assert f"at most {FASTEST_KMH:g} km/h " in query
    assert f"more than {MOST_LEGS:g} " in errors
    assert f"more than {PAST_S:g} s before" in errors
    assert f"more than {LONGEST_SHIFT / 3600:g} h after" in errors


def test_effect_in_the_guide_passes_its_check(tmp_path):
    (example,) = blocks(DOCS / "guide" / "own-effects.md", "python")
    file = tmp_path / "example.py"
    file.write_text(example)
    (effect,) = (value for value in runpy.run_path(str(file)).values() if isinstance(value, Effect))
    check_effect(effect)


def test_wire_page_has_the_table_of_every_message():
    page = sections(DOCS / "reference" / "wire.md")
    names = {struct.__name__ for struct in all_structs(Wire) if struct not in {Outlook, LegOutlook}}
    assert names == set(page) - {"Keys", "Batch"}
    assert all(f"<!-- generated: wire/{name} -->" in page[name] for name in names)


def all_structs(base):
    """Yield the structs of the wire contract."""
    for struct in base.__subclasses__():
        if struct.__module__ == Wire.__module__:
            yield struct
        yield from all_structs(struct)


def test_wire_page_has_every_key():
    keys = sections(DOCS / "reference" / "wire.md")["Keys"]
    assert {f"`fleet/{{vehicle}}/{kind}`" in keys for kind in OF_VEHICLES} == {True}
    assert "`weather/{station}`" in keys
    assert "`models/{name}/{version}/errors`" in keys
    assert "`findings/{who}/{effect}`" in keys
    assert set(KINDS) == {*OF_VEHICLES, "weather", "errors", "finding"}
