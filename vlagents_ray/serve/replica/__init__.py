"""The Ray Serve deployment of a replica, and its metrics."""
