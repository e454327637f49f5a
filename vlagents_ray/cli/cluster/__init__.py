"""`vlagents-ray up` and `down`: a warm Ray cluster on this machine, in which servers and evaluations start sooner."""
