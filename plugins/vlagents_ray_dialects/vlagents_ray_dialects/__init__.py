"""Protocols of other systems: their clients at this project's server, and their servers as
policies.
"""
