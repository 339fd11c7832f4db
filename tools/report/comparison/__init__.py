"""Report of `socast compare`."""
