"""Report of `socast diagnose`."""
