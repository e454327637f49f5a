"""The messages and the mappings of GR00T's protocol."""
