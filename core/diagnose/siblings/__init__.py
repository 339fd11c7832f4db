"""Name what distinguishes one car or one group from its siblings, and since when."""
