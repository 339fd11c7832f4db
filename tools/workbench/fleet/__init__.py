"""The records and binary frames of the pages about the fleet."""
