"""Protocols of other systems, so that their clients can use the server without changes.

Each dialect has a folder. Its codec converts bytes to values; its handler converts values to an `Obs` with a key
mapping, puts that into the same batch queue as all other requests, and replies as the client expects.
"""
