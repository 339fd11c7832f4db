"""The records of the pages about rides, errors, causes and models."""
