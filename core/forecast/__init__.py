"""What is ahead of each car: the filter of its charge, what is learned of shifts, and the outlook."""
