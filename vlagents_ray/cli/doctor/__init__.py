"""`vlagents-ray doctor`, `policies` and `envs`: what this machine has, what is missing, and how to get it."""
