"""Bytes of other systems' protocols to values and back, and key mappings: for dialects (server) and `upstream` (client)."""
