"""Whether diagnosis finds what a simulation hides: data sets made from one simulation each, and figures over many."""
