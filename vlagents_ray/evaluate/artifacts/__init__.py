"""The files of episodes: videos, trajectories, provenance."""
