"""Probabilities of the causes of a residual: each effect of the library, several of them, none, or an unknown one."""
