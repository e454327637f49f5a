"""Protocols of other systems, so that their clients can use the server without changes; see
`base`.
"""
