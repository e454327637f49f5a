"""The execution of an episode: the loop, the clock, and the attribution of errors."""
