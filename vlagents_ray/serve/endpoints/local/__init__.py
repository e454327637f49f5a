"""Endpoints for processes on the same machine: Unix sockets, and shared memory or plasma beside them."""
