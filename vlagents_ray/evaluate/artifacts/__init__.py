"""The files of episodes: videos, trajectories and provenance."""
