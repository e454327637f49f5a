"""What is to be evaluated: configuration, cases and jobs."""
