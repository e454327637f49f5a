"""Starts a server: its Ray, HAProxy, ports and deployment file, and the check that it is ready."""
