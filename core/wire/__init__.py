"""Messages on the wire and their decoding into columns."""
