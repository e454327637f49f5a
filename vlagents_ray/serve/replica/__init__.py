"""The Ray Serve deployment of a replica: its application, metadata and metrics."""
