"""vLLM-Omni's protocol for robots: RoboArena's, at a path of its own."""
