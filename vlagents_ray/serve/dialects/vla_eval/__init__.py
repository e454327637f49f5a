"""The protocol of the vla-eval harness."""
