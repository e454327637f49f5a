"""Chunks of actions: which row belongs to which tick, and executing them while the next chunk is computed."""
