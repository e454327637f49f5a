"""Transports to a server on the same machine: Unix sockets, with shared memory or plasma for the observations."""
