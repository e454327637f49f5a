"""Starts a server: Ray, HAProxy, ports and the deployment file, and the check that the server is
ready.
"""
