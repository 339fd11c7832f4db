"""Test that the figure of elevation names its lines and axes, and that the guide shows it."""

import xml.etree.ElementTree as ET

import numpy as np

from tests.support.elevation_figure import COLOURS, FIGURE, FigureRide, elevation_figure
from tests.support.paths import ROOT


def test_figure_names_its_axes_with_units_and_every_line():
    distance = np.linspace(0.0, 3000.0, 50)
    truth = 50.0 + 0.01 * distance
    fix = np.where(np.arange(50) % 7 == 0, np.nan, truth + 2.0)
    ride = FigureRide(distance, truth, fix, dict.fromkeys(COLOURS, truth - 1.0))
    words = [each.text for each in ET.fromstring(elevation_figure(ride)).iter() if each.text]
    for label in ("elevation [m]", "error of the elevation [m]", "distance [km]", "truth", "fixes", *COLOURS):
        assert label in words
    assert words.count("error 1.0 m (rms)") == len(COLOURS)
    assert "error 2.0 m (rms)" in words


def test_guide_shows_the_figure():
    assert f"]({FIGURE.name})" in (ROOT / "docs" / "guide" / "elevation.md").read_text(encoding="utf-8")
