"""Consumption models and the files that hold them.

A model is a sum of terms over columns of the ride table; see `socast.core.models.linear`. Other packages import the
names of this package.
"""

from socast.core.models.file import (
    BASIC_PHYSICAL,
    BASIC_TERMS,
    BUILT_IN_MODELS,
    EXTENDED_PHYSICAL,
    HILLS_OF_BUILT_IN,
    decode_model,
    encode_model,
    load,
    make_physical_term,
    save,
    stamp,
)
from socast.core.models.interval import ANY
from socast.core.models.linear import (
    CORRECTION,
    FORMAT,
    VEHICLE,
    VEHICLE_MODEL,
    Fit,
    LinearModel,
    Term,
    Training,
)
from socast.core.totals.context import Model

__all__ = [
    "ANY",
    "BASIC_PHYSICAL",
    "BASIC_TERMS",
    "BUILT_IN_MODELS",
    "CORRECTION",
    "EXTENDED_PHYSICAL",
    "FORMAT",
    "HILLS_OF_BUILT_IN",
    "VEHICLE",
    "VEHICLE_MODEL",
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
