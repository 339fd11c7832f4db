"""Report of `socast evaluate-soc`."""
