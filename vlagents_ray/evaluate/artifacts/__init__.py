"""What an episode leaves in files: videos, trajectories, provenance."""
