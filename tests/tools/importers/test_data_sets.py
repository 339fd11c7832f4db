"""Test that the catalogue has the models of all data sets."""

from socast.core.vehicles import load_catalogue
from socast.tools.importers import bmw_i3, twizy, ved


def test_imported_models_are_in_the_catalogue():
    assert {ved.MODEL, bmw_i3.MODEL, twizy.MODEL} <= set(load_catalogue())
