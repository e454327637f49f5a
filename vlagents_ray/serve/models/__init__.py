"""Loaded checkpoints: copies of the agent, the cache of models, and padding to compiled batch
sizes.
"""
