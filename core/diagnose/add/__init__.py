"""Add an effect to a model and test it on held-out days and vehicles."""
