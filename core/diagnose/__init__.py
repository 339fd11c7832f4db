"""Diagnosis: asks of windows where a model fails, which physical effect it lacks, and whether adding it helps."""
