"""Consumption models and the files that hold them.

A model is a sum of terms over columns of the ride table; see `core.models.linear`. This package's own names are what
other packages import.
"""

from core.models.file import decode_model, encode_model, load, save, stamp
from core.models.linear import (
    ANY,
    BASIC_PHYSICAL,
    BASIC_TERMS,
    BUILT_IN_MODELS,
    EXTENDED_PHYSICAL,
    FORMAT,
    VEHICLE,
    VEHICLE_MODEL,
    Curve,
    Fit,
    LinearModel,
    Term,
    Training,
    make_physical_term,
)
from core.totals.context import Model

__all__ = [
    "ANY",
    "BASIC_PHYSICAL",
    "BASIC_TERMS",
    "BUILT_IN_MODELS",
    "EXTENDED_PHYSICAL",
    "FORMAT",
    "VEHICLE",
    "VEHICLE_MODEL",
    "Curve",
    "Fit",
    "LinearModel",
    "Model",
    "Term",
    "Training",
    "decode_model",
    "encode_model",
    "load",
    "make_physical_term",
    "save",
    "stamp",
]
