"""Doors with ports of their own, for clients whose protocols are not HTTP: a process beside the replicas."""
