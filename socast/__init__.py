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

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
