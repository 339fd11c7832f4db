"""Search for a term that explains the remaining residual and that the library of effects lacks."""
