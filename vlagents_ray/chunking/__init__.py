"""Chunks of actions: the tick of each row, and the execution of a chunk while the next one is
computed.
"""
