"""Keep what a test adds to the libraries of effects and vehicle models from later tests."""

from collections.abc import Iterator
from contextlib import contextmanager

from socast.core.effects import registry
from socast.core.vehicles import catalogue


@contextmanager
def restored_libraries() -> Iterator[None]:
    """Remove the effects that the block has loaded from files, and all vehicle models that are not shipped."""
    effects, files = dict(registry._library), dict(registry._brought_by)
    try:
        yield
    finally:
        for kept, now in ((effects, registry._library), (files, registry._brought_by)):
            if now != kept:
                now.clear()
                now.update(kept)
        catalogue._OWN.clear()
