"""The engine: it checks requests, puts them into the batch queue, runs batches, and builds
replies.
"""
