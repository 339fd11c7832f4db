"""Figures that measurements publish, and the pages that show them."""
