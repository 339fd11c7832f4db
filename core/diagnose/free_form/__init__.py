"""Search for a term that the library of effects lacks."""
