"""Chunks of actions: the tick of each row, and their execution while the next chunk is computed."""
