"""Tests of the condition of cars."""
