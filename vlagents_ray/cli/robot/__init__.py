"""`vlagents-ray robot`: a simulated robot, driven by a policy, by a human, or by both."""
