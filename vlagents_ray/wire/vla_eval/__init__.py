"""The messages and the mapping of vla-eval's protocol."""
