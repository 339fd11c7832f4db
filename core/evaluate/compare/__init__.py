"""Compare models, and sets of rides, with measured energies."""
