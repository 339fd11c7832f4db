"""Where the error of a model lives: at which level, and in which kind of load."""
