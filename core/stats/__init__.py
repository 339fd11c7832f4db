"""Statistics that evaluation and diagnosis share."""
