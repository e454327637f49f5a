"""Policies in Python environments of their own: other pins than the server's, or another Python.

`config` is what a deployment file may say, and `interpreter` finds out what an environment can do. `agent` is a
replica's policy, or stands for one that runs in a process behind it, which `child` starts and `host` is. `making`
makes environments.
"""
