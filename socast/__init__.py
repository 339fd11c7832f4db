"""Forecast what electric cars consume, and find the physics that a consumption model lacks.

This package is the public interface of the product. Everything that it exports is stable between minor versions; the
packages `core`, `stream` and `tools` behind it are not.

Exports are imported on first use, so `from socast import effect` loads only what an effect needs.

Examples
--------
>>> import socast
>>> tables = socast.make_tables("recordings/shift.mcap")
>>> model = socast.load_model("extended_physical")
>>> energy_kwh = model.predict(tables.rides)
>>> len(energy_kwh) == len(tables.rides)
True
"""

import lazy_loader

_load_export, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> object:
    """Return an export, or the version of the product."""
    if name == "__version__":
        from importlib.metadata import version  # noqa: PLC0415 - only whoever asks for the version needs it

        return version("socast")
    return _load_export(name)
