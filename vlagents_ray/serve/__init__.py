"""The policy server on Ray Serve."""
