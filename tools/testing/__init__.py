"""Test with recordings: compare forecasts with those of an earlier replay, by command and in pytest."""
