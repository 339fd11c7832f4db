"""Consumption models and the files that hold them.

A model is a sum of terms over columns of the ride table; see `core.models.linear`. This package's own names are what
other packages import.
"""

from core.models.file import decode, encode, load, save, stamped
from core.models.linear import (
    ANY,
    BASIC_PHYSICAL,
    BASIC_TERMS,
    EXTENDED_PHYSICAL,
    FORMAT,
    KNOWN,
    VEHICLE,
    VEHICLE_MODEL,
    Curve,
    Fit,
    LinearModel,
    Model,
    Term,
    Training,
    physical_term,
)

__all__ = [
    "ANY",
    "BASIC_PHYSICAL",
    "BASIC_TERMS",
    "EXTENDED_PHYSICAL",
    "FORMAT",
    "KNOWN",
    "VEHICLE",
    "VEHICLE_MODEL",
    "Curve",
    "Fit",
    "LinearModel",
    "Model",
    "Term",
    "Training",
    "decode",
    "encode",
    "load",
    "physical_term",
    "save",
    "stamped",
]
