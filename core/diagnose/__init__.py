"""Diagnose a model: find where it fails, which physical effect it lacks, and whether adding the effect helps."""
