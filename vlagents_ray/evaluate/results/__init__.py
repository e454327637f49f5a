"""The folder of results: code that writes each episode exactly once, and that reads, merges,
compares and summarises results.
"""
