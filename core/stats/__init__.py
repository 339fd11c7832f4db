"""Statistics shared by evaluation, monitoring and diagnosis."""
