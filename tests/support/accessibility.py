"""Checks of a page with axe-core."""

from importlib.resources import files
from typing import Any, Final

SERIOUS: Final = {"serious", "critical"}


def list_violations(page: Any) -> list[str]:
    """Return the serious and critical findings of axe-core on a page, with the elements concerned."""
    if not page.evaluate("() => 'axe' in window"):
        page.evaluate(files("axe_playwright_python").joinpath("axe.min.js").read_text(encoding="utf-8"))
    found = page.evaluate("() => axe.run(document, {resultTypes: ['violations']})")["violations"]
    return [
        f"{one['id']}: {node['html'][:160]}" for one in found if one["impact"] in SERIOUS for node in one["nodes"][:3]
    ]
