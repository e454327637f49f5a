"""Key mappings: the cameras, states and actions that a client's keys stand for."""
