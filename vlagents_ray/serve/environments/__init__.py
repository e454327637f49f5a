"""Policies in Python environments of their own: other pins than the server's, or another Python.

`config` is what a deployment file may say, `interpreter` finds out what an environment can do, `child` stands in
a replica for a policy that runs in a process behind it, and `host` is that process. `making` makes environments.
"""
