"""The model of a replica: its loading and replacement, copies of the agent, and padding to compiled
batch sizes.
"""
