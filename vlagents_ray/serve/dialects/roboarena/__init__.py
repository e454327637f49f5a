"""RoboArena's protocol: openpi's, with a configuration as the first message and an `endpoint` in each request."""
