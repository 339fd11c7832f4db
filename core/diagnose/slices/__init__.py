"""Find the kinds of ride on which a model errs."""
