"""The messages and the mappings of openpi's protocol, and of RoboArena's copy of it."""
