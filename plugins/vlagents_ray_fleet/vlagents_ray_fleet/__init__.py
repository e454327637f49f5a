"""The plan of a fleet: replicas, batch sizes and GPUs for robots, and a simulation of it."""
