"""The plan of an evaluation: configuration, cases and jobs."""
