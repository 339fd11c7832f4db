"""Report of `socast evaluate`."""
