"""Recordings that can be shared: names are hashed, and places and times moved, while rides stay as they were."""
