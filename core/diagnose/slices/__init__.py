"""Find groups of rides for which the bias of a model differs from that for other rides."""
