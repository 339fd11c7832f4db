"""Derive signals from cleaned samples: forces, weather, sun."""
