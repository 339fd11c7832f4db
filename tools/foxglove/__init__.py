"""Recordings for the viewer Foxglove: positions and warnings on topics of their own, and a layout."""
